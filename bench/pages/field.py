"""docs/results/field.md: the table of what :mod:`bench.accuracy.field` flew."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bench.pages.text import machine, paragraph, table

if TYPE_CHECKING:
    from bench.accuracy.field import Figures

TITLES = {
    "brighton": "`brighton`: nine photographs of a wooded park, 14 s apart",
    "seneca": "`seneca`: near-infrared survey photographs of fields, 10 s apart, up to 22 degrees off nadir",
    "caliterra": "`caliterra`: survey photographs of bare ground from 30 to 50 m",
    "nust": "`nust`: video of a campus on a satellite map of another date",
    "gazebo-a1": "`gazebo-a1`: town drawn by Gazebo, for reference",
    "gazebo-a2": "`gazebo-a2`: the same town, hard turns, for reference",
    "gazebo-a1-evening": "`gazebo-a1-evening`: low evening light on a map of noon, for reference",
}
NAMES = {
    "ncc": "NCC", "sift": "SIFT", "auto": "auto", "learned": "learned",
    "paper-ncc": "paper's NCC, OpenCV", "paper-sift": "paper's SIFT, OpenCV",
    "classical": "plain classical recipe",
}  # fmt: skip
COLUMNS = ["method", "frames", "fixed", "within 1, 5, 10 m", "median, m", "RMS, m", "wrong", "outside", "ms"]
INTRO = (
    "Made by `python -m bench.accuracy.field` on {machine}, one thread, beside other work: its milliseconds are "
    "upper bounds. Each flight goes through `track` with default settings; a flight without positions in its "
    "telemetry starts at its true place (sigma 15 m)."
)
FIGURES = (
    "Median and RMS are over all fixes, wrong ones too; **wrong** are those more than 10 m off, **outside** those "
    "outside the ellipse of three of their own sigmas. The truth of `nust` is the ground in the middle of each "
    "frame, good to about a metre, and its fixes are moved there."
)
PEERS = (
    "`paper's NCC` and `paper's SIFT` are `--profile paper`: the paper's recipe by OpenCV, which refuses almost "
    "nothing and follows its own last answer. The plain classical recipe (`bench/accuracy/classical.py`) takes "
    "each frame by itself, its window of 45 m about the telemetry's position (else a drawn one, sigma 15 m): the "
    "frame rectified by attitude and height onto the map's grid, upright RootSIFT without a cap, contrast 0.01, "
    "ratio 0.9, and a vote for the translation within 3 % of the height. It always answers, and states no sigma."
)


def write(docs: Path, rows: list[Figures]) -> None:
    """Write the page below ``docs``."""
    lines = ["# The field", "", *paragraph(INTRO.format(machine=machine()))]
    lines += [*paragraph(FIGURES), *paragraph(PEERS)]
    for flight in dict.fromkeys(row.flight for row in rows):
        own = [_cells(row) for row in rows if row.flight == flight]
        lines += [f"## {TITLES[flight]}", "", *table(COLUMNS, own)]
    (docs / "field.md").write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


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
        f"{true.p50_ms:.0f}",
    ]
