"""A flight without end: the built-in one, drawn once, flown forth and back; and what is measured of each frame."""

from __future__ import annotations

import gc
import math
import resource
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any

import numpy as np

from bench.accuracy.truth import off, prior_at, true_places_m
from engine import Budget, Camera, Fix, Frame, MatcherOptions, Navigator, NoFix, OrthoMap, Prior, SceneMatcher
from engine.geo import Array
from engine.matching.method import Method
from engine.options import NavigatorOptions
from scenematch.report.metrics import FALSE_SIGMAS, WRONG_M
from scenematch.simulator import plan_flight

RATE_HZ = 2.24
DIVE_M, DIVE_S = 40.0, 50.0
START_NS = 1_000_000_000
START_SIGMA_M = 10.0
GRACE_MS = 5.0
"""How much later than its budget an answer may come before it counts as a miss."""
PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


@dataclass(frozen=True)
class Course:
    """Frames that can be flown forth and back for ever.

    Attributes:
        site: the map.
        camera: of the frames.
        frames: in the order of the flight, with telemetry.
        places_m: (N, 2) true east and north.
        step_ns: between two frames.
        headless_every: every so many frames one comes without its heading; 0 leaves them all theirs.
    """

    site: OrthoMap
    camera: Camera
    frames: list[Frame]
    places_m: Array
    step_ns: int
    headless_every: int = 0

    @property
    def start(self) -> Prior:
        """Where the flight begins."""
        return prior_at(self.places_m[0], START_SIGMA_M)

    def frame(self, number: int) -> Frame:
        """The frame with this number, stamped by it; on the way back the drone flies backwards."""
        index, back = there_and_back(number, len(self.frames))
        frame, sign = self.frames[index], -1.0 if back else 1.0
        return replace(
            frame,
            timestamp_ns=START_NS + number * self.step_ns,
            east_velocity_mps=sign * (frame.east_velocity_mps or 0.0),
            north_velocity_mps=sign * (frame.north_velocity_mps or 0.0),
            heading_deg=None if self.headless_every and number % self.headless_every == 0 else frame.heading_deg,
        )

    def error(self, number: int, fix: Fix) -> tuple[float, float]:
        """Horizontal distance of a fix from the truth, in metres and in sigmas of its own covariance."""
        return off(fix, self.places_m[there_and_back(number, len(self.frames))[0]])


def there_and_back(number: int, count: int) -> tuple[int, bool]:
    """Which of ``count`` frames comes at a number, and whether the way leads back: 0 1 2 1 0 1 2 ..."""
    if count < 2:
        return 0, False
    phase = number % (2 * count - 2)
    return (phase, False) if phase < count else (2 * count - 2 - phase, True)


def draw(count: int | None = None, dive_m: float = DIVE_M, rate_hz: float = RATE_HZ) -> Course:
    """Draw the built-in flight; ``dive_m`` deep waves of the height give windows of many sizes."""
    plan = plan_flight(1, frames=count, rate_hz=rate_hz)
    dive = np.zeros((len(plan), 3))
    dive[:, 2] = 0.5 * dive_m * (np.cos(2.0 * np.pi * plan.truth.time_s / DIVE_S) - 1.0)
    truth, told = (replace(m, position_m=m.position_m + dive) for m in (plan.truth, plan.telemetry))
    plan = replace(plan, truth=truth, telemetry=told)
    site = plan.town.site()
    places_m = true_places_m(site, plan.truth_rows())
    return Course(site, plan.camera, list(plan.iter_frames()), places_m, round(1e9 / rate_hz))


def warm(course: Course, method: str | type[Method], options: MatcherOptions | None = None) -> SceneMatcher:
    """A matcher that is ready to fly."""
    matcher = SceneMatcher(course.site, course.camera, method, "cpu", options)
    matcher.warmup()
    return matcher


# ------------------------------------------------------------------------------------------------- one frame


