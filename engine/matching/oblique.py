"""The part of a frame over relief to correlate: an upright rectangle without the far field."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from engine.matching.align import MIN_SIDE_PX, Patch, orthorectify
from engine.matching.query import Query
from engine.matching.relief import ground_relief
from engine.orthomap import OrthoMap
from engine.values import Attitude, Window

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OBLIQUE_DEG = 25.0
"""Angle of the optical axis off the vertical beyond which the ground no longer looks like a plane."""
FIELD_DEG = 60.0
"""Ground farther off the vertical is left out: walls hide it, and an error of height or tilt moves it most."""
_CELLS = 96  # of the grid that finds the rectangle, along the longer side


def is_oblique(query: Query, attitude: Attitude) -> bool:
    """Whether a frame looks far from the vertical."""
    return -float(query.camera.enu_from_camera(attitude)[2, 2]) < math.cos(math.radians(OBLIQUE_DEG))


def relief_patch(
    query: Query,
    attitude: Attitude,
    height_m: float,
    level: int,
    nadir_px: Array | None,
    most_px: tuple[int, int] | None = None,
) -> Patch | None:
    """The largest upright part of a frame over the relief that shows ground of the map, in pixels of a level.

    Args:
        query: the frame.
        attitude: about grid north.
        height_m: above the ground below the camera.
        level: of the pyramid.
        nadir_px: (2,) full-resolution pixel about which the ground is looked up, and from which the part must show
            ground of the map; None takes the ground for level and all of it for the map.
        most_px: rows and columns of its middle that are kept; None keeps all.

    Returns:
        Patch | None: None if no 8 x 8 pixels are seen.
    """
    site, jacobian = query.site, query.jacobian * 2.0**level
    relief = ground_relief(site, nadir_px, level)
    photo = orthorectify(query.gray, query.camera, attitude, height_m, jacobian, relief)
    if photo is None:
        return None
    valid = photo.valid & _near(photo.valid.shape, photo.offset_px, jacobian, height_m)
    if nadir_px is not None:
        valid &= _on_map(site, valid.shape, photo.offset_px + site.level_from_full(nadir_px, level), level)
    box = largest_rectangle(valid)
    if most_px is not None:
        height, width = min(most_px[0], box.height_px), min(most_px[1], box.width_px)
        box = Window(box.x0 + (box.width_px - width) // 2, box.y0 + (box.height_px - height) // 2, width, height)
    if min(box.width_px, box.height_px) < MIN_SIDE_PX:
        return None
    part = photo.gray[box.y0 : box.y0 + box.height_px, box.x0 : box.x0 + box.width_px]
    return Patch(np.ascontiguousarray(part), photo.offset_px + np.array([box.x0, box.y0]))


def _near(shape: tuple[int, ...], offset_px: Array, jacobian: Array, height_m: float) -> Mask:
    """(H, W) where the ground is no farther off the vertical than :data:`FIELD_DEG`."""
    x, y = np.arange(shape[1]) + offset_px[0], (np.arange(shape[0]) + offset_px[1])[:, None]
    east, north = (row[0] * x + row[1] * y for row in jacobian)
    return np.asarray(east**2 + north**2 <= (height_m * math.tan(math.radians(FIELD_DEG))) ** 2)


def _on_map(site: OrthoMap, shape: tuple[int, ...], corner_px: Array, level: int) -> Mask:
    """(H, W) which pixels of an orthophoto lie on valid map, given its corner's pixel on the level."""
    valid, corner = np.zeros(shape, np.bool_), np.rint(corner_px).astype(int)
    rows, columns = site.level_shape(level)
    low = np.maximum(corner, 0)
    size = np.minimum(corner + np.array(shape[::-1]), [columns, rows]) - low
    if (size > 0).all():
        (x, y), (width, height) = low - corner, size
        crop = Window(int(low[0]), int(low[1]), int(width), int(height))
        valid[y : y + height, x : x + width] = site.valid(crop, level)
    return valid


def largest_rectangle(valid: Mask) -> Window:
    """The largest upright rectangle of valid pixels, found on a grid of cells.

    Args:
        valid: (H, W).

    Returns:
        Window: empty if there is none.
    """
    step = max(1, max(valid.shape) // _CELLS)
    rows, columns = (n // step for n in valid.shape)
    blocks = valid[: rows * step, : columns * step].reshape(rows, step, columns, step)
    cells: Mask = np.asarray(blocks.all(axis=(1, 3)))
    runs = np.zeros((rows, columns), np.int32)  # valid cells in a row that end in each, upwards
    for row in range(rows):
        runs[row] = np.where(cells[row], (runs[row - 1] if row else 0) + 1, 0)
    best, best_area, lowest = Window(0, 0, 0, 0), 0, runs
    for width in range(1, columns + 1 if rows else 1):  # lowest run of this many columns from each on
        if width > 1:
            lowest = np.minimum(lowest[:, :-1], runs[:, width - 1 :])
        row, column = divmod(int(lowest.argmax()), lowest.shape[1])
        high = int(lowest[row, column])
        if high * width > best_area:
            best_area = high * width
            best = Window(*(n * step for n in (column, row - high + 1, width, high)))
    return best
