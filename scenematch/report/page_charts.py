"""The charts of the report: error, answers, height, score, latency, attitude, velocity, and a closed loop's."""

from __future__ import annotations

import numpy as np

from engine.geo import Array
from scenematch.report.charts import ChartArea, dots
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.metrics import FALSE_SIGMAS, column, truth_per_row

Chart = tuple[str, str]
"""Caption and SVG."""

_BINS = 48
_HEADROOM = 1.08  # upper limit relative to the highest value
_ANGLES = {"roll_deg": "Roll", "pitch_deg": "Pitch", "heading_deg": "Heading"}
_AXES = ("east", "north")
_BASE_S, _MAX_GAP_S = 1.0, 5.0  # between fixes whose difference gives a velocity


def draw_charts(track: FinishedTrack) -> list[Chart]:
    """The charts with their captions; those without data are omitted."""
    if not track.rows:
        return []
    latency_ms, budget_ms = column(track.rows, "latency_ms"), track.settings.get("budget_ms")
    charts = [_error(track), *_loop(track), *_in_sigmas(track), _answers(track)]
    if np.isfinite(track.heights).any():
        charts.append(_height(track))
    if np.isfinite(column(track.rows, "score")).any():
        charts.append(_score(track))
    if np.isfinite(latency_ms).any():
        charts += [_latency(track, latency_ms, budget_ms), _histogram(latency_ms, budget_ms)]
    return charts + _motion(track)


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


def _in_sigmas(track: FinishedTrack) -> list[Chart]:
    """The error in units of the sigma that the fix states in its direction."""
    sigmas = np.sqrt(track.errors.normalised_squared_errors)
    known = sigmas[np.isfinite(sigmas)]
    if not known.size:
        return []
    area = ChartArea(track.time_limits, (0.0, max(1.25 * FALSE_SIGMAS, 1.2 * float(np.percentile(known, 97)))))
    beyond = track.errors.beyond
    marks = [
        area.dots(track.time[~beyond], sigmas[~beyond], "fix"),
        area.dots(track.time[beyond], sigmas[beyond], "beyond"),
        area.overflow(track.time, sigmas, "over"),
    ]
    fixed = [area.horizontal(FALSE_SIGMAS, "limit", f"{FALSE_SIGMAS:g} sigma")]
    what = "Horizontal error, in stated sigmas"
    return [(what, area.svg(f"{what} over time", track.time_label, marks, timed=True, fixed=fixed))]


def _answers(track: FinishedTrack) -> Chart:
    """Fix or reason of refusal of each frame, over the state of the navigator."""
    answers = ["fix" if row.fixed else row.reason or "unknown" for row in track.rows]
    kinds = ["fix", *sorted({*answers} - {"fix"})]
    level = np.array([kinds.index(answer) for answer in answers], np.float64)
    area = ChartArea(track.time_limits, (len(kinds) - 0.5, -0.5), left=150.0)
    fixed, beyond = track.fixed, track.errors.beyond
    marks = [area.strip(track.time, [note.state for note in track.notes])] if track.notes else []
    for kind, chosen in (("refused", ~fixed), ("fix", fixed & ~beyond), ("beyond", beyond)):
        marks.append(dots(area.points(track.time[chosen], level[chosen]), kind))
    names = [kind.replace("_", " ") for kind in kinds]
    chart = area.svg("Answers over time", track.time_label, marks, rows=names, timed=True)
    return "Answers, over the state of the navigator" if track.notes else "Answers", chart


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
    area = ChartArea(track.time_limits, (0.0, _top_ms(latency_ms, budget_ms)))
    marks = [area.dots(track.time, latency_ms, "fix"), area.overflow(track.time, latency_ms, "over")]
    fixed = [] if budget_ms is None else [area.horizontal(budget_ms, "limit", f"budget {budget_ms:g} ms")]
    return "Latency (ms)", area.svg("Latency over time", track.time_label, marks, timed=True, fixed=fixed)


def _histogram(latency_ms: Array, budget_ms: float | None) -> Chart:
    known = latency_ms[np.isfinite(latency_ms)]
    top = _top_ms(latency_ms, budget_ms)
    counts, edges = np.histogram(np.minimum(known, np.nextafter(top, 0.0)), bins=_BINS, range=(0.0, top))
    area = ChartArea((0.0, top), (0.0, _HEADROOM * float(counts.max())))
    marks = [
        area.bars(edges, counts, "bars"),
        area.vertical(float(np.percentile(known, 95)), "mark", f"95 %: {np.percentile(known, 95):.1f} ms"),
        "" if budget_ms is None else area.vertical(budget_ms, "limit", f"budget {budget_ms:g} ms", row=1),
    ]
    return "Frames by latency", area.svg("Histogram of latency", "latency (ms)", marks, timed=False)


def _top_ms(latency_ms: Array, budget_ms: float | None) -> float:
    """Upper limit of the latency axis in milliseconds, ignoring a few outliers."""
    known = latency_ms[np.isfinite(latency_ms)]
    typical = 1.6 * float(np.percentile(known, 97))
    return max(min(_HEADROOM * float(known.max()), typical), _HEADROOM * (budget_ms or 0.0), 0.1)


# ----------------------------------------------------------------------------------------- attitude and velocity


def _motion(track: FinishedTrack) -> list[Chart]:
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
        charts.append(_angle_chart(words, fix, column(stated, name), column(true, name), track))
    if track.is_timed:
        for axis, words in enumerate(_AXES):
            charts.append(_velocity_chart(axis, column(stated, f"{words}_velocity_mps"), track))
    return [chart for chart in charts if chart is not None]


def _angle_chart(words: str, fix: Array, stated: Array, true: Array, track: FinishedTrack) -> Chart | None:
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


def _velocity_chart(axis: int, stated: Array, track: FinishedTrack) -> Chart | None:
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
    area = _area_around(np.concatenate([fix, stated, true]), 0.5, track)
    marks = [
        area.line(track.time, stated, "telemetry"),
        area.dots(track.time, fix, "fix"),
        area.line(track.time, true, "truth"),
    ]
    return caption, area.svg(f"{caption} over time", track.time_label, marks, timed=True, period=period)


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
