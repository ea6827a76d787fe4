"""Whole flights by SIFT, through the Navigator, beside OpenCV's features and the paper's recipe.

    python -m bench.accuracy.flights [--quick] [--docs DIR]

Writes docs/results/flights.md. Recorded flights that are missing are left out; the built-in one always flies.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench import SHARED
from bench.accuracy.truth import answered, rows_of, true_places_m, true_start
from bench.command import parser_on_one_thread
from bench.inputs.views import FRAMES
from bench.pages import flights
from bench.pages.flights import Run
from bench.speed.peers import OpenCvFeatures
from engine import Camera, Fix, Frame, MatcherOptions, Navigator, NoFix, OrthoMap, Prior, SceneMatcher
from engine.geo import Array, enu_from_body
from engine.navigation.navigator import Matcher
from engine.options import SiftOptions
from engine.values import Attitude, Truth
from scenematch.files.flight import open_flight
from scenematch.files.telemetry import ground_amsl_m
from scenematch.files.truth import interpolate_truth, read_truth
from scenematch.report.metrics import Ground, errors_en_m, summarise
from scenematch.runs.paper_recipe import ACCEPT_ALL, PaperSift
from scenematch.simulator import plan_flight

STEPS = {"gazebo-a1": 3, "gazebo-a2": 3, "gazebo-a1-evening": 3, "nust": 2, "caliterra": 1}
MIDDLE = ("nust",)  # whose truth is the ground in the middle of each frame, not below the camera
SIMULATED_SEED, SIMULATED_HZ = 1, 0.56
OURS, NO_ATTITUDE = "scenematch SIFT", "scenematch SIFT, attitude not used"
OPENCV, PAPER = "OpenCV features, scenematch pose", "paper's SIFT"


@dataclass(frozen=True)
class Recorded:
    """A flight as the navigator meets it."""

    name: str
    step: int
    site: OrthoMap
    camera: Camera
    frames: list[tuple[Frame, Prior | None]]
    truth: list[Truth]
    ground: Ground

    def true_place_m(self, stamp_ns: int | None) -> NDArray[np.float64] | None:
        """(2,) true east and north at a moment; None where they are not known."""
        true = None if stamp_ns is None else interpolate_truth(self.truth, stamp_ns)
        return None if true is None else true_places_m(self.site, [true])[0]

    def placed(self) -> list[tuple[Frame, Array]]:
        """Those frames whose true east and north (2,) are known."""
        places = [(frame, self.true_place_m(frame.timestamp_ns)) for frame, _ in self.frames]
        return [(frame, place) for frame, place in places if place is not None]


def recorded(name: str, step: int, *, with_surface: bool = True, **accuracy: float | None) -> Recorded:
    """Every ``step``-th frame of a shared flight; the accuracy of its map as :meth:`OrthoMap.open` takes it."""
    folder = SHARED / name
    camera, surface = Camera.load(folder / "camera.yaml"), folder / "dsm.tif"
    has_surface = with_surface and surface.exists()
    site = OrthoMap.open(folder / "map.tif", surface=surface if has_surface else None, **accuracy)
    flown = open_flight(folder / FRAMES.get(name, "frames"), folder / "telemetry.csv", camera)
    frames = [(item.frame, item.prior) for index, item in enumerate(flown) if index % step == 0]
    ground = Ground(site.ground_m, ground_amsl_m(flown.rows))
    return Recorded(name, step, site, camera, frames, read_truth(folder / "truth.csv"), ground)


def simulated(rate_hz: float = SIMULATED_HZ) -> Recorded:
    """The built-in flight, every second frame of it if nothing else is said."""
    plan = plan_flight(SIMULATED_SEED, rate_hz=rate_hz)
    site = plan.town.site()
    frames: list[tuple[Frame, Prior | None]] = [(frame, None) for frame in plan.iter_frames()]
    return Recorded("built-in", 2, site, plan.camera, frames, plan.truth_rows(), Ground(site.ground_m))


def fly(flight: Recorded, who: str, matcher: Matcher) -> Run:
    """Follow the flight from its true start."""
    options = ACCEPT_ALL if who == PAPER else None
    navigator = Navigator(matcher, true_start(flight.truth), options=options)
    results, spent_ms = answered(navigator.update, flight.frames)
    seen = [where_truth_is(flight.name, flight.site, flight.camera, result) for result in results]
    rows = rows_of(seen, spent_ms)
    shares = [result.score for result in results if isinstance(result, Fix)]
    return Run(
        flight.name,
        who,
        flight.step,
        summarise(rows, flight.truth, frame=flight.site.frame, ground=flight.ground),
        errors_en_m(rows, flight.truth, flight.site.frame).distance_m,
        float(np.mean(shares)) if shares else None,
        attitude_rms_deg(results, flight.truth),
    )


def where_truth_is(name: str, site: OrthoMap, camera: Camera, result: Fix | NoFix) -> Fix | NoFix:
    """An answer on a flight, its fix at the place that the flight's truth is of."""
    return moved_to_middle(result, site, camera) if name in MIDDLE and isinstance(result, Fix) else result


