"""Messages to the autopilot: turn a fix into the fields of a MAVLink message, as each firmware interprets them.

Converts to radians, NED and 1e-7 degrees. Stamps are capture times.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.geo import enu_from_body
from engine.values import Attitude, Fix
from scenematch.bridges.fix_velocity import GroundVelocity
from scenematch.bridges.mavlink_in import GnssFix
from scenematch.bridges.packets import AUTOPILOT_COMPONENT
from scenematch.bridges.parameters import MAX_DELAY_MS, MavlinkOptions
from scenematch.bridges.vehicle import (
    ANGLE_VARIANCE,
    MOUNT_VARIANCE,
    NedOrigin,
    VehicleState,
    is_finite,
    north_east_m,
)
from scenematch.files.quaternions import quaternion_wxyz
from scenematch.files.stamps import GPS_EPOCH_S, GPS_WEEK_S

SENSOR_ID = 1
"""Sensor id in GLOBAL_POSITION_SENSOR; PX4 fuses the one that EKF2_AGP0_ID names, and 0 means none."""

# A fix has no satellites, and the message no value for unknown. The fields that arming checks and estimators read
# express the accuracy: a metre of sigma becomes a dilution of 1 and 10 satellites.
_DILUTION_PER_M, _MIN_DILUTION = 1.0, 0.5
_NO_VELOCITY = mavlink.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ | mavlink.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY


@dataclass(frozen=True, slots=True)
class FixReport:
    """A fix and everything else that a message carries.

    Attributes:
        fix: the position fix.
        captured_ns: capture time of its frame on ``time.monotonic_ns``.
        age_ms: time since capture.
        vehicle: vehicle state at capture.
        origin: origin of the autopilot's NED frame; None if it has none.
        velocity: velocity from the last fixes; None if they give none.
        reset_counter: incremented when the position was acquired again, modulo 256.
        unix_ns: capture time in nanoseconds since 1970.
    """

    fix: Fix
    captured_ns: int
    age_ms: float
    vehicle: VehicleState
    origin: NedOrigin | None
    velocity: GroundVelocity | None
    reset_counter: int
    unix_ns: int


def withhold_reason(report: FixReport, options: MavlinkOptions) -> str | None:
    """Why a fix is not sent, or None if it is sent."""
    vehicle = report.vehicle
    if not is_finite(report.fix):
        return "not finite"
    if report.fix.sigma_m > options.max_sigma_m:
        return "too uncertain"
    if report.age_ms > MAX_DELAY_MS:  # ArduPilot's estimator buffers no longer
        return "too old"
    if options.needs_origin:
        if report.origin is None:
            return "no origin"
        if vehicle.down_m is None:
            return "no height"
        if vehicle.attitude is None:
            return "no attitude"
    # ArduPilot uses these velocities unconditionally: an unknown one would count as zero.
    reads_velocity = options.firmware == "ardupilot" and options.kind != "vision_position_estimate"
    return "no velocity" if reads_velocity and report.velocity is None else None


def fix_message(report: FixReport, options: MavlinkOptions) -> Any:
    """The MAVLink message of a fix that is not withheld."""
    if options.kind == "vision_position_estimate":
        return _vision_position_estimate(report, options.firmware)
    if options.kind == "odometry":
        return _odometry(report, options.firmware)
    if options.kind == "gps_input":
        times_ns = report.captured_ns, report.unix_ns
        return receiver_message(report.fix, report.vehicle, options.gps_id, times_ns, report.velocity)
    return _global_position_sensor(report)


def heartbeat_message() -> Any:
    """Heartbeat of an onboard computer that is not an autopilot."""
    kind, no_autopilot = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID
    return mavlink.MAVLink_heartbeat_message(kind, no_autopilot, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)


def timesync_message(now_ns: int, request_ns: int | None = None) -> Any:
    """A TIMESYNC request stamped ``now_ns``, or the response to the request stamped ``request_ns``."""
    return mavlink.MAVLink_timesync_message(*((0, now_ns) if request_ns is None else (now_ns, request_ns)))


def set_origin_message(system_id: int, origin: NedOrigin, now_ns: int) -> Any:
    """SET_GPS_GLOBAL_ORIGIN for an autopilot without an origin."""
    place = (*_degrees_1e7(origin), round(origin.alt_amsl_m * 1e3))
    return mavlink.MAVLink_set_gps_global_origin_message(system_id, *place, now_ns // 1000)


def command_message(system_id: int, command: int, *values: float) -> Any:
    """COMMAND_LONG to the autopilot; missing parameters are 0."""
    padded = (*values, *(0.0,) * (7 - len(values)))
    return mavlink.MAVLink_command_long_message(system_id, AUTOPILOT_COMPONENT, command, 0, *padded)


def notice_message(severity: int, text: str) -> Any:
    """STATUSTEXT, which the autopilot passes on to the ground station."""
    return mavlink.MAVLink_statustext_message(severity, text.encode("ascii", "replace"))


def acknowledgement_message(command: int, *, accepted: bool) -> Any:
    """COMMAND_ACK."""
    result = mavlink.MAV_RESULT_ACCEPTED if accepted else mavlink.MAV_RESULT_UNSUPPORTED
    return mavlink.MAVLink_command_ack_message(command, result)


def stamp_on_ground_ns(now_ns: int) -> int:
    """Stamp of messages sent before take-off, older than any fix.

    ArduPilot assumes that the quickest message has no delay; that message must be a fix.
    """
    return max(now_ns - round(MAX_DELAY_MS * 1e6), 0)


def no_position_message(now_ns: int) -> Any:
    """ODOMETRY that reports a working camera without a position.

    ArduPilot arms only if visual odometry sent something in the last 0.3 s, and on the ground a camera sees
    nothing. The message's quality keeps it out of navigation.
    """
    nan, stamp_us = math.nan, stamp_on_ground_ns(now_ns) // 1000
    return mavlink.MAVLink_odometry_message(
        stamp_us, mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD, *(0.0, 0.0, 0.0),
        [1.0, 0.0, 0.0, 0.0], *[0.0] * 6, [nan] * 21, [nan] * 21, 0, mavlink.MAV_ESTIMATOR_TYPE_VISION,
        -1,  # failed
    )  # fmt: skip


def pose_covariance(fix: Fix, *, with_attitude: bool = False) -> list[float]:
    """Upper triangle, row by row, of the (6, 6) covariance of north, east, down, roll, pitch and yaw.

    ArduPilot combines the three position variances into one scalar. The height comes from another sensor and its
    large variance would dominate, so it gets the horizontal one.

    Args:
        fix: with its covariance.
        with_attitude: whether to send the fix's attitude; the autopilot's own, sent back, gets little weight.

    Returns:
        21 values in m^2, rad^2 and their products.
    """
    c = fix.covariance_m2
    pose = np.zeros((6, 6))
    pose[0, 0], pose[0, 1], pose[1, 1] = c[1, 1], c[0, 1], c[0, 0]
    pose[2, 2] = fix.sigma_m**2
    pose[3:, 3:] = ANGLE_VARIANCE * np.eye(3)
    if with_attitude and fix.attitude_covariance_deg2 is not None:
        pose[3:, 3:] = fix.attitude_covariance_deg2 * math.radians(1.0) ** 2 + MOUNT_VARIANCE * np.eye(3)
    return [float(v) for v in pose[np.triu_indices(6)]]


def _measured_attitude(report: FixReport) -> Attitude | None:
    """The attitude of the fix, if it solved the whole pose and the camera is not on a gimbal."""
    is_whole = report.fix.attitude_covariance_deg2 is not None and report.vehicle.holder is None
    return report.fix.attitude if is_whole else None


def _angles(report: FixReport) -> tuple[float, float, float]:
    """Roll, pitch and yaw in radians, yaw in [-pi, pi]: as measured by the fix, else the vehicle's."""
    attitude = _measured_attitude(report) or report.vehicle.attitude
    assert attitude is not None  # checked by withhold_reason
    roll, pitch, heading = map(math.radians, astuple(attitude))
    return roll, pitch, math.remainder(heading, 2.0 * math.pi)


