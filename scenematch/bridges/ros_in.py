"""Inputs of the ROS bridge: the names of its topics, and the recent telemetry on ROS time."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

from engine.errors import OptionError
from engine.geo import enu_from_body, wrap_heading_deg
from scenematch.bridges.vehicle import ANGLES, RecentValues, VehicleState, height_above_ground_m, scalar
from scenematch.files.ros import bags
from scenematch.files.ros.messages import (
    ODOMETRY_TYPES,
    attitude_from_message,
    body_velocity_from_message,
    range_from_message,
    stamp_ns,
)

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
        odometry: another camera's odometry, with its twist along the body.
        odometry_type: its message, one of :data:`scenematch.files.ros.messages.ODOMETRY_TYPES`: Odometry,
            TwistWithCovarianceStamped or TwistStamped.

    Raises:
        OptionError: the odometry has another message type.
    """

    image: str = bags.IMAGE
    camera_info: str = bags.CAMERA_INFO
    imu: str = bags.IMU
    compass: str = ""
    height: str = bags.HEIGHT
    range: str = bags.RANGE
    velocity: str = bags.VELOCITY
    odometry: str = ""
    odometry_type: str = "Odometry"

    def __post_init__(self) -> None:
        if self.odometry_type not in ODOMETRY_TYPES:
            known = ", ".join(ODOMETRY_TYPES)
            raise OptionError(f"odometry_type: expected one of {known}, got {self.odometry_type!r}")

    @property
    def image_type(self) -> str:
        """Message type of the images."""
        return f"sensor_msgs/msg/{'CompressedImage' if self.image.endswith('/compressed') else 'Image'}"


class RosTelemetry:
    """Recent telemetry on ROS time. May be read and updated from different threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._attitude, self._compass, self._velocity = RecentValues(ANGLES), RecentValues((True,)), RecentValues()
        self._range, self._height, self._odometry = RecentValues(), RecentValues(), RecentValues()

    def imu(self, message: Any) -> None:
        """Store the attitude of a sensor_msgs/Imu."""
        attitude = attitude_from_message(message)
        if attitude is not None:
            self._add(self._attitude, stamp_ns(message), *attitude)

    def waits_for_attitude(self, time_ns: int) -> bool:
        """Whether the attitude at a ROS time is still expected: attitudes arrive, and the newest is older."""
        with self._lock:
            last_ns = self._attitude.last_ns
        return last_ns is not None and last_ns < time_ns <= last_ns + _ATTITUDE_COMES_NS

    def compass(self, heading_deg: float, now_ns: int) -> None:
        """Store a heading that has no stamp."""
        self._add(self._compass, now_ns, heading_deg)

    def height(self, height_m: float, now_ns: int) -> None:
        """Store a height above take-off that has no stamp."""
        self._add(self._height, now_ns, height_m)

    def range(self, message: Any) -> None:
        """Store the distance of a sensor_msgs/Range."""
        range_m = range_from_message(message)
        if range_m is not None:
            self._add(self._range, stamp_ns(message), range_m)

    def velocity(self, message: Any) -> None:
        """Store the velocity of a geometry_msgs/TwistStamped in east-north-up."""
        linear = message.twist.linear
        self._add(self._velocity, stamp_ns(message), linear.x, linear.y)

    def odometry(self, message: Any, now_ns: int) -> None:
        """Store the velocity along the body of another odometry; one without a stamp counts as now.

        Raises:
            TelemetryError: its velocity is not along the body.
        """
        velocity = body_velocity_from_message(message)
        if velocity is not None:
            self._add(self._odometry, stamp_ns(message) or now_ns, *velocity)

    def vehicle(self, time_ns: int) -> VehicleState:
        """The vehicle state at a ROS time; what is not known is None."""
        with self._lock:
            roll_deg, pitch_deg, yaw_deg = self._attitude.at(time_ns) or (None, None, None)
            heading_deg = scalar(self._compass.at(time_ns))
            heading_deg = yaw_deg if heading_deg is None else heading_deg
            east_mps, north_mps = self._velocity.at(time_ns) or (None, None)
            along_body = self._odometry.at(time_ns)
            # 0 means not stated: nothing to interpolate.
            *_, stated_mps = self._odometry.nearest(time_ns) or (0.0,)
            slant_m, height_m = scalar(self._range.at(time_ns)), scalar(self._height.at(time_ns))
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
            height_agl_m=height_above_ground_m(slant_m, roll_deg, pitch_deg, height_m),
            down_m=None if height_m is None else -height_m,
        )

    def _add(self, series: RecentValues, time_ns: int, *values: float) -> None:
        with self._lock:
            if series.last_ns is not None and time_ns < series.last_ns - RESTART_NS:
                series.clear()
            series.add(time_ns, *values)
