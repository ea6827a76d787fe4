"""The map of the report: the part that was flown over, with track, truth, refusals and error ellipses."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from engine.orthomap import OrthoMap
from engine.report.charts import crosses, dots, line, ticks
from engine.report.explain import jpeg_data_uri
from engine.report.metrics import WRONG_M
from engine.report.plot_data import TrackPlotData
from engine.values import Window
from engine.window import level_crop

Array = NDArray[np.float64]

_MAX_MAP_PX = 1500  # longer side as drawn
_MAP_BYTES = 900_000
_MARGIN_SHARE, _MARGIN_PX = 0.12, 40.0
_ASPECTS = (0.62, 0.95)  # range of height over width, as far as the map allows
_MAX_ELLIPSES = 400
_SIGMAS = 3.0
_MAX_STEP_M = 60.0  # between positions that a line connects, unless the median step is large


@dataclass(frozen=True, slots=True)
class TrackMap:
    """The part of the map that the report draws.

    Attributes:
        site: the map.
        window: the part that is drawn, in full-resolution pixels.
        level: pyramid level from which it is drawn.
    """

    site: OrthoMap
    window: Window
    level: int

    @property
    def box(self) -> tuple[float, float, float, float]:
        """SVG view box in pixels of the level: x, y, width and height."""
        scale = 2.0**self.level
        return (0.0, 0.0, round(self.window.width_px / scale, 1), round(self.window.height_px / scale, 1))

    def drawing_xy(self, en_m: Array) -> Array:
        """East and north (..., 2) in metres as x and y (..., 2) of the drawing."""
        corner = np.array([self.window.x0, self.window.y0]) - 0.5
        return np.asarray((self.site.pixel_from_enu(en_m) - corner) / 2.0**self.level, np.float64)

    def rectangle(self, window: Window) -> tuple[float, float, float, float]:
        """A window of the map in units of the drawing: x, y, width and height."""
        x, y = ((a - b) / 2.0**self.level for a, b in ((window.x0, self.window.x0), (window.y0, self.window.y0)))
        return (round(x, 1), round(y, 1), window.width_px / 2.0**self.level, window.height_px / 2.0**self.level)


def map_of_track(site: OrthoMap, plot_data: TrackPlotData) -> TrackMap:
    """The part of the map with fixes, refusals and truth, and a margin; the whole map without any of them."""
    positions_m = np.concatenate([plot_data.errors.fix_en_m, plot_data.errors.truth_en_m, plot_data.refused_en_m])
    pixels = site.pixel_from_enu(positions_m[np.isfinite(positions_m).all(axis=1)])
    size = np.array([site.width_px, site.height_px], np.float64)
    low, high = np.zeros(2), size
    if len(pixels):
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        middle, span = (low + high) / 2.0, (high - low) * (1.0 + 2.0 * _MARGIN_SHARE) + 2.0 * _MARGIN_PX
        span = np.maximum(span, [span[1] / _ASPECTS[1], span[0] * _ASPECTS[0]])
        span = np.minimum(span, size)
        low = np.clip(middle - span / 2.0, 0.0, size - span)
        high = low + span
    x0, y0 = (int(v) for v in low)
    width, height = (int(v) for v in np.ceil(high) - [x0, y0])
    level = 0
    while max(width, height) >> level > _MAX_MAP_PX and level + 1 < site.levels:
        level += 1
    return TrackMap(site, Window(x0, y0, width, height), level)


def draw_map(track_map: TrackMap, plot_data: TrackPlotData) -> str:
    """The map as SVG: from bottom to top map, path, ellipses, fixes, refusals, wrong fixes, selected frame."""
    _, _, width, height = track_map.box
    crop = level_crop(track_map.site, track_map.window, track_map.level)
    gray = track_map.site.gray(crop, track_map.level).copy()
    gray[~track_map.site.valid(crop, track_map.level)] = 238
    fixes, wrong = track_map.drawing_xy(plot_data.errors.fix_en_m), plot_data.errors.distance_m > WRONG_M
    ground = f'<image href="{jpeg_data_uri(gray, _MAP_BYTES)}" width="{width:g}" height="{height:g}" '
    refused = track_map.drawing_xy(plot_data.refused_en_m)
    arm = max(width, height) / 170.0
    marks = [
        ground + 'preserveAspectRatio="none" opacity="0.82"/>',
        _path(track_map, plot_data),
        _ellipses(track_map, plot_data),
        dots(fixes, "under"),
        dots(fixes[~wrong], "fix"),
        crosses(refused, "refused", arm),
        crosses(fixes[wrong], "wrong", arm),
        '<rect class="now-window" id="now-window" width="0" height="0"/><path class="dots now" id="now" d=""/>',
        _scale_bar(track_map),
    ]
    known = int(np.isfinite(fixes[:, 0]).sum())
    label = f"Map with {known} fixes, {int(plot_data.refused.sum())} refusals and {int(wrong.sum())} wrong fixes."
    head = f'<svg class="map" id="map" viewBox="0 0 {width:g} {height:g}" role="img"'
    return f'{head} aria-label="{escape(label, quote=True)}">{"".join(marks)}</svg>'


def _path(track_map: TrackMap, plot_data: TrackPlotData) -> str:
    """The true path, or without truth that of the fixes."""
    truth = plot_data.errors.truth_en_m
    kind, positions_m = ("truth", truth) if np.isfinite(truth).any() else ("path", plot_data.errors.fix_en_m)
    step_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    median_step_m = float(np.nanmedian(step_m)) if np.isfinite(step_m).any() else 0.0
    points = track_map.drawing_xy(positions_m)
    points[1:][step_m > max(_MAX_STEP_M, 5.0 * median_step_m)] = np.nan
    return line(points, "halo") + line(points, kind)


def _ellipses(track_map: TrackMap, plot_data: TrackPlotData) -> str:
    """Error ellipses of three sigmas, of evenly spaced fixes where there are many."""
    errors = plot_data.errors
    known = np.flatnonzero(np.isfinite(errors.fix_en_m[:, 0]) & np.isfinite(errors.covariance_en_m2[:, 0, 0]))
    if known.size > _MAX_ELLIPSES:
        known = known[np.round(np.linspace(0, known.size - 1, _MAX_ELLIPSES)).astype(int)]
    parts = []
    for i in known:
        x, y = track_map.drawing_xy(errors.fix_en_m[i])
        to_px = np.linalg.inv(track_map.site.enu_jacobian(track_map.site.pixel_from_enu(errors.fix_en_m[i])))
        covariance = to_px @ errors.covariance_en_m2[i] @ to_px.T / 4.0**track_map.level
        values, vectors = np.linalg.eigh(covariance)
        a, b = _SIGMAS * np.sqrt(np.maximum(values[::-1], 0.0))
        angle_deg = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        at = f"translate({x:.1f} {y:.1f}) rotate({angle_deg:.0f})"
        parts.append(f'<ellipse class="ellipse" rx="{a:.2f}" ry="{b:.2f}" transform="{at}"/>')
    return "".join(parts)


def _scale_bar(track_map: TrackMap) -> str:
    """A scale bar of a round length, about a fifth of the width."""
    _, _, width, height = track_map.box
    unit_m = track_map.site.gsd_m_per_px * 2.0**track_map.level
    length_m, text = ticks(0.0, width * unit_m, 5)[1]
    x, y, end = 0.03 * width, height - 0.03 * width, 0.03 * width + length_m / unit_m
    bar = f'd="M{x:.1f} {y:.1f}H{end:.1f}"'
    name = f'<text x="{x:.1f}" y="{y - 0.014 * width:.1f}" font-size="{0.024 * width:.1f}" '
    return (
        f'<path class="scale-under" {bar}/><path class="scale-bar" {bar}/>'
        f'{name}stroke-width="{0.006 * width:.1f}">{text} m, north up</text>'
    )