def _ned(report: FixReport, firmware: str) -> tuple[float, float, float]:
    """North, east and down from the origin in metres; down is the vehicle's, since a map's datum differs."""
    assert report.origin is not None  # checked by withhold_reason
    assert report.vehicle.down_m is not None
    return (*north_east_m(report.fix.lat_deg, report.fix.lon_deg, report.origin, firmware), report.vehicle.down_m)


def _vision_position_estimate(report: FixReport, firmware: str) -> Any:
    return mavlink.MAVLink_vision_position_estimate_message(
        report.captured_ns // 1000,
        *_ned(report, firmware),
        *_angles(report),
        pose_covariance(report.fix, with_attitude=_measured_attitude(report) is not None),
        report.reset_counter,
    )


def _odometry(report: FixReport, firmware: str) -> Any:
    # Aligned to north, which is NED for PX4; ArduPilot accepts only FRD, and reads it as NED.
    frame = mavlink.MAV_FRAME_LOCAL_FRD if firmware == "ardupilot" else mavlink.MAV_FRAME_LOCAL_NED
    nan = math.nan
    velocity, covariance = [nan, nan, nan], [nan] * 21
    if report.velocity is not None:
        velocity = _body_velocity(report.velocity, report.vehicle)
        covariance = [0.0] * 21
        covariance[0] = covariance[6] = covariance[11] = report.velocity.sigma_mps**2
    return mavlink.MAVLink_odometry_message(
        report.captured_ns // 1000,
        frame,
        mavlink.MAV_FRAME_BODY_FRD,
        *_ned(report, firmware),
        list(quaternion_wxyz(*_angles(report))),
        *velocity,
        *(nan, nan, nan),
        pose_covariance(report.fix, with_attitude=_measured_attitude(report) is not None),
        covariance,
        report.reset_counter,
        mavlink.MAV_ESTIMATOR_TYPE_VISION,
        0,  # quality unknown: the covariance states it
    )


