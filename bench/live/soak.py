"""What lasts: a queue that is fed too fast, and thousands of frames in which nothing may grow."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from bench.live.endless import PERCENTILES, START_NS, Course, fly, summary, warm
from bench.live.growth import Growth, resident_mb
from engine import Fix, Frame, Navigator, SceneMatcher
from engine.navigation.live import Answer, Live, LiveOptions

Row = dict[str, Any]
FACTORS = (2, 5, 10)
DEADLINE_MS = 40.0
SAMPLE_EVERY = 50
SOAK_BUDGET_MS = 40.0


# ---------------------------------------------------------------------------------------------------- queue


def queue(course: Course, seconds: float = 3.0) -> list[Row]:
    """Live, fed with more frames than it can take."""
    matcher = warm(course, "auto")
    frame_ms = float(np.median(fly(course, matcher, 100).wall_ms))
    rows = []
    for factor in FACTORS:
        frames = _faster(course, factor, round(seconds * 1e3 * factor / frame_ms))
        answers: list[Answer] = []
        before_mb = resident_mb()
        options = LiveOptions(deadline_ms=DEADLINE_MS)
        with Live(lambda start: Navigator(matcher, start), answers.append, course.start, options) as live:
            spent_s = _feed(live, frames, frame_ms / factor * 1e-3)
        ages = np.array([answer.age_ms for answer in answers])
        counts = live.counts
        rows.append(
            {
                "factor": factor,
                "frame_ms": frame_ms,
                "deadline_ms": DEADLINE_MS,
                "fed_hz": len(frames) / spent_s,
                "submitted": counts.submitted,
                "answered": counts.answered,
                "dropped": counts.dropped,
                "late": counts.late,
                "workers_replaced": counts.workers_replaced,
                "fixes": sum(isinstance(answer.result, Fix) for answer in answers),
                "stale": sum(answer.result.timestamp_ns != answer.frame.timestamp_ns for answer in answers),
                **{name: float(np.percentile(ages, level)) for name, level in PERCENTILES.items()},
                "rss_before_mb": before_mb,
                "rss_after_mb": resident_mb(),
            }
        )
    return rows


def _faster(course: Course, factor: int, count: int) -> list[Frame]:
    """Frames of a camera that takes ``factor`` pictures in the time of one; nearly alike ones are alike."""
    step_ns = course.step_ns // factor
    return [replace(course.frame(n // factor), timestamp_ns=START_NS + n * step_ns) for n in range(count)]


def _feed(live: Live, frames: list[Frame], interval_s: float) -> float:
    """Submit frames at a steady rate; returns how many seconds it took."""
    start = time.perf_counter()
    for number, frame in enumerate(frames):
        wait_s = start + number * interval_s - time.perf_counter()
        if wait_s > 0:
            time.sleep(wait_s)
        live.submit(frame)
    return time.perf_counter() - start


# ----------------------------------------------------------------------------------------------------- soak


class Soaked:
    """What may not grow in flight: the process, and the caches of a matcher, which are warm before it."""

    def __init__(self, matcher: SceneMatcher, frames: int) -> None:
        self._matcher, self._work = matcher, matcher.cache_counters
        self._growth, self._frames = Growth(SAMPLE_EVERY, -(-frames // SAMPLE_EVERY)), 0

    def sample(self, *_: object) -> None:
        """Take note of one frame more."""
        self._growth.look(self._frames)
        self._frames += 1

    def row(self) -> Row:
        """What grew, from the first sample to the last."""
        work, seen = self._matcher.cache_counters, self._growth.seen
        return {
            "frames": self._frames,
            "rss_mb": seen[:, 1].tolist(),
            "rss_every": SAMPLE_EVERY,
            "rss_slope_mb": self._growth.slope_mb() * 1e4,
            "open_files": seen[[0, -1], 2].tolist(),
            "threads": seen[[0, -1], 3].tolist(),
            "cache_growth": {name: count - self._work.get(name, 0) for name, count in work.items()},
        }


def soak(course: Course, frames: int = 4_000) -> list[Row]:
    """Thousands of frames by each method alone; the frames by both are those of the budgets."""
    rows = []
    for method in ("ncc", "sift"):
        matcher = warm(course, method)
        growth = Soaked(matcher, frames)
        rows.append(
            {**summary(fly(course, matcher, frames, SOAK_BUDGET_MS, growth.sample), method), **growth.row()}
        )
    return rows