def moved_to_middle(fix: Fix, site: OrthoMap, camera: Camera) -> Fix:
    """The fix at the ground that the middle of its frame shows, where it has a pose."""
    if fix.attitude is None or fix.up_m is None:
        return fix
    ray = camera.enu_from_camera(fix.attitude) @ camera.frame_rays[4]
    east, north = np.array([fix.east_m, fix.north_m]) + ray[:2] * (fix.up_m - site.ground_m) / -ray[2]
    lat, lon = site.frame.geodetic_from_enu(east, north)
    return replace(fix, east_m=float(east), north_m=float(north), lat_deg=float(lat), lon_deg=float(lon))


def attitude_rms_deg(results: list[Fix | NoFix], truth: list[Truth]) -> float | None:
    """RMS of the angle of the whole rotation from true to measured attitude; None where none is known."""
    angles = []
    for result in results:
        true = None if result.timestamp_ns is None else interpolate_truth(truth, result.timestamp_ns)
        if isinstance(result, Fix) and result.attitude is not None and true is not None:
            if true.heading_deg is None or true.roll_deg is None or true.pitch_deg is None:
                continue
            between = _turn(result.attitude) @ _turn(Attitude(true.roll_deg, true.pitch_deg, true.heading_deg)).T
            angles.append(math.degrees(float(np.linalg.norm(cv2.Rodrigues(between)[0]))))
    return float(np.sqrt(np.mean(np.square(angles)))) if angles else None


def _turn(attitude: Attitude) -> NDArray[np.float64]:
    return enu_from_body(attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg)


def methods(flight: Recorded) -> Iterator[tuple[str, Matcher]]:
    """The four that every flight is flown by."""
    yield OURS, _engine(flight, SiftOptions())
    yield NO_ATTITUDE, _engine(flight, SiftOptions(use_attitude=False))
    yield OPENCV, OpenCvFeatures(flight.site, flight.camera, prepared=True)
    yield PAPER, SceneMatcher(flight.site, flight.camera, PaperSift, "cpu")


def _engine(flight: Recorded, options: SiftOptions) -> SceneMatcher:
    matcher = SceneMatcher(flight.site, flight.camera, "sift", "cpu", MatcherOptions(sift=options))
    matcher.warmup()
    return matcher


# ------------------------------------------------------------------------- what the telemetry does not tell


def variants() -> list[tuple[str, dict[str, Any], SiftOptions]]:
    """Name, what becomes of each frame's telemetry (a number multiplies the height), and the options."""
    unknown = {"heading_deg": None, "height_agl_m": None}
    return [
        ("as recorded", {}, SiftOptions()),
        ("attitude known, not used", {}, SiftOptions(use_attitude=False)),
        ("roll and pitch unknown", {"roll_deg": None, "pitch_deg": None}, SiftOptions()),
        ("heading unknown", {"heading_deg": None}, SiftOptions()),
        ("height unknown", {"height_agl_m": None}, SiftOptions()),
        ("height given as half", {"height_agl_m": 0.5}, SiftOptions()),
        ("height given as double", {"height_agl_m": 2.0}, SiftOptions()),
        ("heading and height unknown", unknown, SiftOptions()),
        ("nothing known but the start", {**unknown, "roll_deg": None, "pitch_deg": None}, SiftOptions()),
    ]


def retold(frame: Frame, changes: dict[str, Any]) -> Frame:
    """The frame with other telemetry; a number given for the height is a factor on it."""
    factor = changes.get("height_agl_m")
    if factor is not None and frame.height_agl_m is not None:
        changes = {**changes, "height_agl_m": factor * frame.height_agl_m}
    return replace(frame, **changes)


def fly_variants(flight: Recorded) -> Iterator[Run]:
    """The built-in flight under every telemetry."""
    for name, changes, options in variants():
        frames = [(retold(frame, changes), prior) for frame, prior in flight.frames]
        yield fly(replace(flight, frames=frames), name, _engine(flight, options))


def main() -> None:
    """Fly, and write the page."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--quick", action="store_true", help="a few frames of each flight")
    options = parser.parse_args()
    there = [(name, step) for name, step in STEPS.items() if (SHARED / name).is_dir()]
    runs, built_in = [], simulated()
    for name, step in [*there, (built_in.name, built_in.step)]:
        flight = built_in if name == built_in.name else recorded(name, step)
        if options.quick:
            flight = replace(flight, frames=flight.frames[:8])
        for who, matcher in methods(flight):
            runs.append(fly(flight, who, matcher))
            print(f"{name}, {who}: {runs[-1].summary['fixes']} of {len(flight.frames)} frames fixed", flush=True)
    if options.quick:
        built_in = replace(built_in, frames=built_in.frames[:8])
    flights.write(options.docs, runs, list(fly_variants(built_in)))


if __name__ == "__main__":
    main()
