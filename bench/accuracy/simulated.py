"""Flights over simulated towns in one light and season, on the map of another.

    python -m bench.accuracy.simulated [--hills] [--quick] [--docs DIR]

Writes the tables of docs/results/simulator.md: of the conditions, or with ``--hills`` that of flat towns and hilly
ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from bench.accuracy.rebuilt import rebuilt
from bench.accuracy.shutter import Shutter, ShutterFlight
from bench.accuracy.truth import answered, pooled, rows_of, true_start
from bench.command import parser_on_one_thread
from bench.pages.text import fill, machine, paragraph, percent, printed, table_of
from engine import Navigator, SceneMatcher
from scenematch.report.metrics import Ground, summarise
from scenematch.runs.settings import TrackSettings
from scenematch.simulator import FlightPlan, plan_flight

SEEDS = (71, 72, 73, 74, 75)
"""No threshold was fitted on these towns."""
DAYS = ("noon", "evening", "winter", "haze")
HARDER: dict[str, dict[str, Any]] = {
    "noon, hills of 30 m and a river": {"relief_m": 30.0, "river": True},
    "noon, 10 ms exposure, 20 ms readout": {"shutter": Shutter(exposure_ms=10.0, readout_ms=20.0)},
    "noon, 30 % of the houses changed": {"changed": 0.3},
    "overcast": {"condition": "overcast"},
    "autumn": {"condition": "autumn"},
    "dusk": {"condition": "dusk"},
}
RATE_HZ = 0.28
"""Every fourth frame of the paper's flight."""
WAYS = (("ncc", "engine"), ("sift", "engine"), ("ncc", "paper"), ("sift", "paper"))
PAPER = "paper's recipe"
HILLY_SEEDS, HILLY_DAYS = (1, 2, 31, 32, 71), ("noon", "evening")
"""The ground below was worked out on the towns 21 to 26."""
HILLS_M = (0.0, 15.0, 30.0, 60.0)
DAY, WHO, RMS = ("frames' day", "day", "s"), ("by", "who", "s"), ("RMS m", "rms_m", ".2f")
FIXED, FALSE = ("availability", "availability", percent), ("false", "false_fixes", "d")


@dataclass(frozen=True)
class Run:
    """A flight over one town by one method."""

    day: str
    seed: int
    method: str
    profile: str
    summary: dict[str, Any]
    hills_m: float
    with_attitude: bool


Ready = list[tuple[TrackSettings, SceneMatcher]]
"""Matchers with their settings."""


def matchers(plan: FlightPlan, ways: tuple[tuple[str, str], ...]) -> Ready:
    """Each way to match over the map of a town, warmed up."""
    site = plan.town.site()
    settings = [TrackSettings(method=method, profile=profile, device="cpu") for method, profile in ways]
    made = [(each, each.matcher(site, plan.camera)) for each in settings]
    for _, matcher in made:
        matcher.warmup()
    return made


def fly(
    plan: FlightPlan, ready: Ready, day: str, hills_m: float = 0.0, *, with_attitude: bool = True
) -> Iterator[Run]:
    """The same frames by every matcher, each from the true start."""
    truth, frames = plan.truth_rows(), list(plan.iter_frames())
    if not with_attitude:
        frames = [replace(frame, roll_deg=None, pitch_deg=None) for frame in frames]
    for settings, matcher in ready:
        navigator = Navigator(matcher, true_start(truth), options=settings.acceptance)
        rows = rows_of(*answered(navigator.update, ((frame,) for frame in frames)))
        ground = Ground(matcher.site.ground_m, plan.town.datum_amsl_m)
        summary = summarise(rows, truth, frame=matcher.site.frame, ground=ground)
        yield Run(day, plan.seed, settings.method, settings.profile, summary, hills_m, with_attitude)


def flights(seeds: tuple[int, ...], frames: int | None) -> Iterator[Run]:
    """All days over all towns; the map of a town, which is of noon in all of them, is prepared once."""
    for seed in seeds:
        plans = [plan_flight(seed, frames=frames, rate_hz=RATE_HZ, condition=day) for day in DAYS]
        ready = matchers(plans[0], WAYS)
        for day, plan in zip(DAYS, plans, strict=True):
            yield from fly(plan, ready, day)


