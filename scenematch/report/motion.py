"""Compare the steps from fix to fix with the telemetry's velocity, for want of truth.

This does not measure accuracy: a constant offset, such as the map's, does not show, and fixes that contradict the
velocity were already refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from engine.geo import Array, LocalFrame
from scenematch.files.telemetry import TelemetryRow
from scenematch.files.track import TrackRow
from scenematch.report.metrics import column, percentiles

MAX_STEP_S = 5.0
"""Longest step that counts; in longer ones the velocity's own error dominates."""


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
    return facts | percentiles(np.array(off_m), {"median_m": 50, "p95_m": 95, "max_m": 100})


def _velocity(telemetry: Sequence[TelemetryRow]) -> tuple[Array, Array]:
    """(N,) seconds from the first frame, and (N, 2) velocity, NaN if it is unknown."""
    time_s = np.array([row.timestamp_ns - telemetry[0].timestamp_ns for row in telemetry], np.float64) / 1e9
    axes = [column(telemetry, name) for name in ("east_velocity_mps", "north_velocity_mps")]
    return time_s, np.stack(axes, axis=-1)
