"""Writer of a flight as a bag of ROS 1 or ROS 2 (sqlite3, mcap), with the topics of a camera driver and MAVROS."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from engine.camera import Camera
from engine.errors import OptionError, TelemetryError
from engine.values import Frame, Prior, Truth
from scenematch.files.ros.bags import (
    CAMERA_INFO,
    COMPASS,
    HEIGHT,
    IMAGE,
    IMU,
    POSITION,
    TRUTH,
    TRUTH_ALTITUDE,
    TRUTH_ATTITUDE,
    TRUTH_HEIGHT,
    VELOCITY,
    import_rosbags,
)
from scenematch.files.ros.messages import MessageFactory

BAG_KINDS = ("ros1", "ros2-sqlite3", "ros2-mcap")
"""Kinds of bags that can be written."""

BAG_FILES = {".bag": "ros1", ".db3": "ros2-sqlite3", ".mcap": "ros2-mcap"}
"""Kinds of bags by the suffix of the one file that they can be, in lower or upper case."""

_PART_SUFFIXES = (".db3", ".mcap")
_PARTS = ("metadata.yaml", "*.mcap", "*.db3")  # the files of a ROS 2 bag

Write = Callable[[str, int, Any], None]
"""Writes a message, by topic, time in nanoseconds and message."""


def write_bag(
    path: str | Path,
    frames: Iterable[tuple[Frame, Prior | None]],
    camera: Camera,
    *,
    kind: str,
    truth: Iterable[Truth] = (),
    replace: bool = False,
) -> int:
    """Write a flight as a bag, with the topic names of a camera driver and MAVROS.

    The bag is written to a temporary folder and moved into place when complete; until then an older one stays.

    Args:
        path: a file X.bag for ros1; for the others a folder, or one file X.db3 (ros2-sqlite3) or X.mcap
            (ros2-mcap), which lacks the folder's metadata.yaml.
        frames: stamped frames with their prior positions, consumed one at a time before ``truth``.
        camera: written with every frame; bags have no message for its mount.
        kind: one of :data:`BAG_KINDS`.
        truth: the true states, written under ``/truth``.
        replace: whether an existing bag is replaced.

    Returns:
        The number of frames written.

    Raises:
        OptionError: the kind is unknown or does not match the suffix, or the existing path may not be replaced.
        MissingExtraError: rosbags is not installed.
        TelemetryError: a frame has no stamp, or the bag cannot be written.
    """
    path = Path(path)
    if kind not in BAG_KINDS:
        raise OptionError(f"kind: expected one of {', '.join(BAG_KINDS)}, got {kind!r}")
    check_name(path, kind)
    check_replaceable(path, replace)
    count = 0
    with _replaced(path, replace) as unfinished, _bag_writer(path, unfinished, kind) as (write, messages):
        for frame, prior in frames:
            if frame.timestamp_ns is None:
                raise TelemetryError(f"{path}: frame {count}: expected a stamp, got None")
            _write_frame(write, messages, frame, prior, camera, frame.timestamp_ns)
            count += 1
        for row in truth:
            _write_truth(write, messages, row)
    return count


def check_name(path: Path, kind: str) -> None:
    """Check that the name of a bag goes with its kind.

    Raises:
        OptionError: the suffix is that of another kind, or a bag of ros1 has none.
    """
    of_a_folder = None if kind == "ros1" else kind
    if BAG_FILES.get(path.suffix.lower(), of_a_folder) != kind:
        suffix = next(suffix for suffix, each in BAG_FILES.items() if each == kind)
        wanted = f"a name that ends in {suffix}" + (" or is a folder's" if of_a_folder else "")
        raise OptionError(f"path: expected {wanted} for {kind}, got {path}")


def check_replaceable(path: Path, replace: bool) -> None:
    """Check that a bag can be written to a path.

    Raises:
        OptionError: a bag exists and ``replace`` is off, or a folder contains anything but a bag.
    """
    if not (path.exists() or path.is_symlink()):
        return
    if not replace:
        raise OptionError(f"path: {path} exists; choose another name, or add `replace` to replace it")
    if path.is_dir():
        parts = {file for pattern in _PARTS for file in path.glob(pattern)}
        others = sorted(set(path.iterdir()) - parts)
        if others or path.is_symlink():
            cause = f"it also contains {others[0].name}" if others else "it is a link"
            raise OptionError(f"path: expected a bag in {path} to replace, but {cause}")


@contextmanager
def _replaced(path: Path, replace: bool) -> Iterator[Path]:
    """A temporary path for a new bag, which replaces the older one when the block succeeds."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A folder of its own beside the target: the files of a bag contain its name.
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=path.parent) as folder:
            is_part = path.suffix.lower() in _PART_SUFFIXES  # of a ROS 2 bag, whose files have the folder's name
            unfinished = Path(folder) / (path.stem if is_part else path.name)
            yield unfinished
            if is_part:
                unfinished = next(unfinished.glob(f"*{path.suffix.lower()}"))
            check_replaceable(path, replace)  # once more: writing takes time
            older = Path(folder) / "older"
            if path.exists():
                path.rename(older)
            try:
                unfinished.rename(path)
            except OSError:
                if older.exists():
                    older.rename(path)
                raise
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be written: {error}") from None


