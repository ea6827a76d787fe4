"""DJI's subtitles (.SRT): telemetry that a drone writes beside its video, one cue per frame or second.

Convention:
    The clock is the video's, from its first frame. Cues name their frame (FrameCnt) or come once per frame; cues
    of a second each match one extracted picture each. Both syntaxes are supported: ``[latitude: ..] [longitude:
        ..] [rel_alt: .. abs_alt: ..] [gb_yaw: ..]``, and ``GPS(lon, lat, ..)
    BAROMETER: ..`` or ``H ..m``. Heights are above the take-off point. The third number of GPS() is an altitude on
    some models and a count of satellites on others, and is ignored; so is HOME(). Gimbal angles of only zeros mean
    no gimbal.
"""

from __future__ import annotations

import itertools
import math
import re
import statistics
from pathlib import Path

from engine.errors import TelemetryError
from scenematch.files.photos import gimbal_columns
from scenematch.files.resampling import FlightLog, TimeSeries, make_position_series, make_series

_NUMBER = r"([+-]?[0-9]{1,18}(?:\.[0-9]{1,18})?)"
_TIME = r"([0-9]{1,3}):([0-9]{2}):([0-9]{2})[,.]([0-9]{3})"
# Every repetition is bounded, so that matching takes linear time on any input.
_CUE = re.compile(rf"^[ \t]{{0,8}}{_TIME}[ \t]{{0,8}}-->[ \t]{{0,8}}{_TIME}.*$", re.MULTILINE)
_PAIR = re.compile(rf"\b([A-Za-z_.]{{1,20}})[ \t]{{0,3}}[: ][ \t]{{0,3}}{_NUMBER}")
_GPS = re.compile(rf"\bGPS ?\( ?{_NUMBER} ?, ?{_NUMBER} ?(?:,[^)]{{0,40}})?\)")
_HEIGHT = re.compile(rf"\bBAROMETER ?: ?{_NUMBER}|\bH {_NUMBER} ?m\b")
_MARKUP = re.compile(r"<[^>]{0,200}>")
_MAX_FRAME_NS = 120_000_000  # between two frames of a video; cues further apart come about once a second
_ANGLES = ("gb_roll", "gb_pitch", "gb_yaw")
_GIMBAL_COLUMNS = ("roll_deg", "pitch_deg", "heading_deg", "heading_sigma_deg", "tilt_sigma_deg")


def read_srt(path: Path) -> FlightLog:
    """Read the telemetry in a video's subtitles.

    Raises:
        TelemetryError: the file is not UTF-8 text, has no cues, or its cues have no telemetry.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise TelemetryError(
            f"{path}: expected subtitles as UTF-8 text, got the byte {error.object[error.start]:#04x}"
        ) from None
    starts = list(_CUE.finditer(text))
    if not starts:
        raise TelemetryError(f"{path}: expected subtitles with 00:00:00,000 --> 00:00:00,033, got none")
    ends = [match.start() for match in starts[1:]] + [len(text)]
    cues = [_values(text[match.end() : end]) for match, end in zip(starts, ends, strict=True)]
    stamps_ns = [_time_ns(match) for match in starts]

    def numbers(name: str) -> list[float]:
        return [cue.get(name, math.nan) for cue in cues]

    def series(name: str) -> TimeSeries | None:
        return make_series(stamps_ns, numbers(name))

    positions = make_position_series(stamps_ns, numbers("latitude"), numbers("longitude"))
    angles = {name: series(name) for name in _GIMBAL_COLUMNS}
    known = angles | {"alt_amsl_m": series("abs_alt")} | positions
    frame_numbers = _frame_numbers(stamps_ns, [cue.get("framecnt") for cue in cues])
    captures_ns = stamps_ns if frame_numbers is None else []
    return FlightLog(path, known, {"take-off": series("rel_alt")}, captures_ns, frame_numbers=frame_numbers)


def _frame_numbers(stamps_ns: list[int], counts: list[float | None]) -> TimeSeries | None:
    """Number of the video's frame at each cue, from 1; None if cues do not state it."""
    if all(count is not None for count in counts) and len(counts) > 1:
        known = [count for count in counts if count is not None]
        if all(a < b for a, b in itertools.pairwise(known)):
            return make_series(stamps_ns, [count - known[0] + 1.0 for count in known])
    steps_ns = [b - a for a, b in itertools.pairwise(stamps_ns)]
    if steps_ns and statistics.median(steps_ns) <= _MAX_FRAME_NS:
        return make_series(stamps_ns, [float(i) for i in range(1, len(stamps_ns) + 1)])
    return None


def _time_ns(match: re.Match[str]) -> int:
    hours, minutes, seconds, milliseconds = (int(part) for part in match.groups()[:4])
    return (((hours * 60 + minutes) * 60 + seconds) * 1000 + milliseconds) * 1_000_000


def _values(cue: str) -> dict[str, float]:
    """Numbers of one cue by name; those of the older syntax under the names of the newer one."""
    cue = _MARKUP.sub(" ", cue)
    values = {key.lower(): float(value) for key, value in _PAIR.findall(cue)}
    if "longtitude" in values:  # misspelled by some models
        values["longitude"] = values["longtitude"]
    if gps := _GPS.search(cue):
        values["longitude"], values["latitude"] = float(gps.group(1)), float(gps.group(2))
    if "rel_alt" not in values and (height := _HEIGHT.search(cue)):
        values["rel_alt"] = float(height.group(1) or height.group(2))
    return values | gimbal_columns(values, _ANGLES)
