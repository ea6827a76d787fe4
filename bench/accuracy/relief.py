"""Flights over hills: the built-in flight over flat towns and hilly ones, with attitude and with it withheld.

    python -m bench.accuracy.relief [--quick] [--docs DIR]

Writes the table of docs/results/simulator.md, section "Hills", between its markers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator

from bench.accuracy.simulated import PAGE, RATE_HZ, WAYS, Run, fly, matchers
from bench.command import parser_on_one_thread
from bench.pages.text import machine, paragraph, rewrite, table
from scenematch.simulator import plan_flight

SEEDS = (1, 2, 31, 32, 71)
"""The ground below was worked out on the towns 21 to 26."""
RELIEFS_M = (0.0, 15.0, 30.0, 60.0)
DAYS = ("noon", "evening")
BEGIN, END = "<!-- bench.accuracy.relief -->", "<!-- end of bench.accuracy.relief -->"


def flights(
    seeds: tuple[int, ...], reliefs_m: tuple[float, ...], frames: int | None
) -> Iterator[tuple[float, Run]]:
    """All flights with the height of their hills; every hilly town has its river, its map is of noon."""
    for seed in seeds:
        for relief_m in reliefs_m:
            world = {"relief_m": relief_m, "river": relief_m > 0.0}
            plans = [plan_flight(seed, frames=frames, rate_hz=RATE_HZ, condition=day, **world) for day in DAYS]
            site = plans[0].town.site()
            ready = list(matchers(site, plans[0].camera, WAYS[:2]))
            for day, plan in zip(DAYS, plans, strict=True):
                for known in (True, False):
                    yield from ((relief_m, run) for run in fly(plan, day, ready, site, with_attitude=known))


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


def lines(runs: list[tuple[float, Run]]) -> list[str]:
    """The table, a row for each height of the hills, day, method and with or without attitude."""
    same: dict[tuple[float, str, str, bool], list[Run]] = {}
    for relief_m, run in runs:
        same.setdefault((relief_m, run.day, run.method, run.with_attitude), []).append(run)
    rows = []
    for key in sorted(same, key=lambda k: (k[0], DAYS.index(k[1]), k[2], not k[3])):
        relief_m, day, method, known = key
        who = method.upper() + ("" if known else ", attitude withheld")
        rows.append([f"{relief_m:g} m", day, who, *pooled(same[key])])
    return table(["hills", "frames' day", "by", "RMS m", "worst m", "availability", "false", "NEES"], rows)


def main() -> None:
    """Fly, and write the table."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--quick", action="store_true", help="a few frames over one town with high hills")
    options = parser.parse_args()
    seeds, reliefs_m, frames = (SEEDS[:1], RELIEFS_M[-1:], 5) if options.quick else (SEEDS, RELIEFS_M, None)
    runs = []
    for relief_m, run in flights(seeds, reliefs_m, frames):
        runs.append((relief_m, run))
        print(json.dumps([relief_m, run.day, run.with_attitude, run.method, run.seed, *pooled([run])]), flush=True)
    rewrite(options.docs / PAGE, BEGIN, END, [*lines(runs), *paragraph(f"Measured with {machine()}.")])


if __name__ == "__main__":
    main()
