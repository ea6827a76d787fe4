"""Flight logs: the reader of each file type, and the capture times of frames on the log's clock."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from engine.errors import OptionError, TelemetryError
from engine.formats.frames import FrameSource, VideoFile
from engine.formats.logs.dataflash import read_dataflash
from engine.formats.logs.dji_srt import read_srt
from engine.formats.logs.ulog import read_ulog
from engine.formats.photos import exif_telemetry
from engine.formats.resampling import UTC_FROM_NS, FlightLog, truth_from_log
from engine.formats.ros.bags import BagFrames, is_bag, read_bag
from engine.formats.telemetry import read_telemetry
from engine.formats.truth import read_truth
from engine.values import Truth

_READERS = {".bin": read_dataflash, ".ulg": read_ulog, ".srt": read_srt}
LOG_SUFFIXES = tuple(_READERS)
"""Suffixes of flight logs, in lower or upper case."""


@dataclass(frozen=True, slots=True)
class LogClock:
    """Source of the capture times of a flight whose telemetry is a log.

    Attributes:
        stamps: CSV file with ``timestamp_ns`` and ``frame``; None uses the times of the video or bag, the log's
            camera messages, or the photographs' EXIF.
        offset_s: added to every frame's stamp.

    Raises:
        OptionError: the offset is not finite.
    """

    stamps: Path | None = None
    offset_s: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.offset_s) and abs(self.offset_s) < 9e9):
            raise OptionError(f"offset_s: expected finite seconds, got {self.offset_s}")


AS_LOGGED = LogClock()
"""The frames' own stamps, without offset."""


def is_log(path: str | Path) -> bool:
    """Whether a path is a flight log or a bag, by its suffix."""
    return Path(path).suffix.lower() in LOG_SUFFIXES or is_bag(path)


def open_log(path: str | Path) -> FlightLog:
    """Read a flight log: ArduPilot's DataFlash (.BIN), PX4's ULog (.ulg), DJI's subtitles (.SRT), or a bag of ROS.

    Raises:
        TelemetryError: the file cannot be read, is none of these, or has no usable series.
    """
    path = Path(path)
    try:
        if is_bag(path):
            return read_bag(path)
        if path.stat().st_size == 0:
            raise TelemetryError(f"{path}: expected a flight log, got an empty file")
        return _READERS[path.suffix.lower()](path)
    except KeyError:
        raise TelemetryError(f"{path}: expected a log named {', '.join(LOG_SUFFIXES)}") from None
    except FileNotFoundError:
        raise TelemetryError(f"{path}: no such file") from None
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be read: {error.strerror or error}") from None


def stamp_frames(source: FrameSource, log: FlightLog, clock: LogClock = AS_LOGGED) -> tuple[list[int], list[str]]:
    """Capture time and name of each frame, in the order of time.

    Args:
        source: the frames.
        log: the flight log.
        clock: source of the times, and their offset.

    Returns:
        Stamps in nanoseconds, on the log's clock or in UTC, and names.

    Raises:
        TelemetryError: there are no capture times, or the number of camera messages differs from that of images.
    """
    stamps_ns, names = _unshifted_stamps(source, log, clock)
    offset_ns = round(clock.offset_s * 1e9)
    return [stamp_ns + offset_ns for stamp_ns in stamps_ns], names


def _unshifted_stamps(source: FrameSource, log: FlightLog, clock: LogClock) -> tuple[list[int], list[str]]:
    if clock.stamps is not None:
        rows = read_telemetry(clock.stamps, source, source.description)
        return [row.timestamp_ns for row in rows], [row.frame for row in rows]
    if isinstance(source, (VideoFile, BagFrames)):
        stamps_ns = source.stamps_ns()
        return stamps_ns, source.names[: len(stamps_ns)]
    if log.captures_ns.size:
        if log.captures_ns.size != len(source.names):
            raise TelemetryError(
                f"{log.path}: expected a camera message for each of {len(source.names)} pictures, got "
                f"{log.captures_ns.size}; say when they were taken with `frame_stamps`"
            )
        return [int(stamp_ns) for stamp_ns in log.captures_ns], list(source.names)
    rows = exif_telemetry([source.path / name for name in source.names])
    if not rows:
        raise TelemetryError(
            f"{log.path}: expected to know when the pictures were taken: it has no camera messages, they have no "
            "EXIF times, and no `frame_stamps` was given"
        )
    return [row.timestamp_ns for row in rows], [row.frame for row in rows]


def open_truth(path: str | Path, stamp_ns: int | None = None) -> list[Truth]:
    """Read truth from truth.csv, or from the positions of a log; from a bag's ``/truth`` topics where it has them.

    Args:
        path: truth.csv or a log.
        stamp_ns: a stamp of the frames; where it is UTC, the truth of a log is converted to UTC.

    Raises:
        TelemetryError: the file cannot be read or has no positions.
    """
    if not is_log(path):
        return read_truth(path)
    log = read_bag(Path(path), truth=True) if is_bag(path) else open_log(path)
    return truth_from_log(log, utc=stamp_ns is not None and stamp_ns >= UTC_FROM_NS)
