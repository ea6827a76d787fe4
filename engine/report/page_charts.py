"""The charts of the report: error, answers, height, score and latency over time, and how the latencies spread."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from engine.formats.notes import Note
from engine.formats.track import TrackRow
from engine.report.charts import Limits, Plot, dots
from engine.report.figures import TrackPlotData
from engine.report.metrics import FALSE_SIGMAS, WRONG_M

Array = NDArray[np.float64]

_BINS = 48
_ROOM = 1.08  # above the highest value


def draw_charts(
    rows: Sequence[TrackRow], notes: Sequence[Note] | None, scene: TrackPlotData, budget_ms: float | None
) -> list[tuple[str, str]]:
    """The charts, each with its caption; what there is nothing of is left out."""
    if not rows:
        return []
    time = (float(scene.time[0]), float(scene.time[-1]))
    latency_ms = _column(rows, "latency_ms")
    charts = [_error(scene, time), _answers(rows, notes, scene, time)]
    if np.isfinite(scene.heights).any():
        charts.append(_height(scene, time))
    if np.isfinite(_column(rows, "score")).any():
        charts.append(_score(rows, scene, time))
    if np.isfinite(latency_ms).any():
        charts += [_latency(latency_ms, scene, time, budget_ms), _histogram(latency_ms, budget_ms)]
    return charts


def _column(rows: Sequence[TrackRow], name: str) -> Array:
    return np.array([np.nan if (value := getattr(row, name)) is None else value for row in rows], np.float64)


def _error(scene: TrackPlotData, time: Limits) -> tuple[str, str]:
    """The error with one and three of the stated sigmas; without truth the sigma alone."""
    errors, known = scene.errors, np.isfinite(scene.errors.distance_m)
    covariance = errors.covariance_en_m2
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    sigma = np.sqrt((a + c) / 2.0 + np.hypot((a - c) / 2.0, b))
    stated = np.isfinite(sigma)
    limits = [0.5]
    if stated.any():
        limits.append(1.15 * FALSE_SIGMAS * float(np.percentile(sigma[stated], 90)))
    if known.any():
        limits.append(1.2 * float(np.percentile(errors.distance_m[known], 97)))
    plot = Plot(time, (0.0, max(limits)))
    zero = np.zeros_like(sigma)
    wrong = np.where(errors.distance_m > WRONG_M, errors.distance_m, np.nan)
    marks = [
        plot.band(scene.time, zero, FALSE_SIGMAS * sigma, "sigmas"),
        plot.band(scene.time, zero, sigma, "sigma"),
        plot.level(WRONG_M, "limit", f"wrong above {WRONG_M:g} m"),
        plot.dots(scene.time, errors.distance_m, "fix"),
        plot.dots(scene.time, wrong, "wrong"),
        plot.overflow(scene.time, errors.distance_m, "over"),
    ]
    what = (
        "Horizontal error (m), on one and three stated sigmas"
        if known.any()
        else "Stated sigma (m), one and three"
    )
    return what, plot.svg(f"{what} over time", scene.time_label, marks, timed=True)


def _answers(
    rows: Sequence[TrackRow], notes: Sequence[Note] | None, scene: TrackPlotData, time: Limits
) -> tuple[str, str]:
    """Fix or reason of each frame, on the state of the navigator."""
    kinds = ["fix", *sorted({row.reason or "unknown" for row in rows if not row.fixed})]
    place = np.array([kinds.index("fix" if row.fixed else row.reason or "unknown") for row in rows], np.float64)
    plot = Plot(time, (len(kinds) - 0.5, -0.5), left=150.0)
    fixed = np.array([row.fixed for row in rows])
    wrong = scene.errors.distance_m > WRONG_M
    marks = [plot.strip(scene.time, [note.state for note in notes])] if notes else []
    for kind, chosen in (("refused", ~fixed), ("fix", fixed & ~wrong), ("wrong", wrong)):
        marks.append(dots(plot.places(scene.time[chosen], place[chosen]), kind))
    names = [kind.replace("_", " ") for kind in kinds]
    chart = plot.svg("Answers over time", scene.time_label, marks, rows=names, timed=True)
    return "Answers, on the state of the navigator" if notes else "Answers", chart


def _height(scene: TrackPlotData, time: Limits) -> tuple[str, str]:
    found, true = scene.heights.T
    known = scene.heights[np.isfinite(scene.heights)]
    low, high = np.percentile(known, [1, 99])
    room = max(0.15 * (high - low), 1.0)
    plot = Plot(time, (float(low - room), float(high + room)))
    marks = [plot.line(scene.time, true, "truth"), plot.dots(scene.time, found, "fix")]
    what = "True height above ground (m); this method measures none"
    if np.isfinite(found).any():
        what = "Height above ground (m)" + (", measured and true (line)" if np.isfinite(true).any() else "")
    return what, plot.svg(what, scene.time_label, marks, timed=True)


def _score(rows: Sequence[TrackRow], scene: TrackPlotData, time: Limits) -> tuple[str, str]:
    score, methods = _column(rows, "score"), [row.method for row in rows]
    plot = Plot(time, (min(0.0, float(np.nanmin(score))), 1.0))
    fixed = np.array([row.fixed for row in rows])
    sift = np.array([method == "sift" for method in methods])
    both = sift.any() and not sift.all()
    kinds = (("refused", ~fixed), ("fix", fixed & ~sift), ("sift" if both else "fix", fixed & sift))
    marks = [plot.dots(scene.time[chosen], score[chosen], kind) for kind, chosen in kinds]
    what = "Score: correlation, and of SIFT (green) the share of matches that agree"
    if not both:
        what = "Score: share of matches that agree" if sift.any() else "Score: correlation at the peak"
    return what, plot.svg(what, scene.time_label, marks, timed=True)


def _latency(latency_ms: Array, scene: TrackPlotData, time: Limits, budget_ms: float | None) -> tuple[str, str]:
    plot = Plot(time, (0.0, _top_ms(latency_ms, budget_ms)))
    marks = [
        plot.dots(scene.time, latency_ms, "fix"),
        plot.overflow(scene.time, latency_ms, "over"),
        "" if budget_ms is None else plot.level(budget_ms, "limit", f"budget {budget_ms:g} ms"),
    ]
    return "Latency (ms)", plot.svg("Latency over time", scene.time_label, marks, timed=True)


def _histogram(latency_ms: Array, budget_ms: float | None) -> tuple[str, str]:
    known = latency_ms[np.isfinite(latency_ms)]
    top = _top_ms(latency_ms, budget_ms)
    counts, edges = np.histogram(np.minimum(known, np.nextafter(top, 0.0)), bins=_BINS, range=(0.0, top))
    plot = Plot((0.0, top), (0.0, _ROOM * float(counts.max())))
    marks = [
        plot.bars(edges, counts, "bars"),
        plot.upright(float(np.percentile(known, 95)), "mark", f"95 %: {np.percentile(known, 95):.1f} ms"),
        "" if budget_ms is None else plot.upright(budget_ms, "limit", f"budget {budget_ms:g} ms", row=1),
    ]
    return "Frames by latency", plot.svg("Histogram of latency", "latency (ms)", marks, timed=False)


def _top_ms(latency_ms: Array, budget_ms: float | None) -> float:
    """Up to where latencies are drawn: a few very late ones do not press the others flat."""
    known = latency_ms[np.isfinite(latency_ms)]
    ordinary = 1.6 * float(np.percentile(known, 97))
    return max(min(_ROOM * float(known.max()), ordinary), _ROOM * (budget_ms or 0.0), 0.1)
