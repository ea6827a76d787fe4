"""track.csv: the result of every frame, one row each, written during the run.

notes.csv has details of the same frames that track.csv lacks, needed to redraw a report.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from engine.values import Fix, NoFix, Reason
from scenematch.files.tables import Bounds, CsvRow, cell_text, cells_of, read_table, write_table
from scenematch.files.telemetry import BOUNDS

__all__ = ["TrackRow", "read_track", "track_row", "with_notes", "write_notes", "write_track"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackRow:
    """The result of one frame; what is unknown is None.

    The fields are the columns of track.csv, then those of notes.csv, in their order.

    Attributes:
        timestamp_ns: capture time of the frame.
        frame: name of the frame.
        status: "fix" or "no_fix".
        reason: value of :class:`engine.values.Reason` if refused.
        lat_deg: WGS84 latitude of the camera.
        lon_deg: WGS84 longitude of the camera.
        east_m: east of the map's origin.
        north_m: north of the map's origin.
        up_m: height in the surface model's datum.
        sigma_east_m: standard deviation east.
        sigma_north_m: standard deviation north.
        covariance_en_m2: covariance of east and north.
        score: NCC, or the ratio of inliers for matched points.
        method: "ncc", "sift" or "learned".
        window_width_px: width of the map window that was searched.
        window_height_px: height of the map window that was searched.
        latency_ms: from the frame's arrival to its result.
        deadline_met: whether the result came within the budget; None without a budget.
        state: state of the navigator after the frame, see :class:`engine.navigation.navigator.NavigatorState`.
        window_x0_px: first column of the map window that was searched.
        window_y0_px: first row of the map window that was searched.
        heading_deg: heading of the match, clockwise from true north.
        stage: last stage of the search that the budget allowed.
        confidence: probability that the fix is correct.
        detail: one sentence with figures on why the frame was refused.
        sigma_up_m: standard deviation of the height, if it was measured.
        roll_deg: roll of the whole pose, if measured; positive right side down.
        pitch_deg: the same; positive nose up.
        roll_sigma_deg: standard deviation of the roll, if known; so are the next two.
        pitch_sigma_deg: of the pitch.
        heading_sigma_deg: of the heading.
        protection_level_m: radius that contains the vehicle except with a probability of at most 1e-4; None if no
            bound holds.
        looks: the looks at the frame with the evidence after each, in nats.
        alt_amsl_m: height above mean sea level, which neither file has; an export may know it.
    """

    timestamp_ns: int | None
    frame: str
    status: str
    reason: str | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    east_m: float | None = None
    north_m: float | None = None
    up_m: float | None = None
    sigma_east_m: float | None = None
    sigma_north_m: float | None = None
    covariance_en_m2: float | None = None
    score: float | None = None
    method: str | None = None
    window_width_px: int | None = None
    window_height_px: int | None = None
    latency_ms: float | None = None
    deadline_met: bool | None = None
    state: str | None = None
    window_x0_px: int | None = None
    window_y0_px: int | None = None
    heading_deg: float | None = None
    stage: str | None = None
    confidence: float | None = None
    detail: str | None = None
    sigma_up_m: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    roll_sigma_deg: float | None = None
    pitch_sigma_deg: float | None = None
    heading_sigma_deg: float | None = None
    protection_level_m: float | None = None
    looks: str | None = None
    alt_amsl_m: float | None = None

    @property
    def fixed(self) -> bool:
        """Whether the frame has a position fix."""
        return self.status == "fix"


_NAMES = tuple(f.name for f in fields(TrackRow))
COLUMNS = _NAMES[: _NAMES.index("state")]
"""The header of track.csv."""
NOTE_COLUMNS = ("frame", *_NAMES[len(COLUMNS) : -1])
"""The header of notes.csv."""
_LATER = NOTE_COLUMNS[NOTE_COLUMNS.index("sigma_up_m") :]  # columns of notes.csv that older runs lack
_OF_A_FIX = ("lat_deg", "lon_deg", "east_m", "north_m", "up_m", "confidence")  # columns that a Fix has by name
_ANGLE_SIGMAS = ("roll_sigma_deg", "pitch_sigma_deg", "heading_sigma_deg")
_POSITION = ("lat_deg", "lon_deg", "east_m", "north_m", "sigma_east_m", "sigma_north_m", "covariance_en_m2")
_NOT_NEGATIVE = Bounds(0.0, math.inf, "a finite number of 0 or more")
_BOUNDS = {name: BOUNDS[name] for name in ("lat_deg", "lon_deg")}
_BOUNDS |= dict.fromkeys(("sigma_east_m", "sigma_north_m", "latency_ms"), _NOT_NEGATIVE)
_DECIMALS = {"lat_deg": 9, "lon_deg": 9, "covariance_en_m2": 6} | dict.fromkeys(
    ("east_m", "north_m", "up_m", "latency_ms"), 3
)


def track_row(
    name: str,
    result: Fix | NoFix,
    *,
    latency_ms: float | None,
    deadline_met: bool | None,
    state: str | None = None,
) -> TrackRow:
    """The row of one frame's result.

    Args:
        name: name of the frame.
        result: the fix or the refusal.
        latency_ms: time from the frame's arrival to its result.
        deadline_met: whether that was within the budget; None without a budget.
        state: state of the navigator after it.
    """
    window = result.window
    row = TrackRow(
        timestamp_ns=result.timestamp_ns,
        frame=name,
        status="no_fix" if isinstance(result, NoFix) else "fix",
        score=_number(result.score),
        method=result.method,
        window_width_px=None if window is None else window.width_px,
        window_height_px=None if window is None else window.height_px,
        window_x0_px=None if window is None else window.x0,
        window_y0_px=None if window is None else window.y0,
        latency_ms=latency_ms,
        deadline_met=deadline_met,
        state=state,
        looks=looks_text(result) or None,
    )
    if isinstance(result, NoFix):
        return replace(row, reason=result.reason.value, detail=result.detail or None)
    return _with_fix(row, result)


def looks_text(result: Fix | NoFix) -> str:
    """The looks at a frame with the evidence after each, in nats."""
    return "; ".join(map(str, result.looks))


def _number(value: float | None) -> float | None:
    """A number of NumPy's as Python's."""
    return None if value is None else float(value)


def _with_fix(row: TrackRow, result: Fix) -> TrackRow:
    """The row with what only a fix has."""
    covariance, level_m = result.covariance_m2, result.protection_level_m()
    # If no height was measured, roll and pitch are the telemetry's or unknown.
    tilt = None if result.up_m is None else result.attitude
    numbers: dict[str, Any] = {name: _number(getattr(result, name)) for name in _OF_A_FIX}
    if result.attitude_sigma_deg is not None:
        numbers |= zip(_ANGLE_SIGMAS, result.attitude_sigma_deg, strict=True)
    return replace(
        row,
        **numbers,
        sigma_east_m=math.sqrt(covariance[0, 0]),
        sigma_north_m=math.sqrt(covariance[1, 1]),
        covariance_en_m2=float(covariance[0, 1]),
        heading_deg=None if result.attitude is None else float(result.attitude.heading_deg),
        stage=result.stage,
        sigma_up_m=None if result.up_m is None else math.sqrt(covariance[2, 2]),
        roll_deg=None if tilt is None else float(tilt.roll_deg),
        pitch_deg=None if tilt is None else float(tilt.pitch_deg),
        protection_level_m=level_m if math.isfinite(level_m) else None,
    )


def write_track(path: str | Path, rows: Iterable[TrackRow]) -> list[TrackRow]:
    """Write track.csv: degrees to 9 decimals, metres to 3, sigmas and scores to 4.

    Each row is on disk before the next is asked for, so that an interrupted run keeps its rows.

    Returns:
        The rows.

    Raises:
        TelemetryError: the file cannot be written.
    """
    written: list[TrackRow] = []

    def cells(row: TrackRow) -> list[str]:
        written.append(row)
        return [cell_text(getattr(row, name), _DECIMALS.get(name, 4)) for name in COLUMNS]

    write_table(path, COLUMNS, map(cells, rows))
    return written


def read_track(path: str | Path) -> list[TrackRow]:
    """Read track.csv; a run that was interrupted before its first frame has no rows.

    Raises:
        TelemetryError: the file cannot be read, or a row is invalid: the message has line and column.
    """
    return [_row(csv_row) for csv_row in read_table(path, COLUMNS)]


def _row(csv_row: CsvRow) -> TrackRow:
    status, reason = csv_row.text("status"), csv_row.values["reason"]
    if status not in ("fix", "no_fix"):
        raise csv_row.error("status", "fix or no_fix")
    if reason and reason not in {known.value for known in Reason}:
        raise csv_row.error("reason", "a known reason or nothing")
    if csv_row.values["deadline_met"] not in ("", "true", "false"):
        raise csv_row.error("deadline_met", "true, false or nothing")
    for column in _POSITION:
        if status == "fix" and not csv_row.values[column]:
            raise csv_row.error(column, "a number, since the row is a fix")
    return TrackRow(**cells_of(TrackRow, csv_row, _BOUNDS))


def write_notes(path: str | Path, rows: Iterable[TrackRow]) -> None:
    """Write notes.csv.

    Raises:
        TelemetryError: the file cannot be written.
    """
    write_table(path, NOTE_COLUMNS, ([cell_text(getattr(row, name), 4) for name in NOTE_COLUMNS] for row in rows))


def with_notes(rows: Iterable[TrackRow], path: str | Path) -> list[TrackRow]:
    """The rows of a track with what notes.csv says of their frames; without that file as they are.

    Raises:
        TelemetryError: the file cannot be read, or a cell is not what its column holds.
    """
    if not Path(path).is_file():
        return list(rows)
    required = [name for name in NOTE_COLUMNS if name not in _LATER]
    notes = {csv_row.text("frame"): csv_row for csv_row in read_table(path, required, _LATER)}
    return [replace(row, **cells_of(TrackRow, notes[row.frame])) if row.frame in notes else row for row in rows]