def _write_frame(
    write: Write, messages: MessageFactory, frame: Frame, prior: Prior | None, camera: Camera, time_ns: int
) -> None:
    image = frame.image if isinstance(frame.image, np.ndarray) else frame.image.cpu().numpy()
    write(IMAGE, time_ns, messages.image(time_ns, "camera", image))
    write(CAMERA_INFO, time_ns, messages.camera_info(time_ns, "camera", camera))
    angles = frame.roll_deg, frame.pitch_deg, frame.heading_deg
    if None not in angles:
        write(IMU, time_ns, messages.imu(time_ns, "base_link", *angles))  # type: ignore[arg-type]
    if frame.heading_deg is not None:
        write(COMPASS, time_ns, messages.float64(frame.heading_deg))
    if frame.height_agl_m is not None:
        write(HEIGHT, time_ns, messages.float64(frame.height_agl_m))
    if frame.east_velocity_mps is not None and frame.north_velocity_mps is not None:
        velocity = messages.velocity(time_ns, "map", frame.east_velocity_mps, frame.north_velocity_mps)
        write(VELOCITY, time_ns, velocity)
    if prior is not None and prior.lat_deg is not None and prior.lon_deg is not None:
        covariance_m2 = np.diag([prior.sigma_m**2, prior.sigma_m**2, 0.0])
        position = messages.position(time_ns, "base_link", prior.lat_deg, prior.lon_deg, covariance_m2)
        write(POSITION, time_ns, position)


def _write_truth(write: Write, messages: MessageFactory, row: Truth) -> None:
    time_ns = row.timestamp_ns
    write(TRUTH, time_ns, messages.position(time_ns, "base_link", row.lat_deg, row.lon_deg, np.zeros((3, 3))))
    angles = row.roll_deg, row.pitch_deg, row.heading_deg
    if None not in angles:
        write(TRUTH_ATTITUDE, time_ns, messages.imu(time_ns, "base_link", *angles))  # type: ignore[arg-type]
    if row.height_agl_m is not None:
        write(TRUTH_HEIGHT, time_ns, messages.float64(row.height_agl_m))
    if row.alt_amsl_m is not None:
        write(TRUTH_ALTITUDE, time_ns, messages.float64(row.alt_amsl_m))


@contextmanager
def _bag_writer(path: Path, unfinished: Path, kind: str) -> Iterator[tuple[Write, MessageFactory]]:
    """A function that writes messages to a new bag, and their factory; errors name ``path``."""
    _, typesys = import_rosbags()
    from rosbags import rosbag1, rosbag2

    ros1 = kind == "ros1"
    types = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if ros1 else typesys.Stores.ROS2_HUMBLE)
    serialize = types.serialize_ros1 if ros1 else types.serialize_cdr
    plugin = rosbag2.StoragePlugin.SQLITE3 if kind == "ros2-sqlite3" else rosbag2.StoragePlugin.MCAP
    connections: dict[str, Any] = {}
    try:
        writer: Any
        if ros1:
            writer = rosbag1.Writer(unfinished)
        else:
            writer = rosbag2.Writer(unfinished, version=9, storage_plugin=plugin)
        with writer:

            def write(topic: str, time_ns: int, message: Any) -> None:
                name = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, name, typestore=types)
                writer.write(connections[topic], time_ns, bytes(serialize(message, name)))

            yield write, MessageFactory(types.types.__getitem__, ros1)
    except (OSError, rosbag1.WriterError, rosbag2.WriterError) as error:
        raise TelemetryError(f"{path}: cannot be written: {error}") from None
