"""Visual odometry between fixes: velocities are withheld, and every second 5 s of a flight is not matched.

    python -m bench.accuracy.odometry [FLIGHT ...] [--quick]

Prints the tables of docs/results/odometry.md. Without names it flies what nothing was fitted to, gazebo-a1 and
nust; gazebo-a2 and "built-in" are what the covariance was fitted to.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from bench import SHARED
from bench.accuracy.flights import Recorded, recorded, simulated, where_truth_is
from bench.accuracy.truth import true_start
from bench.command import parser_on_one_thread
from engine import Budget, Camera, Fix, Frame, Navigator, NavigatorOptions, NoFix, Prior, Reason, SceneMatcher
from engine.assumed_errors import AssumedErrors
from engine.geo import Array
from engine.matching.align import to_gray
from engine.navigation.motion import GroundMotion
from engine.navigation.odometry import NoMotion, VisualOdometry

REPORTED, BUILT_IN = ("gazebo-a1", "nust"), "built-in"
PERIOD_S = 5.0  # with matching, then without
USEFUL_M = 10.0  # a prediction that states more is no position
TRUTH_SIGMA_M = {"nust": 1.0}  # of a truth that is none, per axis
NO_VELOCITY, PICTURES, TELEMETRY = "none", "odometry", "telemetry's velocity"


def flight_of(name: str) -> Recorded:
    """A shared flight as recorded, or the built-in one at 3 Hz."""
    return simulated(rate_hz=3.0) if name == BUILT_IN else recorded(name, 1)


def without_velocity(frame: Frame) -> Frame:
    return replace(frame, east_velocity_mps=None, north_velocity_mps=None)


# --------------------------------------------------------------------------------------- flights with gaps


class EverySecondPeriod:
    """A matcher that refuses every frame of each second period, as over water."""

    def __init__(self, matcher: SceneMatcher, first_ns: int) -> None:
        self._matcher, self._first_ns = matcher, first_ns
        self.site, self.camera = matcher.site, matcher.camera

    def withholds(self, frame: Frame) -> bool:
        return int(((frame.timestamp_ns or 0) - self._first_ns) * 1e-9 // PERIOD_S) % 2 == 1

    def locate(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        if self.withholds(frame):
            return NoFix(reason=Reason.NO_TEXTURE, timestamp_ns=frame.timestamp_ns)
        return self._matcher.locate(frame, prior, budget)


@dataclass
class Gaps:
    """What became of a flight.

    Attributes:
        frames: in all.
        known: with a fix, or a prediction that states ``USEFUL_M`` or less.
        wrong: of these, off by more than 3 of their sigmas and 10 m.
        matched: frames that were not withheld.
        fixed: of these.
        off_m: (2,) error of the prediction at the end of each gap.
        way_m: flown in each gap.
        sigma_m: that each of those predictions states, the map's own error left out.
        back_s: until the first fix after each gap.
    """

    frames: int = 0
    known: int = 0
    wrong: int = 0
    matched: int = 0
    fixed: int = 0
    off_m: list[Array] = field(default_factory=list)
    way_m: list[float] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)


def fly(flight: Recorded, velocity: str) -> Gaps:
    """Follow the flight from its true start, by one kind of velocity."""
    matcher = SceneMatcher(flight.site, flight.camera, "ncc", "cpu")
    matcher.warmup()
    frames = [frame if velocity == TELEMETRY else without_velocity(frame) for frame, _ in flight.frames]
    gappy = EverySecondPeriod(matcher, frames[0].timestamp_ns or 0)
    navigator = Navigator(gappy, true_start(flight.truth), options=NavigatorOptions(odometry=velocity == PICTURES))
    gaps, way_m, before, ended_ns, middle_m = Gaps(), 0.0, None, None, np.zeros(2)
    for index, frame in enumerate(frames):
        result, stamp_ns = navigator.update(frame), frame.timestamp_ns or 0
        place = flight.true_place_m(stamp_ns)
        withheld = gappy.withholds(frame)
        if isinstance(result, Fix):
            seen = where_truth_is(flight.name, flight.site, flight.camera, result)
            middle_m = np.array([seen.east_m - result.east_m, seen.north_m - result.north_m])
        known = _known(navigator, result, middle_m)
        _count(gaps, result, known, place, withheld=withheld)
        if ended_ns is not None and isinstance(result, Fix):
            gaps.back_s.append((stamp_ns - ended_ns) * 1e-9)
            ended_ns = None
        if withheld and before is not None and place is not None:
            way_m += float(np.hypot(*(place - before)))
        before = place
        ends = withheld and index + 1 < len(frames) and not gappy.withholds(frames[index + 1])
        if ends and place is not None and navigator.prediction is not None:
            predicted = navigator.prediction
            gaps.off_m.append(np.array([predicted.east_m, predicted.north_m]) + middle_m - place)
            map_m = AssumedErrors().on_map(flight.site).map_m
            gaps.sigma_m.append(math.sqrt(max(predicted.sigma_m**2 - map_m**2, 0.0)))
            gaps.way_m.append(way_m)
            ended_ns = frames[index + 1].timestamp_ns
        if not withheld or ends:  # a gap without an end that can be judged is no way of the next
            way_m = 0.0
    return gaps


def _known(navigator: Navigator, result: Fix | NoFix, middle_m: Array) -> tuple[Array, float] | None:
    """Place (2,) and standard deviation where the position is known; ``middle_m`` leads to the truth's place."""
    predicted = navigator.prediction
    if isinstance(result, Fix):
        return np.array([result.east_m, result.north_m]) + middle_m, result.sigma_m
    if predicted is None or predicted.sigma_m > USEFUL_M:
        return None
    return np.array([predicted.east_m, predicted.north_m]) + middle_m, predicted.sigma_m