class Collections:
    """Counts the milliseconds that Python's garbage collector takes while it is entered."""

    def __init__(self) -> None:
        self.ms, self._start_ns = 0.0, 0

    def __enter__(self) -> Collections:
        gc.callbacks.append(self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        gc.callbacks.remove(self._note)

    def _note(self, phase: str, info: Mapping[str, int]) -> None:
        if phase == "start":
            self._start_ns = time.perf_counter_ns()
        else:
            self.ms += (time.perf_counter_ns() - self._start_ns) * 1e-6


@dataclass(frozen=True)
class Taken:
    """What one call took.

    Attributes:
        wall_ms: from call to answer.
        cpu_ms: that the calling thread was on a core; what it waited for other threads is not in it.
        collector_ms: in the garbage collector.
        preempted: how often the core was taken from it.
    """

    wall_ms: float
    cpu_ms: float
    collector_ms: float
    preempted: int


def cause(taken: Taken, stages_ms: Mapping[str, float], budget_ms: float, allowed_ms: float) -> str:
    """Why an answer came after ``allowed_ms``: what it would have to be without to be on time."""
    if taken.cpu_ms <= allowed_ms:
        return "preempted" if taken.preempted else "held or waiting"
    if taken.wall_ms - taken.collector_ms <= allowed_ms:
        return "garbage collector"
    return f"stage {stage_at(stages_ms, budget_ms)}"


def stage_at(stages_ms: Mapping[str, float], moment_ms: float) -> str:
    """The stage that ran at a moment, of stages that ran one after the other; "none" after the last."""
    end = 0.0
    for name, spent_ms in stages_ms.items():
        end += spent_ms
        if moment_ms < end:
            return name
    return "none"


# ----------------------------------------------------------------------------------------------- many frames


@dataclass(frozen=True)
class Flown:
    """What became of the frames of a flight, in their order.

    Attributes:
        budget_ms: of each; infinite where there was none.
        wall_ms: (N,) from call to answer.
        cpu_ms: (N,) on a core.
        error_m: (N,) horizontal, NaN where there is no fix.
        error_sigmas: (N,) the same in sigmas of the fix's own covariance.
        stages: fixes by stage.
        reasons: refusals by reason.
        stale: fixes that carry another frame's stamp.
        windows: different sizes of the window.
        causes: of the misses.
    """

    budget_ms: float
    wall_ms: Array
    cpu_ms: Array
    error_m: Array
    error_sigmas: Array
    stages: Counter[str]
    reasons: Counter[str]
    stale: int
    windows: int
    causes: Counter[str]


def fly(
    course: Course,
    matcher: SceneMatcher,
    count: int,
    budget_ms: float = math.inf,
    each: Callable[[int, float], None] | None = None,
    options: NavigatorOptions | None = None,
) -> Flown:
    """Follow the course for ``count`` frames; ``each`` as in :func:`measured`."""
    navigator = Navigator(matcher, course.start, Budget(total_ms=budget_ms), options)
    return measured(navigator.update, lambda n: (course.frame(n),), course.error, count, budget_ms, each)


def measured(
    locate: Callable[..., Fix | NoFix],
    asked: Callable[[int], tuple[Any, ...]],
    error_of: Callable[[int, Fix], tuple[float, float]],
    count: int,
    budget_ms: float,
    each: Callable[[int, float], None] | None = None,
) -> Flown:
    """What becomes of so many frames.

    Args:
        locate: answers a frame.
        asked: its arguments by their number, a frame first.
        error_of: the error of a frame's fix, in metres and in sigmas.
        count: of the frames.
        budget_ms: of each.
        each: is called after each of them, untimed, with its number and the milliseconds it took.
    """
    wall, cpu, error, sigmas = np.full((4, count), np.nan)  # written now, so that memory does not grow in flight
    stages, reasons, causes = Counter[str](), Counter[str](), Counter[str]()
    windows, stale = set[tuple[int, int]](), 0
    with Collections() as collections:
        for number in range(count):
            arguments = asked(number)
            result, taken = timed(lambda a=arguments: locate(*a), collections)
            wall[number], cpu[number] = taken.wall_ms, taken.cpu_ms
            if result.window is not None:
                windows.add((result.window.width_px, result.window.height_px))
            if isinstance(result, Fix):
                error[number], sigmas[number] = error_of(number, result)
                stages[result.stage] += 1
                stale += result.timestamp_ns != arguments[0].timestamp_ns
            else:
                reasons[result.reason.value] += 1
            if taken.wall_ms > budget_ms + GRACE_MS:
                causes[cause(taken, result.timings.stages_ms, budget_ms, budget_ms + GRACE_MS)] += 1
            if each is not None:
                each(number, taken.wall_ms)
    return Flown(budget_ms, wall, cpu, error, sigmas, stages, reasons, int(stale), len(windows), causes)


def timed(call: Callable[[], Any], collections: Collections) -> tuple[Any, Taken]:
    """What a call returns, and what it took."""
    collected, switches = collections.ms, resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw
    cpu, start = time.thread_time_ns(), time.perf_counter_ns()
    result = call()
    wall_ms, cpu_ms = (time.perf_counter_ns() - start) * 1e-6, (time.thread_time_ns() - cpu) * 1e-6
    switches = resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw - switches
    return result, Taken(wall_ms, cpu_ms, collections.ms - collected, switches)


def summary(flown: Flown, who: str, stop_ms: float = 0.0, **more: Any) -> dict[str, Any]:
    """A flight as a row: latency, accuracy, and what was late and why; ``stop_ms`` is a stop nobody can help."""
    fixed = np.isfinite(flown.error_m)
    error, count = flown.error_m[fixed], len(flown.wall_ms)
    allowed_ms, tenth = flown.budget_ms + GRACE_MS, -(-count // 10)
    return {
        "who": who,
        "budget_ms": flown.budget_ms if math.isfinite(flown.budget_ms) else None,
        "frames": count,
        "within": float(np.mean(flown.wall_ms <= allowed_ms)),
        "within_budget": float(np.mean(flown.wall_ms <= flown.budget_ms)),
        "within_but_a_stop": float(np.mean(flown.wall_ms <= allowed_ms + stop_ms)),
        "within_on_core": float(np.mean(flown.cpu_ms <= allowed_ms)),
        "causes": dict(flown.causes.most_common()),
        "availability": float(fixed.mean()),
        "rms_m": float(np.sqrt(np.mean(error**2))) if len(error) else None,
        "wrong": int(np.sum((error > WRONG_M) & ~(flown.error_sigmas[fixed] <= FALSE_SIGMAS))),
        "stale": flown.stale,
        "stages": dict(flown.stages),
        "reasons": dict(flown.reasons),
        "windows": flown.windows,
        "p99_first": float(np.percentile(flown.wall_ms[:tenth], 99)),
        "p99_last": float(np.percentile(flown.wall_ms[-tenth:], 99)),
        "mean": float(flown.wall_ms.mean()),
        **{name: float(np.percentile(flown.wall_ms, level)) for name, level in PERCENTILES.items()},
        **more,
    }
