"""docs/results/field-simulated.md: the tables of :mod:`bench.accuracy.scenes`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bench.pages.field import COLUMNS, outcome
from bench.pages.text import machine, paragraph, table

if TYPE_CHECKING:
    from bench.accuracy.field import Figures

TITLES = {
    "snow": "Snow on the map of summer: the paper's flight and camera in winter",
    "city": "A city from 120 m, overcast: its map is of a sunny noon from 12 degrees off the vertical, 5 m off, "
    "without heights, and a tenth of the houses are new on either; the camera is tilted by 9 degrees that nothing "
    "tells, and of the attitude only the heading is known",
    "oblique": "A camera 45 degrees off the vertical over hills of 60 m in autumn and in winter, on the map of "
    "summer with its surface; the vehicle's position",
}
NAMES = {"ncc": "NCC", "sift": "SIFT", "auto": "auto"}
INTRO = (
    "Made by `python -m bench.accuracy.scenes` on {machine}, one thread: towns that are drawn for "
    "it, on which nothing was fitted. *Each frame* is matched by itself about a drawn prior (sigma 15 m); *track* "
    "is the flight from its true start, a frame every 3.6 s."
)
FIGURES = (
    "Errors are those of the vehicle's true position. In the city they are those against where that position lies "
    "on the map, which leaves out the map's own error of 5 m; **outside** are outside the ellipse of three of "
    "their own sigmas about the true position, **wrong** are more than 10 m from it."
)


@dataclass(frozen=True)
class Row:
    """Figures of a scene by a method, against the truth and against where the truth lies on the map."""

    scene: str
    method: str
    how: str
    true: Figures
    on_map: Figures


def write(docs: Path, rows: list[Row]) -> None:
    """Write the page below ``docs``."""
    lines = ["# The field, simulated", "", *paragraph(INTRO.format(machine=machine())), *paragraph(FIGURES)]
    for scene in dict.fromkeys(row.scene for row in rows):
        lines += paragraph(f"**{TITLES[scene]}.**")
        own = [_cells(row) for row in rows if row.scene == scene]
        lines += table(["method", "how", *COLUMNS[1:]], own)
    (docs / "field-simulated.md").write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _cells(row: Row) -> list[str]:
    fixed, *cells = outcome(row.true, row.on_map)
    share = f"{fixed}, {100.0 * row.true.fixed / row.true.frames:.0f} %"
    return [NAMES[row.true.method], row.how, str(row.true.frames), share, *cells]
