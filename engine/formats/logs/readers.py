"""Flight logs: which reader a file is given, and when each frame was taken on the log's clock."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from engine.errors import OptionError, TelemetryError
from engine.formats.frames import FrameSource, VideoFile, exif_telemetry
from engine.formats.logs.dataflash import read_dataflash
from engine.formats.logs.dji_srt import read_srt
from engine.formats.logs.ulog import read_ulog
from engine.formats.resampling import EPOCH_NS, Log, truth_of
from engine.formats.ros.bags import BagFrames, is_bag, read_bag
from engine.formats.telemetry import read_telemetry
from engine.formats.truth import read_truth
from engine.values import Truth

_READERS = {".bin": read_dataflash, ".ulg": read_ulog, ".srt": read_srt}
LOG_SUFFIXES = tuple(_READERS)
"""Files that are read as logs, in either case."""


@dataclass(frozen=True, slots=True)
class LogClock:
    """When the frames of a flight with a log were taken.

    Attributes:
        stamps: a CSV with ``timestamp_ns`` and ``frame``; without it the video's or bag's own times, the log's
            camera messages or the photographs' EXIF.
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
"""The frames' own stamps, as they are."""


def is_log(path: str | Path) -> bool:
    """Whether a path is a flight log or a bag, by its ending."""
    return Path(path).suffix.lower() in LOG_SUFFIXES or is_bag(path)


def open_log(path: str | Path) -> Log:
    """Read a flight log: ArduPilot's DataFlash (.BIN), PX4's ULog (.ulg), DJI's subtitles (.SRT), or a bag of ROS.

    Raises:
        TelemetryError: the file cannot be read, is none of them, or knows nothing of use.
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


def stamp_frames(source: FrameSource, log: Log, clock: LogClock = AS_LOGGED) -> tuple[list[int], list[str]]:
    """When each frame was taken, and its name, in the order of time.

    Returns:
        tuple[list[int], list[str]]: stamps in nanoseconds, on the log's clock or in UTC, and names.

    Raises:
        TelemetryError: nothing says when the frames were taken, or the log's camera messages are not as many.
    """
    stamps_ns, names = _own_stamps(source, log, clock)
    offset_ns = round(clock.offset_s * 1e9)
    return [stamp_ns + offset_ns for stamp_ns in stamps_ns], names


def _own_stamps(source: FrameSource, log: Log, clock: LogClock) -> tuple[list[int], list[str]]:
    if clock.stamps is not None:
        rows = read_telemetry(clock.stamps, source, source.described)
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
    """Truth from truth.csv, or a log's own positions; of a bag those under ``/truth``, where it has them.

    Args:
        path: truth.csv or a log.
        stamp_ns: a stamp of the frames: where it is UTC, a log's truth is put there too.

    Raises:
        TelemetryError: the file cannot be read or has no positions.
    """
    if not is_log(path):
        return read_truth(path)
    log = read_bag(Path(path), truth=True) if is_bag(path) else open_log(path)
    return truth_of(log, utc=stamp_ns is not None and stamp_ns >= EPOCH_NS)
