"""What lasts: a queue that is fed too fast, and thousands of frames in which nothing may grow."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.live.endless import START_NS, Course, fly, summary, warm
from engine import Fix, Frame, Navigator, SceneMatcher
from engine.navigation.live import Answer, Live, LiveOptions

Row = dict[str, Any]
FACTORS = (2, 5, 10)
DEADLINE_MS = 40.0
SAMPLE_EVERY = 50
SOAK_BUDGET_MS = 40.0


def rss_mb() -> float:
    """Resident memory of this process."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


# ---------------------------------------------------------------------------------------------------- queue


def queue(course: Course, seconds: float = 3.0) -> list[Row]:
    """Live, fed with more frames than it can take."""
    matcher = warm(course, "auto")
    frame_ms = float(np.median(fly(course, matcher, 100).wall_ms))
    rows = []
    for factor in FACTORS:
        frames = _faster(course, factor, round(seconds * 1e3 * factor / frame_ms))
        answers: list[Answer] = []
        before_mb = rss_mb()
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
                **{
                    name: float(np.percentile(ages, level))
                    for name, level in (("p50", 50), ("p99", 99), ("max", 100))
                },
                "rss_before_mb": before_mb,
                "rss_after_mb": rss_mb(),
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


class Growth:
    """What may not grow in flight, sampled every so many frames: memory, open files, threads, caches."""

    def __init__(self, matcher: SceneMatcher, frames: int) -> None:
        self._matcher = matcher
        self._work = matcher.cache_counters
        self._samples = np.full((-(-frames // SAMPLE_EVERY), 3), np.nan)
        self._frames = 0

    def sample(self, _: int) -> None:
        """Take note of one frame more."""
        if self._frames % SAMPLE_EVERY == 0:
            open_files, threads = (len(os.listdir(f"/proc/self/{kind}")) for kind in ("fd", "task"))
            self._samples[self._frames // SAMPLE_EVERY] = rss_mb(), open_files, threads
        self._frames += 1

    def row(self) -> Row:
        """What grew, from the first sample to the last."""
        work, samples = self._matcher.cache_counters, self._samples
        return {
            "frames": self._frames,
            "rss_mb": samples[:, 0].tolist(),
            "rss_every": SAMPLE_EVERY,
            "rss_slope_mb": slope(samples[:, 0], SAMPLE_EVERY) * 1e4,
            "open_files": samples[[0, -1], 1].tolist(),
            "threads": samples[[0, -1], 2].tolist(),
            "cache_growth": {name: count - self._work.get(name, 0) for name, count in work.items()},
        }


def soak(course: Course, frames: int = 4_000) -> list[Row]:
    """Thousands of frames by each method alone; the frames by both are those of the budgets."""
    rows = []
    for method in ("ncc", "sift"):
        matcher = warm(course, method)
        growth = Growth(matcher, frames)
        rows.append(
            {**summary(fly(course, matcher, frames, SOAK_BUDGET_MS, growth.sample), method), **growth.row()}
        )
    return rows


def slope(values: NDArray[np.float64], every: int) -> float:
    """Growth a frame by least squares, after the first tenth, of a value sampled every so many frames."""
    kept = values[len(values) // 10 :]
    return float(np.polyfit(np.arange(len(kept)) * every, kept, 1)[0]) if len(kept) > 1 else 0.0
