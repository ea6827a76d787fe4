"""Heights of a surface model under a map: the overlapping part, its pixels and its grid."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from engine.errors import MapError
from engine.maps.grids import Grid, apply_affine, overlap
from engine.maps.rasters import MEMORY_LIMIT_PX, Source, map_errors
from engine.values import Window

SURFACE_LIMIT_PX = MEMORY_LIMIT_PX // 4
"""Surfaces of up to this many pixels are held in memory; heights take four times the memory of grey values."""
HEIGHT_RANGE_M = (-1000.0, 20000.0)
"""Surface heights outside are nodata, whether tagged or not (-9999, -32768, 3e38)."""


def read_surface(source: Source, grid: Grid, limit_px: int = SURFACE_LIMIT_PX) -> tuple[NDArray[np.float32], Grid]:
    """The part of a surface model under a map, averaged down if it exceeds a limit.

    Args:
        source: the model.
        grid: of the map.
        limit_px: largest number of pixels of the result.

    Returns:
        (H, W) float32 heights in metres, NaN where unknown, and their grid.

    Raises:
        MapError: it cannot be read, or does not overlap the map.
    """
    part = surface_part(source, grid)
    factor = max(1.0, math.sqrt(float(part.area_px) / limit_px))
    shape = (math.ceil(part.height_px / factor), math.ceil(part.width_px / factor))
    return read_heights(source, part, shape), part_grid(source.grid, part, shape)


def surface_part(source: Source, grid: Grid) -> Window:
    """The part of a surface model under a map, in the model's pixels.

    Raises:
        MapError: it has no heights (a picture, complex numbers), or does not overlap the map.
    """
    dtypes = source.dataset.dtypes
    dtype = dtypes[0]
    if np.dtype(dtype).kind not in "iuf":
        raise MapError(f"surface: expected heights as real numbers, got {dtype} in {source.path}")
    if len(dtypes) >= 3 and set(dtypes) == {"uint8"}:  # the map given twice: its red would become relief
        raise MapError(
            f"surface: expected one band of heights, got a picture of {len(dtypes)} bands, {source.path}"
        )
    part = overlap(grid, source.grid)
    if part is None:
        raise MapError(f"surface: expected one that overlaps the map, got {source.path}")
    return part


def read_heights(source: Source, part: Window, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Heights of a window of a surface model, averaged if the result is coarser.

    Args:
        source: the model.
        part: window in its pixels.
        shape: rows and columns of the result.

    Returns:
        ``shape`` float32 heights in metres, NaN where unknown.

    Raises:
        MapError: it cannot be read.
    """
    from rasterio.enums import Resampling

    whole = shape == (part.height_px, part.width_px)
    with map_errors("surface", source.path):
        data = source.dataset.read(
            1,
            window=part.slices,
            out_shape=shape,
            masked=True,
            resampling=Resampling.nearest if whole else Resampling.average,
        )
    heights = data.astype(np.float32).filled(np.nan) * source.dataset.scales[0] + source.dataset.offsets[0]
    heights[~((heights > HEIGHT_RANGE_M[0]) & (heights < HEIGHT_RANGE_M[1]))] = np.nan
    return np.asarray(heights, np.float32)


def part_grid(own: Grid, part: Window, shape: tuple[int, int]) -> Grid:
    """The grid of a window of another grid, decimated to ``shape`` (rows, columns)."""
    low, size = np.array([part.x0, part.y0]), np.array([part.width_px, part.height_px])
    scale = size / np.array(shape[::-1])
    # Pixel x of the decimated copy covers the file's pixels around low + (x + 0.5) * scale - 0.5.
    crop_to_file = np.column_stack([np.diag(scale), low + 0.5 * scale - 0.5])
    linear = own.pixel_to_crs[:, :2] @ crop_to_file[:, :2]
    origin = apply_affine(own.pixel_to_crs, crop_to_file[:, 2])
    return Grid(shape[1], shape[0], np.column_stack([linear, origin]), own.crs)
