"""The adaptive window: the crop of the map that a frame is matched against (eq. 4, 5), and its pyramid level."""

from __future__ import annotations

import math

from engine.errors import OptionError
from engine.orthomap import OrthoMap
from engine.values import Window

MARGIN = 1.3
"""The margin of equations 4 and 5; the paper's."""
LEVEL_OCTAVES = 0.25
"""How much coarser than requested a level's pixels may be, in octaves."""
SPREAD_SIGMAS = 3.0
"""How many standard deviations of the prior a window covers to each side."""


def window_size_px(footprint_px: tuple[float, float], moved_px: tuple[float, float]) -> tuple[float, float]:
    """Width and height of the window in map pixels: W = 1.3 s T + v tau (eq. 4, 5).

    Args:
        footprint_px: s T, the frame's extent (width, height) on the map.
        moved_px: v tau, the movement (x, y) since the last frame; signs are ignored.

    Raises:
        OptionError: an extent is not positive and finite.
    """
    if not all(math.isfinite(v) and v > 0 for v in footprint_px):
        raise OptionError(f"footprint_px: expected positive finite extents, got {footprint_px}")
    width, height = (MARGIN * extent + abs(step) for extent, step in zip(footprint_px, moved_px, strict=True))
    return width, height


def place_window(
    center_px: tuple[float, float], size_px: tuple[float, float], map_size_px: tuple[int, int]
) -> Window | None:
    """The window in whole pixels about a centre, clipped to the map.

    Args:
        center_px: (x, y).
        size_px: width and height before it is clipped.
        map_size_px: width and height of the map.

    Returns:
        Window | None: None if the window is outside the map.
    """
    spans = []
    for center, size, limit in zip(center_px, size_px, map_size_px, strict=True):
        low = max(0, math.floor(center - size / 2.0 + 0.5))
        high = min(limit, math.floor(center + size / 2.0 + 0.5) + 1)
        if low >= high:
            return None
        spans.append((low, high - low))
    return Window(spans[0][0], spans[1][0], spans[0][1], spans[1][1])


def level_crop(site: OrthoMap, window: Window, level: int, *, step_px: int = 1) -> Window:
    """The part of one pyramid level that a window in map pixels covers.

    Args:
        site: the map.
        window: in full-resolution pixels, inside the map.
        level: of the pyramid.
        step_px: width and height are rounded up to a multiple of this if the level is large enough, so that a
            flight uses few different sizes and plans none in flight.
    """
    rows, columns = site.level_shape(level)
    spans = []
    for start, size, limit in ((window.x0, window.width_px, columns), (window.y0, window.height_px, rows)):
        low, high = start >> level, min(limit, max((start + size) >> level, (start >> level) + 1))
        length = min(limit, -(-(high - low) // step_px) * step_px)
        spans.append((min(low, limit - length), length))
    return Window(spans[0][0], spans[1][0], spans[0][1], spans[1][1])


def level_for(gsd_m_per_px: float, wanted_m_per_px: float, levels: int, coarser: float = LEVEL_OCTAVES) -> int:
    """The coarsest pyramid level whose pixels are coarser than requested by at most this many octaves."""
    return min(max(math.floor(math.log2(wanted_m_per_px / gsd_m_per_px) + coarser), 0), levels - 1)
