"""Flights over hills: the built-in flight over flat towns and hilly ones, with attitude and with it withheld.

    python -m bench.accuracy.relief [--quick] [--docs DIR]

Writes the table of docs/results/simulator.md, section "Hills", between its markers.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from bench import RESULTS
from bench.accuracy.simulated import RATE_HZ, START_SIGMA_M, matchers
from bench.pages.text import machine, paragraph, table
from engine import Frame, Navigator, OrthoMap, Prior, SceneMatcher
from engine.runtime.threads import set_threads
from scenematch.files.track import track_row
from scenematch.report.metrics import Ground, summarise
from scenematch.simulator import FlightPlan, plan_flight

SEEDS = (1, 2, 31, 32, 71)
"""The ground below was worked out on the towns 21 to 26."""
RELIEFS_M = (0.0, 15.0, 30.0, 60.0)
DAYS = ("noon", "evening")
WAYS = (("ncc", "engine"), ("sift", "engine"))
BEGIN, END = "<!-- bench.accuracy.relief -->", "<!-- end of bench.accuracy.relief -->"


@dataclass(frozen=True)
class Run:
    """A flight over one town by one method, with attitude or without."""

    relief_m: float
    day: str
    with_attitude: bool
    method: str
    seed: int
    summary: dict[str, Any]


def fly(plan: FlightPlan, frames: list[Frame], matcher: SceneMatcher, site: OrthoMap) -> dict[str, Any]:
    """The figures of merit of a flight from the true start."""
    truth = plan.truth_rows()
    start = Prior(lat_deg=truth[0].lat_deg, lon_deg=truth[0].lon_deg, sigma_m=START_SIGMA_M)
    navigator = Navigator(matcher, start)
    rows = [
        track_row(str(index), navigator.update(frame), latency_ms=0.0, deadline_met=None)
        for index, frame in enumerate(frames)
    ]
    ground = Ground(site.ground_m, plan.town.datum_amsl_m + site.ground_m)
    return summarise(rows, truth, frame=site.frame, ground=ground)


def flights(seeds: tuple[int, ...], reliefs_m: tuple[float, ...], frames: int | None) -> Iterator[Run]:
    """All flights; every hilly town has its river, and its map, which is of noon, is prepared once."""
    for seed in seeds:
        for relief_m in reliefs_m:
            ready: list[tuple[str, str, Any]] = []
            for day in DAYS:
                plan = plan_flight(
                    seed, frames=frames, rate_hz=RATE_HZ, condition=day, relief_m=relief_m, river=relief_m > 0.0
                )
                if not ready:
                    site = plan.town.site()
                    ready = list(matchers(site, plan.camera, WAYS))
                with_attitude = list(plan.iter_frames())
                no_attitude = [replace(frame, roll_deg=None, pitch_deg=None) for frame in with_attitude]
                for method, _, matcher in ready:
                    yield Run(relief_m, day, True, method, seed, fly(plan, with_attitude, matcher, site))
                    yield Run(relief_m, day, False, method, seed, fly(plan, no_attitude, matcher, site))


def pooled(runs: list[Run]) -> list[str]:
    """Cells of all runs together."""
    each = [run.summary for run in runs]
    frames, fixes = (sum(s[key] for s in each) for key in ("frames", "fixes"))

    def mean(key: str, power: int) -> float:
        return sum(s["fixes"] * s[key] ** power for s in each if s["fixes"]) / max(1, fixes)

    rms_m, nees = math.sqrt(mean("rms_m", 2)), mean("nees_mean", 1)
    worst_m = max((s["max_m"] for s in each if s["fixes"]), default=math.nan)
    false = sum(s["false_fixes"] for s in each)
    return [f"{rms_m:.2f}", f"{worst_m:.1f}", f"{100.0 * fixes / frames:.1f} %", str(false), f"{nees:.2f}"]


def lines(runs: list[Run]) -> list[str]:
    """The table, a row for each height of the hills, day, method and with or without attitude."""
    rows = []
    keys = dict.fromkeys((run.relief_m, run.day, run.method, run.with_attitude) for run in runs)
    for relief_m, day, method, with_attitude in sorted(
        keys, key=lambda k: (k[0], DAYS.index(k[1]), k[2], not k[3])
    ):
        same = [
            r
            for r in runs
            if (r.relief_m, r.day, r.method, r.with_attitude) == (relief_m, day, method, with_attitude)
        ]
        who = method.upper() + ("" if with_attitude else ", attitude withheld")
        rows.append([f"{relief_m:g} m", day, who, *pooled(same)])
    return table(["hills", "frames' day", "by", "RMS m", "worst m", "availability", "false", "NEES"], rows)


def write(docs: Path, runs: list[Run]) -> None:
    """Put the table between the page's markers."""
    page = docs / "simulator.md"
    head, rest = page.read_text(encoding="utf-8").split(BEGIN)
    tail = rest.split(END)[1]
    body = [BEGIN, "", *lines(runs), *paragraph(f"Measured with {machine()}."), END]
    page.write_text(head + "\n".join(body) + tail, encoding="utf-8")


def main() -> None:
    """Fly, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few frames over one town with high hills")
    parser.add_argument("--docs", type=Path, default=RESULTS, help="folder of the page")
    options = parser.parse_args()
    set_threads(1)
    cv2.setNumThreads(1)
    seeds, reliefs_m, frames = (SEEDS[:1], RELIEFS_M[-1:], 5) if options.quick else (SEEDS, RELIEFS_M, None)
    runs: list[Run] = []
    for run in flights(seeds, reliefs_m, frames):
        runs.append(run)
        short = {
            key: run.summary[key] for key in ("frames", "fixes", "rms_m", "max_m", "false_fixes", "nees_mean")
        }
        print(json.dumps([run.relief_m, run.day, run.with_attitude, run.method, run.seed, short]), flush=True)
    write(options.docs, runs)


if __name__ == "__main__":
    main()
