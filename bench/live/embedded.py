"""A matcher embedded as the README shows it, on a recorded flight, while a process burns each core."""

from __future__ import annotations

import math
import multiprocessing
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import cycle, islice
from typing import Any

import numpy as np

from bench import SHARED
from bench.accuracy.flights import recorded
from bench.accuracy.truth import off, prior_about
from bench.live.burden import hogs
from bench.live.endless import measured, summary
from engine import Budget, Fix, Frame, SceneMatcher, set_realtime
from engine.geo import Array

Row = dict[str, Any]
FLIGHT = "gazebo-a1"
METHODS = ("auto", "ncc", "sift")
BUDGETS_MS = (10.0, 40.0, 121.0)
PRIOR_SIGMA_M = 5.0
PAUSE_SHARE = 0.25  # of a frame's time: a thread in real time that never pauses is throttled by the kernel
SCHEDULING = ("defaults", "realtime")


def embedded(frames: int = 2_000) -> list[Row]:
    """Every method and budget, by default and in real time; none where the flight is not there."""
    if not (SHARED / FLIGHT).is_dir():
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
    flight = recorded(FLIGHT, 1)
    matcher = SceneMatcher(flight.site, flight.camera, method=method)
    matcher.warmup()
    placed = list(islice(cycle(flight.placed()), count))
    if scheduling == "realtime":
        set_realtime()
    rows = []
    for budget_ms in budgets_ms:
        rng, budget = np.random.default_rng(1), Budget(total_ms=budget_ms)
        asked = [(frame, prior_about(place, PRIOR_SIGMA_M, rng), budget) for frame, place in placed]
        flown = measured(matcher.locate, asked.__getitem__, partial(_error, placed), count, budget_ms, _pause)
        rows.append(summary(flown, f"{method}, {scheduling}"))
    return rows


def _error(placed: list[tuple[Frame, Array]], number: int, fix: Fix) -> tuple[float, float]:
    """Counted as wrong by its distance alone."""
    return off(fix, placed[number][1])[0], math.inf


def _pause(_: int, took_ms: float) -> None:
    time.sleep(PAUSE_SHARE * took_ms * 1e-3)
