"""docs/results/field.md: the table of what :mod:`bench.accuracy.field` flew."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.pages.text import machine, paragraph, table

if TYPE_CHECKING:
    from bench.accuracy.field import Figures, Votes

TITLES = {
    "brighton": "`brighton`: nine photographs of a beach, 14 s apart",
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
INTRO = (
    "Made by `python -m bench.accuracy.field` on {machine}, one thread, beside other work: its milliseconds are "
    "upper bounds. Each flight goes through `track` with default settings; a flight without positions in its "
    "telemetry starts at its true place (sigma 15 m)."
)
FIGURES = (
    "Median and RMS are over all fixes, wrong ones too; **wrong** are those more than 10 m off, **outside** those "
    "outside the ellipse of three of their own sigmas. The truth of `nust` is the ground "
    "in the middle of each frame, good to about a metre, and its fixes are moved there."
)
PEERS = (
    "`paper's NCC` and `paper's SIFT` are `--profile paper`: the paper's recipe by OpenCV, which refuses almost "
    "nothing and follows its own last answer. The plain classical recipe (`bench/accuracy/classical.py`) takes "
    "each frame by itself, its window of 45 m about the telemetry's position (else a drawn one, sigma 15 m): "
    "the frame rectified by attitude and height onto the map's grid, upright RootSIFT without a cap, contrast "
    "0.01, ratio 0.9, and a vote for the translation within 3 % of the height. It answers always, and states no "
    "sigma."
)
VOTES = (
    "What its votes mean. *Right* are votes for the true place, *rival* the most for a place of the same window "
    "that is more than 10 m off, *shifted* the most in a window that does not hold the place: moved by up to "
    "200 m, as far as the map allows. Least, median and most of the frames."
)

OTHERS = "## The paper's recipe written plainly with OpenCV\n"
"""From here on the page is kept: not measured by this benchmark."""


def write(docs: Path, rows: list[Figures], votes: list[Votes]) -> None:
    """Write the page below ``docs``."""
    lines = [
        "# The field",
        "",
        *paragraph(INTRO.format(machine=machine())),
        *paragraph(FIGURES),
        *paragraph(PEERS),
    ]
    for flight in dict.fromkeys(row.flight for row in rows):
        own = [row for row in rows if row.flight == flight]
        lines += [f"## {TITLES[flight]}", ""]
        lines += table(
            ["method", "frames", "fixed", "within 1, 5, 10 m", "median, m", "RMS, m", "wrong", "outside", "ms"],
            [_cells(row) for row in own],
        )
    if votes:
        lines += ["## Votes of the plain classical recipe", "", *paragraph(VOTES)]
        lines += table(
            ["flight", "frames", "right", "rival", "shifted", "moved by, m"], [_counts(v) for v in votes]
        )
    page = docs / "field.md"
    kept = page.read_text(encoding="utf-8").partition(OTHERS)[2] if page.exists() else ""
    page.write_text("\n".join(lines).rstrip() + "\n" + (f"\n{OTHERS}{kept}" if kept else ""), encoding="utf-8")


def _cells(row: Figures) -> list[str]:
    every = f", every {row.step}th" if row.step > 1 else ""
    return [
        NAMES[row.method] + every,
        str(row.frames),
        str(row.fixed),
        ", ".join(map(str, row.within)),
        "-" if row.median_m is None else f"{row.median_m:.2f}",
        "-" if row.rms_m is None else f"{row.rms_m:.2f}",
        str(row.wrong),
        "-" if row.outside is None else str(row.outside),
        f"{row.p50_ms:.0f}",
    ]


def _counts(votes: Votes) -> list[str]:
    moved = f"{min(votes.shift_m):.0f} to {max(votes.shift_m):.0f}" if votes.shift_m else "-"
    columns = [_spread(counts) for counts in (votes.right, votes.rival, votes.shifted)]
    return [f"`{votes.flight}`", str(len(votes.right)), *columns, moved]


def _spread(counts: list[int]) -> str:
    if not counts:
        return "-"
    return f"{min(counts)}, {np.median(counts):.0f}, {max(counts)}"
