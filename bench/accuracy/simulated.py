"""Flights over simulated towns in one light and season, on the map of another; and a sheet of what they look like.

    python -m bench.accuracy.simulated [--quick] [--sheet] [--docs DIR]

Writes the tables of docs/results/simulator.md; --sheet draws docs/img/sim-conditions.png instead.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench import DOCS
from bench.command import parser_on_one_thread
from bench.pages.text import machine, paragraph, rewrite, table
from engine import Camera, MatcherOptions, Navigator, OrthoMap, Prior, SceneMatcher
from engine.geo import LocalFrame
from engine.options import ACCEPT_ALL
from engine.values import Attitude
from scenematch.files.track import track_row
from scenematch.report.metrics import Ground, summarise
from scenematch.simulator import CONDITIONS, FlightPlan, Optics, build_town, picture_at, plan_flight
from scenematch.simulator.render import transformer

SEEDS = (71, 72, 73, 74, 75)
"""No threshold was fitted on these towns."""
DAYS = ("noon", "evening", "winter", "haze")
HARDER: dict[str, dict[str, Any]] = {
    "noon, hills of 30 m and a river": {"relief_m": 30.0, "river": True},
    "noon, 10 ms exposure, 20 ms readout": {"optics": Optics(exposure_ms=10.0, readout_ms=20.0)},
    "noon, 30 % of the houses changed": {"changed": 0.3},
    "overcast": {"condition": "overcast"},
    "autumn": {"condition": "autumn"},
    "dusk": {"condition": "dusk"},
}
RATE_HZ = 0.28
"""Every fourth frame of the paper's flight."""
START_SIGMA_M = 15.0
WAYS = (("ncc", "engine"), ("sift", "engine"), ("ncc", "paper"), ("sift", "paper"))
PAGE = "simulator.md"
BEGIN, END = "<!-- bench.accuracy.simulated -->", "<!-- end of bench.accuracy.simulated -->"
SHEET_SEED, CELL_PX = 41, 170
PLACES = ((0.0, 0.0, 20.0), (95.0, -110.0, 100.0), (-80.0, 120.0, 250.0))  # east, north and heading of its rows


@dataclass(frozen=True)
class Run:
    """A flight over one town by one method."""

    day: str
    seed: int
    method: str
    profile: str
    summary: dict[str, Any]
    with_attitude: bool = True


def matchers(site: OrthoMap, camera: Camera, ways: tuple[tuple[str, str], ...]) -> Iterator[tuple[str, str, Any]]:
    """Each way to match over a map, warmed up."""
    for method, profile in ways:
        matcher = SceneMatcher(site, camera, method, "cpu", MatcherOptions(profile=profile))
        matcher.warmup()
        yield method, profile, matcher


def fly(
    plan: FlightPlan, day: str, ready: list[tuple[str, str, Any]], site: OrthoMap, *, with_attitude: bool = True
) -> Iterator[Run]:
    """The same frames by every matcher, each from the true start."""
    truth, frames = plan.truth_rows(), list(plan.iter_frames())
    if not with_attitude:
        frames = [replace(frame, roll_deg=None, pitch_deg=None) for frame in frames]
    start = Prior(lat_deg=truth[0].lat_deg, lon_deg=truth[0].lon_deg, sigma_m=START_SIGMA_M)
    for method, profile, matcher in ready:
        navigator = Navigator(matcher, start, options=ACCEPT_ALL if profile == "paper" else None)
        rows = []
        for index, frame in enumerate(frames):
            begin = time.perf_counter()
            result = navigator.update(frame)
            spent_ms = (time.perf_counter() - begin) * 1e3
            rows.append(track_row(str(index), result, latency_ms=spent_ms, deadline_met=None))
        ground = Ground(site.ground_m, plan.town.datum_amsl_m)
        summary = summarise(rows, truth, frame=site.frame, ground=ground)
        yield Run(day, plan.seed, method, profile, summary, with_attitude)


def flights(seeds: tuple[int, ...], frames: int | None) -> Iterator[Run]:
    """All days over all towns; the map of a town, which is of noon in all of them, is prepared once."""
    for seed in seeds:
        ready: list[tuple[str, str, Any]] = []
        for day in DAYS:
            plan = plan_flight(seed, frames=frames, rate_hz=RATE_HZ, condition=day)
            if not ready:
                site = plan.town.site()
                ready = list(matchers(site, plan.camera, WAYS))
            yield from fly(plan, day, ready, site)


