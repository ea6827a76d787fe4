"""Plots of a track: the path over the map, position, height and error over time (the paper's Fig. 7 to 11).

Convention:
    Colours are distinct under all common colour vision deficiencies (Okabe and Ito): truth dark, fixes blue,
    refusals vermilion. matplotlib's global state is not used, so that other plots are unaffected.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from engine.geo import LocalFrame
from engine.values import Truth, Window
from scenematch.files.track import TrackRow
from scenematch.report.metrics import FALSE_SIGMAS, WRONG_M, Ground
from scenematch.report.plot_data import TrackPlotData, format_metres, larger_variance_m2, prepare_plot_data

if TYPE_CHECKING:
    from engine.orthomap import OrthoMap

Array = NDArray[np.float64]

DPI = 130
TRUTH, FIX, REFUSED, GRID = "#1a1a1a", "#0072B2", "#D55E00", "#d9d9d9"
_MAX_MAP_PX = 1600  # longer side of the map as drawn; more is not visible
_MAX_GAP_S = 5.0  # interval without truth over which its line is broken


def draw_figures(
    directory: str | Path,
    rows: Sequence[TrackRow],
    truth: Sequence[Truth] | None = None,
    *,
    site: OrthoMap | None = None,
    title: str = "",
    frame: LocalFrame | None = None,
    ground: Ground | None = None,
) -> list[Path]:
    """Draw path.png and position.png, and where data exists height.png and error.png.

    Args:
        directory: folder of the files, created where it does not exist.
        rows: the track.
        truth: in the order of time, or None.
        site: the map under the path, or None for a blank background.
        title: heading of every plot.
        frame: origin of east and north; None uses the map's, else the first known position.
        ground: level of the ground; None uses flat ground at 0.

    Returns:
        Paths of the written files; empty for a track without any known position.
    """
    directory = Path(directory)
    frame = frame or (site.frame if site is not None else _first_position(rows, truth))
    if frame is None:
        return []
    plot_data = prepare_plot_data(rows, truth, frame, ground or Ground(), title)
    figures = {"path.png": _path(plot_data, site), "position.png": _position(plot_data)}
    if np.isfinite(plot_data.heights[:, 0]).any():
        figures["height.png"] = _height(plot_data)
    if np.isfinite(plot_data.errors.distance_m).any():
        figures["error.png"] = _error(plot_data)
    directory.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(directory / name, dpi=DPI, facecolor="white")
    return [directory / name for name in figures]


def _first_position(rows: Sequence[TrackRow], truth: Sequence[Truth] | None) -> LocalFrame | None:
    if truth:
        return LocalFrame(truth[0].lat_deg, truth[0].lon_deg)
    positions = ((row.lat_deg, row.lon_deg) for row in rows)
    return next((LocalFrame(lat, lon) for lat, lon in positions if lat is not None and lon is not None), None)


def _new_figure(plot_data: TrackPlotData, size_in: tuple[float, float], panels: int = 1) -> tuple[Any, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_in, layout="constrained")
    axes = figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(True, color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
        ax.tick_params(labelsize=9)
    heading = [line for line in (plot_data.title, plot_data.figures) if line]
    # Of the figure, not of the axes: those of a narrow map end before the line does.
    figure.suptitle("\n".join(heading), fontsize=10.5, x=0.02, ha="left")
    return figure, list(axes)


def _legend(figure: Any, axes: Sequence[Any]) -> None:
    """One legend for all axes, below them."""
    by_label = {
        label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    if by_label:
        handles, labels = list(by_label.values()), list(by_label)
        columns = min(len(labels), 6)
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def plain_log_ticks(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers: 1, 2 and 5 of each decade, or 1 alone over more than two.

    matplotlib's own labels of a short axis (2 x 10^1, 3 x 10^1, ...) overlap.

    Args:
        axis: ``xaxis`` or ``yaxis``, after everything is drawn on it.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    multiples = (1.0, 2.0, 5.0) if high <= 100.0 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=multiples, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _line(time: Array, values: Array) -> tuple[Array, Array]:
    """A line that is broken at long gaps but not at single missing values."""
    known = np.isfinite(values)
    time, values = time[known], values[known]
    steps = np.diff(time)
    median_step = float(np.median(steps)) if steps.size else 0.0
    breaks = np.flatnonzero(steps > max(_MAX_GAP_S, 3.0 * median_step)) + 1
    return np.insert(time, breaks, np.nan), np.insert(values, breaks, np.nan)


def _draw_series(ax: Any, time: Array, fix: Array, truth: Array) -> None:
    """Draw truth as a line and fixes as dots on top."""
    if np.isfinite(truth).any():
        ax.plot(*_line(time, truth), color=TRUTH, linewidth=1.1, label="truth", zorder=2)
    ax.plot(time, fix, ".", color=FIX, markersize=4.5, markeredgewidth=0, label="fix", zorder=3)


def _draw_refused(ax: Any, x: Array, y: Array) -> None:
    if np.isfinite(y).any():
        ax.plot(x, y, "x", color=REFUSED, markersize=5, markeredgewidth=1.3, label="refused", zorder=4)


# ------------------------------------------------------------------------------------------------ Fig. 7, 9


def _path(plot_data: TrackPlotData, site: OrthoMap | None) -> Any:
    low, high = _view(plot_data)
    span = high - low
    width_in = 8.0
    figure, (ax,) = _new_figure(
        plot_data, (width_in, float(np.clip(width_in * span[1] / span[0], 3.4, 9.0)) + 0.9)
    )
    ax.set(aspect="equal", xlabel="east (m)", ylabel="north (m)")
    if site is not None:
        ax.grid(False)
        _draw_map(ax, site, low, high)
    fix, truth = plot_data.errors.fix_en_m, plot_data.errors.truth_en_m
    if np.isfinite(truth).any():
        order = np.isfinite(truth[:, 0])
        ax.plot(*truth[order].T, color="white", linewidth=3.2, alpha=0.8, zorder=2, solid_joinstyle="round")
        ax.plot(*truth[order].T, color=TRUTH, linewidth=1.2, label="truth", zorder=2.1, solid_joinstyle="round")
    else:
        fixed = np.isfinite(fix[:, 0])
        ax.plot(*fix[fixed].T, color=FIX, linewidth=0.7, alpha=0.7, zorder=2)
    ax.scatter(*fix.T, s=17, color=FIX, edgecolors="white", linewidths=0.5, label="fix", zorder=3)
    _draw_refused(ax, plot_data.refused_en_m[:, 0], plot_data.refused_en_m[:, 1])
    _note_outside(ax, np.any((fix < low) | (fix > high), axis=1))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    _legend(figure, [ax])
    return figure


def _note_outside(ax: Any, outside: NDArray[np.bool_]) -> None:
    count = int(outside.sum())
    if count:
        ax.annotate(
            f"{count} {'fix' if count == 1 else 'fixes'} outside the view",
            (0.99, 0.01),
            xycoords="axes fraction",
            ha="right",
            va="bottom",
            fontsize=9,
            color=REFUSED,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )


def _view(plot_data: TrackPlotData) -> tuple[Array, Array]:
    """Lower and upper corner (2,) of the view in metres: the flight with a margin; outliers do not enlarge it."""
    truth = plot_data.errors.truth_en_m
    shown = truth if np.isfinite(truth).any() else plot_data.errors.fix_en_m
    if not np.isfinite(shown).any():
        shown = np.zeros((1, 2))
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    margin = max(0.12 * float((high - low).max()), 15.0)
    return low - margin, high + margin


def _draw_map(ax: Any, site: OrthoMap, low: Array, high: Array) -> None:
    """Draw the part of the map in view in pale grey; its grid may be rotated against north."""
    from matplotlib.transforms import Affine2D

    crop = _crop(site, low, high)
    if crop is None:
        return
    window, level = crop
    gray = np.asarray(site.gray(window, level), dtype=np.float64)
    gray = np.where(site.valid(window, level), gray, np.nan)
    if not np.isfinite(gray).any():
        return
    dark, light = np.nanpercentile(gray, [1.0, 99.0])
    pale = 0.45 + 0.55 * np.clip((gray - dark) / max(light - dark, 1e-9), 0.0, 1.0)
    # Edges of the crop in full-resolution pixels, whose centres are integers.
    left, right = ((x << level) - 0.5 for x in (window.x0, window.x0 + window.width_px))
    top, bottom = ((y << level) - 0.5 for y in (window.y0, window.y0 + window.height_px))
    corners = np.array([[left, top], [right, top], [left, bottom]])
    origin, x_end, y_end = np.asarray(site.enu_from_pixel(corners), dtype=np.float64)
    matrix = np.eye(3)
    matrix[:2, 0], matrix[:2, 1] = (x_end - origin) / (right - left), (y_end - origin) / (bottom - top)
    matrix[:2, 2] = origin - matrix[:2, :2] @ corners[0]
    ax.imshow(
        pale,
        cmap="gray",
        vmin=0.0,
        vmax=1.0,
        extent=(left, right, bottom, top),
        transform=Affine2D(matrix) + ax.transData,
        interpolation="antialiased",
        zorder=0,
    )


def _crop(site: OrthoMap, low: Array, high: Array) -> tuple[Window, int] | None:
    """Window and pyramid level that cover the view at sufficient resolution, or None outside the map."""
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    pixels = np.asarray(site.pixel_from_enu(corners), dtype=np.float64)
    first, last = pixels.min(axis=0), pixels.max(axis=0)
    level = 0
    while level + 1 < site.levels and (last - first).max() > _MAX_MAP_PX << level:
        level += 1
    height_px, width_px = site.level_shape(level)
    x0, y0 = (max(0, int(np.floor((v + 0.5) / 2**level))) for v in first)
    x1, y1 = (int(np.ceil((v + 0.5) / 2**level)) for v in last)
    x1, y1 = min(x1, width_px), min(y1, height_px)
    return (Window(x0, y0, x1 - x0, y1 - y0), level) if x1 > x0 and y1 > y0 else None


# ----------------------------------------------------------------------------------------------- Fig. 8, 10


def _position(plot_data: TrackPlotData) -> Any:
    figure, axes = _new_figure(plot_data, (9.0, 6.0), panels=2)
    for axis, (ax, name) in enumerate(zip(axes, ("east (m)", "north (m)"), strict=True)):
        fix, truth = plot_data.errors.fix_en_m[:, axis], plot_data.errors.truth_en_m[:, axis]
        _draw_series(ax, plot_data.time, fix, truth)
        _draw_refused(ax, plot_data.time, plot_data.refused_en_m[:, axis])
        ax.set_ylabel(name)
        _limit(ax, truth if np.isfinite(truth).any() else fix, fix)
    axes[-1].set_xlabel(plot_data.time_label)
    _legend(figure, axes)
    return figure


def _limit(ax: Any, shown: Array, points: Array) -> None:
    """Set limits from ``shown`` with a margin; points beyond them become triangles at the edge."""
    if not np.isfinite(shown).any():
        return
    low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
    margin = max(0.15 * (high - low), 2.0)
    _clip(ax, low - margin, high + margin, points)


def _clip(ax: Any, low: float, high: float, points: Array) -> None:
    line = next(line for line in ax.get_lines() if line.get_label() == "fix")
    time = np.asarray(line.get_xdata(), dtype=np.float64)
    ax.set_ylim(low, high)
    inset = 0.015 * (high - low)
    for beyond, edge, marker in ((points > high, high - inset, "^"), (points < low, low + inset, "v")):
        if beyond.any():
            edges = np.full(int(beyond.sum()), edge)
            label = f"fix {'above' if marker == '^' else 'below'} the scale"
            ax.plot(time[beyond], edges, marker, color=FIX, markersize=6, label=label, zorder=5)


# -------------------------------------------------------------------------------------------------- Fig. 11


def _height(plot_data: TrackPlotData) -> Any:
    figure, (ax,) = _new_figure(plot_data, (9.0, 4.2))
    fix, truth = plot_data.heights.T
    _draw_series(ax, plot_data.time, fix, truth)
    difference = (fix - truth)[np.isfinite(fix - truth)]
    if difference.size:
        rms, bias = float(np.sqrt(np.mean(difference**2))), float(difference.mean())
        heading = f"{plot_data.title}\nheight: RMS {format_metres(rms)}, bias {format_metres(bias)}"
        ax.set_title(heading.strip(), fontsize=10.5, loc="left")
    ax.set(xlabel=plot_data.time_label, ylabel="height above the ground (m)")
    low, high = np.percentile(fix[np.isfinite(fix)], [2.0, 98.0])
    if np.isfinite(truth).any():  # implausible heights do not enlarge the scale
        low, high = np.clip([low, high], 0.5 * np.nanmin(truth) - 5.0, 1.5 * np.nanmax(truth) + 5.0)
    _limit(ax, np.append(truth, [low, high]), fix)
    _draw_rug(ax, plot_data)
    _legend(figure, [ax])
    return figure


def _draw_rug(ax: Any, plot_data: TrackPlotData) -> None:
    """Draw refusals, which have no value, as ticks along the lower edge."""
    if plot_data.refused.any():
        time = plot_data.time[plot_data.refused]
        edge, low = ax.get_xaxis_transform(), np.full(time.size, 0.02)
        ax.plot(time, low, "|", color=REFUSED, markersize=7, transform=edge, label="refused")


# -------------------------------------------------------------------------------------------- error in time


def _error(plot_data: TrackPlotData) -> Any:
    figure, (ax,) = _new_figure(plot_data, (9.0, 4.2))
    distance = plot_data.errors.distance_m
    sigma = np.sqrt(larger_variance_m2(plot_data.errors.covariance_en_m2))
    known = np.isfinite(sigma)
    for factor, alpha in ((FALSE_SIGMAS, 0.13), (1.0, 0.22)):
        band = np.where(known, factor * sigma, np.nan)
        label = f"{factor:g} σ as stated"
        ax.fill_between(plot_data.time, 0.0, band, color=FIX, alpha=alpha, linewidth=0, label=label, zorder=1)
    ax.plot(plot_data.time, distance, ".", color=FIX, markersize=4.5, markeredgewidth=0, label="fix", zorder=3)
    limits = [4.0 * float(np.nanmedian(distance)), 1.2 * float(np.nanpercentile(distance, 95))]
    if known.any():
        limits.append(1.15 * FALSE_SIGMAS * float(np.nanpercentile(sigma, 90)))
    top = max(min(max(limits), 1.1 * max(float(np.nanmax(distance)), limits[-1])), 0.5)
    if top > WRONG_M:
        ax.axhline(WRONG_M, color=TRUTH, linewidth=0.9, linestyle=(0, (4, 3)), label=f"wrong above {WRONG_M:g} m")
    _clip(ax, 0.0, top, distance)
    _draw_rug(ax, plot_data)
    ax.set(xlabel=plot_data.time_label, ylabel="horizontal error (m)")
    _legend(figure, [ax])
    return figure
