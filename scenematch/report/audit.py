"""Draw a map audit: the map, the probability of a fix at each position, and the causes of low ones."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from engine.values import Window
from engine.window import level_crop
from scenematch.check.availability import SUITABLE, Audit, Flag, RouteAvailability
from scenematch.report.explain import level_within

if TYPE_CHECKING:
    from engine.orthomap import OrthoMap

_MAX_MAP_PX = 1600  # longer side of the map as drawn; more is not visible
_WIDTH_IN, _MAX_HEIGHT_IN = 9.0, 11.0
_DPI, _MAX_MARKS_PX = 130, 7.0
# Distinct by shape, and by colours under all common colour vision deficiencies (Okabe and Ito).
_MARKS = {
    Flag.FLAT: ("o", "#56B4E9", "flat, such as water"),
    Flag.REPEATED: ("s", "#E69F00", "repeated"),
    Flag.UNSTABLE: ("^", "#009E73", "fine random texture, such as forest"),
    Flag.WEAK: ("v", "#CC79A7", "weak"),
    Flag.NODATA: ("x", "#8c8c8c", "no data"),
    Flag.EDGE: ("+", "#8c8c8c", "too near the edge"),
}


def draw_audit(path: Path, audit: Audit, route: RouteAvailability | None, *, title: str) -> None:
    """Draw an audit as an image file.

    Args:
        path: the file, replaced if it exists.
        audit: the result of the audit.
        route: drawn if given, with a heavier line where positions are not suitable.
        title: heading.
    """
    from matplotlib.figure import Figure

    site, part = audit.plan.site, audit.plan.window
    scale = site.gsd_m_per_px
    right, bottom = part.x0 + part.width_px, part.y0 + part.height_px
    extent = (part.x0 * scale, right * scale, bottom * scale, part.y0 * scale)
    height_in = float(np.clip((_WIDTH_IN - 2.0) * part.height_px / part.width_px, 3.0, _MAX_HEIGHT_IN))
    figure = Figure(figsize=(_WIDTH_IN, height_in + 1.6), layout="constrained")
    ax = figure.subplots()
    ax.imshow(_background(site, part), cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="antialiased")
    shown = ax.imshow(
        np.ma.masked_invalid(audit.availability),
        cmap="viridis",
        vmin=0.0,
        vmax=1.0,
        alpha=0.45,
        extent=extent,
        interpolation="nearest",
    )
    figure.colorbar(shown, ax=ax, shrink=0.7, label="probability of a fix")
    _draw_marks(ax, audit)
    if route is not None:
        _draw_route(ax, route, scale)
    ax.set(
        xlim=extent[:2], ylim=extent[2:], xlabel="metres from the map's left edge", ylabel="metres from its top"
    )
    ax.set_title(f"{title}\n{_figures(audit, route)}", fontsize=10.5, loc="left")
    ax.tick_params(labelsize=9)
    if ax.get_legend_handles_labels()[0]:
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.savefig(path, dpi=_DPI, facecolor="white")


def _background(site: OrthoMap, part: Window) -> Any:
    """A part of the map in grey at the coarsest sufficient pyramid level; white where it has no data."""
    level = level_within(site, max(part.width_px, part.height_px), _MAX_MAP_PX)
    shown = level_crop(site, part, level)
    gray = site.gray(shown, level)
    gray[~site.valid(shown, level)] = 255
    return gray


def _draw_marks(ax: Any, audit: Audit) -> None:
    scale = audit.plan.site.gsd_m_per_px
    size = float(np.clip(220.0 / max(audit.flags.shape), 1.5, _MAX_MARKS_PX))
    for flag, (marker, colour, label) in _MARKS.items():
        positions_m = (audit.plan.centers_px[audit.flags == flag] + 0.5) * scale
        if len(positions_m):
            style: dict[str, Any] = {"markersize": size, "markeredgewidth": 1.0, "linestyle": ""}
            ax.plot(*positions_m.T, marker, color=colour, label=label, **style)


def _draw_route(ax: Any, route: RouteAvailability, scale: float) -> None:
    x, y = (route.xy_px + 0.5).T * scale
    ax.plot(x, y, color="white", linewidth=3.4, alpha=0.9, zorder=4)
    ax.plot(x, y, color="#1a1a1a", linewidth=1.4, label="route", zorder=5)
    if route.stretches:
        poor = np.where(route.probability < SUITABLE, y, np.nan)
        ax.plot(x, poor, color="#D55E00", linewidth=4.0, label="poor stretch", zorder=6, solid_capstyle="round")


def _figures(audit: Audit, route: RouteAvailability | None) -> str:
    parts = [f"{audit.shares['good']:.0%} of the positions suitable"]
    if route is not None:
        parts.append(f"{route.availability:.0%} predicted along {route.length_m:,.0f} m of route")
    return ", ".join(parts)
