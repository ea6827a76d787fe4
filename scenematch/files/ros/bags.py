"""Bags of ROS 1 and ROS 2 (sqlite3, mcap): the images, telemetry and calibration of a flight.

Convention:
    Timestamps are capture times from the headers. A message without a header (std_msgs/Float64) or with a zero
    stamp gets its recording time. Frames are named by their index from 0, like those of a video.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import CalibrationError, TelemetryError, require
from engine.geo import enu_from_body
from scenematch.files.frames import ForwardFrames
from scenematch.files.resampling import (
    FlightLog,
    Floats,
    Stamps,
    TimeSeries,
    interpolate,
    make_position_series,
    make_series,
)
from scenematch.files.ros import messages

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
"""Suffixes of bag files, in lower or upper case; a folder is a bag if it contains metadata.yaml."""
IMAGE, CAMERA_INFO = "/camera/image_raw", "/camera/camera_info"
IMU, COMPASS = "/mavros/imu/data", "/mavros/global_position/compass_hdg"
HEIGHT = "/mavros/global_position/rel_alt"
VELOCITY, POSITION = "/mavros/local_position/velocity_local", "/mavros/global_position/global"
TRUTH, TRUTH_ATTITUDE = "/truth/fix", "/truth/imu"
TRUTH_HEIGHT, TRUTH_ALTITUDE = "/truth/height_agl", "/truth/alt_amsl"
"""Topics to write, preferred if a bag has several of a type."""

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_FLOAT, _CALIBRATION = "std_msgs/msg/Float64", ("sensor_msgs/msg/CameraInfo",)

Sample = tuple[int, tuple[float | None, ...]]
"""Stamp in nanoseconds, and values; None if one is unknown."""


def is_bag(path: str | Path) -> bool:
    """Whether a path is a bag, by its suffix or, for a folder, by its metadata.yaml."""
    path = Path(path)
    return path.suffix.lower() in BAG_SUFFIXES or (path / "metadata.yaml").is_file()


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity of the telemetry.

    Attributes:
        type: message type that states it.
        values: extracts the values; None if a message has none, and for a value that it lacks.
        topics: what the names of a bag's topics with it end in, best first; empty is any but truth.
        truth: the same if the bag's ``/truth`` topics replace them.
    """

    type: str
    values: Callable[[Any], tuple[Any, ...] | None]
    topics: tuple[str, ...] = ()
    truth: tuple[str, ...] = ()


def _data(message: Any) -> tuple[float]:
    return (message.data,)


QUANTITIES = {
    "imu": Quantity("sensor_msgs/msg/Imu", messages.attitude_from_message, ("/imu/data", ""), (TRUTH_ATTITUDE,)),
    "compass": Quantity(_FLOAT, _data, ("/compass_hdg",)),
    "range": Quantity("sensor_msgs/msg/Range", lambda message: (messages.range_from_message(message),), ("",)),
    "height": Quantity(_FLOAT, _data, ("/rel_alt",), (TRUTH_HEIGHT,)),
    "altitude": Quantity(_FLOAT, _data, (), (TRUTH_ALTITUDE,)),
    "velocity": Quantity(
        "geometry_msgs/msg/TwistStamped", lambda m: (m.twist.linear.x, m.twist.linear.y), ("/velocity_local",)
    ),
    "place": Quantity("sensor_msgs/msg/NavSatFix", messages.position_from_message, (POSITION, ""), (TRUTH,)),
    "odometry": Quantity("nav_msgs/msg/Odometry", messages.body_velocity_from_message),
}
"""The quantities of a bag's and of a live vehicle's telemetry, by name."""


