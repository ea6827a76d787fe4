"""What the autopilot is told: a fix in, the fields of a MAVLink message out, as each firmware reads them.

Radians, NED and 1e-7 degrees begin here. Stamps are of capture.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.adapters.mavlink_in import FIRMWARES
from engine.adapters.packets import AUTOPILOT
from engine.adapters.parameters import MAX_DELAY_MS
from engine.adapters.vehicle import ANGLE_VARIANCE, Origin, Vehicle, north_east_m
from engine.errors import OptionError
from engine.geo import enu_from_body
from engine.values import Fix, check_positive

MESSAGES = {
    "ardupilot": ("vision_position_estimate", "odometry", "gps_input"),
    "px4": ("global_position_sensor", "odometry"),
}
"""What each firmware takes; the first is the default."""

SENSOR_ID = 1
"""Of GLOBAL_POSITION_SENSOR; PX4 takes the sensor that its EKF2_AGP0_ID names, and 0 names none."""

_GPS_EPOCH_S, _LEAP_S, _WEEK_MS = 315964800, 18, 604_800_000
_VELOCITY_S = (0.4, 1.5)  # how far apart two fixes are that give a velocity
_ACCELERATION_MPS2 = 3.0  # such a velocity is that of half the time before
_SATELLITES = 10  # an arming check of ArduPilot's counts them; GPS_INPUT cannot say that there are none


@dataclass(frozen=True, slots=True, kw_only=True)
class Outgoing:
    """What is sent, and what is withheld.

    Attributes:
        firmware: ardupilot or px4.
        message: one of ``MESSAGES``; empty for the firmware's default.
        max_sigma_m: a fix that is known worse is not sent; ArduPilot would clamp its sigma and believe it.
        max_age_ms: a fix whose capture is longer ago is not sent; ArduPilot's estimator looks back no further.

    Raises:
        OptionError: a name is unknown, or a number out of range.
    """

    firmware: str = "ardupilot"
    message: str = ""
    max_sigma_m: float = 10.0
    max_age_ms: float = MAX_DELAY_MS

    def __post_init__(self) -> None:
        check_positive(self, "max_sigma_m", "max_age_ms")
        if self.firmware not in FIRMWARES:
            raise OptionError(f"firmware: expected one of {', '.join(FIRMWARES)}, got {self.firmware!r}")
        if self.message and self.message not in MESSAGES[self.firmware]:
            known = ", ".join(MESSAGES[self.firmware])
            raise OptionError(f"message: expected one of {known} for {self.firmware}, got {self.message!r}")
        if self.max_age_ms > MAX_DELAY_MS:
            raise OptionError(f"max_age_ms: expected at most {MAX_DELAY_MS:g}, got {self.max_age_ms:g}")
        if self.max_sigma_m > 100.0:
            raise OptionError(
                f"max_sigma_m: expected at most 100, where ArduPilot clamps, got {self.max_sigma_m:g}"
            )

    @property
    def kind(self) -> str:
        """The message that is sent."""
        return self.message or MESSAGES[self.firmware][0]

    @property
    def needs_origin(self) -> bool:
        """Whether positions are sent about the autopilot's origin."""
        return self.kind in ("vision_position_estimate", "odometry")


@dataclass(frozen=True, slots=True)
class Velocity:
    """Velocity over ground by two fixes, and its standard deviation per axis."""

    east_mps: float
    north_mps: float
    sigma_mps: float


@dataclass(frozen=True, slots=True)
class Sending:
    """All that a message is made of.

    Attributes:
        fix: what the engine found.
        captured_ns: when its frame was captured, on our clock.
        age_ms: since then.
        vehicle: what it knew at that moment.
        origin: of the autopilot's NED; None where it has none.
        velocity: by the last fixes; None where they do not tell.
        reset_counter: steps once where the position was taken up anew.
        unix_ns: the capture in nanoseconds since 1970.
    """

    fix: Fix
    captured_ns: int
    age_ms: float
    vehicle: Vehicle
    origin: Origin | None
    velocity: Velocity | None
    reset_counter: int
    unix_ns: int


