"""A matcher embedded as the README shows it, on a recorded flight, while a process burns each core."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import cycle, islice
from typing import Any

import numpy as np

from bench import SHARED
from bench.live.burden import hogs
from bench.live.endless import GRACE_MS, PERCENTILES
from engine import Budget, Camera, Fix, Frame, OrthoMap, Prior, SceneMatcher, set_realtime
from engine.geo import Array
from scenematch.files.flight import open_flight
from scenematch.files.truth import read_truth
from scenematch.report.metrics import WRONG_M

Row = dict[str, Any]
FLIGHT = SHARED / "gazebo-a1"
METHODS = ("auto", "ncc", "sift")
BUDGETS_MS = (10.0, 40.0, 121.0)
PRIOR_SIGMA_M = 5.0
PAUSE_SHARE = 0.25  # of a frame's time: a thread in real time that never pauses is throttled by the kernel
SCHEDULING = ("defaults", "realtime")


def embedded(frames: int = 2_000) -> list[Row]:
    """Every method and budget, by default and in real time; none where the flight is not there."""
    if not FLIGHT.is_dir():
        return []
    rows = []
    for scheduling in SCHEDULING:
        with hogs_on_every_core():
            for method in METHODS:
                with multiprocessing.get_context("spawn").Pool(1) as pool:  # as fresh as a user's process
                    rows += pool.apply(match_flight, (method, BUDGETS_MS, frames, scheduling))
    return rows


@contextmanager
def hogs_on_every_core() -> Iterator[None]:
    """One busy process on each core that this one may run on."""
    with ExitStack() as stack:
        for core in sorted(os.sched_getaffinity(0)):
            (hog,) = stack.enter_context(hogs(1))
            os.sched_setaffinity(hog.pid, {core})
        yield


def match_flight(method: str, budgets_ms: tuple[float, ...], count: int, scheduling: str) -> list[Row]:
    """Match the frames of the flight, over and over, with priors of its truth and noise; one row a budget."""
    site = OrthoMap.open(FLIGHT / "map.tif", surface=FLIGHT / "dsm.tif")
    matcher = SceneMatcher(site, Camera.load(FLIGHT / "camera.yaml"), method=method)
    matcher.warmup()
    frames = {
        item.frame.timestamp_ns: item.frame for item in open_flight(FLIGHT / "frames", FLIGHT / "telemetry.csv")
    }
    flown = [
        (frames[row.timestamp_ns], site.frame.enu_from_geodetic(row.lat_deg, row.lon_deg)[:2])
        for row in read_truth(FLIGHT / "truth.csv")
        if row.timestamp_ns in frames
    ]
    if scheduling == "realtime":
        set_realtime()
    return [
        {"who": f"{method}, {scheduling}", "budget_ms": budget_ms, **_match(matcher, flown, budget_ms, count)}
        for budget_ms in budgets_ms
    ]


def _match(matcher: SceneMatcher, flown: list[tuple[Frame, Array]], budget_ms: float, count: int) -> Row:
    """The figures of one budget."""
    rng = np.random.default_rng(1)
    took, off, stages, reasons = [], [], Counter[str](), Counter[str]()
    for frame, place_m in islice(cycle(flown), count):
        east, north = place_m + rng.normal(0.0, PRIOR_SIGMA_M, 2)
        prior = Prior(east_m=float(east), north_m=float(north), sigma_m=PRIOR_SIGMA_M)
        start = time.perf_counter()
        result = matcher.locate(frame, prior, Budget(total_ms=budget_ms))
        took.append(1e3 * (time.perf_counter() - start))
        time.sleep(PAUSE_SHARE * took[-1] * 1e-3)
        if isinstance(result, Fix):
            off.append(float(np.hypot(result.east_m - place_m[0], result.north_m - place_m[1])))
            stages[result.stage] += 1
        else:
            reasons[result.reason.value] += 1
    times, errors = np.array(took), np.array(off)
    return {
        "frames": count,
        "within": float(np.mean(times <= budget_ms + GRACE_MS)),
        "within_budget": float(np.mean(times <= budget_ms)),
        "availability": len(off) / count,
        "rms_m": float(np.sqrt(np.mean(errors**2))) if off else None,
        "wrong": int(np.sum(errors > WRONG_M)),
        "stages": dict(stages),
        "reasons": dict(reasons),
        **{name: float(np.percentile(times, level)) for name, level in PERCENTILES.items()},
    }
