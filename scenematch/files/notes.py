"""notes.csv: details of each frame that track.csv lacks, needed to redraw a report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path

from engine.values import Fix, NoFix
from scenematch.files.tables import cell_text, cells_of, read_table, write_table


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameNote:
    """One row of notes.csv; what is unknown is None. The fields are the columns, in their order.

    Attributes:
        frame: name of the frame.
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
    """

    frame: str
    state: str
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


COLUMNS = tuple(f.name for f in fields(FrameNote))
"""The header of notes.csv."""
_LATER = COLUMNS[COLUMNS.index("sigma_up_m") :]  # columns that older runs lack


def frame_note(name: str, result: Fix | NoFix, state: str) -> FrameNote:
    """The note of one frame's result.

    Args:
        name: name of the frame.
        result: the fix or the refusal.
        state: state of the navigator after it.
    """
    x0, y0 = (None, None) if result.window is None else (result.window.x0, result.window.y0)
    if isinstance(result, NoFix):
        return FrameNote(frame=name, state=state, window_x0_px=x0, window_y0_px=y0, detail=result.detail or None)
    # If no height was measured, roll and pitch are the telemetry's or unknown.
    tilt = None if result.up_m is None else result.attitude
    level_m = result.protection_level_m()
    roll_sigma_deg, pitch_sigma_deg, heading_sigma_deg = result.attitude_sigma_deg or (None, None, None)
    return FrameNote(
        frame=name,
        state=state,
        window_x0_px=x0,
        window_y0_px=y0,
        heading_deg=None if result.attitude is None else float(result.attitude.heading_deg),
        sigma_up_m=None if result.up_m is None else math.sqrt(result.covariance_m2[2, 2]),
        roll_deg=None if tilt is None else float(tilt.roll_deg),
        pitch_deg=None if tilt is None else float(tilt.pitch_deg),
        roll_sigma_deg=roll_sigma_deg,
        pitch_sigma_deg=pitch_sigma_deg,
        heading_sigma_deg=heading_sigma_deg,
        stage=result.stage,
        confidence=None if result.confidence is None else float(result.confidence),
        protection_level_m=level_m if math.isfinite(level_m) else None,
    )


def write_notes(path: str | Path, notes: Iterable[FrameNote]) -> None:
    """Write notes.csv.

    Raises:
        TelemetryError: the file cannot be written.
    """
    write_table(path, COLUMNS, ([cell_text(getattr(note, name), 4) for name in COLUMNS] for note in notes))


def read_notes(path: str | Path) -> list[FrameNote]:
    """Read notes.csv.

    Raises:
        TelemetryError: the file cannot be read, or a cell is not what its column holds.
    """
    required = [name for name in COLUMNS if name not in _LATER]
    return [FrameNote(**cells_of(FrameNote, csv_row)) for csv_row in read_table(path, required, _LATER)]
