"""Errors by segment: how far a track drifts against truth over so many metres of path, or so many seconds.

Convention:
    The error of a segment is how much the displacement between its two ends is off, |(p_j - p_i) - (q_j - q_i)|:
    what evo's ``evo_rpe --pose_relation trans_part --all_pairs --pairs_from_reference`` has of poses without
    rotation. It is blind to an offset that is the same at both ends, which the errors of position show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenematch.files.track import TrackRow
from scenematch.report.metrics import TrackErrors

Array = NDArray[np.float64]

LENGTHS_M = (10.0, 50.0, 100.0, 500.0, 1000.0)
DURATIONS_S = (1.0, 10.0, 30.0, 60.0, 300.0)
_TOLERANCE = 0.1  # of the asked length, as evo has it


def segment_errors(rows: Sequence[TrackRow], errors: TrackErrors) -> list[dict[str, Any]]:
    """Errors of the segments of a track, a row for each length and duration that it is long enough for.

    Args:
        rows: the track.
        errors: of the track, against truth.

    Returns:
        JSON values: ``length_m`` or ``duration_s``, ``segments`` (their number), ``median_m``, ``p95_m`` and
        ``max_m``. A segment begins at each scored fix, and ends at the one whose distance along the true path, or
        in time, is nearest to what is asked, if that is within a tenth of it.
    """
    scored = np.flatnonzero(np.isfinite(errors.distance_m))
    if scored.size < 2:
        return []
    error_m, true_m = errors.error_en_m[scored], errors.truth_en_m[scored]
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true_m, axis=0), axis=1))])
    stamps_ns = np.array([row.timestamp_ns or 0 for row in rows], np.int64)[scored]  # what is scored has one
    time_s = (stamps_ns - stamps_ns[0]) / 1e9
    table = [_row("length_m", length, path_m, error_m) for length in LENGTHS_M]
    table += [_row("duration_s", duration, time_s, error_m) for duration in DURATIONS_S]
    return [row for row in table if row is not None]


def _row(name: str, asked: float, along: Array, error_m: Array) -> dict[str, Any] | None:
    begins, ends = segment_ends(along, asked)
    if not begins.size:
        return None
    off_m = np.linalg.norm(error_m[ends] - error_m[begins], axis=1)
    return {
        name: asked,
        "segments": int(off_m.size),
        "median_m": float(np.median(off_m)),
        "p95_m": float(np.percentile(off_m, 95)),
        "max_m": float(off_m.max()),
    }


def segment_ends(along: Array, asked: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last index of each segment.

    Args:
        along: (N,) distance or time of each pose from the first, not descending.
        asked: length of a segment, in the same unit.

    Returns:
        Two arrays of the same length. Of equally near ends the earlier one is taken.
    """
    begins = np.arange(len(along))
    after = np.searchsorted(along, along + asked)
    before, after = np.maximum(after - 1, begins), np.minimum(after, len(along) - 1)
    off_before, off_after = np.abs(along[before] - along - asked), np.abs(along[after] - along - asked)
    # Where the vehicle hovers, the distance stays the same: the earliest pose of these ends the segment.
    before = np.maximum(np.searchsorted(along, along[before]), begins)
    ends = np.where(off_before <= off_after, before, after)
    near = np.minimum(off_before, off_after) <= _TOLERANCE * asked
    return begins[near], ends[near]
