"""Scores of NCC on simulated and recorded flights and over the seasons: ``python -m bench.accuracy.scores``.

Writes docs/results/scores.md. Every figure comes from the engine's own steps; it needs the recorded data.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bench import RESULTS
from bench.accuracy.trials import Ground, flown
from bench.command import parser_on_one_thread
from bench.inputs.farmland import farmland, vintages
from bench.pages.text import machine, paragraph, table
from engine import MatcherOptions, OrthoMap, Prior
from engine.budget import Budget, Deadline
from engine.kernels.scores import SCORES, enhance
from engine.maps.prepared import PreparedMap
from engine.matching.align import to_gray
from engine.matching.correlation import Aligned, Correlator
from engine.matching.covariance import score_sigma
from engine.matching.peak_evidence import candidate_of
from engine.matching.query import Query
from engine.ncc_fft import match_template, prepare
from engine.options import NccOptions
from engine.runtime.scheduler import Scheduler
from engine.window import level_for
from scenematch.simulator import plan_flight

Gray = NDArray[np.uint8]

CPU = torch.device("cpu")
RISK = MatcherOptions().risk
SEEDS = (7, 8, 9)
WRONG_M = 10.0
PRIOR_OFF_M = 20.0  # at most, per axis
PRIOR_SIGMA_M = 12.0
RECORDED = {
    "gazebo-a1": ("town A1, drawn by Gazebo", 8),
    "gazebo-a1-evening": ("town A1 in low evening light, map of noon", 8),
    "gazebo-a2": ("town A1, flight A2 with hard turns", 8),
    "nust": ("campus, video on a satellite map of another date", 4),
    "caliterra": ("bare ground from 30 to 50 m, map of the same day", 1),
}
SEASON_PX, SEASON_REACH_PX, SEASON_WITHIN_PX, SEASON_PATCHES = 200, 100, 4.0, 12
HEAD = ["measured on", *(f'`"{score}"`' for score in SCORES)]
TIMED_PX, TIMED_RUNS = 228, 300


@dataclass(frozen=True)
class Trial:
    """One search: how far off the peak is, by how many sigmas it leads its rival, and whether it is accepted."""

    error_m: float
    lead: float
    accepted: bool


# --------------------------------------------------------------------------------------------------- inputs


def simulated(light: str) -> Iterator[Ground]:
    for seed in SEEDS:
        plan = plan_flight(seed, rate_hz=0.28, condition=light)
        site = plan.town.site()
        places = [site.frame.enu_from_geodetic(row.lat_deg, row.lon_deg) for row in plan.truth_rows()]
        yield Ground(f"{seed}", site, plan.camera, list(plan.iter_frames()), np.array(places))


# ------------------------------------------------------------------------------------------------- measuring


def fly(flight: Ground, score: str, site: OrthoMap | None = None) -> list[Trial]:
    """Every frame searched about a place off the truth, on its own map or on one that it does not show."""
    options = NccOptions(score=score, exhaustive=True)
    ground = site or flight.site
    prepared = PreparedMap(ground, CPU, options.enhance_radius_px, score)
    pinhole = replace(flight.camera, distortion_model="plumb_bob", distortion=np.zeros(5))
    rng = np.random.default_rng(0)
    trials = []
    for frame, truth in zip(flight.frames, flight.places_m, strict=True):
        east, north = truth + rng.uniform(-PRIOR_OFF_M, PRIOR_OFF_M, 2)
        prior = Prior(east_m=float(east), north_m=float(north), sigma_m=PRIOR_SIGMA_M)
        gray = flight.camera.undistort(to_gray(frame))
        query = Query(frame, gray, pinhole, ground, prior, CPU, Scheduler(Deadline(Budget()), CPU), RISK)
        trials.append(search(query, prepared, options, truth))
    return trials


def search(query: Query, prepared: PreparedMap, options: NccOptions, truth: NDArray[np.float64]) -> Trial:
    """The steps of engine/matching/ncc.py, keeping the rival of the peak also where it is refused."""
    refused = Trial(np.inf, 0.0, False)
    site, height_m = query.site, query.frame.height_agl_m
    assert height_m is not None
    level = level_for(site.gsd_m_per_px, height_m / query.camera.focal_px, site.levels)
    correlator = Correlator(query, prepared, options)
    aligned = correlator.align(query.telemetry, level)
    if not isinstance(aligned, Aligned):
        return refused
    window = correlator.window(aligned)
    peak = None if window is None else correlator.search(aligned, window)
    if peak is None:
        return refused
    pixels = aligned.template.size
    nadir = site.full_from_level(np.array([peak.x, peak.y]) - aligned.patch.offset_px, level)
    error_m = float(np.hypot(*(site.enu_from_pixel(nadir) - truth)))
    lead = (peak.score - peak.second_score) / score_sigma(pixels)
    found = candidate_of(correlator, aligned, peak, window)
    accepted = found.is_inside and replace(found.evidence, prior_chi_square=None).suffices(RISK)
    return Trial(error_m, lead if error_m <= WRONG_M else -lead, accepted)


def seasons(years: dict[int, Gray], pairs: list[tuple[int, int]], score: str) -> tuple[list[float], list[float]]:
    """Per pair of years the share of patches that are found, and of all patches the lead."""
    maps = {year: prepare(torch.from_numpy(enhance(gray, score=score))) for year, gray in years.items()}
    rng = np.random.default_rng(0)
    shares, leads = [], []
    for old, new in pairs:
        rows, columns = years[old].shape
        found = 0
        for _ in range(SEASON_PATCHES):
            x, y = (int(rng.integers(SEASON_REACH_PX, n - SEASON_PX - SEASON_REACH_PX)) for n in (columns, rows))
            patch = np.ascontiguousarray(years[old][y : y + SEASON_PX, x : x + SEASON_PX])
            side = SEASON_PX + 2 * SEASON_REACH_PX
            window = maps[new].crop(x - SEASON_REACH_PX, y - SEASON_REACH_PX, side, side)
            template = torch.from_numpy(enhance(patch, score=score))
            peak = match_template(window, template, exclusion_px=6.0, exhaustive=True)
            right = np.hypot(peak.x - SEASON_REACH_PX, peak.y - SEASON_REACH_PX) <= SEASON_WITHIN_PX
            lead = (peak.score - peak.second_score) / score_sigma(template.numel())
            leads.append(lead if right else -lead)
            found += bool(right)
        shares.append(found / SEASON_PATCHES)
    return shares, leads


def median_ms(score: str) -> float:
    gray = np.random.default_rng(0).integers(0, 256, (TIMED_PX, TIMED_PX)).astype(np.uint8)
    spent = []
    for _ in range(TIMED_RUNS):
        start = time.perf_counter()
        enhance(gray, score=score)
        spent.append(time.perf_counter() - start)
    return float(np.median(spent) * 1e3)


# ---------------------------------------------------------------------------------------------------- writing


def outcome(trials: list[Trial]) -> str:
    fixes = np.array([trial.error_m for trial in trials if trial.accepted])
    right = fixes[fixes <= WRONG_M]
    rms = f"{np.sqrt(np.mean(right**2)):.2f} m" if len(right) else "-"
    wrong, lead = len(fixes) - len(right), float(np.median([trial.lead for trial in trials]))
    return f"{len(fixes)}, {wrong}, {rms}, {lead:.1f}"


def chance(trials: list[Trial]) -> str:
    """The lead of places that are not there; it is negative by the sign of wrong ones."""
    highest = float(np.quantile([-trial.lead for trial in trials], 0.95))
    return f"{sum(trial.accepted for trial in trials)}, {highest:.2f}"


def found(shares: list[float], leads: list[float]) -> str:
    return f"{100 * np.mean(shares):.1f} %, {100 * min(shares):.0f} %, {np.median(leads):.1f}"


def per_score(cell: Callable[[str], str]) -> list[str]:
    return [cell(score) for score in SCORES]


def measure() -> list[list[str]]:
    """Rows of the table of figures, the first cell of each saying what was measured."""
    rows = []
    for light in ("noon", "evening"):
        flights = list(simulated(light))
        count = sum(len(flight.frames) for flight in flights)
        cells = per_score(lambda score, f=flights: outcome([t for one in f for t in fly(one, score)]))
        rows.append([f"simulated towns, {light} ({count}); fitted on", *cells])
        others = list(zip(flights, flights[1:] + flights[:1], strict=True))
        cells = per_score(lambda s, o=others: chance([t for one, other in o for t in fly(one, s, other.site)]))
        rows.append([f"the same on the map of another town ({count}); fitted on", *cells])
    for name, (title, step) in RECORDED.items():
        flight = flown(name, step)
        cells = per_score(lambda score, f=flight: outcome(fly(f, score)))
        rows.append([f"{title} ({len(flight.frames)})", *cells])
    years = {int(year): farmland(year) for year in vintages()}
    pairs = list(permutations(years, 2))
    fitted = [pair for pair in pairs if not (pair[0] % 2 or pair[1] % 2)]
    for title, part in (("fitted on", fitted), ("the other pairs", [p for p in pairs if p not in fitted])):
        cells = per_score(lambda score, p=part: found(*seasons(years, p, score)))
        rows.append([f"years of farmland, {len(part)} pairs ({len(part) * SEASON_PATCHES}); {title}", *cells])
    rows.append([f"time for {TIMED_PX} x {TIMED_PX} px", *per_score(lambda score: f"{median_ms(score):.2f} ms")])
    return rows


PAGE = f"""# Scores

{{made}}
Height, heading and tilt are the telemetry's, the prior is up to {PRIOR_OFF_M:.0f} m off per axis.

- **Flights** (frames): fixes, wrong ones by more than {WRONG_M:.0f} m, RMS of the others, median lead of the
  peak over its rival in sigmas.
- **Map of another town** (frames): positions accepted, all wrong; 95th percentile of the lead.
- **Years of farmland** (patches of {SEASON_PX} x {SEASON_PX} px of 5 m, searched {SEASON_REACH_PX} px to
  each side): found within {SEASON_WITHIN_PX:.0f} px, the same of the worst pair, lead.
- Rows that say "fitted on" chose the scores and their settings; the others only judge them.

"""


def main() -> None:
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--page", type=Path, default=RESULTS / "scores.md", help="what to write")
    options = parser.parse_args()
    made = "\n".join(paragraph(f"Made by `python -m bench.accuracy.scores` on {machine()}, one thread."))
    options.page.write_text(PAGE.format(made=made) + "\n".join(table(HEAD, measure())), encoding="utf-8")


if __name__ == "__main__":
    main()
