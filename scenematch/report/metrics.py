"""summary.json: availability, latency and, with truth, accuracy of a track.

Convention:
    An error is fix minus truth, in metres east and north. A frame is scored if it has a fix and truth is known
    at its time; frames without truth are counted, not scored.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.geo import Array, LocalFrame
from engine.values import Truth
from scenematch.files.track import TrackRow
from scenematch.files.truth import interpolate_truth

WRONG_M = 10.0
"""A fix with a larger error is wrong, whatever its stated sigma."""
FALSE_SIGMAS = 3.0
"""A wrong fix whose error exceeds this many of its own sigmas is false."""
_FLOOR_M2 = 1e-6  # (1 mm)^2: keeps covariances that were rounded when written invertible


@dataclass(frozen=True, slots=True)
class Ground:
    """The level of the ground, which links the heights of fixes and truth.

    Attributes:
        ground_m: in the surface model's datum (0 for flat ground).
        ground_amsl_m: the same level above mean sea level, or None if unknown.
    """

    ground_m: float = 0.0
    ground_amsl_m: float | None = None


@dataclass(frozen=True, slots=True)
class TrackErrors:
    """Errors of each row of a track; NaN if a row is not scored.

    Attributes:
        truth_en_m: (N, 2) true position; NaN where unknown.
        fix_en_m: (N, 2) position of the fix; NaN where refused.
        error_en_m: (N, 2) fix minus truth.
        covariance_en_m2: (N, 2, 2) covariance that the fix states.
    """

    truth_en_m: Array
    fix_en_m: Array
    error_en_m: Array
    covariance_en_m2: Array

    @property
    def has_truth(self) -> bool:
        """Whether the truth is known at any row."""
        return bool(np.isfinite(self.truth_en_m).any())

    @property
    def distance_m(self) -> Array:
        """(N,) horizontal error in metres."""
        return np.asarray(np.hypot(self.error_en_m[:, 0], self.error_en_m[:, 1]), dtype=np.float64)

    @property
    def sigma_m(self) -> Array:
        """(N,) stated standard deviation along the longer axis of the covariance."""
        a, b, c = self.covariance_en_m2[:, 0, 0], self.covariance_en_m2[:, 0, 1], self.covariance_en_m2[:, 1, 1]
        return np.asarray(np.sqrt((a + c) / 2.0 + np.hypot((a - c) / 2.0, b)), dtype=np.float64)

    @property
    def normalised_squared_errors(self) -> Array:
        """(N,) normalised squared error e^T C^-1 e; its mean (NEES) is 2 if the covariance is consistent."""
        c = self.covariance_en_m2 + _FLOOR_M2 * np.eye(2)
        e, n = self.error_en_m[:, 0], self.error_en_m[:, 1]
        determinant = np.maximum(c[:, 0, 0] * c[:, 1, 1] - c[:, 0, 1] ** 2, _FLOOR_M2**2)
        weighted = c[:, 1, 1] * e**2 - 2.0 * c[:, 0, 1] * e * n + c[:, 0, 0] * n**2
        return np.asarray(weighted / determinant, dtype=np.float64)

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """(N,) whether the error exceeds three stated sigmas; False if either is unknown."""
        return np.asarray(self.normalised_squared_errors > FALSE_SIGMAS**2, dtype=np.bool_)


def column(records: Sequence[object], name: str) -> Array:
    """(N,) one attribute of each record; NaN if it or the record is None."""
    values = (getattr(record, name, None) for record in records)
    return np.array([np.nan if value is None else value for value in values], np.float64)


def percentiles(values: Array, shares: Mapping[str, float]) -> dict[str, float | None]:
    """Percentiles of the known values by their names, None if no value is known."""
    known = values[np.isfinite(values)]
    return {name: float(np.percentile(known, share)) if known.size else None for name, share in shares.items()}


def truth_per_row(rows: Sequence[TrackRow], truth: Sequence[Truth]) -> list[Truth | None]:
    """The truth interpolated at the time of each row, or None."""
    return [None if row.timestamp_ns is None else interpolate_truth(truth, row.timestamp_ns) for row in rows]


def errors_en_m(rows: Sequence[TrackRow], truth: Sequence[Truth] | None, frame: LocalFrame) -> TrackErrors:
    """Convert fixes and truth to one local frame and subtract.

    Args:
        rows: the track, N rows.
        truth: in the order of time, or None.
        frame: origin of east and north.

    Returns:
        Positions, errors and covariances in metres, N rows each.
    """
    truth_en, fix_en = (
        frame.enu_from_geodetic(column(places, "lat_deg"), column(places, "lon_deg"))
        for places in (truth_per_row(rows, truth or []), rows)
    )
    east, north = column(rows, "sigma_east_m"), column(rows, "sigma_north_m")
    cross = np.nan_to_num(column(rows, "covariance_en_m2")) + 0.0 * east  # unknown with the sigmas
    covariance = np.stack([east**2, cross, cross, north**2], axis=-1).reshape(-1, 2, 2)
    return TrackErrors(truth_en, fix_en, fix_en - truth_en, covariance)


def height_pairs_m(rows: Sequence[TrackRow], truth: Sequence[Truth] | None, ground: Ground) -> Array:
    """Measured and true heights above the ground.

    The ground is one level. True heights above the sea are used where ``ground.ground_amsl_m`` is known, else true
    heights above the ground.

    Args:
        rows: the track, N rows.
        truth: in the order of time, or None.
        ground: level of the ground.

    Returns:
        (N, 2) measured and true heights in metres; NaN where unknown.
    """
    true = truth_per_row(rows, truth or [])
    true_m = column(true, "height_agl_m")
    if ground.ground_amsl_m is not None:
        amsl_m = column(true, "alt_amsl_m") - ground.ground_amsl_m
        true_m = np.where(np.isfinite(amsl_m), amsl_m, true_m)
    return np.column_stack([column(rows, "up_m") - ground.ground_m, true_m])


def summarise(
    rows: Sequence[TrackRow],
    truth: Sequence[Truth] | None = None,
    *,
    frame: LocalFrame | None = None,
    ground: Ground | None = None,
) -> dict[str, Any]:
    """Figures of merit of a track as JSON values; what is unknown is None.

    Args:
        rows: the track, one row per frame.
        truth: in the order of time, or None.
        frame: origin of east and north; None uses the first true position.
        ground: level of the ground; None uses flat ground at 0.

    Returns:
        ``frames``, ``fixes``, ``availability``, ``status``, ``reasons``, ``method``, ``methods``,
        ``latency_ms``, ``deadlines_missed``, ``stated_sigma_median_m`` and ``stated_sigma_p95_m`` (over the fixes,
        using the larger sigma of each); with truth also ``frames_without_truth``,
        ``scored_fixes``, ``rms_m``, ``median_m``, ``r95_m``, ``max_m``, ``wrong_over_10m``, ``false_fixes``,
        ``within_1_sigma``, ``within_2_sigma`` and ``within_3_sigma`` (shares of the fixes, 0.393, 0.865 and 0.989
        if the covariance is consistent), ``beyond_3_sigma``, ``nees_mean``, ``height_rms_m`` and
        ``height_bias_m``.
    """
    fixes = sum(row.fixed for row in rows)
    sigmas_m = np.maximum(column(rows, "sigma_east_m"), column(rows, "sigma_north_m"))
    methods = Counter(row.method for row in rows if row.fixed and row.method is not None)
    summary: dict[str, Any] = {
        "frames": len(rows),
        "fixes": fixes,
        "availability": fixes / len(rows) if rows else None,
        "status": {"fix": fixes, "no_fix": len(rows) - fixes},
        "reasons": _counts(row.reason for row in rows if row.reason is not None),
        "method": "mixed" if len(methods) > 1 else next(iter(methods), None),
        "methods": _counts(methods.elements()),
        "latency_ms": percentiles(column(rows, "latency_ms"), {"p50": 50, "p95": 95, "p99": 99, "max": 100}),
        "deadlines_missed": sum(row.deadline_met is False for row in rows),
        **percentiles(sigmas_m, {"stated_sigma_median_m": 50, "stated_sigma_p95_m": 95}),
    }
    if truth:
        frame = frame or LocalFrame(truth[0].lat_deg, truth[0].lon_deg)
        summary |= _accuracy(errors_en_m(rows, truth, frame))
        summary |= _height(height_pairs_m(rows, truth, ground or Ground()))
    return summary


def figures_in_words(summary: Mapping[str, Any], forms: Iterable[tuple[str, Callable[[Any], str]]]) -> list[str]:
    """Figures of a summary as text, a dash where one is unknown.

    Args:
        summary: by :func:`summarise`.
        forms: the name of each figure, of the latency's too, and what writes it.
    """
    known = {**summary, **summary["latency_ms"]}
    return ["-" if known.get(name) is None else form(known[name]) for name, form in forms]


def _counts(values: Any) -> dict[str, int]:
    """Number of occurrences of each value, most frequent first, ties by name."""
    return dict(sorted(Counter(values).items(), key=lambda item: (-item[1], item[0])))


def _accuracy(errors: TrackErrors) -> dict[str, Any]:
    scored = np.isfinite(errors.distance_m)
    distance, normalised_squared_errors = errors.distance_m[scored], errors.normalised_squared_errors[scored]
    wrong = distance > WRONG_M
    # NaN, from a fix without sigma, is not within three sigmas: if wrong, the fix counts as false.
    false = wrong & ~(normalised_squared_errors <= FALSE_SIGMAS**2)
    stated = normalised_squared_errors[np.isfinite(normalised_squared_errors)]
    return {
        "frames_without_truth": int(np.isnan(errors.truth_en_m[:, 0]).sum()),
        "scored_fixes": int(distance.size),
        "rms_m": float(np.sqrt(np.mean(distance**2))) if distance.size else None,
        **percentiles(distance, {"median_m": 50, "r95_m": 95, "max_m": 100}),
        "wrong_over_10m": int(wrong.sum()),
        "false_fixes": int(false.sum()),
        **{f"within_{n}_sigma": float((stated <= n**2).mean()) if stated.size else None for n in (1, 2, 3)},
        "beyond_3_sigma": int((stated > FALSE_SIGMAS**2).sum()),
        "nees_mean": float(stated.mean()) if stated.size else None,
    }


def _height(pairs: Array) -> dict[str, Any]:
    error = pairs[:, 0] - pairs[:, 1]
    error = error[np.isfinite(error)]
    return {
        "height_rms_m": float(np.sqrt(np.mean(error**2))) if error.size else None,
        "height_bias_m": float(error.mean()) if error.size else None,
    }