class BagFrames(ForwardFrames):
    """The images of one topic of a bag.

    Of pictures with the same timestamp the first counts; names are indices among all pictures of the topic.

    Args:
        path: the bag.
        topic: topic of the images; None if there is only one.

    Raises:
        TelemetryError: the bag cannot be read, has no images, or has several image topics and none was given.
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        self.path = path
        with _opened(path) as reader:
            self.topic = _image_topic(path, reader, topic)
            stamps_ns = [time_ns for _, time_ns, _ in _messages(path, reader, {self.topic}, _IMAGES)]
        if not stamps_ns:
            raise TelemetryError(f"{path}: expected pictures on {self.topic}, got none")
        # Simulators publish a picture again if there is no new one yet.
        fresh = [k for k in range(len(stamps_ns)) if k == 0 or stamps_ns[k] != stamps_ns[k - 1]]
        self.names, self._stamps_ns = [str(index) for index in fresh], [stamps_ns[index] for index in fresh]
        self._restart()

    @property
    def description(self) -> str:
        """The range of indices, for messages."""
        return f"an index from 0 to {self.names[-1]} of {self.topic}"

    def stamps_ns(self) -> list[int]:
        """Capture time of each frame in nanoseconds.

        Raises:
            TelemetryError: a stamp is not later than the one before it.
        """
        for name, (before, after) in zip(self.names[1:], itertools.pairwise(self._stamps_ns), strict=True):
            if after <= before:
                raise TelemetryError(
                    f"{self.path}: {self.topic}: expected frame {name} after {before / 1e9:.6f} s, "
                    f"got {after / 1e9:.6f} s"
                )
        return list(self._stamps_ns)

    def _restart(self) -> None:
        self._stream, self._next = _image_messages(self.path, self.topic), 0

    def _decode(self, index: int) -> NDArray[np.uint8]:
        skipped, self._next = index - self._next, index + 1
        message = next(itertools.islice(self._stream, skipped, None), None)
        if message is None:
            raise TelemetryError(f"{self.path}: {self.topic}: frame {index} has vanished since the bag was opened")
        try:
            image = messages.image_from_message(message)
        except TelemetryError as error:
            raise TelemetryError(f"{self.path}: {self.topic}: frame {index}: {error}") from None
        return np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image


def _image_messages(path: Path, topic: str) -> Iterator[Any]:
    """The image messages of one topic; closing the generator closes the file."""
    with _opened(path) as reader:
        for _, _, message in _messages(path, reader, {topic}, _IMAGES):
            yield message


def read_bag_camera(path: str | Path, topic: str | None = None) -> Camera:
    """Read the calibration in a bag: the camera_info beside the image topic, else any other.

    Args:
        path: the bag.
        topic: topic of the images; None if there is only one.

    Raises:
        TelemetryError: the bag cannot be read, or has no calibration.
        CalibrationError: the calibration is not usable.
    """
    path = Path(path)
    with _opened(path) as reader:
        beside = _image_topic(path, reader, topic).rpartition("/")[0] + "/camera_info"
        found = _topic(reader, _CALIBRATION, (beside, ""))
        first = None if found is None else next(_messages(path, reader, {found}, _CALIBRATION), None)
    if first is None:
        raise TelemetryError(f"{path}: expected a sensor_msgs/CameraInfo, got none; name a file with `camera`")
    try:
        return messages.camera_from_message(first[2])
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def read_bag(path: Path, *, truth: bool = False, odometry_topic: str | None = None) -> FlightLog:
    """Read the telemetry of a bag.

    ==========================  ===========================================================================
    ``.../compass_hdg``         heading_deg, unless the same MAVROS' Imu has it with a stamp
    sensor_msgs/Imu             roll_deg, pitch_deg
    sensor_msgs/Range           height along the body's down axis
    ``.../rel_alt``             height above take-off
    ``.../velocity_local``      east and north velocity; without ``odometry_topic``
    ``odometry_topic``          the velocity along the body, turned by the attitude above
    sensor_msgs/NavSatFix       the prior
    ==========================  ===========================================================================

    Args:
        path: the bag.
        truth: whether the ``/truth`` topics replace these, if the bag has them.
        odometry_topic: another camera's nav_msgs/Odometry, used for velocity and its accuracy.

    Raises:
        TelemetryError: the bag cannot be read, or has no usable series, or no usable velocity on that topic.
    """
    with _opened(path) as reader:
        has_truth = truth and _topic(reader, (QUANTITIES["place"].type,), (TRUTH,)) is not None
        found = {
            name: _topic(reader, (each.type,), each.truth if has_truth else each.topics)
            for name, each in QUANTITIES.items()
        }
        if odometry_topic is not None:
            found["odometry"] = _odometry_topic(path, reader, odometry_topic)
        names = {topic: name for name, topic in found.items() if topic is not None}
        known: dict[str, list[Sample]] = {name: [] for name in names.values()}
        kinds = {QUANTITIES[name].type for name in known}
        for topic, time_ns, message in _messages(path, reader, set(names), kinds) if names else ():
            numbers = QUANTITIES[names[topic]].values(message)
            if numbers is not None:
                known[names[topic]].append((time_ns, numbers))
    if _is_same_mavros(found.get("imu"), found.get("compass")):
        known.pop("compass", None)

    def series_of(name: str, index: int = 0) -> TimeSeries | None:
        return make_series(*_column(known, name, index))

    series: dict[str, TimeSeries | None] = {
        "roll_deg": series_of("imu", 0),
        "pitch_deg": series_of("imu", 1),
        "heading_deg": series_of("compass") if "compass" in known else series_of("imu", 2),
        "alt_amsl_m": series_of("altitude"),
        "east_velocity_mps": series_of("velocity", 0),
        "north_velocity_mps": series_of("velocity", 1),
        "sigma_m": series_of("place", 2),
        **make_position_series(*_column(known, "place", 0), _column(known, "place", 1)[1]),
    }
    if odometry_topic is not None:
        series |= _odometry_series(path, odometry_topic, known["odometry"], series)
    heights = {"rangefinder": series_of("range"), "take-off": series_of("height")}
    return FlightLog(path, series, heights)


def _odometry_topic(path: Path, reader: Any, topic: str) -> str:
    kind = QUANTITIES["odometry"].type
    names = _topic_names(reader, (kind,))
    if topic not in names:
        raise TelemetryError(f"{path}: expected {kind} on {topic}, got {', '.join(names) or 'none'}")
    return topic


def _odometry_series(
    path: Path, topic: str, samples: list[Sample], series: Mapping[str, TimeSeries | None]
) -> dict[str, TimeSeries | None]:
    """East and north velocity and its accuracy: the body velocity rotated by the attitude at that time."""
    stamps_ns = np.array([time_ns for time_ns, _ in samples], np.int64)

    def angle_deg(name: str) -> Floats:
        found = series[name]
        unknown = np.full(len(stamps_ns), np.nan)
        return unknown if found is None else interpolate(found, stamps_ns, is_angle=name != "pitch_deg")

    # Without roll and pitch the vehicle counts as level, as for pictures.
    roll_deg, pitch_deg = np.nan_to_num(angle_deg("roll_deg")), np.nan_to_num(angle_deg("pitch_deg"))
    attitudes = zip(roll_deg, pitch_deg, angle_deg("heading_deg"), strict=True)
    along_body = np.array([values for _, values in samples], np.float64).reshape(-1, 4)
    turned = [enu_from_body(*angles) @ each for angles, each in zip(attitudes, along_body[:, :3], strict=True)]
    enu_mps = np.array(turned, np.float64).reshape(-1, 3)
    if not np.isfinite(enu_mps).all(axis=1).any():
        lacks = "a heading at the times of" if len(samples) else "a velocity that can be used on"
        raise TelemetryError(f"{path}: expected {lacks} {topic}, got none")
    return {
        "east_velocity_mps": make_series(stamps_ns, enu_mps[:, 0]),
        "north_velocity_mps": make_series(stamps_ns, enu_mps[:, 1]),
        "velocity_sigma_mps": make_series(stamps_ns, along_body[:, 3], along_body[:, 3] > 0.0),
    }


def _is_same_mavros(imu: str | None, compass: str | None) -> bool:
    """Whether both topics are from one MAVROS; its Imu has the same heading, with the time of measurement."""
    if imu is None or not imu.endswith("/imu/data"):
        return False
    return compass == imu.removesuffix("/imu/data") + "/global_position/compass_hdg"


def _column(known: Mapping[str, list[Sample]], name: str, index: int = 0) -> tuple[Stamps, Floats]:
    """Stamps (N,) in nanoseconds and values (N,) of one quantity; NaN where unknown."""
    samples = known.get(name, [])
    values = [numbers[index] for _, numbers in samples]
    return np.array([time_ns for time_ns, _ in samples], np.int64), np.array(values, np.float64)


def stamp_or(message: Any, otherwise_ns: int) -> int:
    """The stamp of a message's header, or another time if there is none or it is not set."""
    return (messages.stamp_ns(message) if hasattr(message, "header") else 0) or otherwise_ns


