"""docs/results/field-simulated.md: the tables of :mod:`bench.accuracy.scenes`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bench.pages.field import COLUMNS, NAMES, outcome
from bench.pages.text import fill, measured, table

if TYPE_CHECKING:
    from bench.accuracy.field import Figures


@dataclass(frozen=True)
class Row:
    """Figures of a scene by a method, against the truth and against where the truth lies on the map."""

    scene: str
    method: str
    how: str
    true: Figures
    on_map: Figures


def write(docs: Path, rows: list[Row]) -> None:
    """Fill in the page below ``docs``: of each scene what was matched."""
    scenes = {row.scene: [_cells(each) for each in rows if each.scene == row.scene] for row in rows}
    columns = ["method", "how", *COLUMNS[1:]]
    fill(docs / "field-simulated.md", measured() | {name: table(columns, own) for name, own in scenes.items()})


def _cells(row: Row) -> list[str]:
    fixed, *cells = outcome(row.true, row.on_map)
    share = f"{fixed}, {100.0 * row.true.fixed / row.true.frames:.0f} %"
    return [NAMES[row.true.method], row.how, str(row.true.frames), share, *cells]
