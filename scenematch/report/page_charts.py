"""The charts of the report: error, answers, height, score, latency, attitude, and a closed loop's."""

from __future__ import annotations

import numpy as np

from engine.geo import Array
from scenematch.report.charts import ChartArea, dots
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.metrics import FALSE_SIGMAS, column, truth_per_row

Chart = tuple[str, str]
"""Caption and SVG."""

_HEADROOM = 1.08  # upper limit relative to the highest value
_ANGLES = {"roll_deg": "Roll", "pitch_deg": "Pitch", "heading_deg": "Heading"}


def draw_charts(track: FinishedTrack) -> list[Chart]:
    """The charts with their captions; those without data are omitted."""
    if not track.rows:
        return []
    latency_ms, budget_ms = column(track.rows, "latency_ms"), track.settings.get("budget_ms")
    charts = [_error(track), *_loop(track), _answers(track)]
    if np.isfinite(track.heights).any():
        charts.append(_height(track))
    if np.isfinite(column(track.rows, "score")).any():
        charts.append(_score(track))
    if np.isfinite(latency_ms).any():
        charts.append(_latency(track, latency_ms, budget_ms))
    return charts + _attitude(track)


def _error(track: FinishedTrack) -> Chart:
    """The error with one and three stated sigmas as lines; without truth the stated sigma."""
    errors, known = track.errors, np.isfinite(track.errors.distance_m)
    sigma = errors.sigma_m
    stated = sigma[np.isfinite(sigma)]
    if not known.any():
        top = 1.2 * float(np.percentile(stated, 98)) if stated.size else 1.0
        area = ChartArea(track.time_limits, (0.0, max(top, 0.5)))
        what = "Stated sigma (m)"
        marks = [area.dots(track.time, sigma, "fix"), area.overflow(track.time, sigma, "over")]
        return what, area.svg(f"{what} over time", track.time_label, marks, timed=True)
    typical = float(np.percentile(errors.distance_m[known], 97))
    # Three sigmas are visible unless they would flatten the errors.
    shown = 1.1 * FALSE_SIGMAS * float(np.percentile(stated, 90)) if stated.size else 0.0
    area = ChartArea(track.time_limits, (0.0, max(1.3 * typical, min(shown, 5.0 * typical), 0.1)))
    beyond = np.where(errors.beyond, errors.distance_m, np.nan)
    lines = [
        area.line(track.time, np.where(factor * sigma <= area.y_limits[1], factor * sigma, np.nan), kind)
        for factor, kind in ((FALSE_SIGMAS, "sigmas"), (1.0, "sigma"))
    ]
    marks = [
        *lines,
        area.dots(track.time, errors.distance_m, "fix"),
        area.dots(track.time, beyond, "beyond"),
        area.overflow(track.time, errors.distance_m, "over"),
    ]
    what = "Horizontal error (m)"
    if all(lines):
        what += ", with one and three stated sigmas (lines)"
    elif stated.size:
        what += ", with its stated sigma (line)" if any(lines) else f"; stated sigma {np.median(stated):.1f} m"
    return what, area.svg(f"{what} over time", track.time_label, marks, timed=True)


def _answers(track: FinishedTrack) -> Chart:
    """Fix or reason of refusal of each frame, over the state of the navigator."""
    answers = ["fix" if row.fixed else row.reason or "unknown" for row in track.rows]
    kinds = ["fix", *sorted({*answers} - {"fix"})]
    level = np.array([kinds.index(answer) for answer in answers], np.float64)
    area = ChartArea(track.time_limits, (len(kinds) - 0.5, -0.5), left=150.0)
    fixed, beyond = track.fixed, track.errors.beyond
    marks = [area.strip(track.time, [row.state or "" for row in track.rows])] if track.has_notes else []
    for kind, chosen in (("refused", ~fixed), ("fix", fixed & ~beyond), ("beyond", beyond)):
        marks.append(dots(area.points(track.time[chosen], level[chosen]), kind))
    names = [kind.replace("_", " ") for kind in kinds]
    chart = area.svg("Answers over time", track.time_label, marks, rows=names, timed=True)
    return "Answers, over the state of the navigator" if track.has_notes else "Answers", chart


def _height(track: FinishedTrack) -> Chart:
    measured, true = track.heights.T
    area = _area_around(track.heights, 1.0, track)
    marks = [area.line(track.time, true, "truth"), area.dots(track.time, measured, "fix")]
    what = "True height above ground (m); this method measures none"
    if np.isfinite(measured).any():
        what = "Height above ground (m)" + (", measured and true (line)" if np.isfinite(true).any() else "")
    return what, area.svg(what, track.time_label, marks, timed=True)


def _area_around(values: Array, least_margin: float, track: FinishedTrack) -> ChartArea:
    """The area that shows values over time, without a few outliers."""
    low, high = np.percentile(values[np.isfinite(values)], [1, 99]).tolist()
    margin = max(0.15 * (high - low), least_margin)
    return ChartArea(track.time_limits, (low - margin, high + margin))