class FixVelocity:
    """The velocity by the last fixes; an adapter's stand-in where the vehicle's own would be fed back to it."""

    def __init__(self) -> None:
        self._fixes: deque[tuple[int, Fix]] = deque(maxlen=64)
        self._resets: int | None = None

    def add(self, fix: Fix, captured_ns: int, resets: int) -> Velocity | None:
        """The velocity up to this fix; None after a reset, and where no other fix is near enough in time."""
        if resets != self._resets or (self._fixes and captured_ns <= self._fixes[-1][0]):
            self._fixes.clear()
        self._resets = resets
        self._fixes.append((captured_ns, fix))
        while (captured_ns - self._fixes[0][0]) * 1e-9 > _VELOCITY_S[1]:
            self._fixes.popleft()
        before_ns, before = self._fixes[0]
        interval_s = (captured_ns - before_ns) * 1e-9
        if interval_s < _VELOCITY_S[0]:
            return None
        noise_mps = math.hypot(fix.sigma_m, before.sigma_m) / interval_s
        sigma_mps = math.hypot(noise_mps, 0.5 * interval_s * _ACCELERATION_MPS2)
        east_mps, north_mps = (fix.east_m - before.east_m), (fix.north_m - before.north_m)
        return Velocity(east_mps / interval_s, north_mps / interval_s, sigma_mps)


def why_withheld(sending: Sending, options: Outgoing) -> str | None:
    """Why a fix is not sent, or None where it is."""
    vehicle, fix = sending.vehicle, sending.fix
    if not all(map(math.isfinite, (fix.lat_deg, fix.lon_deg, *fix.covariance_m2.ravel()))):
        return "not finite"
    if fix.sigma_m > options.max_sigma_m:
        return "too uncertain"
    if sending.age_ms > options.max_age_ms:
        return "too old"
    if options.needs_origin:
        if sending.origin is None:
            return "no origin"
        if vehicle.down_m is None:
            return "no height"
        if None in (vehicle.roll_deg, vehicle.pitch_deg, vehicle.heading_deg):
            return "no attitude"
    # ArduPilot reads these velocities whatever they say: where none is known, zero would be believed.
    reads_velocity = options.firmware == "ardupilot" and options.kind != "vision_position_estimate"
    return "no velocity" if reads_velocity and sending.velocity is None else None


def make_message(sending: Sending, options: Outgoing) -> Any:
    """The message of a fix that is not withheld."""
    if options.kind == "vision_position_estimate":
        return _vision_position_estimate(sending, options.firmware)
    if options.kind == "odometry":
        return _odometry(sending, options.firmware)
    return _gps_input(sending) if options.kind == "gps_input" else _global_position_sensor(sending)


def heartbeat_message() -> Any:
    """That the bridge is there: a companion computer, no autopilot."""
    kind, nobody = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID
    return mavlink.MAVLink_heartbeat_message(kind, nobody, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)


def timesync_message(now_ns: int, asked_ns: int | None = None) -> Any:
    """A question for the time now, or the answer to one with the stamp ``asked_ns``."""
    return mavlink.MAVLink_timesync_message(*((0, now_ns) if asked_ns is None else (now_ns, asked_ns)))


