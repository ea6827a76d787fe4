"""Bags of ROS 1 and ROS 2 (sqlite3, mcap): the pictures, telemetry and calibration of a flight.

Convention:
    Stamps are those of the headers: of capture. A message without a header (std_msgs/Float64), or whose stamp is
    zero, counts from when it was recorded. Frames are named by their index from 0, as those of a video.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import CalibrationError, EngineError, TelemetryError, require
from engine.formats.frames import FrameSource
from engine.formats.resampling import Floats, Log, Series, Stamps, make_log, make_position, make_series
from engine.formats.ros.messages import attitude_of, camera_of, picture_of, position_of, range_of, stamp_ns

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
"""Files that are read as bags, in either case; a folder is one where it holds metadata.yaml."""
IMAGE, CAMERA_INFO = "/camera/image_raw", "/camera/camera_info"
IMU, COMPASS = "/mavros/imu/data", "/mavros/global_position/compass_hdg"
HEIGHT, RANGE = "/mavros/global_position/rel_alt", "/mavros/rangefinder/rangefinder"
VELOCITY, POSITION = "/mavros/local_position/velocity_local", "/mavros/global_position/global"
TRUTH, TRUTH_ATTITUDE = "/truth/fix", "/truth/imu"
TRUTH_HEIGHT, TRUTH_ALTITUDE = "/truth/height_agl", "/truth/alt_amsl"
"""Topics that are written, and preferred where a bag offers several."""

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_FLOAT, _CALIBRATION = "std_msgs/msg/Float64", "sensor_msgs/msg/CameraInfo"

Sample = tuple[int, tuple[float | None, ...]]


def is_bag(path: str | Path) -> bool:
    """Whether a path is a bag, by its ending or, for a folder, by its metadata.yaml."""
    path = Path(path)
    return path.suffix.lower() in BAG_SUFFIXES or (path / "metadata.yaml").is_file()


class BagFrames(FrameSource):
    """The pictures of one topic of a bag, read forward; going back starts again at the first.

    Args:
        path: the bag.
        topic: of the pictures; None for the only one.

    Raises:
        TelemetryError: the bag cannot be read, has no picture, or several topics have and none was named.
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        self.path = path
        with _opened(path) as reader:
            self.topic = _image_topic(path, reader, topic)
            self._stamps_ns = [time_ns for _, time_ns, _ in _messages(path, reader, {self.topic}, _IMAGES)]
        if not self._stamps_ns:
            raise TelemetryError(f"{path}: expected pictures on {self.topic}, got none")
        self.names = [str(index) for index in range(len(self._stamps_ns))]
        self._reset()

    @property
    def described(self) -> str:
        """The indices that there are."""
        return f"an index from 0 to {len(self.names) - 1} of {self.topic}"

    def stamps_ns(self) -> list[int]:
        """When each frame was captured.

        Raises:
            TelemetryError: a frame is not later than the one before it.
        """
        for index, (before, after) in enumerate(itertools.pairwise(self._stamps_ns), start=1):
            if after <= before:
                raise TelemetryError(
                    f"{self.path}: {self.topic}: expected frame {index} after {before / 1e9:.6f} s, "
                    f"got {after / 1e9:.6f} s"
                )
        return list(self._stamps_ns)

    def _reset(self) -> None:
        self._stream, self._next = _pictures(self.path, self.topic), 0
        self._last: tuple[int, NDArray[np.uint8]] | None = None

    def read(self, name: str) -> NDArray[np.uint8]:
        """One frame as (H, W, 3) RGB; cheap where names come in ascending order."""
        self.check(name)
        index = int(name)
        if self._last is None or self._last[0] != index:
            if index < self._next:
                self._reset()
            skipped = index - self._next
            self._next = index + 1
            found = next(itertools.islice(self._stream, skipped, None), None)
            if found is None:
                raise TelemetryError(f"{self.path}: {self.topic}: frame {index} is no longer there")
            try:
                picture = picture_of(found)
            except TelemetryError as error:
                raise TelemetryError(f"{self.path}: {self.topic}: frame {index}: {error}") from None
            rgb = np.repeat(picture[:, :, None], 3, axis=2) if picture.ndim == 2 else picture
            self._last = (index, rgb)
        return self._last[1].copy()


