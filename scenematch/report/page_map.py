"""The map of a report: draw the part flown over, in colour, with tracks, truth and error ellipses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.geo import Array
from engine.maps.grids import by_corner, part_grid
from engine.maps.rasters import STRETCH_PERCENT, map_errors, palette_of, stretched
from engine.orthomap import OrthoMap
from engine.values import Window
from engine.window import level_crop
from scenematch.report.charts import crosses, dots, line, ticks
from scenematch.report.explain import Image, evenly_spaced, jpeg_data_uri, level_within
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.loop_record import LoopRecord
from scenematch.report.metrics import TrackErrors
from scenematch.report.page_parts import filled

_MAX_MAP_PX = 1500  # longer side as drawn
_MAP_BYTES = 900_000
_MARGIN_SHARE, _MARGIN_PX = 0.12, 40.0
_ASPECTS = (0.62, 0.95)  # range of height over width, as far as the map allows
_MAX_ELLIPSES = 40
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

    @property
    def extent_m(self) -> tuple[float, float]:
        """Width and height on the ground in metres."""
        return (self.window.width_px * self.site.gsd_m_per_px, self.window.height_px * self.site.gsd_m_per_px)

    def drawing_xy(self, en_m: Array) -> Array:
        """East and north (..., 2) in metres as x and y (..., 2) of the drawing."""
        corner = np.array([self.window.x0, self.window.y0]) - 0.5
        return np.asarray((self.site.pixel_from_enu(en_m) - corner) / 2.0**self.level, np.float64)

    def rectangle(self, window: Window) -> tuple[float, float, float, float]:
        """A window of the map in units of the drawing: x, y, width and height."""
        x, y = ((a - b) / 2.0**self.level for a, b in ((window.x0, self.window.x0), (window.y0, self.window.y0)))
        return (round(x, 1), round(y, 1), window.width_px / 2.0**self.level, window.height_px / 2.0**self.level)


def map_of_tracks(tracks: Sequence[FinishedTrack], view_px: float = 0.0) -> TrackMap:
    """The part of the map with fixes, refusals and truth, plus a margin; the whole map if there are none.

    Args:
        tracks: one, or several to draw together on the first one's map.
        view_px: side of the window of one frame, the smallest size of the part.
    """
    site = tracks[0].site
    positions_m = np.concatenate(
        [en_m for t in tracks for en_m in (t.errors.fix_en_m, t.errors.truth_en_m, t.refused_en_m)]
    )
    pixels = site.pixel_from_enu(positions_m[np.isfinite(positions_m).all(axis=1)])
    size = np.array([site.width_px, site.height_px], np.float64)
    low, high = np.zeros(2), size
    if len(pixels):
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        middle, span = (low + high) / 2.0, (high - low) * (1.0 + 2.0 * _MARGIN_SHARE) + 2.0 * _MARGIN_PX
        span = np.maximum(span, view_px)
        span = np.maximum(span, [span[1] / _ASPECTS[1], span[0] * _ASPECTS[0]])
        span = np.minimum(span, size)
        low = np.clip(middle - span / 2.0, 0.0, size - span)
        high = low + span
    x0, y0 = (int(v) for v in low)
    width, height = (int(v) for v in np.ceil(high) - [x0, y0])
    level = level_within(site, max(width, height), _MAX_MAP_PX)
    return TrackMap(site, Window(x0, y0, width, height), level)


def draw_map(track_map: TrackMap, label: str, marks: Sequence[str]) -> str:
    """The map as SVG, with marks on it, from bottom to top, and a scale bar.

    Args:
        track_map: the part that is drawn.
        label: alternative text.
        marks: SVG elements in units of the drawing.
    """
    unit_m = track_map.site.gsd_m_per_px * 2.0**track_map.level
    length_m, text = ticks(0.0, track_map.box[2] * unit_m, 5)[1]  # about a fifth of the width
    ground = jpeg_data_uri(_ground(track_map), _MAP_BYTES)
    return filled(
        "map.svg", size=track_map.box[2:], label=label, ground=ground, marks=marks, bar=length_m / unit_m,
        length=text,
    )  # fmt: skip


def track_marks(track_map: TrackMap, track: FinishedTrack) -> list[str]:
    """The marks of one track: path, ellipses, fixes, refusals, fixes beyond three sigmas, the selected frame."""
    errors = track.errors
    fixes, beyond = track_map.drawing_xy(errors.fix_en_m), errors.beyond
    refused = track_map.drawing_xy(track.refused_en_m)
    _, _, width, height = track_map.box
    arm = max(width, height) / 170.0
    path = connected(track_map, errors.truth_en_m if errors.has_truth else errors.fix_en_m)
    return [
        line(path, "halo"),
        _ellipses(track_map, errors),
        dots(fixes, "under"),
        dots(fixes[~beyond], "fix"),
        line(path, "truth" if errors.has_truth else "path"),
        crosses(refused, "refused", arm),
        crosses(fixes[beyond], "beyond", arm),
        '<rect class="now-window" id="now-window" width="0" height="0"/><path class="dots now" id="now" d=""/>',
    ]


def loop_marks(track_map: TrackMap, loop: LoopRecord) -> list[str]:
    """Plan and estimate as lines on the map."""
    plan, estimate = (connected(track_map, places[:, :2]) for places in (loop.plan_m, loop.estimate_m))
    return [line(estimate, "estimate"), line(plan, "plan")]


def _ground(track_map: TrackMap) -> Image:
    """The picture of the map, (h, w, 3) in colour if the map has colours, else (h, w) in grey."""
    crop = level_crop(track_map.site, track_map.window, track_map.level)
    valid = track_map.site.valid(crop, track_map.level)
    _, _, width, height = track_map.box
    shape = max(1, round(height)), max(1, round(width))
    colour = map_colours(track_map.site, track_map.window, shape)
    picture = track_map.site.gray(crop, track_map.level) if colour is None else colour
    if valid.shape != picture.shape[:2]:
        valid = cv2.resize(valid.astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    picture[~valid] = 238
    return picture


def connected(track_map: TrackMap, positions_m: Array) -> Array:
    """Positions (N, 2) in units of the drawing; NaN after a step that no line should cross."""
    step_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    median_step_m = float(np.nanmedian(step_m)) if np.isfinite(step_m).any() else 0.0
    points = track_map.drawing_xy(positions_m)
    points[1:][step_m > max(_MAX_STEP_M, 5.0 * median_step_m)] = np.nan
    return points


def _ellipses(track_map: TrackMap, errors: TrackErrors) -> str:
    """Outlines of three sigmas around some fixes, spaced to be readable."""
    known = np.flatnonzero(np.isfinite(errors.fix_en_m[:, 0]) & np.isfinite(errors.covariance_en_m2[:, 0, 0]))
    parts: list[str] = []
    drawn: list[tuple[float, float, float]] = []  # x, y and the longer half axis
    scale = 2.0**track_map.level
    apart = max(track_map.box[2:]) / _MAX_ELLIPSES
    for i, (x, y) in zip(known, track_map.drawing_xy(errors.fix_en_m[known]).tolist(), strict=True):
        if any(np.hypot(x - u, y - v) < max(apart, c) for u, v, c in drawn):
            continue
        to_px = np.linalg.inv(track_map.site.enu_jacobian(track_map.site.pixel_from_enu(errors.fix_en_m[i])))
        values, vectors = np.linalg.eigh(to_px @ errors.covariance_en_m2[i] @ to_px.T / scale**2)
        a, b = _SIGMAS * np.sqrt(np.maximum(values[::-1], 0.0))
        if any(np.hypot(x - u, y - v) < a + c for u, v, c in drawn):
            continue
        drawn.append((x, y, float(a)))
        angle_deg = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        at = f"translate({x:.1f} {y:.1f}) rotate({angle_deg:.0f})"
        shape = f'rx="{a:.2f}" ry="{b:.2f}" transform="{at}"/>'
        parts.append(f'<ellipse class="rim" {shape}<ellipse class="ellipse" {shape}')
    return "".join(parts[i] for i in evenly_spaced(np.arange(len(parts)), _MAX_ELLIPSES))


def map_colours(site: OrthoMap, window: Window, shape: tuple[int, int]) -> Image | None:
    """Colours of a window; None if the map has no file, or that no three bands and no colour table.

    Args:
        site: the map.
        window: in full-resolution pixels, inside the map.
        shape: rows and columns of the result.

    Returns:
        (h, w, 3) RGB; undefined on nodata. Bands other than uint8 are stretched between two percentiles.

    Raises:
        MapError: the file cannot be read.
    """
    from rasterio import Affine
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    if site.open_file is None:
        return None
    source = site.open_file()
    palette = palette_of(source.dataset)
    if source.dataset.count < 3 and palette is None:
        return None
    given, wanted = source.grid, part_grid(site.grid, window, shape)
    view = {
        "src_crs": given.crs.to_wkt(), "src_transform": Affine(*by_corner(given)),
        "crs": wanted.crs.to_wkt(), "transform": Affine(*by_corner(wanted)),
        "height": shape[0], "width": shape[1],
        "resampling": Resampling.bilinear if palette is None else Resampling.nearest,
    }  # fmt: skip
    with map_errors("map", source.path), WarpedVRT(source.dataset, **view) as warped:
        bands = warped.read([1, 2, 3] if palette is None else [1])
    return _stretched(np.moveaxis(bands if palette is None else palette[:, bands[0]], 0, -1))


def _stretched(colour: NDArray[np.generic]) -> Image:
    """Bands (h, w, 3) as uint8, all stretched alike."""
    if colour.dtype == np.uint8:
        return np.ascontiguousarray(colour, np.uint8)
    values = np.asarray(colour, np.float64)
    known = values[np.isfinite(values)]
    return stretched(values, np.percentile(known, STRETCH_PERCENT) if known.size else np.array([0.0, 1.0]))
