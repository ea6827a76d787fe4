"""Flights as bags of ROS 1 and ROS 2 for tests and fuzzing, with the topics of a camera driver and MAVROS."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from engine.camera import Camera
from engine.values import Frame, Prior, Truth
from scenematch.files.ros import bags
from scenematch.files.ros.messages import MessageFactory

BAG_KINDS = ("ros1", "ros2-sqlite3", "ros2-mcap")


class BagMessages(MessageFactory):
    """Messages besides those that a bridge publishes."""

    def float64(self, value: float) -> Any:
        """A std_msgs/Float64."""
        return self.make("std_msgs/msg/Float64", data=float(value))

    def vector(self, x: float, y: float, z: float) -> Any:
        """A geometry_msgs/Vector3."""
        return self.make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))

    def camera_info(self, time_ns: int, frame_id: str, camera: Camera) -> Any:
        """A sensor_msgs/CameraInfo; it has no field for the mount."""
        K = camera.matrix
        blocks = {
            "D": camera.distortion,
            "K": K.ravel(),
            "R": np.eye(3).ravel(),
            "P": np.c_[K, np.zeros(3)].ravel(),
        }
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(time_ns, frame_id),
            height=camera.height_px,
            width=camera.width_px,
            distortion_model=camera.distortion_model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **(blocks if self.ros1 else {name.lower(): values for name, values in blocks.items()}),
        )

    def image(self, time_ns: int, frame_id: str, pixels: NDArray[np.uint8]) -> Any:
        """A sensor_msgs/Image of (H, W) grey or (H, W, 3) RGB, uint8."""
        height, width = pixels.shape[:2]
        encoding, data = "mono8" if pixels.ndim == 2 else "rgb8", np.ascontiguousarray(pixels).ravel()
        return self.make(
            "sensor_msgs/msg/Image", header=self.header(time_ns, frame_id), height=height, width=width,
            encoding=encoding, is_bigendian=0, step=pixels[0].size, data=data,
        )  # fmt: skip

    def imu(self, time_ns: int, frame_id: str, roll_deg: float, pitch_deg: float, heading_deg: float) -> Any:
        """A sensor_msgs/Imu with orientation only."""
        unknown = np.array([-1.0, *(0.0,) * 8])
        return self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(time_ns, frame_id),
            orientation=self.quaternion(roll_deg, pitch_deg, heading_deg),
            orientation_covariance=np.zeros(9),
            angular_velocity=self.vector(0.0, 0.0, 0.0),
            angular_velocity_covariance=unknown,
            linear_acceleration=self.vector(0.0, 0.0, 0.0),
            linear_acceleration_covariance=unknown,
        )

    def velocity(self, time_ns: int, frame_id: str, east_mps: float, north_mps: float) -> Any:
        """A geometry_msgs/TwistStamped of a velocity over ground; the unknown components are NaN."""
        nan = math.nan
        linear, angular = self.vector(east_mps, north_mps, nan), self.vector(nan, nan, nan)
        twist = self.make("geometry_msgs/msg/Twist", linear=linear, angular=angular)
        return self.make("geometry_msgs/msg/TwistStamped", header=self.header(time_ns, frame_id), twist=twist)


def write_bag(
    path: Path,
    frames: Iterable[tuple[Frame, Prior | None]],
    camera: Camera,
    *,
    kind: str,
    truth: Iterable[Truth] = (),
) -> int:
    """Write stamped frames with their priors; returns how many."""
    ros1, count = kind == "ros1", 0
    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    make = BagMessages(types.types.__getitem__, ros1)
    plugin = rosbag2.StoragePlugin.SQLITE3 if kind == "ros2-sqlite3" else rosbag2.StoragePlugin.MCAP
    writer: Any = rosbag1.Writer(path) if ros1 else rosbag2.Writer(path, version=9, storage_plugin=plugin)
    connections: dict[str, Any] = {}

    def write(topic: str, time_ns: int, message: Any) -> None:
        name = message.__msgtype__
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, name, typestore=types)
        data = types.serialize_ros1(message, name) if ros1 else types.serialize_cdr(message, name)
        writer.write(connections[topic], time_ns, bytes(data))

    with writer:
        for frame, prior in frames:
            _write_frame(write, make, frame, prior, camera)
            count += 1
        for row in truth:
            _write_truth(write, make, row)
    return count


def _write_frame(write: Any, make: BagMessages, frame: Frame, prior: Prior | None, camera: Camera) -> None:
    time_ns = frame.timestamp_ns
    write(bags.IMAGE, time_ns, make.image(time_ns, "camera", frame.image))
    write(bags.CAMERA_INFO, time_ns, make.camera_info(time_ns, "camera", camera))
    angles = frame.roll_deg, frame.pitch_deg, frame.heading_deg
    if None not in angles:
        write(bags.IMU, time_ns, make.imu(time_ns, "base_link", *angles))
    if frame.heading_deg is not None:
        write(bags.COMPASS, time_ns, make.float64(frame.heading_deg))
    if frame.height_agl_m is not None:
        write(bags.HEIGHT, time_ns, make.float64(frame.height_agl_m))
    if frame.east_velocity_mps is not None and frame.north_velocity_mps is not None:
        velocity = make.velocity(time_ns, "map", frame.east_velocity_mps, frame.north_velocity_mps)
        write(bags.VELOCITY, time_ns, velocity)
    if prior is not None and prior.lat_deg is not None and prior.lon_deg is not None:
        covariance_m2 = np.diag([prior.sigma_m**2, prior.sigma_m**2, 0.0])
        position = make.position(time_ns, "base_link", prior.lat_deg, prior.lon_deg, covariance_m2)
        write(bags.POSITION, time_ns, position)


def _write_truth(write: Any, make: BagMessages, row: Truth) -> None:
    time_ns = row.timestamp_ns
    position = make.position(time_ns, "base_link", row.lat_deg, row.lon_deg, np.zeros((3, 3)))
    write(bags.TRUTH, time_ns, position)
    angles = row.roll_deg, row.pitch_deg, row.heading_deg
    if None not in angles:
        write(bags.TRUTH_ATTITUDE, time_ns, make.imu(time_ns, "base_link", *angles))
    if row.height_agl_m is not None:
        write(bags.TRUTH_HEIGHT, time_ns, make.float64(row.height_agl_m))
    if row.alt_amsl_m is not None:
        write(bags.TRUTH_ALTITUDE, time_ns, make.float64(row.alt_amsl_m))


def flight_bag(folder: Path, path: Path) -> None:
    """Write a flight folder of the simulator as a bag of ROS 1, as ``.ci/extras`` does."""
    from scenematch.files.flight import open_flight
    from scenematch.files.truth import read_truth

    camera = Camera.load(folder / "camera.yaml")
    flight = open_flight(folder / "frames", folder / "telemetry.csv", camera)
    frames = ((item.frame, item.prior) for item in flight)
    write_bag(path, frames, camera, kind="ros1", truth=read_truth(folder / "truth.csv"))
