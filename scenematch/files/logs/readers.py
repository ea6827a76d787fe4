"""Flight logs: the reader of each file type, and the capture times of frames on the log's clock."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np

from engine.errors import TelemetryError
from engine.values import Truth
from scenematch.files.frames import FrameSource, VideoFile
from scenematch.files.logs.dataflash import read_dataflash
from scenematch.files.logs.dji_srt import read_srt
from scenematch.files.logs.ulog import read_ulog
from scenematch.files.photos import photo_telemetry, photo_truth
from scenematch.files.resampling import UTC_FROM_NS, FlightLog, TimeSeries, truth_from_log
from scenematch.files.ros.bags import BagFrames, is_bag, read_bag
from scenematch.files.telemetry import read_telemetry
from scenematch.files.truth import read_truth

_READERS = {".bin": read_dataflash, ".ulg": read_ulog, ".srt": read_srt}
LOG_SUFFIXES = tuple(_READERS)
"""Suffixes of flight logs, in lower or upper case."""
# Of a video's frames: if fewer are numbered without a gap, they were extracted at another rate.
_SHARE_OF_ALL = 0.9


def is_log(path: str | Path) -> bool:
    """Whether a path is a flight log or a bag, by its suffix."""
    return Path(path).suffix.lower() in LOG_SUFFIXES or is_bag(path)


def is_photographs(path: str | Path) -> bool:
    """Whether a path is a folder but not a bag."""
    return Path(path).is_dir() and not is_bag(path)


def open_log(path: str | Path, odometry_topic: str | None = None) -> FlightLog:
    """Read a flight log: ArduPilot's DataFlash (.BIN), PX4's ULog (.ulg), DJI's subtitles (.SRT), or a bag of ROS.

    Args:
        path: the file.
        odometry_topic: topic of a bag with the velocity from another camera's odometry.

    Raises:
        TelemetryError: the file cannot be read, is none of these, or has no usable series.
    """
    path = Path(path)
    try:
        if is_bag(path):
            return read_bag(path, odometry_topic=odometry_topic)
        if path.stat().st_size == 0:
            raise TelemetryError(f"{path}: expected a flight log, got an empty file")
        return _READERS[path.suffix.lower()](path)
    except KeyError:
        raise TelemetryError(f"{path}: expected a log named {', '.join(LOG_SUFFIXES)}") from None
    except FileNotFoundError:
        raise TelemetryError(f"{path}: no such file") from None
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be read: {error.strerror or error}") from None


def stamp_frames(source: FrameSource, log: FlightLog, stamps: Path | None = None) -> tuple[list[int], list[str]]:
    """Capture time and name of each frame, in the order of time.

    Args:
        source: the frames.
        log: the flight log.
        stamps: CSV file with ``timestamp_ns`` and ``frame``; None uses the times of the video or bag, the numbers
            of a video's frames in the pictures' names, the log's camera messages, or the photographs' EXIF.

    Returns:
        Stamps in nanoseconds, on the log's clock or in UTC, and names.

    Raises:
        TelemetryError: there are no capture times, or the number of camera messages differs from that of images.
    """
    if stamps is not None:
        rows = read_telemetry(stamps, source, source.description)
        return [row.timestamp_ns for row in rows], [row.frame for row in rows]
    if isinstance(source, (VideoFile, BagFrames)):
        stamps_ns = source.stamps_ns()
        return stamps_ns, source.names[: len(stamps_ns)]
    if log.frame_numbers is not None:
        return _stamps_by_number(source, log, log.frame_numbers)
    if log.captures_ns.size:
        if log.captures_ns.size != len(source.names):
            raise TelemetryError(
                f"{log.path}: expected a camera message for each of {len(source.names)} pictures, got "
                f"{log.captures_ns.size}; give their times with `frame_stamps`"
            )
        return [int(stamp_ns) for stamp_ns in log.captures_ns], list(source.names)
    rows, _ = photo_telemetry([source.path / name for name in source.names])
    if not rows:
        raise TelemetryError(
            f"{log.path}: expected to know when the pictures were taken: it has no camera messages, they have no "
            "EXIF times, and no `frame_stamps` was given"
        )
    return [row.timestamp_ns for row in rows], [row.frame for row in rows]


def _stamps_by_number(source: FrameSource, log: FlightLog, numbers: TimeSeries) -> tuple[list[int], list[str]]:
    """Times of pictures that were extracted from a video, by the number of the frame in their names.

    If there is a picture 0, the first frame is 0, as OpenCV counts; else it is 1, as ffmpeg counts.
    """
    found = [re.findall(r"[0-9]+", Path(name).stem) for name in source.names]
    numbered = sorted((int(digits[-1]), name) for digits, name in zip(found, source.names, strict=True) if digits)
    asked = "expected pictures with the numbers of the video's frames in their names, or `frame_stamps`"
    if len(numbered) < len(found) or any(a[0] == b[0] for a, b in itertools.pairwise(numbered)):
        raise TelemetryError(f"{log.path}: {asked}, got {source.names[0]} to {source.names[-1]}")
    first, last = numbered[0][0], numbered[-1][0]
    from_1 = 1 if first == 0 else 0
    count = int(numbers.values[-1])
    if last + from_1 > count + 1:
        raise TelemetryError(f"{log.path}: {asked}, got number {last} for a video of {count} frames")
    if last - first + 1 == len(numbered) < _SHARE_OF_ALL * count and len(numbered) > 1:
        raise TelemetryError(
            f"{log.path}: {asked}, got {first} to {last} without a gap for a video of {count} frames: pictures "
            "extracted at another rate are not numbered like its frames"
        )
    at = np.array([number + from_1 for number, _ in numbered], np.float64)
    begin_ns = int(numbers.stamps_ns[0])
    offsets_ns = np.interp(at, numbers.values, (numbers.stamps_ns - begin_ns).astype(np.float64))
    return [begin_ns + round(float(offset_ns)) for offset_ns in offsets_ns], [name for _, name in numbered]


def open_truth(path: str | Path, stamp_ns: int | None = None) -> list[Truth]:
    """Read truth from truth.csv, or from the positions of a log; from a bag's ``/truth`` topics if it has them.

    Args:
        path: truth.csv, a log, or a folder of photographs whose EXIF has positions.
        stamp_ns: a timestamp of the frames; if it is UTC, the truth of a log is converted to UTC.

    Raises:
        TelemetryError: the file cannot be read or has no positions.
    """
    if is_photographs(path):
        return photo_truth(Path(path))
    if not is_log(path):
        return read_truth(path)
    log = read_bag(Path(path), truth=True) if is_bag(path) else open_log(path)
    return truth_from_log(log, utc=stamp_ns is not None and stamp_ns >= UTC_FROM_NS)
