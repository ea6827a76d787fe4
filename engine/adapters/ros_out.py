"""What the ROS nodes publish: a fix in, its pose, the diagnostics and the picture of its window out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.adapters.vehicle import ANGLE_VARIANCE, Origin, Vehicle, north_east_m
from engine.errors import OptionError
from engine.formats.ros.messages import MessageFactory
from engine.geo import LocalFrame
from engine.orthomap import OrthoMap
from engine.values import Fix, Window

FIRMWARES = ("none", "ardupilot", "px4")
"""For whom a pose is: an autopilot behind MAVROS has its own projection, and its own way with covariances."""

_UNKNOWN_ANGLE_VARIANCE = math.pi**2
_UNKNOWN_HEIGHT_M2 = 1e6
_VIEW_PX = 640  # the window is shown in a level of the map that fits


@dataclass(frozen=True, slots=True, kw_only=True)
class RosOptions:
    """How fixes are told.

    Attributes:
        frame_id: of the poses: east-north-up about the origin.
        firmware: one of :data:`FIRMWARES`.
        origin: of the poses; None for the map's. An autopilot's must be the one of its estimator.
    """

    frame_id: str = "map"
    firmware: str = "none"
    origin: Origin | None = None

    def __post_init__(self) -> None:
        if self.firmware not in FIRMWARES:
            raise OptionError(f"firmware: expected one of {', '.join(FIRMWARES)}, got {self.firmware!r}")


def is_finite(fix: Fix) -> bool:
    """Whether every number of a fix may travel."""
    numbers = (fix.lat_deg, fix.lon_deg, fix.east_m, fix.north_m, *fix.covariance_m2.ravel())
    return all(map(math.isfinite, numbers))


def pose(
    maker: MessageFactory, fix: Fix, vehicle: Vehicle, captured_ns: int, site: OrthoMap, options: RosOptions
) -> Any:
    """A fix as geometry_msgs/PoseWithCovarianceStamped: east, north and up about the origin.

    Up is the vehicle's own height above take-off, else above the ground, else the fix's above the map's ground.
    The orientation is what the method measured, else the vehicle's own.
    """
    known = [None if vehicle.down_m is None else -vehicle.down_m, vehicle.height_agl_m,
             None if fix.up_m is None else fix.up_m - site.ground_m]  # fmt: skip
    up_m = next((height_m for height_m in known if height_m is not None), None)
    angles = vehicle.roll_deg, vehicle.pitch_deg, vehicle.heading_deg
    if fix.attitude is not None:
        angles = fix.attitude.roll_deg, fix.attitude.pitch_deg, fix.attitude.heading_deg
    roll_deg, pitch_deg, heading_deg = angles
    east_m, north_m = place_m(fix, site.frame, options)
    covariance = pose_covariance(fix, options.firmware, knows_up=up_m is not None, angles=angles)
    point = maker.make("geometry_msgs/msg/Point", x=east_m, y=north_m, z=up_m or 0.0)
    turn = maker.quaternion(roll_deg or 0.0, pitch_deg or 0.0, heading_deg if heading_deg is not None else 90.0)
    inner = maker.make("geometry_msgs/msg/Pose", position=point, orientation=turn)
    return maker.make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=maker.header(captured_ns, options.frame_id),
        pose=maker.make("geometry_msgs/msg/PoseWithCovariance", pose=inner, covariance=covariance.ravel()),
    )


def place_m(fix: Fix, frame: LocalFrame, options: RosOptions) -> tuple[float, float]:
    """East and north of the origin: in its tangent plane, or as the firmware takes degrees to metres."""
    origin = options.origin
    if options.firmware == "none":
        if origin is None:
            return fix.east_m, fix.north_m
        about = LocalFrame(origin.lat_deg, origin.lon_deg)
        east_m, north_m = about.enu_from_geodetic(fix.lat_deg, fix.lon_deg)
        return float(east_m), float(north_m)
    begin = origin or Origin(frame.lat_deg, frame.lon_deg, 0.0)
    north_m, east_m = north_east_m(fix.lat_deg, fix.lon_deg, begin, options.firmware)
    return east_m, north_m


def pose_covariance(
    fix: Fix, firmware: str, *, knows_up: bool, angles: tuple[float | None, ...]
) -> NDArray[np.float64]:
    """(6, 6) of east, north, up and the turns about them.

    An autopilot makes one figure of the position's variances, and that of the height, which is its own, would
    drown the others: it gets the horizontal one.
    """
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = fix.covariance_m2
    if firmware != "none":
        covariance[2, :2] = covariance[:2, 2] = 0.0
        covariance[2, 2] = fix.sigma_m**2
    elif not knows_up:
        covariance[2, :2] = covariance[:2, 2] = 0.0
        covariance[2, 2] = _UNKNOWN_HEIGHT_M2
    turns = [_UNKNOWN_ANGLE_VARIANCE if angle is None else ANGLE_VARIANCE for angle in angles]
    # Leaning is about both horizontal axes at once, whichever way the nose points.
    covariance[3, 3] = covariance[4, 4] = max(turns[:2])
    covariance[5, 5] = turns[2]
    return covariance


def diagnostics(maker: MessageFactory, time_ns: int, level: int, text: str, values: dict[str, str]) -> Any:
    """A diagnostic_msgs/DiagnosticArray of one status."""
    pairs = [maker.make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()]
    status = maker.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=maker.octet(level),
        name="scenematch: position",
        message=text,
        hardware_id="",
        values=pairs,
    )
    header = maker.header(time_ns, "")
    return maker.make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])


def window_picture(site: OrthoMap, window: Window, fix: Fix | None) -> NDArray[np.uint8]:
    """The crop of the map that was searched, (H, W, 3) RGB, at most 640 px long, the fix in it as a red cross."""
    import cv2

    longest_px = max(window.width_px, window.height_px)
    level = min(max(math.floor(math.log2(longest_px / _VIEW_PX)), 0), site.levels - 1)
    step, (rows, columns) = 2**level, site.level_shape(level)
    x0, y0 = min(window.x0 // step, columns - 1), min(window.y0 // step, rows - 1)
    width, height = (math.ceil(side / step) for side in (window.width_px, window.height_px))
    gray = site.gray(Window(x0, y0, min(width, columns - x0), min(height, rows - y0)), level)
    share = min(_VIEW_PX / max(gray.shape), 1.0)
    size = max(round(gray.shape[1] * share), 1), max(round(gray.shape[0] * share), 1)
    rgb = np.repeat(cv2.resize(gray, size, interpolation=cv2.INTER_AREA)[:, :, None], 3, axis=2)
    if fix is not None:
        x, y = (site.level_from_full(fix.map_xy_px, level) - (x0, y0)) * share
        cv2.drawMarker(rgb, (round(float(x)), round(float(y))), (255, 0, 0), cv2.MARKER_CROSS, 15, 1)
    return np.asarray(rgb, np.uint8)