def harder(seeds: tuple[int, ...], frames: int | None) -> Iterator[Run]:
    """What the first table leaves out, by the engine alone."""
    for name, options in HARDER.items():
        town = {key: value for key, value in options.items() if key not in ("shutter", "changed")}
        for seed in seeds:
            rebuild = rebuilt(seed, options.get("changed", 0.0))
            plan = plan_flight(seed, frames=frames, rate_hz=RATE_HZ, rebuild=rebuild, **town)
            plan = ShutterFlight.of(plan, options["shutter"]) if "shutter" in options else plan
            yield from fly(plan, matchers(plan, WAYS[:2]), name)


def hills(seeds: tuple[int, ...], hills_m: tuple[float, ...], frames: int | None) -> Iterator[Run]:
    """Flat towns and hilly ones, with attitude and with it withheld; every hilly town has its river."""
    for seed in seeds:
        for height_m in hills_m:
            world = {"relief_m": height_m, "river": height_m > 0.0}
            plans = [plan_flight(seed, frames=frames, rate_hz=RATE_HZ, condition=d, **world) for d in HILLY_DAYS]
            ready = matchers(plans[0], WAYS[:2])
            for day, plan in zip(HILLY_DAYS, plans, strict=True):
                for known in (True, False):
                    yield from fly(plan, ready, day, height_m, with_attitude=known)


def lines(runs: list[Run], ways: tuple[tuple[str, str], ...]) -> list[str]:
    """The table of some runs, a row for each day and way."""
    rows = []
    for day in dict.fromkeys(run.day for run in runs):
        for method, profile in ways:
            who = f"{method.upper()}, {'scenematch' if profile == 'engine' else PAPER}"
            same = [run.summary for run in runs if (run.day, run.method, run.profile) == (day, method, profile)]
            rows.append({"day": day, "who": who, **pooled(same)})
    counts, wrong = ("frames", "frames", "d"), ("off > 10 m", "wrong_over_10m", "d")
    return table_of(rows, DAY, WHO, counts, RMS, FIXED, FALSE, wrong)


def hilly_lines(runs: list[Run]) -> list[str]:
    """The table of the hills, a row for each of their heights, day, method and with or without attitude."""
    same: dict[tuple[float, int, str, bool], list[dict[str, Any]]] = {}
    for run in runs:
        key = (run.hills_m, HILLY_DAYS.index(run.day), run.method, not run.with_attitude)
        same.setdefault(key, []).append(run.summary)
    rows = []
    for hills_m, day, method, withheld in sorted(same):
        who = method.upper() + (", attitude withheld" if withheld else "")
        figures = pooled(same[hills_m, day, method, withheld])
        rows.append({"hills": f"{hills_m:g} m", "day": HILLY_DAYS[day], "who": who, **figures})
    worst, nees = ("worst m", "max_m", ".1f"), ("NEES", "nees", ".2f")
    return table_of(rows, ("hills", "hills", "s"), DAY, WHO, RMS, worst, FIXED, FALSE, nees)


def main() -> None:
    """Fly, and write the tables."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--quick", action="store_true", help="a few frames over one town")
    parser.add_argument("--hills", action="store_true", help="fly over hills, and write their table")
    options = parser.parse_args()
    page, measured = options.docs / "simulator.md", paragraph(f"Measured with {machine()}.")
    frames = 5 if options.quick else None
    if options.hills:
        seeds, hills_m = (HILLY_SEEDS[:1], HILLS_M[-1:]) if options.quick else (HILLY_SEEDS, HILLS_M)
        fill(page, {"hills": [*hilly_lines(printed(hills(seeds, hills_m, frames))), *measured]})
        return
    seeds = SEEDS[:1] if options.quick else SEEDS
    body = lines(printed(flights(seeds, frames)), WAYS)
    more = lines(printed(harder(seeds[:2], frames)), WAYS[:2])
    fill(page, {"conditions": [*body, "The engine on what is harder, two towns each:", "", *more, *measured]})


if __name__ == "__main__":
    main()
