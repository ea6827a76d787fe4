"""The charts of the report: error, answers, height, score and latency over time, and the latencies' histogram."""

from __future__ import annotations

import numpy as np

from engine.geo import Array
from scenematch.report.charts import ChartArea, dots
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.metrics import FALSE_SIGMAS, column

Chart = tuple[str, str]
"""Caption and SVG."""

_BINS = 48
_HEADROOM = 1.08  # upper limit relative to the highest value


def draw_charts(track: FinishedTrack) -> list[Chart]:
    """The charts with their captions; those without data are omitted."""
    if not track.rows:
        return []
    latency_ms, budget_ms = column(track.rows, "latency_ms"), track.settings.get("budget_ms")
    charts = [_error(track), *_in_sigmas(track), _answers(track)]
    if np.isfinite(track.heights).any():
        charts.append(_height(track))
    if np.isfinite(column(track.rows, "score")).any():
        charts.append(_score(track))
    if np.isfinite(latency_ms).any():
        charts += [_latency(track, latency_ms, budget_ms), _histogram(latency_ms, budget_ms)]
    return charts


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
    known = track.heights[np.isfinite(track.heights)]
    low, high = np.percentile(known, [1, 99])
    margin = max(0.15 * (high - low), 1.0)
    area = ChartArea(track.time_limits, (float(low - margin), float(high + margin)))
    marks = [area.line(track.time, true, "truth"), area.dots(track.time, measured, "fix")]
    what = "True height above ground (m); this method measures none"
    if np.isfinite(measured).any():
        what = "Height above ground (m)" + (", measured and true (line)" if np.isfinite(true).any() else "")
    return what, area.svg(what, track.time_label, marks, timed=True)


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
