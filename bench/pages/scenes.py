"""docs/results/field-simulated.md: the tables and the picture of :mod:`bench.accuracy.scenes`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.pages.text import machine, paragraph, table
from engine.values import Window

if TYPE_CHECKING:
    from bench.accuracy.field import Figures
    from bench.accuracy.scenes import Scene

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
COLUMNS = [
    "method",
    "how",
    "frames",
    "fixed",
    "within 1, 5, 10 m",
    "median, m",
    "RMS, m",
    "wrong",
    "outside",
    "ms",
]
CELL_PX = 260
PICTURE = "field-simulated.png"


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
    lines += [f"![frames and maps of the scenes](img/{PICTURE})", ""]
    lines += ["A scene a row, in the order of the tables: three frames, and its map on the right.", ""]
    for scene in dict.fromkeys(row.scene for row in rows):
        lines += paragraph(f"**{TITLES[scene]}.**")
        own = [row for row in rows if row.scene == scene]
        lines += table(COLUMNS, [_cells(row) for row in own])
    (docs / "field-simulated.md").write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _cells(row: Row) -> list[str]:
    true, on_map = row.true, row.on_map
    return [
        NAMES[row.method],
        row.how,
        str(true.frames),
        f"{true.fixed}, {100.0 * true.fixed / true.frames:.0f} %",
        ", ".join(map(str, on_map.within)),
        "-" if on_map.median_m is None else f"{on_map.median_m:.2f}",
        "-" if on_map.rms_m is None else f"{on_map.rms_m:.2f}",
        str(true.wrong),
        str(true.outside),
        f"{true.p50_ms:.0f}",
    ]


def draw(scenes: list[Scene], docs: Path) -> None:
    """A row for each scene: three of its frames, and its map."""
    cells = [[*(frame.image for frame in scene.frames[::3][:3]), _map(scene)] for scene in scenes]
    rows = [np.hstack([_cell(image) for image in row]) for row in cells]
    (docs / "img").mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(docs / "img" / PICTURE), cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))


def _map(scene: Scene) -> NDArray[np.uint8]:
    site = scene.site
    return site.gray(Window(0, 0, site.width_px, site.height_px))


def _cell(image: object) -> NDArray[np.uint8]:
    picture = np.asarray(image, np.uint8)
    picture = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    side = min(picture.shape[:2])
    top, left = ((n - side) // 2 for n in picture.shape[:2])
    square = picture[top : top + side, left : left + side]
    small = cv2.resize(square, (CELL_PX - 4, CELL_PX - 4), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.copyMakeBorder(small, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(255,) * 3), np.uint8)