def _body_velocity(velocity: GroundVelocity, vehicle: VehicleState) -> list[float]:
    """Velocity in m/s along the body's axes, by the autopilot's own attitude, which it uses to rotate it back."""
    enu_mps = np.array([velocity.east_mps, velocity.north_mps, vehicle.up_velocity_mps or 0.0])
    assert vehicle.attitude is not None  # checked by withhold_reason
    return [float(v) for v in enu_from_body(*astuple(vehicle.attitude)).T @ enu_mps]


def receiver_message(
    place: Fix | GnssFix,
    vehicle: VehicleState,
    gps_id: int,
    times_ns: tuple[int, int],
    velocity: GroundVelocity | None = None,
) -> Any:
    """GPS_INPUT of a fix, or of the position of the autopilot's own receiver while the vehicle stands still.

    ArduPilot arms only if each receiver has a fix, and on the ground a camera sees nothing.

    Args:
        place: the position.
        vehicle: its height and vertical velocity.
        gps_id: number of the receiver that the message emulates.
        times_ns: its timestamps on the monotonic clock and since 1970.
        velocity: of a fix; the message states none for a receiver's position.
    """
    week, week_ms = divmod(times_ns[1] // 1_000_000 - GPS_EPOCH_S * 1000, GPS_WEEK_S * 1000)
    alt_m, up_mps, sigma_m = vehicle.alt_amsl_m, vehicle.up_velocity_mps, place.sigma_m
    dilution = max(_DILUTION_PER_M * sigma_m, _MIN_DILUTION)
    ignored = 0 if alt_m is not None else mavlink.GPS_INPUT_IGNORE_FLAG_ALT
    ignored |= 0 if up_mps is not None else mavlink.GPS_INPUT_IGNORE_FLAG_VEL_VERT
    ignored |= 0 if velocity is not None else _NO_VELOCITY
    return mavlink.MAVLink_gps_input_message(
        times_ns[0] // 1000,
        gps_id,
        ignored,
        week_ms,
        week,
        3,  # a 3D fix
        *_degrees_1e7(place),
        alt_m or 0.0,
        *(dilution, dilution),
        *((0.0, 0.0) if velocity is None else (velocity.north_mps, velocity.east_mps)),
        -(up_mps or 0.0),
        0.0 if velocity is None else velocity.sigma_mps,
        sigma_m,
        sigma_m,
        round(10.0 / dilution),
    )


def _global_position_sensor(report: FixReport) -> Any:
    age_us = round(report.age_ms * 1000.0)
    return mavlink.MAVLink_global_position_sensor_message(
        0,
        0,
        SENSOR_ID,
        # MAVLink defines this stamp as the time of sending; the time since capture is a separate field.
        report.captured_ns // 1000 + age_us,
        age_us,
        mavlink.GLOBAL_POSITION_SRC_VISION,
        0,
        *_degrees_1e7(report.fix),
        math.nan,
        math.nan,  # the fix has no height
        report.fix.sigma_m,
        math.nan,
    )


def _degrees_1e7(place: Fix | GnssFix | NedOrigin) -> tuple[int, int]:
    return round(place.lat_deg * 1e7), round(math.remainder(place.lon_deg, 360.0) * 1e7)
