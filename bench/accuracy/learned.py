"""Single frames of the recorded flights by a learned matcher, at their telemetry's position and far from it.

    python -m bench.accuracy.learned --weights FILE --weights FILE [--method learned] [--flight NAME[:STEP] ...]

Each frame is matched alone, with a prior of 15 m sigma: the telemetry's position, or where that has none the truth
and a random error of 10 m. A second pass moves the priors by ``--shift-m``, so that most windows do not hold the
place: what is accepted there and is not the true place counts as wrong. Prints one row a flight and pass.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench import SHARED
from bench.accuracy.flights import MIDDLE, moved_to_middle
from bench.inputs.views import FRAMES
from engine import Camera, Fix, MatcherOptions, OrthoMap, Prior, SceneMatcher
from engine.geo import chi_square
from engine.matching import METHODS
from engine.options import LearnedOptions
from engine.runtime.threads import set_threads
from scenematch.files.flight import Flight, FlightFrame, open_flight
from scenematch.files.truth import interpolate_truth, read_truth

FLIGHTS = ("brighton", "seneca", "caliterra", "nust:10")
SIGMA_M = 15.0
NO_POSITION_M = 10.0  # error of the prior where the telemetry has none
SHIFTED_M = 5.0  # besides the shift
WRONG_M, WRONG_CHI_SQUARE = 10.0, 11.83  # three sigma in two dimensions


@dataclass(frozen=True)
class Trial:
    """One frame: its error where it was fixed, its chi-square, and what it took, in all and on the processor."""

    error_m: float | None
    chi_square: float
    ms: float
    cpu_ms: float


def trials(name: str, step: int, matcher: SceneMatcher, flight: Flight, shift_m: float) -> Iterator[Trial]:
    truth = read_truth(SHARED / name / "truth.csv")
    rng = np.random.default_rng(0)
    for index in range(0, len(flight), step):
        item = flight.read(index)
        assert item.frame.timestamp_ns is not None
        true = interpolate_truth(truth, item.frame.timestamp_ns)
        if true is None:
            continue
        site = matcher.site
        place_m = np.asarray(site.enu_from_pixel(site.pixel_from_geodetic(true.lat_deg, true.lon_deg)))
        prior = prior_of(item, place_m, shift_m, rng)
        start, cpu_start = time.perf_counter(), time.process_time()
        result = matcher.locate(item.frame, prior)
        ms, cpu_ms = (time.perf_counter() - start) * 1e3, (time.process_time() - cpu_start) * 1e3
        if not isinstance(result, Fix):
            yield Trial(None, 0.0, ms, cpu_ms)
            continue
        at = moved_to_middle(result, site, matcher.camera) if name in MIDDLE else result
        error = np.array([at.east_m, at.north_m]) - place_m
        yield Trial(float(np.hypot(*error)), chi_square(error, result.covariance_m2[:2, :2]), ms, cpu_ms)


def prior_of(item: FlightFrame, place_m: np.ndarray, shift_m: float, rng: np.random.Generator) -> Prior:
    if item.prior is not None and not shift_m:
        return item.prior
    angle = rng.uniform(0.0, 2.0 * np.pi)
    error = rng.normal(0.0, SHIFTED_M if shift_m else NO_POSITION_M, 2)
    east, north = place_m + error + shift_m * np.array([np.cos(angle), np.sin(angle)])
    return Prior(east_m=float(east), north_m=float(north), sigma_m=SIGMA_M)


def row(flight: str, found: list[Trial], shift_m: float) -> str:
    errors = np.array([trial.error_m for trial in found if trial.error_m is not None])
    outside = np.array([trial.chi_square for trial in found if trial.error_m is not None]) > WRONG_CHI_SQUARE
    cells = [flight, f"{shift_m:.0f}", str(len(found)), str(len(errors))]
    cells += [str(int((errors <= limit).sum())) for limit in (1.0, 5.0, 10.0)]
    cells += [f"{np.median(errors):.2f}", f"{np.sqrt((errors**2).mean()):.2f}"] if len(errors) else ["", ""]
    cells += [str(int((outside & (errors > WRONG_M)).sum())), str(int(outside.sum()))]
    for name in ("ms", "cpu_ms"):
        cells.append(f"{np.median([getattr(trial, name) for trial in found]):.0f}")
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", action="append", default=[], help="a file of the learned method")
    parser.add_argument("--method", default="learned", choices=METHODS)
    parser.add_argument("--flight", action="append", help="NAME or NAME:STEP, every STEP-th frame")
    parser.add_argument("--shift-m", type=float, default=250.0, help="of the second pass; 0 leaves it out")
    parser.add_argument("--device", default="auto")
    arguments = parser.parse_args()
    set_threads(1)
    options = MatcherOptions(learned=LearnedOptions(weights=tuple(arguments.weights)))
    print(
        "| flight | shift m | frames | fixed | 1 m | 5 m | 10 m | median | RMS | wrong | outside | ms | CPU ms |"
    )
    for text in arguments.flight or FLIGHTS:
        name, _, step = text.partition(":")
        folder: Path = SHARED / name
        surface = folder / "dsm.tif"
        site = OrthoMap.open(folder / "map.tif", surface=surface if surface.exists() else None)
        camera = Camera.load(folder / "camera.yaml")
        matcher = SceneMatcher(site, camera, arguments.method, arguments.device, options)
        flight = open_flight(folder / FRAMES.get(name, "frames"), folder / "telemetry.csv")
        for shift_m in (0.0, arguments.shift_m)[: 2 if arguments.shift_m else 1]:
            print(row(name, list(trials(name, int(step or 1), matcher, flight, shift_m)), shift_m), flush=True)


if __name__ == "__main__":
    main()
