"""Build the messages that the ROS nodes publish: a fix's pose and the diagnostics."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.geo import LocalFrame, enu_turn_covariance_rad2
from engine.orthomap import OrthoMap
from engine.values import Fix, check_choice
from scenematch.bridges.vehicle import ANGLE_VARIANCE, MOUNT_VARIANCE, NedOrigin, VehicleState, north_east_m
from scenematch.files.ros.messages import MessageFactory

FIRMWARES = ("none", "ardupilot", "px4")
"""Consumers of the pose: an autopilot behind MAVROS has its own projection and use of covariances."""

FRAME_ID = "map"
"""Frame of the poses, which are east-north-up about the origin."""
_UNKNOWN_ANGLE_VARIANCE = math.pi**2
_UNKNOWN_HEIGHT_M2 = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class RosOptions:
    """Origin and consumer of the poses.

    Attributes:
        firmware: one of :data:`FIRMWARES`.
        origin: origin of the poses; None for the map's. For an autopilot it must be its estimator's.

    Raises:
        OptionError: the firmware is unknown.
    """

    firmware: str = "none"
    origin: NedOrigin | None = None

    def __post_init__(self) -> None:
        check_choice(self, "firmware", FIRMWARES)


def pose(
    messages: MessageFactory,
    fix: Fix,
    vehicle: VehicleState,
    captured_ns: int,
    site: OrthoMap,
    options: RosOptions,
) -> Any:
    """A fix as geometry_msgs/PoseWithCovarianceStamped: east, north and up from the origin in metres.

    Up is the vehicle's height above take-off, else above the ground, else the fix's above the map's ground. The
    orientation is the attitude that the method measured, else the vehicle's.
    """
    candidates_m = [None if vehicle.down_m is None else -vehicle.down_m, vehicle.height_agl_m,
                    None if fix.up_m is None else fix.up_m - site.ground_m]  # fmt: skip
    up_m = next((height_m for height_m in candidates_m if height_m is not None), None)
    attitude = fix.attitude or vehicle
    roll_deg, pitch_deg, heading_deg = angles = attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg
    east_m, north_m = position_en_m(fix, site.frame, options)
    covariance = pose_covariance(fix, options.firmware, knows_up=up_m is not None, angles=angles)
    point = messages.make("geometry_msgs/msg/Point", x=east_m, y=north_m, z=up_m or 0.0)
    orientation = messages.quaternion(
        roll_deg or 0.0, pitch_deg or 0.0, heading_deg if heading_deg is not None else 90.0
    )
    plain = messages.make("geometry_msgs/msg/Pose", position=point, orientation=orientation)
    return messages.make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=messages.header(captured_ns, FRAME_ID),
        pose=messages.make("geometry_msgs/msg/PoseWithCovariance", pose=plain, covariance=covariance.ravel()),
    )


def position_en_m(fix: Fix, frame: LocalFrame, options: RosOptions) -> tuple[float, float]:
    """East and north from the origin in metres: in its tangent plane, or in the firmware's projection."""
    origin = options.origin
    if options.firmware == "none":
        if origin is None:
            return fix.east_m, fix.north_m
        about = LocalFrame(origin.lat_deg, origin.lon_deg)
        east_m, north_m = about.enu_from_geodetic(fix.lat_deg, fix.lon_deg)
        return float(east_m), float(north_m)
    reference = origin or NedOrigin(frame.lat_deg, frame.lon_deg, 0.0)
    north_m, east_m = north_east_m(fix.lat_deg, fix.lon_deg, reference, options.firmware)
    return east_m, north_m


def pose_covariance(
    fix: Fix, firmware: str, *, knows_up: bool, angles: tuple[float | None, ...]
) -> NDArray[np.float64]:
    """Covariance of east, north, up and the rotations about them, as ROS orders a pose.

    An autopilot combines the position variances into one scalar, which a large variance of the height would
    dominate. It uses its own height anyway, so the height gets the horizontal variance.

    Args:
        fix: with its covariance.
        firmware: one of :data:`FIRMWARES`.
        knows_up: whether the pose has a height.
        angles: roll, pitch and heading in degrees; None if unknown. Angles of a fix use the fix's covariance.

    Returns:
        (6, 6) in m^2 and rad^2.
    """
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = fix.covariance_m2
    if firmware != "none" or not knows_up:
        covariance[2, :2] = covariance[:2, 2] = 0.0
        covariance[2, 2] = _UNKNOWN_HEIGHT_M2 if firmware == "none" else fix.sigma_m**2
    if fix.attitude is not None and fix.attitude_covariance_deg2 is not None:
        measured = fix.attitude.roll_deg, fix.attitude.pitch_deg, fix.attitude.heading_deg
        covariance[3:, 3:] = enu_turn_covariance_rad2(fix.attitude_covariance_deg2, measured)
        covariance[3:, 3:] += MOUNT_VARIANCE * np.eye(3)
        return covariance
    variances_rad2 = [_UNKNOWN_ANGLE_VARIANCE if angle is None else ANGLE_VARIANCE for angle in angles]
    # Roll and pitch mix into both horizontal axes, depending on the heading.
    covariance[3, 3] = covariance[4, 4] = max(variances_rad2[:2])
    covariance[5, 5] = variances_rad2[2]
    return covariance


def diagnostics(messages: MessageFactory, time_ns: int, level: int, text: str, values: dict[str, str]) -> Any:
    """A diagnostic_msgs/DiagnosticArray with one status."""
    pairs = [messages.make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()]
    status = messages.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=messages.octet(level),
        name="scenematch: position",
        message=text,
        hardware_id="",
        values=pairs,
    )
    header = messages.header(time_ns, "")
    return messages.make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])
