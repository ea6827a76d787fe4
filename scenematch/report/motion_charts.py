"""Charts of attitude and velocity: the fixes', with the telemetry's and the true ones if known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from engine.geo import Array
from engine.values import Truth
from scenematch.files.notes import FrameNote
from scenematch.files.telemetry import TelemetryRow
from scenematch.files.track import TrackRow
from scenematch.report.charts import ChartArea, Limits
from scenematch.report.metrics import truth_per_row
from scenematch.report.page_charts import Chart, column
from scenematch.report.plot_data import TrackPlotData

_ANGLES = {"roll_deg": "Roll", "pitch_deg": "Pitch", "heading_deg": "Heading"}
_AXES = ("east", "north")
_BASE_S, _MAX_GAP_S = 1.0, 5.0  # between fixes whose difference gives a velocity


def draw_motion(
    rows: Sequence[TrackRow],
    notes: Sequence[FrameNote] | None,
    telemetry: Sequence[TelemetryRow] | None,
    truth: Sequence[Truth] | None,
    plot_data: TrackPlotData,
) -> list[Chart]:
    """Charts of roll, pitch, heading and velocity, those without data left out.

    Args:
        rows: the track.
        notes: one per row, with the attitudes of the fixes, or None.
        telemetry: of the flight, matched to the rows by frame name, or None.
        truth: in the order of time, or None.
        plot_data: plot data of the track.
    """
    if len(rows) < 2:
        return []
    by_frame = {row.frame: row for row in telemetry or ()}
    stated = [by_frame.get(row.frame) for row in rows]
    true = truth_per_row(rows, truth or [])
    charts = []
    for name, words in _ANGLES.items():
        fix = column(notes, name) if notes else np.full(len(rows), np.nan)
        charts.append(_angle(words, fix, column(stated, name), column(true, name), plot_data))
    if plot_data.time_label.startswith("time"):
        charts += [
            _velocity(axis, column(stated, f"{_AXES[axis]}_velocity_mps"), plot_data) for axis in range(len(_AXES))
        ]
    return [chart for chart in charts if chart is not None]


def _angle(words: str, fix: Array, stated: Array, true: Array, plot_data: TrackPlotData) -> Chart | None:
    """Chart of one angle; omitted if neither the fixes nor the telemetry have it."""
    if not (np.isfinite(fix).any() or np.isfinite(stated).any()):
        return None
    if words == "Heading":  # kept continuous across north
        reference = next(a for a in (true, stated, fix) if np.isfinite(a).any())
        reference = _unwrapped(reference)
        fix, stated, true = (_nearest_turn(angle, reference) for angle in (fix, stated, true))
    caption = f"{words} (degrees)"
    error = fix - true
    if np.isfinite(error).any():
        caption += f", RMS error of the fixes {np.sqrt(np.nanmean(error**2)):.2f}"
    return _chart(caption, fix, stated, true, plot_data, 360.0 if words == "Heading" else None)


def _unwrapped(heading_deg: Array) -> Array:
    """The heading without jumps of a full turn, filled in everywhere."""
    known = np.isfinite(heading_deg)
    index = np.arange(len(heading_deg), dtype=np.float64)
    unwrapped = np.unwrap(heading_deg[known], period=360.0)
    return np.asarray(np.interp(index, index[known], unwrapped), np.float64)


def _nearest_turn(angle_deg: Array, reference_deg: Array) -> Array:
    """Angles shifted by whole turns to within half a turn of the reference."""
    return np.asarray(angle_deg - 360.0 * np.round((angle_deg - reference_deg) / 360.0), np.float64)


def _velocity(axis: int, stated: Array, plot_data: TrackPlotData) -> Chart | None:
    errors = plot_data.errors
    fix = velocity_mps(plot_data.time, errors.fix_en_m[:, axis])
    true = velocity_mps(plot_data.time, errors.truth_en_m[:, axis])
    if not (np.isfinite(fix).any() or np.isfinite(stated).any()):
        return None
    caption = f"Velocity {_AXES[axis]} (m/s)"
    if np.isfinite(fix).any():
        caption += f", of fixes at least {_BASE_S:g} s apart"
    return _chart(caption, fix, stated, true, plot_data)


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
    caption: str, fix: Array, stated: Array, true: Array, plot_data: TrackPlotData, period: float | None = None
) -> Chart:
    """Dots of the fixes on lines of telemetry and truth."""
    values = np.concatenate([fix, stated, true])
    low, high = np.percentile(values[np.isfinite(values)], [1, 99])
    margin = max(0.15 * (high - low), 0.5)
    limits: Limits = (float(low - margin), float(high + margin))
    area = ChartArea((float(plot_data.time[0]), float(plot_data.time[-1])), limits)
    marks = [
        area.line(plot_data.time, stated, "telemetry"),
        area.dots(plot_data.time, fix, "fix"),
        area.line(plot_data.time, true, "truth"),
    ]
    return caption, area.svg(f"{caption} over time", plot_data.time_label, marks, timed=True, period=period)
