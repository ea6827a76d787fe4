"""What a budget buys: accuracy and latency from 1 to 121 ms, and the paper's Table I with its tails."""

from __future__ import annotations

from typing import Any

from bench.live.endless import Course, draw, fly, summary, warm
from engine.runtime.threads import set_threads
from scenematch.runs.demo import PAPER_TABLE
from scenematch.runs.paper_recipe import ACCEPT_ALL, RECIPES

Row = dict[str, Any]
BUDGETS_MS = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 40.0, 80.0, 121.0)
DEMO_HZ = 1.12
METHODS = ("ncc", "sift", "auto")


def tradeoff(
    course: Course, frames: int = 100, table_frames: int = 1_000, paper_frames: int = 150
) -> dict[str, list[Row]]:
    """Both tables."""
    return {"curve": curve(course, frames), "table": table_one(table_frames, paper_frames)}


def curve(course: Course, frames: int) -> list[Row]:
    """Every method at every budget."""
    rows = []
    for method in METHODS:
        matcher = warm(course, method)
        rows += [summary(fly(course, matcher, frames, budget_ms), method) for budget_ms in BUDGETS_MS]
    return rows


def table_one(frames: int, paper_frames: int) -> list[Row]:
    """Table I on the demo's flight, level at 150 m: as published, the paper's recipe, and the engine."""
    course = draw(paper_frames, dive_m=0.0, rate_hz=DEMO_HZ)
    rows: list[Row] = []
    for method, (rms_m, ms) in PAPER_TABLE.items():
        rows.append({"who": f"{method.upper()}, as published", "rms_m": rms_m, "mean": ms})
        recipe = warm(course, RECIPES[method])
        flown = fly(course, recipe, paper_frames, options=ACCEPT_ALL)
        rows.append(summary(flown, f"{method.upper()}, paper's recipe", threads=1))
    for threads in (1, 2):
        set_threads(threads)
        for method in METHODS:
            who = f"{method if method == 'auto' else method.upper()}, scenematch"
            rows.append(summary(fly(course, warm(course, method), frames), who, threads=threads))
    set_threads(1)
    return rows
