"""docs/results/flights.md: the tables and the picture of what :mod:`bench.accuracy.flights` flew."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.pages.text import fill, measured, save_pictures, table_of

TITLES = {
    "gazebo-a1": "town A1, drawn by Gazebo",
    "gazebo-a2": "town A1, flight A2 with hard turns",
    "gazebo-a1-evening": "A1 in low evening light, map of noon",
    "nust": "campus, video on a satellite map of another date",
    "caliterra": "bare ground from 30 to 50 m, photographs",
    "built-in": "built-in flight",
}
COLOURS = ("#d55e00", "#e69f00", "#0072b2", "#999999")
WITHIN_M = (0.1, 30.0)


@dataclass(frozen=True)
class Run:
    """What one method made of one flight.

    Attributes:
        flight, who: names.
        step: every how many frames one was flown.
        summary: the figures of summary.json.
        error_m: (N,) horizontal error of every frame, NaN where refused or not scored.
        inlier_share: mean share of matches that agree with the pose, None without a fix.
        attitude_rms_deg: None where truth has none.
    """

    flight: str
    who: str
    step: int
    summary: dict[str, Any]
    error_m: NDArray[np.float64]
    inlier_share: float | None
    attitude_rms_deg: float | None


def write(docs: Path, runs: list[Run], variants: list[Run]) -> None:
    """Fill in the page below ``docs``, and draw its picture."""
    lines = []
    for flight in dict.fromkeys(run.flight for run in runs):
        own = [run for run in runs if run.flight == flight]
        every = f"every {own[0].step}. frame" if own[0].step > 1 else "every frame"
        lines += [f"## {TITLES.get(flight, flight)} ({own[0].summary['frames']} frames, {every})", ""]
        lines += _table(own, "who")
    fill(docs / "flights.md", measured() | {"flights": lines, "telemetry": _table(variants, "telemetry")})
    save_pictures(docs, {"sift-flights.png": _chart(runs)})


def _table(runs: list[Run], first: str) -> list[str]:
    rows = [{**run.summary, **asdict(run), "p50_ms": run.summary["latency_ms"]["p50"]} for run in runs]
    found = (("fixes", "fixes", "d"), ("RMS m", "rms_m", ".2f"), ("median m", "median_m", ".2f"))
    wrong = (("wrong", "wrong_over_10m", "d"), ("false", "false_fixes", "d"), ("agreeing", "inlier_share", ".2f"))
    more = (("height RMS m", "height_rms_m", ".2f"), ("attitude RMS deg", "attitude_rms_deg", ".2f"))
    return table_of(rows, (first, "who", "s"), *found, *wrong, *more, ("median ms", "p50_ms", ".1f"))


def _chart(runs: list[Run]) -> Figure:
    """Share of all frames that were placed within so many metres, one panel a flight."""
    flights, names = (list(dict.fromkeys(getattr(run, key) for run in runs)) for key in ("flight", "who"))
    columns = min(3, len(flights))
    figure = Figure(figsize=(3.6 * columns, 3.1 * -(-len(flights) // columns) + 0.5), layout="constrained")
    distances = np.geomspace(*WITHIN_M, 300)
    for index, flight in enumerate(flights):
        ax = figure.add_subplot(-(-len(flights) // columns), columns, index + 1)
        for run in (run for run in runs if run.flight == flight):
            within = (run.error_m[:, None] <= distances).mean(axis=0)  # a refused frame is never within
            colour = COLOURS[names.index(run.who) % len(COLOURS)]
            ax.plot(distances, 100.0 * within, color=colour, linewidth=2, label=run.who if index == 0 else None)
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_ylim(0, 102)
        ax.set_xlim(*WITHIN_M)
        ax.set_title(TITLES.get(flight, flight), fontsize=9)
        ax.grid(which="both", alpha=0.25)
        if index % columns == 0:
            ax.set_ylabel("% of frames within")
        if index + columns >= len(flights):
            ax.set_xlabel("metres from the truth")
    figure.legend(loc="outside upper center", ncols=len(names), frameon=False, fontsize=9)
    return figure
