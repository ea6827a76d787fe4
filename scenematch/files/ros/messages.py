"""ROS messages: conversion of images, calibrations, attitude, heights, velocities and positions.

Convention:
    Frames follow REP-103: the world is east-north-up, the body forward-left-up, quaternions are x, y, z, w and
    rotate the body to the world. Compass headings are degrees clockwise from true north, as in MAVROS. Messages
        may come from rospy, rclpy or rosbags: only their fields are accessed.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.camera import DISTORTION_MODELS, Camera
from engine.errors import CalibrationError, TelemetryError
from engine.geo import Array, attitude_from_rotation
from scenematch.files.frames import opened_picture
from scenematch.files.quaternions import quaternion_xyzw, rotation_of
from scenematch.files.velocities import velocity_sigma_mps

CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "8UC4": 4}
"""Encodings of sensor_msgs/Image by channels of one byte; 8UC3 and 8UC4 are in BGR order."""
BAYER = {"bayer_rggb8": "BG", "bayer_bggr8": "RG", "bayer_gbrg8": "GR", "bayer_grbg8": "GB"}
"""Encodings of raw colour pictures, and OpenCV's name of each, which starts at the second pixel and row."""
DEEP = ("mono16", "16UC1")
"""Encodings of grey pictures with two bytes per pixel."""
ENCODINGS = (*CHANNELS, *BAYER, *DEEP)
_WHITE_PERCENTILE = 99.9  # of a deep picture: the few brighter pixels are clipped to keep the others' contrast
_ANY_SENSOR_M = (0.0, 1000.0)  # stated by MAVROS for any rangefinder, whatever its range
_FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])  # its own inverse
_NORM_TOLERANCE = 0.01  # of the squared norm of a quaternion
_NOT_STATED = -1.0  # first element of a covariance
_COVARIANCE_KNOWN = 3  # NavSatFix.COVARIANCE_TYPE_KNOWN
NO_POSITION = -1
"""NavSatStatus.status of a receiver without a fix."""


# ---------------------------------------------------------------------------------------------- from messages


def stamp_ns(message: Any) -> int:
    """The stamp of the header in nanoseconds; 0 if not set."""
    stamp = message.header.stamp
    seconds = stamp.secs if hasattr(stamp, "secs") else stamp.sec
    nanoseconds = stamp.nsecs if hasattr(stamp, "nsecs") else stamp.nanosec
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def image_from_message(message: Any) -> NDArray[np.uint8]:
    """Copy the image out of a sensor_msgs/Image or CompressedImage.

    Returns:
        (H, W) grey or (H, W, 3) RGB, uint8.

    Raises:
        TelemetryError: the encoding is not in :data:`ENCODINGS`, or there are too few bytes or no valid image.
    """
    if not hasattr(message, "encoding"):
        with opened_picture(io.BytesIO(memoryview(message.data)), "image", "compressed picture") as picture:
            return np.array(picture if picture.mode == "L" else picture.convert("RGB"), np.uint8)
    encoding = message.encoding
    if encoding in BAYER:
        return _demosaiced(_pixels(message, 1), BAYER[encoding])
    if encoding in DEEP:
        return _of_8_bits(_pixels(message, 2).view(">u2" if message.is_bigendian else "<u2"))
    channels = CHANNELS.get(encoding)
    if channels is None:
        raise TelemetryError(f"image: expected an encoding of {', '.join(ENCODINGS)}, got {encoding!r}")
    pixels = _pixels(message, channels)
    if channels == 1:
        return pixels
    order = (0, 1, 2) if encoding.startswith("rgb") else (2, 1, 0)
    return np.ascontiguousarray(pixels.reshape(*pixels.shape[:1], -1, channels)[:, :, order])


