"""All shared real flights by every method, beside the paper's recipe and the plain classical one.

    python -m bench.accuracy.field [--methods ncc sift ...] [--sets brighton ...] [--step N] [--weights FILE]
                                   [--docs DIR]

Each flight goes through :func:`scenematch.track`, as a user would run it. Writes the page
docs/results/field.md.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench import SHARED
from bench.accuracy.classical import TOLERANCE_SHARE, ClassicalRecipe
from bench.accuracy.flights import MIDDLE, where_truth_is
from bench.accuracy.truth import START_SIGMA_M, answered, rows_of
from bench.command import parser_on_one_thread
from bench.pages import field
from bench.pages.text import printed
from engine import Frame, Navigator, OrthoMap, Prior
from engine.geo import Array
from engine.options import LearnedOptions
from scenematch import FlightFiles, TrackSettings, track
from scenematch.files.track import TrackRow, read_track
from scenematch.files.truth import interpolate_truth
from scenematch.report.metrics import FALSE_SIGMAS, WRONG_M, errors_en_m
from scenematch.runs.arguments import parse_position
from scenematch.runs.inputs import FlightInputs, open_inputs

BLIND = "-blind"  # its positions are withheld
REAL = ("brighton", "seneca", "seneca-blind", "caliterra", "nust")
DRAWN = {"gazebo-a1": 8, "gazebo-a2": 8, "gazebo-a1-evening": 8}
METHODS = ("ncc", "sift", "auto", "learned", "paper-ncc", "paper-sift", "classical")
RECIPE_STEPS = {"nust": 4, "caliterra": 2, "gazebo-a1": 24, "gazebo-a2": 24, "gazebo-a1-evening": 24}
VIDEO = "flight.mp4"
WITHIN_M = (1.0, 5.0, WRONG_M, 20.0)


@dataclass(frozen=True)
class Figures:
    """What one method made of one flight.

    Attributes:
        flight, method: names.
        step: every how many frames one was taken.
        frames, fixed: their numbers.
        within: fixes at most 1, 5, 10 and 20 m off.
        median_m, rms_m: over all fixes; None without one.
        wrong: fixes more than 10 m off.
        outside: fixes outside their own ellipse of three sigma; None where the method states none.
        p50_ms, p99_ms: median and 99th percentile of a frame's time.
    """

    flight: str
    method: str
    step: int
    frames: int
    fixed: int
    within: tuple[int, ...]
    median_m: float | None
    rms_m: float | None
    wrong: int
    outside: int | None
    p50_ms: float
    p99_ms: float


def inputs_of(name: str, step: int) -> tuple[FlightFiles, FlightInputs]:
    """A shared flight, every ``step``-th frame of it."""
    folder = SHARED / name.removesuffix(BLIND)
    files = FlightFiles.in_folder(folder)
    if (folder / VIDEO).is_file():
        files = replace(files, frames=folder / VIDEO)
    inputs = open_inputs(files, [])
    flight = inputs.flight.every(step)
    if name.endswith(BLIND):
        flight.rows[:] = [replace(row, lat_deg=None, lon_deg=None) for row in flight.rows]
    return files, replace(inputs, flight=flight)


def fly(name: str, method: str, step: int, weights: Sequence[Path]) -> Figures:
    """Track a flight as a user would; one without positions in its telemetry starts at its true place."""
    files, inputs = inputs_of(name, step)
    paper = method.startswith("paper-")
    profile = "paper" if paper else "engine"
    settings = TrackSettings(
        start=_start(inputs),
        device="cpu",
        method=method.removeprefix("paper-"),
        profile=profile,
        learned=LearnedOptions(weights=tuple(map(str, weights)) if method == "learned" else ()),
    )
    rows = _middles(name, inputs, settings) if name in MIDDLE else _tracked(files, inputs, settings)
    errors = errors_en_m(rows, inputs.truth, inputs.site.frame)
    spent = [row.latency_ms for row in rows if row.latency_ms is not None]
    squared = None if paper else errors.normalised_squared_errors
    return figures((name, method, step), errors.distance_m, squared, spent)


def _tracked(files: FlightFiles, inputs: FlightInputs, settings: TrackSettings) -> list[TrackRow]:
    with tempfile.TemporaryDirectory() as out:
        track(files, out, settings, force=True, report=False, inputs=inputs)
        return read_track(Path(out) / "track.csv")


def _middles(name: str, inputs: FlightInputs, settings: TrackSettings) -> list[TrackRow]:
    """The rows of the same track with each fix moved to the ground in the middle of its frame, as the truth is.

    A fix with a pose is the vehicle's position, and the file of a track does not hold the pose's attitude.
    """
    matcher = settings.matcher(inputs.site, inputs.camera)
    matcher.warmup()
    navigator = Navigator(matcher, parse_position("start", settings.start), None, settings.acceptance)
    results, spent_ms = answered(navigator.update, ((item.frame, item.prior) for item in inputs.flight))
    return rows_of([where_truth_is(name, inputs.site, inputs.camera, result) for result in results], spent_ms)


def _start(inputs: FlightInputs) -> str | None:
    if any(row.prior is not None for row in inputs.flight.rows):
        return None
    assert inputs.truth
    return f"{inputs.truth[0].lat_deg},{inputs.truth[0].lon_deg},{START_SIGMA_M}"


def figures(
    what: tuple[str, str, int], distance_m: Array, normalised_squared: Array | None, spent_ms: list[float]
) -> Figures:
    """The figures of (N,) errors, NaN where there is no fix."""
    fixes = distance_m[np.isfinite(distance_m)]
    outside = None if normalised_squared is None else int(np.sum(normalised_squared > FALSE_SIGMAS**2))
    within = tuple(int(np.sum(fixes <= limit)) for limit in WITHIN_M)
    return Figures(
        *what,
        len(distance_m),
        len(fixes),
        within,
        float(np.median(fixes)) if len(fixes) else None,
        float(np.sqrt(np.mean(fixes**2))) if len(fixes) else None,
        int(np.sum(fixes > WRONG_M)),
        outside,
        *np.percentile(spent_ms, (50, 99)).tolist(),
    )


# ------------------------------------------------------------------------- the plain classical recipe


def by_recipe(name: str, step: int, seed: int = 1) -> Figures:
    """The recipe on each frame by itself, in a window about the telemetry's position, else about a drawn one."""
    _, inputs = inputs_of(name, step)
    site, rng = inputs.site, np.random.default_rng(seed)
    recipe = ClassicalRecipe(site, inputs.camera)
    recipe.prepare()
    errors, spent = [], []
    for item in inputs.flight:
        truth = interpolate_truth(inputs.truth or [], item.frame.timestamp_ns or 0)
        if truth is None:
            continue
        true = site.pixel_from_enu(site.frame.enu_from_geodetic(truth.lat_deg, truth.lon_deg))
        begin = time.perf_counter()
        nadir = _elected(recipe, item.frame, _expected(site, item.prior, true, rng))
        spent.append((time.perf_counter() - begin) * 1e3)
        errors.append(np.nan if nadir is None else float(np.hypot(*(nadir - true))) * site.gsd_m_per_px)
    return figures((name, "classical", step), np.array(errors), None, spent)


