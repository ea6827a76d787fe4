"""notes.csv: what a run knew of each frame beside its row of track.csv, so that the report can be drawn again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path

from engine.formats.telemetry import cell_text, read_table, write_table
from engine.values import Fix, NoFix


@dataclass(frozen=True, slots=True, kw_only=True)
class Note:
    """One row of notes.csv; what is unknown is None. The fields are the columns, in their order.

    Attributes:
        frame: name of the frame.
        state: of the navigator after the frame, see :class:`engine.navigator.NavigatorState`.
        window_x0_px: first column of the map that was searched.
        window_y0_px: first row of the map that was searched.
        heading_deg: that the match measured or was found at.
        stage: how far the budget went.
        confidence: probability of being right.
        detail: of a refusal, one sentence with its figures.
    """

    frame: str
    state: str
    window_x0_px: int | None = None
    window_y0_px: int | None = None
    heading_deg: float | None = None
    stage: str | None = None
    confidence: float | None = None
    detail: str | None = None


COLUMNS = tuple(f.name for f in fields(Note))
"""The header of notes.csv."""


def note_of(name: str, result: Fix | NoFix, state: str) -> Note:
    """What there is to note of one frame's result.

    Args:
        name: the frame's name.
        result: the fix or the refusal.
        state: of the navigator after it.
    """
    x0, y0 = (None, None) if result.window is None else (result.window.x0, result.window.y0)
    if isinstance(result, NoFix):
        return Note(frame=name, state=state, window_x0_px=x0, window_y0_px=y0, detail=result.detail or None)
    return Note(
        frame=name,
        state=state,
        window_x0_px=x0,
        window_y0_px=y0,
        heading_deg=None if result.attitude is None else float(result.attitude.heading_deg),
        stage=result.stage,
        confidence=None if result.confidence is None else float(result.confidence),
    )


def write_notes(path: str | Path, notes: Iterable[Note]) -> None:
    """Write notes.csv.

    Raises:
        TelemetryError: the file cannot be written.
    """
    write_table(path, COLUMNS, ([cell_text(getattr(note, name), 4) for name in COLUMNS] for note in notes))


def read_notes(path: str | Path) -> list[Note]:
    """Read notes.csv.

    Raises:
        TelemetryError: the file cannot be read, or a cell is not what its column holds.
    """
    return [
        Note(
            frame=cells.text("frame"),
            state=cells.text("state"),
            window_x0_px=cells.integer("window_x0_px"),
            window_y0_px=cells.integer("window_y0_px"),
            heading_deg=cells.number("heading_deg"),
            stage=cells.values["stage"] or None,
            confidence=cells.number("confidence"),
            detail=cells.values["detail"] or None,
        )
        for cells in read_table(path, COLUMNS)
    ]
