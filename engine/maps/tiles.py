"""Square tiles of a level of the map, in which what is large is read, prepared and described."""

from __future__ import annotations

import numpy as np

from engine.values import Window

TILE_PX = 256
"""Side of the tiles of a level in which it is prepared, described and sampled, and of those of a surface."""
WHOLE_LEVEL_PX = 8 << 20
"""Levels of at most this many pixels are prepared and sampled as a whole; also the largest picture or window."""
RIM_PX = 5
"""Pixels so near to where a picture or the map shows nothing are left out: their gradients are of that edge."""
HALO_PX = 64
"""Margin around a tile that is read for description; the descriptor of nearly every keypoint ends within it."""


def tiles_under(window: Window, side_px: int, shape: tuple[int, int]) -> list[Window]:
    """The tiles of a level with this shape that a window touches, row by row.

    They begin on multiples of their side; the last ones are smaller.
    """
    rows = range(window.y0 // side_px * side_px, window.y1, side_px)
    columns = range(window.x0 // side_px * side_px, window.x1, side_px)
    return [Window(x, y, min(side_px, shape[1] - x), min(side_px, shape[0] - y)) for y in rows for x in columns]


def cells_under(window: Window, shape: tuple[int, int]) -> list[Window]:
    """The parts in which a level is prepared and sampled that a window touches: all of a small level, or tiles."""
    if shape[0] * shape[1] <= WHOLE_LEVEL_PX:
        return [Window(0, 0, shape[1], shape[0])]
    return tiles_under(window, TILE_PX, shape)


def widened(window: Window, margin_px: int, shape: tuple[int, int]) -> Window:
    """A window with a margin around it, inside a level with this shape."""
    x0, y0 = max(0, window.x0 - margin_px), max(0, window.y0 - margin_px)
    x1, y1 = min(shape[1], window.x1 + margin_px), min(shape[0], window.y1 + margin_px)
    return Window(x0, y0, x1 - x0, y1 - y0)


def within(part: Window, whole: Window) -> tuple[slice, slice]:
    """Where a window lies in arrays (H, W) of one that contains it."""
    x0, y0 = part.x0 - whole.x0, part.y0 - whole.y0
    return np.s_[y0 : y0 + part.height_px, x0 : x0 + part.width_px]
