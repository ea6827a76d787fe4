"""Inputs of the ROS bridge: the names of its topics, and the recent telemetry on ROS time."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

from engine.geo import enu_from_body, wrap_heading_deg
from scenematch.bridges.vehicle import ANGLES, RecentValues, VehicleState, height_above_ground_m, scalar
from scenematch.files.ros import bags

__all__ = ["RESTART_NS", "RosTelemetry", "RosTopics"]

RESTART_NS = 1_000_000_000
"""A stamp this much older than the last means that a simulator or a bag was restarted."""
_ATTITUDE_COMES_NS = 300_000_000  # largest age of the newest attitude at which another is expected


@dataclass(frozen=True, slots=True, kw_only=True)
class RosTopics:
    """Names of the topics that the bridge subscribes to; an empty name disables one.

    Attributes:
        image: sensor_msgs/Image, or CompressedImage if the name ends with ``/compressed``.
        camera_info: sensor_msgs/CameraInfo, used if no calibration file is given.
        imu: sensor_msgs/Imu; its orientation is the attitude.
        compass: std_msgs/Float64, degrees clockwise from north, for an Imu whose heading is not from north; it has
            no stamp and takes precedence.
        height: std_msgs/Float64, metres above take-off.
        range: sensor_msgs/Range along the body's down axis; takes precedence over the height.
        velocity: geometry_msgs/TwistStamped, east and north in m/s; used if there was no odometry in the last half
            second.
        odometry: nav_msgs/Odometry of another camera, with its twist along the body.
    """

    image: str = bags.IMAGE
    camera_info: str = bags.CAMERA_INFO
    imu: str = bags.IMU
    compass: str = ""
    height: str = bags.HEIGHT
    range: str = ""
    velocity: str = bags.VELOCITY
    odometry: str = ""

    @property
    def image_type(self) -> str:
        """Message type of the images."""
        return f"sensor_msgs/msg/{'CompressedImage' if self.image.endswith('/compressed') else 'Image'}"


class RosTelemetry:
    """Recent telemetry on ROS time. May be read and updated from different threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._recent = {name: RecentValues() for name in ("height", "range", "velocity", "odometry")}
        self._recent |= {"imu": RecentValues(ANGLES), "compass": RecentValues((True,))}

    def add(self, name: str, message: Any, now_ns: int) -> None:
        """Store what a message says; one without a stamp counts as now.

        Args:
            name: one of :data:`scenematch.files.ros.bags.QUANTITIES`, as the topics are named.
            message: of one of its types.
            now_ns: ROS time.

        Raises:
            TelemetryError: the velocity of an odometry is not along the body.
        """
        values = bags.QUANTITIES[name].values(message)
        if values is None or None in values:
            return
        time_ns, series = bags.stamp_or(message, now_ns), self._recent[name]
        with self._lock:
            if series.last_ns is not None and time_ns < series.last_ns - RESTART_NS:
                series.clear()
            series.add(time_ns, *values)

    def waits_for_attitude(self, time_ns: int) -> bool:
        """Whether the attitude at a ROS time is still expected: attitudes arrive, and the newest is older."""
        with self._lock:
            last_ns = self._recent["imu"].last_ns
        return last_ns is not None and last_ns < time_ns <= last_ns + _ATTITUDE_COMES_NS

    def vehicle(self, time_ns: int) -> VehicleState:
        """The vehicle state at a ROS time; what is not known is None."""
        with self._lock:
            at = {name: series.at(time_ns) for name, series in self._recent.items()}
            # 0 means not stated: nothing to interpolate.
            *_, stated_mps = self._recent["odometry"].nearest(time_ns) or (0.0,)
        roll_deg, pitch_deg, yaw_deg = at["imu"] or (None, None, None)
        compass_deg, height_m = scalar(at["compass"]), scalar(at["height"])
        heading_deg = yaw_deg if compass_deg is None else compass_deg
        east_mps, north_mps = at["velocity"] or (None, None)
        along_body = at["odometry"]
        sigma_mps = None
        if along_body is not None and heading_deg is not None:
            turn = enu_from_body(roll_deg or 0.0, pitch_deg or 0.0, heading_deg)
            east_mps, north_mps, _ = (float(v) for v in turn @ along_body[:3])
            sigma_mps = stated_mps or None
        return VehicleState(
            roll_deg=roll_deg,
            pitch_deg=pitch_deg,
            heading_deg=None if heading_deg is None else wrap_heading_deg(heading_deg),
            east_velocity_mps=east_mps,
            north_velocity_mps=north_mps,
            velocity_sigma_mps=sigma_mps,
            height_agl_m=height_above_ground_m(scalar(at["range"]), roll_deg, pitch_deg, height_m),
            down_m=None if height_m is None else -height_m,
        )
