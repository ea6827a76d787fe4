"""Compare several tracks of one flight: cumulative distributions of error and latency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.geo import LocalFrame
from engine.values import Truth
from scenematch.files.track import TrackRow
from scenematch.report.figures import DPI, GRID, plain_log_ticks
from scenematch.report.metrics import errors_en_m

Array = NDArray[np.float64]

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#1a1a1a")
_DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.5, 1.5)))


def draw_comparison(
    path: Path, tracks: Mapping[str, Sequence[TrackRow]], truth: Sequence[Truth] | None = None
) -> None:
    """Draw the cumulative share of all frames by horizontal error and by latency.

    Refused frames count, so a curve ends at the availability: a method that answers few frames accurately ends
        low, one that answers inaccurately rises late.

    Args:
        path: the PNG file.
        tracks: rows by name of the run.
        truth: in the order of time; without it only latencies are drawn.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    panels: list[tuple[str, dict[str, Array]]] = [("time to the answer (ms)", _latencies_ms(tracks))]
    if truth:
        panels.insert(0, ("horizontal error (m)", _errors_m(tracks, truth)))
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (label, values) in zip(axes, panels, strict=True):
        for index, (name, series) in enumerate(values.items()):
            _draw_cumulative(ax, series, len(tracks[name]), name, index)
        ax.set(xscale="log", xlabel=label, ylabel="share of all frames", ylim=(-0.02, 1.02))
        plain_log_ticks(ax.xaxis)
        ax.grid(color=GRID, linewidth=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=DPI, facecolor="white")


def _draw_cumulative(ax: Any, values: Array, frames: int, name: str, index: int) -> None:
    """Draw an empirical cumulative distribution as steps."""
    order = np.sort(values[np.isfinite(values)])
    share = np.arange(1, order.size + 1) / max(1, frames)
    style = {
        "color": _COLOURS[index % len(_COLOURS)],
        "linestyle": _DASHES[index // len(_COLOURS) % len(_DASHES)],
    }
    ax.plot(np.maximum(order, 1e-3), share, drawstyle="steps-post", label=name, linewidth=1.6, **style)


def _errors_m(tracks: Mapping[str, Sequence[TrackRow]], truth: Sequence[Truth]) -> dict[str, Array]:
    frame = LocalFrame(truth[0].lat_deg, truth[0].lon_deg)
    return {name: errors_en_m(rows, truth, frame).distance_m for name, rows in tracks.items()}


def _latencies_ms(tracks: Mapping[str, Sequence[TrackRow]]) -> dict[str, Array]:
    return {
        name: np.array([np.nan if row.latency_ms is None else row.latency_ms for row in rows])
        for name, rows in tracks.items()
    }
