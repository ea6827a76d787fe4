"""What answers are held against: where a flight truly was, priors about it, and how far off a fix is."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from engine import Fix, NoFix, OrthoMap, Prior
from engine.geo import Array
from engine.values import Truth
from scenematch.files.track import TrackRow, track_row
from scenematch.report.metrics import FALSE_SIGMAS, WRONG_M

START_SIGMA_M = 15.0


def true_start(truth: Sequence[Truth], sigma_m: float = START_SIGMA_M) -> Prior:
    """The true place at the beginning."""
    return Prior(lat_deg=truth[0].lat_deg, lon_deg=truth[0].lon_deg, sigma_m=sigma_m)


def true_places_m(site: OrthoMap, truth: Sequence[Truth]) -> Array:
    """(N, 2) east and north."""
    return site.frame.enu_from_geodetic([row.lat_deg for row in truth], [row.lon_deg for row in truth])


def prior_at(place_m: Array, sigma_m: float) -> Prior:
    """A place (2,) with its standard deviation."""
    return Prior(east_m=float(place_m[0]), north_m=float(place_m[1]), sigma_m=sigma_m)


def prior_about(place_m: Array, sigma_m: float, rng: np.random.Generator, off_m: float | None = None) -> Prior:
    """A prior that is off by so much per axis (one sigma), else by as much as it says."""
    return prior_at(place_m + rng.normal(0.0, sigma_m if off_m is None else off_m, 2), sigma_m)


def off(fix: Fix, place_m: Array) -> tuple[float, float]:
    """Distance of a fix from a place (2,), in metres and in sigmas of the fix's own covariance."""
    error_m = np.array([fix.east_m, fix.north_m]) - place_m
    squared = float(error_m @ np.linalg.solve(fix.covariance_m2[:2, :2], error_m))
    return float(np.hypot(*error_m)), float(np.sqrt(squared))


def is_false(fix: Fix, place_m: Array) -> bool:
    """Off by more than 10 m and three of its own sigmas."""
    distance_m, sigmas = off(fix, place_m)
    return distance_m > WRONG_M and sigmas > FALSE_SIGMAS


def answered(
    locate: Callable[..., Fix | NoFix], frames: Iterable[tuple[Any, ...]]
) -> tuple[list[Fix | NoFix], list[float]]:
    """What becomes of frames, one after the other, and the milliseconds that each takes.

    Args:
        locate: answers a frame.
        frames: the arguments of each call.
    """
    results, spent_ms = [], []
    for arguments in frames:
        begin = time.perf_counter()
        results.append(locate(*arguments))
        spent_ms.append((time.perf_counter() - begin) * 1e3)
    return results, spent_ms


def rows_of(results: Sequence[Fix | NoFix], spent_ms: Sequence[float]) -> list[TrackRow]:
    """The rows of a track, each frame named by its number."""
    return [
        track_row(str(index), result, latency_ms=ms, deadline_met=None)
        for index, (result, ms) in enumerate(zip(results, spent_ms, strict=True))
    ]


def pooled(summaries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of several tracks, each as its summary.json, as of one: every scored fix counts alike."""
    scored = [one for one in summaries if one.get("scored_fixes")]
    frames, fixes = (sum(one[name] for one in summaries) for name in ("frames", "fixes"))

    def mean(name: str, power: int) -> float | None:
        known = [(one["scored_fixes"], one[name]) for one in scored if one.get(name) is not None]
        return sum(n * v**power for n, v in known) / sum(n for n, _ in known) if known else None

    mean_square_m2 = mean("rms_m", 2)
    judged = [one for one in summaries if "false_fixes" in one]  # a track without truth says nothing of it
    return {
        "tracks": len(summaries),
        "frames": frames,
        "fixes": fixes,
        "availability": fixes / frames if frames else None,
        "rms_m": None if mean_square_m2 is None else math.sqrt(mean_square_m2),
        "worst_rms_m": max((one["rms_m"] for one in scored), default=None),
        "max_m": max((one["max_m"] for one in scored if "max_m" in one), default=None),
        "nees": mean("nees_mean", 1),
        "false_fixes": sum(one["false_fixes"] for one in judged) if judged else None,
        "wrong_over_10m": sum(one["wrong_over_10m"] for one in judged) if judged else None,
    }