def harder(seeds: tuple[int, ...], frames: int | None) -> Iterator[Run]:
    """What the first table leaves out, by the engine alone."""
    for name, options in HARDER.items():
        for seed in seeds:
            plan = plan_flight(seed, frames=frames, rate_hz=RATE_HZ, **options)
            site = plan.town.site()
            yield from fly(plan, name, list(matchers(site, plan.camera, WAYS[:2])), site)


def pooled(runs: list[Run]) -> list[str]:
    """Cells of all runs together: frames, RMS, availability, false fixes, wrong ones."""
    each = [run.summary for run in runs]
    frames, fixes = (sum(s[key] for s in each) for key in ("frames", "fixes"))
    squares = sum(s["fixes"] * s["rms_m"] ** 2 for s in each if s["fixes"])
    rms = f"{math.sqrt(squares / fixes):.2f}" if fixes else "-"
    counts = [str(sum(s[key] for s in each)) for key in ("false_fixes", "wrong_over_10m")]
    return [str(frames), rms, f"{100.0 * fixes / frames:.1f} %", *counts]


def lines(runs: list[Run], ways: tuple[tuple[str, str], ...]) -> list[str]:
    """The table of some runs, a row for each day and way."""
    rows = []
    for day in dict.fromkeys(run.day for run in runs):
        for method, profile in ways:
            who = f"{method.upper()}, {'scenematch' if profile == 'engine' else 'paper' + chr(39) + 's recipe'}"
            same = [run for run in runs if (run.day, run.method, run.profile) == (day, method, profile)]
            rows.append([day, who, *pooled(same)])
    return table(["frames' day", "by", "frames", "RMS m", "availability", "false", "off > 10 m"], rows)


def write(docs: Path, runs: list[Run], more: list[Run]) -> None:
    """Put the tables between the page's markers."""
    body = lines(runs, WAYS)
    if more:
        body += ["The engine on what is harder, two towns each:", "", *lines(more, WAYS[:2])]
    rewrite(docs / PAGE, BEGIN, END, [*body, *paragraph(f"Measured with {machine()}.")])


def draw_sheet(path: Path) -> None:
    """Frames of one town, a column for every condition and a row for every place."""
    from PIL import Image

    camera = Camera.from_fov(2 * CELL_PX, 2 * CELL_PX, 60.0)
    columns = [_column(name, camera) for name in CONDITIONS]
    sheet = Image.fromarray(np.hstack(columns)).quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path, optimize=True)


def _column(name: str, camera: Camera) -> NDArray[np.uint8]:
    town = build_town(SHEET_SEED, condition=name, relief_m=25.0, river=True)
    middle = town.pixel_to_crs @ ((town.ortho.shape[1] - 1) / 2, (town.ortho.shape[0] - 1) / 2, 1.0)
    lon, lat = transformer(town.crs_epsg).transform(*middle, direction="INVERSE")
    cells = [np.full((22, CELL_PX, 3), 255, np.uint8)]
    cv2.putText(cells[0], name, (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    for east, north, heading in PLACES:
        attitude, rng = Attitude(2.0, -3.0, heading), np.random.default_rng(1)
        seen = picture_at(town, camera, LocalFrame(lat, lon), np.array([east, north, 165.0]), attitude, rng)
        small = cv2.resize(seen, (CELL_PX, CELL_PX), interpolation=cv2.INTER_AREA)
        cells.append(
            np.asarray(cv2.copyMakeBorder(small[2:, 2:], 2, 0, 2, 0, cv2.BORDER_CONSTANT, value=(255,) * 3))
        )
    return np.vstack(cells)


def main() -> None:
    """Fly, and write the tables; or draw the sheet."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--quick", action="store_true", help="a few frames over one town")
    parser.add_argument("--sheet", action="store_true", help="draw the frames of every condition, fly nothing")
    options = parser.parse_args()
    if options.sheet:
        draw_sheet(DOCS / "img" / "sim-conditions.png")
        return
    seeds, frames = (SEEDS[:1], 5) if options.quick else (SEEDS, None)
    runs: list[Run] = []
    for run in flights(seeds, frames):
        runs.append(run)
        short = {key: run.summary[key] for key in ("frames", "fixes", "rms_m", "false_fixes")}
        print(json.dumps([run.day, run.seed, run.method, run.profile, short]), flush=True)
    write(options.docs, runs, list(harder(seeds[:2], frames)))


if __name__ == "__main__":
    main()