def _pixels(message: Any, pixel_bytes: int) -> NDArray[np.uint8]:
    """Copy of the rows (H, W * pixel_bytes) without their padding."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    row = width * pixel_bytes
    if height < 1 or width < 1 or step < row or data.size < (height - 1) * step + row:
        raise TelemetryError(
            f"image: expected {height} rows of {step} bytes for {width} x {height} {message.encoding}, "
            f"got {data.size} bytes"
        )
    # The last row may lack padding.
    return np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False).copy()


def _demosaiced(mosaic: NDArray[np.uint8], pattern: str) -> NDArray[np.uint8]:
    """(H, W, 3) RGB of a raw colour picture."""
    import cv2

    if min(mosaic.shape) < 2:
        raise TelemetryError(f"image: expected at least 2 x 2 pixels of a Bayer mosaic, got {mosaic.shape}")
    return np.asarray(cv2.cvtColor(mosaic, getattr(cv2, f"COLOR_Bayer{pattern}2RGB")), np.uint8)


def _of_8_bits(levels: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """(H, W) of a picture whose levels fill 10, 12, 14 or 16 bits."""
    white = max(float(np.percentile(levels, _WHITE_PERCENTILE)), 1.0)
    return np.asarray(np.clip(levels.astype(np.float32) * (255.0 / white), 0.0, 255.0), np.uint8)


def camera_from_message(message: Any) -> Camera:
    """The calibration of a sensor_msgs/CameraInfo, for a nadir camera whose image top points to the nose.

    Raises:
        CalibrationError: the camera is not calibrated, uses binning, or its distortion model is unknown.
    """
    if max(message.binning_x, message.binning_y) > 1 or message.roi.width or message.roi.height:
        raise CalibrationError("camera_info: expected pictures without binning or region of interest")
    matrix = np.asarray(message.K if hasattr(message, "K") else message.k, np.float64)
    distortion = np.asarray(message.D if hasattr(message, "D") else message.d, np.float64)
    model = message.distortion_model or "plumb_bob"
    if matrix.size != 9:
        raise CalibrationError(f"camera_info: expected 9 numbers in K, got {matrix.size}")
    if not distortion.any():  # ROS writes no distortion as zero, four or five zeros
        distortion = np.zeros(DISTORTION_MODELS.get(model, (5,))[-1])
    try:
        return Camera(int(message.width), int(message.height), matrix.reshape(3, 3), model, distortion)
    except CalibrationError as error:
        raise CalibrationError(f"camera_info: {error}") from None


def attitude_from_message(message: Any) -> tuple[float, float, float] | None:
    """Roll, pitch and heading in degrees of a sensor_msgs/Imu; None if it has no orientation."""
    rotation = _rotation(message.orientation)
    if message.orientation_covariance[0] == _NOT_STATED or rotation is None:
        return None
    return attitude_from_rotation(rotation @ _FLU_FROM_FRD)


def body_velocity_from_message(message: Any) -> tuple[float, float, float, float] | None:
    """Velocity along the body (forward, right, down) in m/s of another odometry, and its standard deviation.

    Args:
        message: nav_msgs/Odometry, whose twist is by definition along the axes of ``child_frame_id``, the body's
            (forward-left-up). If some odometry uses the pose's frame for it, the pose's orientation rotates the
            twist back into the body; the frame's north does not matter.

    Returns:
        None if the message has no valid velocity, by
        :func:`scenematch.files.velocities.velocity_sigma_mps`, or no orientation if one is needed. The standard
        deviation is per axis, and 0 if the covariance is not stated: zeros, -1, or not finite.
    """
    linear = message.twist.twist.linear
    velocity = np.array([linear.x, linear.y, linear.z], np.float64)
    covariance = np.asarray(message.twist.covariance, np.float64)
    variances = [0.0] * 3 if covariance[0] == _NOT_STATED else covariance[0:15:7].tolist()
    sigma_mps = velocity_sigma_mps(velocity, variances, turned=True)
    if message.child_frame_id and message.child_frame_id == message.header.frame_id:
        rotation = _rotation(message.pose.pose.orientation)
        if rotation is None:
            return None
        velocity = rotation.T @ velocity
    if sigma_mps is None:
        return None
    forward, right, down = (float(v) for v in _FLU_FROM_FRD @ velocity)
    return forward, right, down, sigma_mps


def _rotation(q: Any) -> Array | None:
    """(3, 3) of a geometry_msgs/Quaternion, from the body (forward-left-up) to the world; None if invalid."""
    x, y, z, w = (float(v) for v in (q.x, q.y, q.z, q.w))
    square = x * x + y * y + z * z + w * w
    return rotation_of(w, x, y, z) if abs(square - 1.0) < _NORM_TOLERANCE else None


def range_from_message(message: Any) -> float | None:
    """Distance in metres along the beam of a sensor_msgs/Range; None outside the range that it states.

    Also None if the stated range is MAVROS' default: a sonar then reports its largest distance beyond its reach.
    """
    range_m = float(message.range)
    if (message.min_range, message.max_range) == _ANY_SENSOR_M:
        return None
    return range_m if range_m > 0.0 and message.min_range <= range_m <= message.max_range else None


def position_from_message(message: Any) -> tuple[float, float, float | None] | None:
    """Latitude and longitude in degrees and sigma in metres of a sensor_msgs/NavSatFix; None if unknown."""
    lat_deg, lon_deg = float(message.latitude), float(message.longitude)
    if message.status.status == NO_POSITION or not (math.isfinite(lat_deg) and math.isfinite(lon_deg)):
        return None
    covariance = np.asarray(message.position_covariance, np.float64).reshape(3, 3)[:2, :2]
    if message.position_covariance_type == 0 or not np.isfinite(covariance).all():
        return lat_deg, lon_deg, None
    return lat_deg, lon_deg, math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))


# ------------------------------------------------------------------------------------------------ to messages


@dataclass(frozen=True, slots=True)
class MessageFactory:
    """Constructs messages of ROS 1 or ROS 2.

    Attributes:
        find: returns the class of a name such as "sensor_msgs/msg/Image".
        ros1: whether headers have ``seq`` and the fields of calibrations are upper case.
        time: constructs a stamp from seconds and nanoseconds; None uses the class builtin_interfaces/msg/Time.
        octet: converts a single byte to the stored type.
    """

    find: Callable[[str], Any]
    ros1: bool
    time: Callable[[int, int], Any] | None = None
    octet: Callable[[int], Any] = int

    def make(self, kind: str, /, **fields: Any) -> Any:
        """Construct a message from all of its fields."""
        return self.find(kind)(**fields)

    def header(self, time_ns: int, frame_id: str) -> Any:
        """A std_msgs/Header with a time in nanoseconds and a frame."""
        sec, nanosec = divmod(time_ns, 1_000_000_000)
        if self.time is not None:
            stamp = self.time(sec, nanosec)
        else:
            stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        count = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **count)

    def quaternion(self, roll_deg: float, pitch_deg: float, heading_deg: float) -> Any:
        """A geometry_msgs/Quaternion of an attitude."""
        x, y, z, w = quaternion_xyzw(roll_deg, pitch_deg, heading_deg)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def position(self, time_ns: int, frame_id: str, lat_deg: float, lon_deg: float, covariance_m2: Array) -> Any:
        """A sensor_msgs/NavSatFix with covariance (3, 3) of east, north, up; the altitude is NaN, unknown."""
        status = self.make("sensor_msgs/msg/NavSatStatus", status=0, service=0)
        return self.make(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(time_ns, frame_id),
            status=status,
            latitude=float(lat_deg),
            longitude=float(lon_deg),
            altitude=math.nan,
            position_covariance=np.asarray(covariance_m2, np.float64).ravel(),
            position_covariance_type=_COVARIANCE_KNOWN,
        )