def _pictures(path: Path, topic: str) -> Iterator[Any]:
    """The messages of one topic; the file is closed with the generator."""
    with _opened(path) as reader:
        for _, _, message in _messages(path, reader, {topic}, _IMAGES):
            yield message


def read_bag_camera(path: str | Path, topic: str | None = None) -> Camera:
    """The calibration in a bag: of the camera_info beside the pictures, else the only one.

    Args:
        path: the bag.
        topic: of the pictures; None for the only one.

    Raises:
        TelemetryError: the bag cannot be read, or has none.
        CalibrationError: it is not usable.
    """
    path = Path(path)
    with _opened(path) as reader:
        beside = _image_topic(path, reader, topic).rpartition("/")[0] + "/camera_info"
        found = _topic(reader, _CALIBRATION, (beside, ""))
        first = None if found is None else next(_messages(path, reader, {found}, {_CALIBRATION}), None)
    if first is None:
        raise TelemetryError(f"{path}: expected a sensor_msgs/CameraInfo, got none; name a file with `camera`")
    try:
        return camera_of(first[2])
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def read_bag(path: Path, *, truth: bool = False) -> Log:
    """What a bag says of the vehicle.

    ==========================  ===========================================================================
    ``.../compass_hdg``         heading_deg; without it the Imu's
    sensor_msgs/Imu             roll_deg, pitch_deg
    sensor_msgs/Range           height along the body's down axis
    ``.../rel_alt``             height above take-off
    ``.../velocity_local``      east and north velocity
    sensor_msgs/NavSatFix       the prior
    ==========================  ===========================================================================

    Args:
        path: the bag.
        truth: whether the ``/truth`` topics are read in their places, where there are any.

    Raises:
        TelemetryError: the bag cannot be read, or knows nothing of use.
    """
    with _opened(path) as reader:
        true = truth and _topic(reader, _TAKEN["place"][0], (TRUTH,)) is not None
        endings = _TRUE_ENDINGS if true else _ENDINGS
        found = {name: _topic(reader, _TAKEN[name][0], ends) for name, ends in endings.items()}
        names = {topic: name for name, topic in found.items() if topic is not None}
        known: dict[str, list[Sample]] = {name: [] for name in names.values()}
        kinds = {_TAKEN[name][0] for name in known}
        for topic, time_ns, message in _messages(path, reader, set(names), kinds) if names else ():
            numbers = _TAKEN[names[topic]][1](message)
            if numbers is not None:
                known[names[topic]].append((time_ns, numbers))
    column = _columns(known)
    (place_ns, lat_deg), (_, lon_deg) = column("place", 0), column("place", 1)
    series: dict[str, Series | None] = {
        "roll_deg": make_series(*column("imu", 0)),
        "pitch_deg": make_series(*column("imu", 1)),
        "heading_deg": make_series(*(column("compass", 0) if "compass" in known else column("imu", 2))),
        "alt_amsl_m": make_series(*column("altitude", 0)),
        "east_velocity_mps": make_series(*column("velocity", 0)),
        "north_velocity_mps": make_series(*column("velocity", 1)),
        "sigma_m": make_series(*column("place", 2)),
        **make_position(place_ns, lat_deg, lon_deg),
    }
    heights = {"rangefinder": make_series(*column("range", 0)), "take-off": make_series(*column("height", 0))}
    return make_log(path, series, heights)


