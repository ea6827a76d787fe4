"""Charts of attitude and velocity: the fixes', with the telemetry's and the true ones if known."""

from __future__ import annotations

import numpy as np

from engine.geo import Array
from scenematch.report.charts import ChartArea
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.metrics import column, truth_per_row
from scenematch.report.page_charts import Chart

_ANGLES = {"roll_deg": "Roll", "pitch_deg": "Pitch", "heading_deg": "Heading"}
_AXES = ("east", "north")
_BASE_S, _MAX_GAP_S = 1.0, 5.0  # between fixes whose difference gives a velocity


def draw_motion(track: FinishedTrack) -> list[Chart]:
    """Charts of roll, pitch, heading and velocity, those without data left out.

    The notes have the attitudes of the fixes; the telemetry belongs to the rows by frame name.
    """
    rows = track.rows
    if len(rows) < 2:
        return []
    by_frame = {row.frame: row for row in track.telemetry or ()}
    stated = [by_frame.get(row.frame) for row in rows]
    true = truth_per_row(rows, track.truth or [])
    charts = []
    for name, words in _ANGLES.items():
        fix = column(track.notes or [None] * len(rows), name)
        charts.append(_angle(words, fix, column(stated, name), column(true, name), track))
    if track.is_timed:
        for axis, words in enumerate(_AXES):
            charts.append(_velocity(axis, column(stated, f"{words}_velocity_mps"), track))
    return [chart for chart in charts if chart is not None]


def _angle(words: str, fix: Array, stated: Array, true: Array, track: FinishedTrack) -> Chart | None:
    """Chart of one angle; omitted if neither the fixes nor the telemetry have it."""
    if not (np.isfinite(fix).any() or np.isfinite(stated).any()):
        return None
    if words == "Heading":  # kept continuous across north
        reference = _unwrapped(next(a for a in (true, stated, fix) if np.isfinite(a).any()))
        fix, stated, true = (a - 360.0 * np.round((a - reference) / 360.0) for a in (fix, stated, true))
    caption = f"{words} (degrees)"
    error = fix - true
    if np.isfinite(error).any():
        caption += f", RMS error of the fixes {np.sqrt(np.nanmean(error**2)):.2f}"
    return _chart(caption, fix, stated, true, track, 360.0 if words == "Heading" else None)


def _unwrapped(heading_deg: Array) -> Array:
    """The heading without jumps of a full turn, filled in everywhere."""
    known = np.isfinite(heading_deg)
    index = np.arange(len(heading_deg), dtype=np.float64)
    unwrapped = np.unwrap(heading_deg[known], period=360.0)
    return np.asarray(np.interp(index, index[known], unwrapped), np.float64)


def _velocity(axis: int, stated: Array, track: FinishedTrack) -> Chart | None:
    fix = velocity_mps(track.time, track.errors.fix_en_m[:, axis])
    true = velocity_mps(track.time, track.errors.truth_en_m[:, axis])
    if not (np.isfinite(fix).any() or np.isfinite(stated).any()):
        return None
    caption = f"Velocity {_AXES[axis]} (m/s)"
    if np.isfinite(fix).any():
        caption += f", of fixes at least {_BASE_S:g} s apart"
    return _chart(caption, fix, stated, true, track)


def velocity_mps(time_s: Array, position_m: Array) -> Array:
    """Velocity about each known position, from the nearest ones at least half a second before and after it.

    Args:
        time_s: (N,) not descending.
        position_m: (N,), NaN where unknown.

    Returns:
        (N,); NaN at the ends, where the position is unknown, and where the two are more than 5 s apart.
    """
    velocity = np.full(len(time_s), np.nan)
    known = np.flatnonzero(np.isfinite(position_m))
    if known.size < 3:
        return velocity
    time, position = time_s[known], position_m[known]
    before = np.searchsorted(time, time - _BASE_S / 2.0 + 1e-6, side="right") - 1
    after = np.searchsorted(time, time + _BASE_S / 2.0 - 1e-6, side="left")
    inside = (before >= 0) & (after < known.size)
    a, b = before[inside], after[inside]
    gap = time[b] - time[a]
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = (position[b] - position[a]) / gap
    velocity[known[inside]] = np.where((gap > 0.0) & (gap <= _MAX_GAP_S), rate, np.nan)
    return velocity


def _chart(
    caption: str, fix: Array, stated: Array, true: Array, track: FinishedTrack, period: float | None = None
) -> Chart:
    """Dots of the fixes on lines of telemetry and truth."""
    values = np.concatenate([fix, stated, true])
    low, high = np.percentile(values[np.isfinite(values)], [1, 99])
    margin = max(0.15 * (high - low), 0.5)
    area = ChartArea(track.time_limits, (float(low - margin), float(high + margin)))
    marks = [
        area.line(track.time, stated, "telemetry"),
        area.dots(track.time, fix, "fix"),
        area.line(track.time, true, "truth"),
    ]
    return caption, area.svg(f"{caption} over time", track.time_label, marks, timed=True, period=period)