def _image_topic(path: Path, reader: Any, topic: str | None) -> str:
    names = _topic_names(reader, _IMAGES)
    if topic is None and len(names) == 1:
        return names[0]
    if topic is not None and topic in names:
        return topic
    expected = "one topic with pictures" if topic is None else f"pictures on {topic}"
    hint = "; choose with `image_topic`" if topic is None and names else ""
    raise TelemetryError(f"{path}: expected {expected}, got {', '.join(names) or 'none'}{hint}")


def _topic_names(reader: Any, msgtypes: tuple[str, ...]) -> list[str]:
    return sorted({str(c.topic) for c in reader.connections if c.msgtype in msgtypes and c.msgcount})


def _topic(reader: Any, msgtypes: tuple[str, ...], suffixes: tuple[str, ...]) -> str | None:
    """The first topic of these types whose name has a suffix, best first; an empty suffix excludes truth."""
    for suffix in suffixes:
        for name in _topic_names(reader, msgtypes):
            if name.endswith(suffix) and (suffix or not name.startswith("/truth/")):
                return name
    return None


def _messages(
    path: Path, reader: Any, topics: Collection[str], msgtypes: Collection[str]
) -> Iterator[tuple[str, int, Any]]:
    """Topic, stamp in nanoseconds and message of the given topics, in the order of recording."""
    wanted = [c for c in reader.connections if c.topic in topics and c.msgtype in msgtypes]
    with _readable(path):
        for connection, recorded_ns, data in reader.messages(wanted):
            message = reader.deserialize(data, connection.msgtype)
            yield str(connection.topic), stamp_or(message, recorded_ns), message


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An open reader of the bag."""
    highlevel, typesys = import_rosbags()
    if not path.exists():
        raise TelemetryError(f"{path}: no such bag")
    with _readable(path):
        reader = highlevel.AnyReader([path], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))
        reader.open()
    try:
        yield reader
    finally:
        with suppress(Exception):  # the interpreter may be shutting down, or the bag corrupt
            reader.close()


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Convert whatever rosbags raises on a corrupt bag to a TelemetryError of one line."""
    try:
        yield
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise TelemetryError(f"{path}: expected a bag that can be read: {reason}") from None


def import_rosbags() -> tuple[Any, Any]:
    """Import the modules of rosbags for reading and for types.

    Raises:
        MissingExtraError: rosbags is not installed.
    """
    require("rosbags", "bags")
    return require("rosbags.highlevel", "bags"), require("rosbags.typesys", "bags")