_TAKEN: dict[str, tuple[str, Callable[[Any], tuple[float | None, ...] | None]]] = {
    "imu": ("sensor_msgs/msg/Imu", attitude_of),
    "compass": (_FLOAT, lambda message: (message.data,)),
    "range": ("sensor_msgs/msg/Range", lambda message: (range_of(message),)),
    "height": (_FLOAT, lambda message: (message.data,)),
    "altitude": (_FLOAT, lambda message: (message.data,)),
    "velocity": ("geometry_msgs/msg/TwistStamped", lambda m: (m.twist.linear.x, m.twist.linear.y)),
    "place": ("sensor_msgs/msg/NavSatFix", position_of),
}
"""What is read: of which type, and its numbers, or None where a message has none."""
_ENDINGS = {
    "imu": ("/imu/data", ""),
    "compass": ("/compass_hdg",),
    "range": (RANGE, ""),
    "height": ("/rel_alt",),
    "velocity": ("/velocity_local",),
    "place": (POSITION, ""),
}
_TRUE_ENDINGS = {
    "imu": (TRUTH_ATTITUDE,),
    "height": (TRUTH_HEIGHT,),
    "altitude": (TRUTH_ALTITUDE,),
    "place": (TRUTH,),
}


def _columns(known: dict[str, list[Sample]]) -> Callable[[str, int], tuple[Stamps, Floats]]:
    """Stamps (N,) and values (N,), NaN where unknown, of one number of a topic's messages."""

    def column(name: str, at: int) -> tuple[Stamps, Floats]:
        samples = known.get(name, [])
        values = [numbers[at] for _, numbers in samples]
        return np.array([time for time, _ in samples], np.int64), np.array(values, np.float64)

    return column


def _taken_ns(message: Any, recorded_ns: int) -> int:
    return (stamp_ns(message) if hasattr(message, "header") else 0) or recorded_ns


def _image_topic(path: Path, reader: Any, topic: str | None) -> str:
    names = _names(reader, _IMAGES)
    if topic is None and len(names) == 1:
        return names[0]
    if topic is not None and topic in names:
        return topic
    asked = "one topic with pictures" if topic is None else f"pictures on {topic}"
    hint = "; choose with `image_topic`" if topic is None and names else ""
    raise TelemetryError(f"{path}: expected {asked}, got {', '.join(names) or 'none'}{hint}")


def _names(reader: Any, msgtypes: tuple[str, ...]) -> list[str]:
    return sorted({str(c.topic) for c in reader.connections if c.msgtype in msgtypes and c.msgcount})


def _topic(reader: Any, msgtype: str, endings: tuple[str, ...]) -> str | None:
    """The first topic of a type by the endings of its name, the best first; an empty one is any but the truth."""
    for ending in endings:
        for name in _names(reader, (msgtype,)):
            if name.endswith(ending) and (ending or not name.startswith("/truth/")):
                return name
    return None


def _messages(
    path: Path, reader: Any, topics: Collection[str], msgtypes: Collection[str]
) -> Iterator[tuple[str, int, Any]]:
    """Topic, stamp and message of topics, in the order of recording."""
    wanted = [c for c in reader.connections if c.topic in topics and c.msgtype in msgtypes]
    with _readable(path):
        for connection, recorded_ns, data in reader.messages(wanted):
            message = reader.deserialize(data, connection.msgtype)
            yield str(connection.topic), _taken_ns(message, recorded_ns), message


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The bag's reader."""
    highlevel, typesys = import_rosbags()
    if not path.exists():
        raise TelemetryError(f"{path}: no such bag")
    with _readable(path):
        reader = highlevel.AnyReader([path], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))
        reader.open()
    try:
        yield reader
    finally:
        with suppress(Exception):  # it may be the end of the interpreter, and damage may show here again
            reader.close()


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Whatever a damaged bag makes the library raise, as one line."""
    try:
        yield
    except EngineError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise TelemetryError(f"{path}: expected a bag that can be read: {reason}") from None


def import_rosbags() -> tuple[Any, Any]:
    """The library's modules for reading and for types.

    Raises:
        MissingExtraError: it is not installed.
    """
    return require("rosbags.highlevel", "bags"), require("rosbags.typesys", "bags")