def _count(
    gaps: Gaps, result: Fix | NoFix, known: tuple[Array, float] | None, place: Array | None, *, withheld: bool
) -> None:
    """Add one frame."""
    gaps.frames += 1
    gaps.matched += not withheld
    gaps.fixed += isinstance(result, Fix)
    gaps.known += known is not None
    if known is not None and place is not None:
        gaps.wrong += bool(np.hypot(*(known[0] - place)) > max(3.0 * known[1], 10.0))


# ----------------------------------------------------------------------------------- velocities and their cost

Follower = Callable[[Frame], GroundMotion | NoMotion]


class Affine:
    """The peer: OpenCV's corners, Lucas-Kanade and estimateAffinePartial2D, with the telemetry's attitude."""

    def __init__(self, camera: Camera) -> None:
        self._camera, self._last = camera, None

    def __call__(self, frame: Frame) -> GroundMotion | NoMotion:
        gray, last = to_gray(frame), self._last
        self._last = frame, gray
        if last is None:
            return NoMotion("first")
        earlier, earlier_gray = last
        corners = cv2.goodFeaturesToTrack(earlier_gray, 200, 0.01, 8)
        if corners is None:
            return NoMotion("no corners")
        moved, status, _ = cv2.calcOpticalFlowPyrLK(earlier_gray, gray, corners, None)
        good = status[:, 0] > 0
        if good.sum() < 3:
            return NoMotion("no points")
        back, _ = cv2.estimateAffinePartial2D(moved[good], corners[good])
        if back is None:
            return NoMotion("no similarity")
        middle = self._camera.matrix[:2, 2]
        moved_m = self._ground_m(earlier, back[:, :2] @ middle + back[:, 2]) - self._ground_m(frame, middle)
        interval_s = ((frame.timestamp_ns or 0) - (earlier.timestamp_ns or 0)) * 1e-9
        return GroundMotion(interval_s, moved_m, np.eye(2), 0.0, 1.0)

    def _ground_m(self, frame: Frame, xy_px: Array) -> Array:
        ray = np.linalg.inv(self._camera.matrix) @ [*xy_px, 1.0]
        assert frame.attitude is not None
        assert frame.height_agl_m is not None
        ray = self._camera.enu_from_camera(frame.attitude) @ ray
        return np.asarray(ray[:2] * frame.height_agl_m / -ray[2])


@dataclass
class Steps:
    """What one of them said of all pairs of frames: errors (2,) of ways, their covariances, and milliseconds."""

    off_m: list[Array] = field(default_factory=list)
    covariance_m2: list[Array] = field(default_factory=list)
    interval_s: list[float] = field(default_factory=list)
    moved_m: list[Array] = field(default_factory=list)
    spent_ms: list[float] = field(default_factory=list)
    refused: int = 0


def velocities(flight: Recorded, stride: int) -> dict[str, Steps]:
    """Each way to a velocity over the same frames, in turns."""
    ours, peer = VisualOdometry(flight.camera), Affine(flight.camera)
    ways: dict[str, Follower] = {"scenematch": ours.update, "OpenCV, affine": peer}
    found, before = {name: Steps() for name in ways}, None
    for frame, _ in flight.frames[::stride]:
        frame, place = without_velocity(frame), flight.true_place_m(frame.timestamp_ns)
        for name, way in ways.items():
            begin = time.perf_counter()
            motion = way(frame)
            spent_ms = (time.perf_counter() - begin) * 1e3
            if before is not None and place is not None:
                _note(found[name], motion, place - before, spent_ms, TRUTH_SIGMA_M.get(flight.name, 0.0))
        before = place
    return found


