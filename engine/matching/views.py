"""Where to search for features: the adaptive window on each pyramid level that the height allows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.maps.landmarks import PREPARED_PX
from engine.matching import refusals
from engine.matching.align import MIN_DOWN, ground_bounds_px
from engine.matching.query import Query
from engine.values import Attitude, NoFix, Window
from engine.window import LEVEL_OCTAVES, level_crop, level_for

_CROP_STEP_PX = 32


@dataclass(frozen=True, slots=True)
class TelemetryHypothesis:
    """What one attempt at a frame assumes about the telemetry.

    Attributes:
        heights_m: the lowest and the highest to search; equal if the height is known.
        x_axis_deg: direction of the map's x axis in the frame, from +x towards +y; None if unknown.
    """

    heights_m: tuple[float, float]
    x_axis_deg: float | None

    @property
    def height_m(self) -> float | None:
        """The height if it is known."""
        return self.heights_m[0] if self.heights_m[0] == self.heights_m[1] else None


@dataclass(frozen=True, slots=True)
class MapView:
    """A part of one level of the map that the frame may show.

    Attributes:
        window: in pixels of the full map.
        level: of the pyramid.
        crop: the window in pixels of the level.
        pixel_ratio: pixel of the level over pixel of the reduced frame, on the ground; at the lowest height.
    """

    window: Window
    level: int
    crop: Window
    pixel_ratio: float

    @property
    def corner_px(self) -> NDArray[np.float64]:
        """(2,) the crop's top-left pixel."""
        return np.array([self.crop.x0, self.crop.y0], np.float64)


def x_axis_deg(query: Query) -> float | None:
    """Direction of the map's x axis in the middle of the frame, by the telemetry; None without a heading."""
    attitude = query.telemetry.grid_attitude
    if attitude is None:
        return None
    x, y, _ = query.camera.enu_from_camera(attitude).T @ np.array([*query.jacobian[:, 0], 0.0])
    return math.degrees(math.atan2(y, x))


def views_of(query: Query, hypothesis: TelemetryHypothesis, method: str, scale: float) -> list[MapView] | NoFix:
    """The windows to search, one per level; a coarser level replaces one that is too large to search.

    Args:
        query: the frame and its prior; without a prior every window is the whole map.
        hypothesis: its heights determine the levels; the greatest height of a level determines its window.
        method: named in a refusal.
        scale: of the reduced frame.
    """
    site, heights_m = query.site, hypothesis.heights_m
    per_height = map_px_per_pixel(query, 1.0, scale)
    if hypothesis.height_m is not None:
        first = last = level_at(query, hypothesis.height_m, scale)
    else:
        first, last = (level_for(1.0, height * per_height, site.levels) for height in heights_m)
    views: dict[int, MapView] = {}
    for level in range(first, last + 1):
        served_m = heights_m[1] if level == last else 2 ** (level + 1.0 - LEVEL_OCTAVES) / per_height
        window = _window(query, served_m, hypothesis.x_axis_deg is not None, method)
        if isinstance(window, NoFix):
            return window
        view = _view(query, window, level, heights_m[0] * per_height)
        views[view.level] = view
    return list(views.values())


def view_in(query: Query, window: Window, height_m: float, scale: float) -> MapView:
    """The view of a given window at one height; see :func:`views_of`."""
    return _view(query, window, level_at(query, height_m, scale), map_px_per_pixel(query, height_m, scale))


def level_at(query: Query, height_m: float, scale: float) -> int:
    """The level whose pixels are like those of a frame reduced to a scale, and no larger."""
    return level_for(1.0, map_px_per_pixel(query, height_m, scale), query.site.levels, coarser=0.0)


def drawn_px(query: Query, height_m: float, scale: float) -> float:
    """Number of pixels of a frame drawn on the level of a scale; :func:`_view` may draw it coarser."""
    return query.gray.size * (map_px_per_pixel(query, height_m) / 2.0 ** level_at(query, height_m, scale)) ** 2


def coarser_scale(query: Query, height_m: float, scale: float) -> float | None:
    """The scale whose level is one above another scale's; None if the map has no such level."""
    level = level_at(query, height_m, scale) + 1
    if level >= query.site.levels:
        return None
    return map_px_per_pixel(query, height_m) / 2.0**level * (1.0 - 1e-9)  # not below the level by rounding


def _view(query: Query, window: Window, level: int, per_px: float) -> MapView:
    """A window on a level, or on a coarser one if too large; ``per_px`` is map pixels per frame pixel."""
    site = query.site
    while window.area_px >> 2 * level > PREPARED_PX and level < site.levels - 1:
        level += 1
    return MapView(window, level, level_crop(site, window, level, step_px=_CROP_STEP_PX), 2**level / per_px)


def _window(query: Query, height_m: float, has_heading: bool, method: str) -> Window | NoFix:
    """The adaptive window (eq. 4, 5) at a height; the whole map if the position is unknown."""
    nadir = query.prior_px
    if nadir is None:
        return Window(0, 0, query.site.width_px, query.site.height_px)
    attitude = query.telemetry.grid_attitude or Attitude(0.0, 0.0, 0.0)
    bounds = ground_bounds_px(query.camera, attitude, height_m, query.jacobian)
    if bounds is None:
        return refusals.tilted(query, attitude, method)
    width, height = (float(n) for n in bounds[1] - bounds[0])
    if not has_heading:  # at any heading the footprint fits the square of its diagonal
        width = height = math.hypot(width, height)
    window = query.window(nadir + bounds.mean(axis=0), (width, height), (width, height))
    return window or refusals.outside(query, method)


def slant_m(query: Query, height_m: float) -> float:
    """Distance to the ground along the optical axis at a height; bounded near the horizon."""
    attitude = query.telemetry.grid_attitude or Attitude(0.0, 0.0, 0.0)
    return height_m / max(-float(query.camera.enu_from_camera(attitude)[2, 2]), MIN_DOWN)


def map_px_per_pixel(query: Query, height_m: float, scale: float = 1.0) -> float:
    """Full-resolution map pixels that one pixel in the middle of the frame covers, reduced to a scale."""
    return slant_m(query, height_m) / (query.camera.focal_px * scale * query.site.gsd_m_per_px)