def set_origin_message(system_id: int, origin: Origin, now_ns: int) -> Any:
    """The origin for an autopilot that has none."""
    lat_1e7, lon_1e7 = round(origin.lat_deg * 1e7), round(origin.lon_deg * 1e7)
    alt_mm = round(origin.alt_amsl_m * 1e3)
    return mavlink.MAVLink_set_gps_global_origin_message(system_id, lat_1e7, lon_1e7, alt_mm, now_ns // 1000)


def command_message(system_id: int, command: int, *values: float) -> Any:
    """A command to the autopilot, its other values 0."""
    padded = (*values, *(0.0,) * (7 - len(values)))
    return mavlink.MAVLink_command_long_message(system_id, AUTOPILOT, command, 0, *padded)


def pose_covariance(fix: Fix) -> list[float]:
    """Upper triangle of the covariance of north, east, down, roll, pitch and yaw, row by row.

    ArduPilot makes one scalar of the position's three variances. That of the height is of another sensor, and a
    large one would drown the others: it is given the horizontal one.
    """
    c = fix.covariance_m2
    pose = np.zeros((6, 6))
    pose[0, 0], pose[0, 1], pose[1, 1] = c[1, 1], c[0, 1], c[0, 0]
    pose[2, 2] = fix.sigma_m**2
    pose[3, 3] = pose[4, 4] = pose[5, 5] = ANGLE_VARIANCE
    return [float(v) for v in pose[np.triu_indices(6)]]


def _angles(vehicle: Vehicle) -> tuple[float, float, float]:
    """Roll, pitch and yaw in radians, yaw in [-pi, pi]."""
    assert vehicle.roll_deg is not None  # why_withheld has looked
    assert vehicle.pitch_deg is not None
    assert vehicle.heading_deg is not None
    yaw = math.remainder(math.radians(vehicle.heading_deg), 2.0 * math.pi)
    return math.radians(vehicle.roll_deg), math.radians(vehicle.pitch_deg), yaw


def _ned(s: Sending, firmware: str) -> tuple[float, float, float]:
    """About the origin; the height is the vehicle's own, since a map's height has another zero."""
    assert s.origin is not None  # why_withheld has looked
    assert s.vehicle.down_m is not None
    return (*north_east_m(s.fix.lat_deg, s.fix.lon_deg, s.origin, firmware), s.vehicle.down_m)


def _vision_position_estimate(s: Sending, firmware: str) -> Any:
    return mavlink.MAVLink_vision_position_estimate_message(
        s.captured_ns // 1000,
        *_ned(s, firmware),
        *_angles(s.vehicle),
        pose_covariance(s.fix),
        s.reset_counter,
    )


def _odometry(s: Sending, firmware: str) -> Any:
    # North is known, which PX4 calls NED; ArduPilot takes FRD only, and means the same.
    frame = mavlink.MAV_FRAME_LOCAL_FRD if firmware == "ardupilot" else mavlink.MAV_FRAME_LOCAL_NED
    nan = math.nan
    velocity, spread = [nan, nan, nan], [nan] * 21
    if s.velocity is not None:
        velocity = _body_velocity(s.velocity, s.vehicle)
        spread = [0.0] * 21
        spread[0] = spread[6] = spread[11] = s.velocity.sigma_mps**2
    return mavlink.MAVLink_odometry_message(
        s.captured_ns // 1000,
        frame,
        mavlink.MAV_FRAME_BODY_FRD,
        *_ned(s, firmware),
        _quaternion(*_angles(s.vehicle)),
        *velocity,
        *(nan, nan, nan),
        pose_covariance(s.fix),
        spread,
        s.reset_counter,
        mavlink.MAV_ESTIMATOR_TYPE_VISION,
        0,  # quality unknown: the covariance says it
    )


def _body_velocity(velocity: Velocity, vehicle: Vehicle) -> list[float]:
    assert vehicle.roll_deg is not None  # why_withheld has looked
    assert vehicle.pitch_deg is not None
    assert vehicle.heading_deg is not None
    enu_mps = np.array([velocity.east_mps, velocity.north_mps, vehicle.up_velocity_mps or 0.0])
    turn = enu_from_body(vehicle.roll_deg, vehicle.pitch_deg, vehicle.heading_deg)
    return [float(v) for v in turn.T @ enu_mps]


def _quaternion(roll: float, pitch: float, yaw: float) -> list[float]:
    """w, x, y, z of the turn from the body to north-east-down."""
    cr, cp, cy = (math.cos(0.5 * v) for v in (roll, pitch, yaw))
    sr, sp, sy = (math.sin(0.5 * v) for v in (roll, pitch, yaw))
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


def _gps_input(s: Sending) -> Any:
    assert s.velocity is not None  # why_withheld has looked
    week, week_ms = divmod(s.unix_ns // 1_000_000 - (_GPS_EPOCH_S - _LEAP_S) * 1000, _WEEK_MS)
    alt_m, up_mps = s.vehicle.alt_amsl_m, s.vehicle.up_velocity_mps
    ignored = 0 if alt_m is not None else mavlink.GPS_INPUT_IGNORE_FLAG_ALT
    ignored |= 0 if up_mps is not None else mavlink.GPS_INPUT_IGNORE_FLAG_VEL_VERT
    return mavlink.MAVLink_gps_input_message(
        s.captured_ns // 1000,
        0,
        ignored,
        week_ms,
        week,
        3,  # a 3D fix
        *_degrees_1e7(s.fix),
        alt_m or 0.0,
        *(1.0, 1.0),  # dilution of precision, which checks look at; the accuracies say how good the fix is
        s.velocity.north_mps,
        s.velocity.east_mps,
        -(up_mps or 0.0),
        s.velocity.sigma_mps,
        s.fix.sigma_m,
        s.fix.sigma_m,
        _SATELLITES,
    )


def _global_position_sensor(s: Sending) -> Any:
    age_us = round(s.age_ms * 1000.0)
    return mavlink.MAVLink_global_position_sensor_message(
        0,
        0,
        SENSOR_ID,
        # By MAVLink's definition this one stamp is of sending, and the time since the capture stands beside it.
        s.captured_ns // 1000 + age_us,
        age_us,
        mavlink.GLOBAL_POSITION_SRC_VISION,
        0,
        *_degrees_1e7(s.fix),
        math.nan,
        math.nan,  # of a height the fix says nothing
        s.fix.sigma_m,
        math.nan,
    )


def _degrees_1e7(fix: Fix) -> tuple[int, int]:
    return round(fix.lat_deg * 1e7), round(math.remainder(fix.lon_deg, 360.0) * 1e7)
