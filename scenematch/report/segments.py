"""Errors by segment: how far a track drifts from truth over a given path length or time, and from its velocity.

Convention:
    The error of a segment is the error of the displacement between its ends, |(p_j - p_i) - (q_j - q_i)|: what
    evo's ``evo_rpe --pose_relation trans_part --all_pairs --pairs_from_reference`` gives for poses without
    rotation. It ignores an offset common to both ends, which the position errors show.

    Without truth, a step from one fix to the next is compared with the integral of the telemetry's velocity. This
    does not measure accuracy: a constant offset, such as the map's, does not show, and fixes that contradict the
    velocity were already refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.geo import Array, LocalFrame
from scenematch.files.telemetry import TelemetryRow
from scenematch.files.track import TrackRow
from scenematch.report.metrics import TrackErrors, column, percentiles

LENGTHS_M = (10.0, 50.0, 100.0, 500.0, 1000.0)
DURATIONS_S = (1.0, 10.0, 30.0, 60.0, 300.0)
_TOLERANCE = 0.1  # of the requested length, as in evo
MAX_STEP_S = 5.0
"""Longest step that counts; in longer ones the velocity's own error dominates."""
_SPREAD = {"median_m": 50, "p95_m": 95, "max_m": 100}


def segment_errors(rows: Sequence[TrackRow], errors: TrackErrors) -> list[dict[str, Any]]:
    """Errors of a track's segments, one row for each length and duration that fits into it.

    Args:
        rows: the track.
        errors: of the track, against truth.

    Returns:
        JSON values: ``length_m`` or ``duration_s``, ``segments`` (their number), ``median_m``, ``p95_m`` and
        ``max_m``. A segment begins at each scored fix, and ends at the one whose distance along the true path, or
        in time, is nearest to the requested one, if within a tenth of it.
    """
    scored = np.flatnonzero(np.isfinite(errors.distance_m))
    if scored.size < 2:
        return []
    error_m, true_m = errors.error_en_m[scored], errors.truth_en_m[scored]
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true_m, axis=0), axis=1))])
    stamps_ns = np.array([row.timestamp_ns or 0 for row in rows], np.int64)[scored]  # scored rows have one
    time_s = (stamps_ns - stamps_ns[0]) / 1e9
    table = [_row("length_m", length, path_m, error_m) for length in LENGTHS_M]
    table += [_row("duration_s", duration, time_s, error_m) for duration in DURATIONS_S]
    return [row for row in table if row is not None]


def _row(name: str, asked: float, along: Array, error_m: Array) -> dict[str, Any] | None:
    begins, ends = segment_ends(along, asked)
    if not begins.size:
        return None
    off_m = np.linalg.norm(error_m[ends] - error_m[begins], axis=1)
    return {name: asked, "segments": int(off_m.size), **percentiles(off_m, _SPREAD)}


def segment_ends(along: Array, asked: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last index of each segment.

    Args:
        along: (N,) distance or time of each pose from the first, not descending.
        asked: length of a segment, in the same unit.

    Returns:
        Two arrays of the same length. The earlier of two equally near ends is taken.
    """
    begins = np.arange(len(along))
    after = np.searchsorted(along, along + asked)
    before, after = np.maximum(after - 1, begins), np.minimum(after, len(along) - 1)
    off_before, off_after = np.abs(along[before] - along - asked), np.abs(along[after] - along - asked)
    # While the vehicle hovers, the distance is constant: the earliest of these poses ends the segment.
    before = np.maximum(np.searchsorted(along, along[before]), begins)
    ends = np.where(off_before <= off_after, before, after)
    near = np.minimum(off_before, off_after) <= _TOLERANCE * asked
    return begins[near], ends[near]


def motion_consistency(
    rows: Sequence[TrackRow], telemetry: Sequence[TelemetryRow] | None, frame: LocalFrame
) -> dict[str, Any] | None:
    """How far the steps between successive fixes differ from the telemetry's velocity.

    Args:
        rows: the track.
        telemetry: one row per row of the track, or None if unknown.
        frame: origin of east and north.

    Returns:
        JSON values: ``steps`` (their number), ``interval_s`` (their median), ``median_m``, ``p95_m`` and
        ``max_m``; None if no step has a velocity at all its frames.
    """
    if not telemetry or [row.timestamp_ns for row in rows] != [row.timestamp_ns for row in telemetry]:
        return None
    time_s, velocity_mps = _velocity(telemetry)
    fixed = [k for k, row in enumerate(rows) if row.fixed]
    fixes = [rows[k] for k in fixed]
    at_m = frame.enu_from_geodetic(column(fixes, "lat_deg"), column(fixes, "lon_deg"))
    off_m, intervals_s = [], []
    for n, (begin, end) in enumerate(pairwise(fixed)):
        interval_s = time_s[end] - time_s[begin]
        span = slice(begin, end + 1)
        off = at_m[n + 1] - at_m[n] - np.trapezoid(velocity_mps[span], time_s[span], axis=0)
        if 0.0 < interval_s <= MAX_STEP_S and np.isfinite(off).all():
            off_m.append(float(np.hypot(*off)))
            intervals_s.append(float(interval_s))
    if not off_m:
        return None
    facts = {"steps": len(off_m), "interval_s": float(np.median(intervals_s))}
    return facts | percentiles(np.array(off_m), _SPREAD)


def _velocity(telemetry: Sequence[TelemetryRow]) -> tuple[Array, Array]:
    """(N,) seconds from the first frame, and (N, 2) velocity, NaN if it is unknown."""
    time_s = np.array([row.timestamp_ns - telemetry[0].timestamp_ns for row in telemetry], np.float64) / 1e9
    axes = [column(telemetry, name) for name in ("east_velocity_mps", "north_velocity_mps")]
    return time_s, np.stack(axes, axis=-1)