def _score(track: FinishedTrack) -> Chart:
    score, fixed = column(track.rows, "score"), track.fixed
    area = ChartArea(track.time_limits, (min(0.0, float(np.nanmin(score))), 1.0))
    sift = np.array([row.method in ("sift", "learned") for row in track.rows])
    both = sift.any() and not sift.all()
    kinds = (("refused", ~fixed), ("fix", fixed & ~sift), ("sift" if both else "fix", fixed & sift))
    marks = [area.dots(track.time[chosen], score[chosen], kind) for kind, chosen in kinds]
    what = "Score: correlation, and of SIFT (green) the share of matches that agree"
    if not both:
        what = "Score: share of matches that agree" if sift.any() else "Score: correlation at the peak"
    return what, area.svg(what, track.time_label, marks, timed=True)


def _latency(track: FinishedTrack, latency_ms: Array, budget_ms: float | None) -> Chart:
    known = latency_ms[np.isfinite(latency_ms)]
    most = min(_HEADROOM * float(known.max()), 1.6 * float(np.percentile(known, 97)))  # without a few outliers
    area = ChartArea(track.time_limits, (0.0, max(most, _HEADROOM * (budget_ms or 0.0), 0.1)))
    marks = [area.dots(track.time, latency_ms, "fix"), area.overflow(track.time, latency_ms, "over")]
    limit = None if budget_ms is None else (budget_ms, f"budget {budget_ms:g} ms")
    return "Latency (ms)", area.svg("Latency over time", track.time_label, marks, timed=True, limit=limit)


# -------------------------------------------------------------------------------------------------------- attitude


def _attitude(track: FinishedTrack) -> list[Chart]:
    """Charts of roll, pitch and heading, those without data left out.

    The rows have the attitudes of the fixes; the telemetry belongs to the rows by frame name.
    """
    rows = track.rows
    if len(rows) < 2:
        return []
    by_frame = {row.frame: row for row in track.telemetry or ()}
    stated = [by_frame.get(row.frame) for row in rows]
    true = truth_per_row(rows, track.truth or [])
    charts = []
    for name, words in _ANGLES.items():
        fix = column(rows, name)
        charts.append(_angle_chart(words, fix, column(stated, name), column(true, name), track))
    return [chart for chart in charts if chart is not None]


def _angle_chart(words: str, fix: Array, stated: Array, true: Array, track: FinishedTrack) -> Chart | None:
    """Dots of the fixes on lines of telemetry and truth; omitted if neither fixes nor telemetry have the angle."""
    if not (np.isfinite(fix).any() or np.isfinite(stated).any()):
        return None
    is_heading = words == "Heading"
    if is_heading:  # kept continuous across north
        reference = _unwrapped(next(a for a in (true, stated, fix) if np.isfinite(a).any()))
        fix, stated, true = (a - 360.0 * np.round((a - reference) / 360.0) for a in (fix, stated, true))
    caption, error = f"{words} (degrees)", fix - true
    if np.isfinite(error).any():
        caption += f", RMS error of the fixes {np.sqrt(np.nanmean(error**2)):.2f}"
    area = _area_around(np.concatenate([fix, stated, true]), 0.5, track)
    marks = [
        area.line(track.time, stated, "telemetry"),
        area.dots(track.time, fix, "fix"),
        area.line(track.time, true, "truth"),
    ]
    period = 360.0 if is_heading else None
    return caption, area.svg(f"{caption} over time", track.time_label, marks, timed=True, period=period)


def _unwrapped(heading_deg: Array) -> Array:
    """The heading without jumps of a full turn, filled in everywhere."""
    known = np.isfinite(heading_deg)
    index = np.arange(len(heading_deg), dtype=np.float64)
    unwrapped = np.unwrap(heading_deg[known], period=360.0)
    return np.asarray(np.interp(index, index[known], unwrapped), np.float64)


# --------------------------------------------------------------------------------------------------- closed loop


def _loop(track: FinishedTrack) -> list[Chart]:
    """Distance from the plan, and the estimate's error with its sigma, on the time axis of the track's charts."""
    loop, start_ns = track.loop, track.rows[0].timestamp_ns
    if loop is None or start_ns is None:
        return []
    time, limits = (loop.timestamp_ns - start_ns) / 1e9, track.time_limits
    settled = loop.settled  # the initial uncertainty would set the scale
    plan = ChartArea(limits, (0.0, 1.1 * max(0.1, float(loop.off_plan_m.max()))))
    top = 1.1 * max(0.1, float(loop.estimate_error_m[settled].max()), float(3.0 * loop.sigma_m[settled].max()))
    estimate = ChartArea(limits, (0.0, top))
    zero = np.zeros(len(time))
    inside = (time >= limits[0]) & (time <= limits[1])
    sick = np.where(loop.healthy, np.nan, top)
    estimate_marks = [
        estimate.band(time[inside], zero[inside], sick[inside], "unhealthy"),
        estimate.band(time[inside], zero[inside], 3.0 * loop.sigma_m[inside], "sigma-band"),
        estimate.line(time[inside], loop.estimate_error_m[inside], "estimate"),
    ]
    off = "Distance of the vehicle from its plan (m)"
    error = "Error of the estimate (m), on three of its sigmas; red: no recent fix"
    label = track.time_label
    return [
        (off, plan.svg(off, label, [plan.line(time[inside], loop.off_plan_m[inside], "plan")], timed=True)),
        (error, estimate.svg(error, label, estimate_marks, timed=True)),
    ]