def _expected(site: OrthoMap, prior: Prior | None, true: Array, rng: np.random.Generator) -> Array:
    if prior is None or prior.lat_deg is None:
        return np.asarray(true + rng.normal(0.0, START_SIGMA_M / site.gsd_m_per_px, 2))
    return np.asarray(site.pixel_from_enu(site.frame.enu_from_geodetic(prior.lat_deg, prior.lon_deg)))


def _elected(recipe: ClassicalRecipe, frame: Frame, centre_px: Array) -> Array | None:
    features = recipe.rectified(frame)
    if features is None or frame.height_agl_m is None:
        return None
    gsd = recipe.site.gsd_m_per_px
    return recipe.elect(features, centre_px, 3.0 * START_SIGMA_M / gsd, TOLERANCE_SHARE * frame.height_agl_m / gsd)


# ------------------------------------------------------------------------------------------- the page


def measure(options: argparse.Namespace) -> Iterator[Figures]:
    """Every set by every method, as it is measured."""
    for name in options.sets:
        if not (SHARED / name.removesuffix(BLIND)).is_dir():
            continue
        for method in options.methods:
            if method == "learned" and not options.weights:
                continue
            step = options.step or DRAWN.get(name, 1)
            if method == "classical":
                yield by_recipe(name, options.step or RECIPE_STEPS.get(name, 1))
            else:
                yield fly(name, method, step, options.weights)


def main() -> None:
    """Measure, print, and write the page."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--sets", nargs="+", choices=[*REAL, *DRAWN], default=[*REAL, *DRAWN])
    parser.add_argument("--step", type=int, help="every how many frames one is taken, of every set")
    parser.add_argument("--weights", type=Path, nargs="+", default=(), help="of the learned method, else left out")
    options = parser.parse_args()
    field.write(options.docs, printed(measure(options)))


if __name__ == "__main__":
    main()
