"""docs/results/field.md: the table of what :mod:`bench.accuracy.field` flew."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bench.pages.text import fill, measured, table

if TYPE_CHECKING:
    from bench.accuracy.field import Figures

NAMES = {
    "ncc": "NCC", "sift": "SIFT", "auto": "auto", "learned": "learned",
    "paper-ncc": "paper's NCC, OpenCV", "paper-sift": "paper's SIFT, OpenCV",
    "classical": "plain classical recipe",
}  # fmt: skip
COLUMNS = [
    "method", "frames", "fixed", "within 1, 5, 10, 20 m", "median, m", "RMS, m", "wrong", "outside",
    "ms, p50 and p99",
]  # fmt: skip


def write(docs: Path, rows: list[Figures]) -> None:
    """Fill in the page below ``docs``: of each flight what was flown."""
    flights = {row.flight: [_cells(each) for each in rows if each.flight == row.flight] for row in rows}
    fill(docs / "field.md", measured() | {name: table(COLUMNS, own) for name, own in flights.items()})


def _cells(row: Figures) -> list[str]:
    every = "" if row.step == 1 else f", every {row.step}{'nd' if row.step == 2 else 'th'}"
    return [NAMES[row.method] + every, str(row.frames), *outcome(row, row)]


def outcome(true: Figures, on_map: Figures) -> list[str]:
    """The cells behind the number of frames; distances are against the map's own truth."""
    return [
        str(true.fixed),
        ", ".join(map(str, on_map.within)),
        *("-" if value is None else f"{value:.2f}" for value in (on_map.median_m, on_map.rms_m)),
        str(true.wrong),
        "-" if true.outside is None else str(true.outside),
        f"{true.p50_ms:.0f}, {true.p99_ms:.0f}",
    ]