def _note(steps: Steps, motion: GroundMotion | NoMotion, true_m: Array, spent_ms: float, truth_m: float) -> None:
    steps.spent_ms.append(spent_ms)
    if isinstance(motion, NoMotion):
        steps.refused += 1
        return
    steps.off_m.append(motion.moved_m - true_m)
    steps.moved_m.append(true_m)
    steps.interval_s.append(motion.interval_s)
    covariance = motion.velocity_covariance_m2ps2 * motion.interval_s**2
    steps.covariance_m2.append(covariance + 2.0 * truth_m**2 * np.eye(2))


def drift_per_100m(steps: Steps) -> float:
    """Error of the way over ``PERIOD_S``, per 100 m flown."""
    off, way, elapsed, sums = np.zeros(2), 0.0, 0.0, np.zeros(2)
    for off_m, true_m, interval_s in zip(steps.off_m, steps.moved_m, steps.interval_s, strict=True):
        off, way, elapsed = off + off_m, way + float(np.hypot(*true_m)), elapsed + interval_s
        if elapsed >= PERIOD_S:
            sums += np.hypot(*off), way
            off, way, elapsed = np.zeros(2), 0.0, 0.0
    return 100.0 * float(sums[0] / sums[1]) if sums[1] else math.nan


# ----------------------------------------------------------------------------------------------- tables


def gap_rows(flight: Recorded) -> Iterator[str]:
    has_velocity = any(frame.east_velocity_mps is not None for frame, _ in flight.frames)
    for velocity in (NO_VELOCITY, PICTURES, *([TELEMETRY] if has_velocity else [])):
        gaps = fly(flight, velocity)
        off_m, way_m = np.array([np.hypot(*off) for off in gaps.off_m]), sum(gaps.way_m)
        variance = np.square(gaps.sigma_m) + TRUTH_SIGMA_M.get(flight.name, 0.0) ** 2
        yield (
            f"| {flight.name} | {velocity} | {100.0 * off_m.sum() / way_m:.1f} | {np.median(off_m):.1f} "
            f"| {off_m.max():.1f} | {np.median(gaps.sigma_m):.1f} | {np.mean(off_m**2 / variance):.2f} "
            f"| {gaps.known / gaps.frames:.1%} | {gaps.fixed / gaps.matched:.1%} | {gaps.wrong} "
            f"| {np.median(gaps.back_s or [math.nan]):.1f} | {max(gaps.back_s, default=math.nan):.1f} |"
        )


def velocity_rows(flight: Recorded, strides: tuple[int, ...]) -> Iterator[str]:
    for stride in strides:
        for name, steps in velocities(flight, stride).items():
            off = np.array(steps.off_m) / np.array(steps.interval_s)[:, None]
            nees = [o @ np.linalg.solve(c, o) for o, c in zip(steps.off_m, steps.covariance_m2, strict=True)]
            spent_ms = np.percentile(steps.spent_ms, [50, 95])
            yield (
                f"| {flight.name} | {np.median(steps.interval_s):.2f} | {name} "
                f"| {np.sqrt((off**2).sum(axis=1).mean()):.2f} | {drift_per_100m(steps):.1f} "
                f"| {'-' if name.startswith('OpenCV') else f'{np.mean(nees):.2f}'} "
                f"| {steps.refused} of {len(steps.spent_ms)} | {spent_ms[0]:.1f} | {spent_ms[1]:.1f} |"
            )


def main() -> None:
    """Fly, and print the tables."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("flights", nargs="*", default=REPORTED)
    parser.add_argument("--quick", action="store_true", help="the first 20 s of each flight")
    options = parser.parse_args()
    there = [name for name in options.flights if name == BUILT_IN or (SHARED / name).is_dir()]
    flights = [flight_of(name) for name in there]
    if options.quick:
        flights = [replace(flight, frames=flight.frames[:100]) for flight in flights]
    print("| flight | velocity | drift m per 100 m | median m | worst m | states m | NEES | known | fixed | wrong "
          "| first fix after s | worst s |\n|---" + "|---" * 11 + "|")  # fmt: skip
    for flight in flights:
        for row in gap_rows(flight):
            print(row, flush=True)
    print("\n| flight | s apart | by | RMS m/s | drift m per 100 m | NEES | refused | p50 ms | p95 ms |\n|---"
          + "|---" * 8 + "|")  # fmt: skip
    for flight in flights:
        for row in velocity_rows(flight, (1, 5)):
            print(row, flush=True)


if __name__ == "__main__":
    main()
