"""Colours of a map window for display, read from the file in any grid."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from engine.maps.grids import Array, Grid, warp_between
from engine.maps.rasters import STRETCH_PERCENT, Source, map_errors, palette_of
from engine.values import Window

Rgb = NDArray[np.uint8]


def read_colour(source: Source, grid: Grid, window: Window, shape: tuple[int, int]) -> Rgb | None:
    """Colours of a window; None if the file has fewer than three bands and no colour table.

    Args:
        source: the map's file.
        grid: of the map in use; the window is in its pixels.
        window: in full-resolution pixels of ``grid``.
        shape: rows and columns of the result.

    Returns:
        (h, w, 3) RGB; undefined on nodata. Bands other than uint8 are stretched between two percentiles.

    Raises:
        MapError: the file cannot be read.
    """
    import cv2

    palette = palette_of(source.dataset)
    if source.dataset.count < 3 and palette is None:
        return None
    xy = _file_pixels(source.grid, grid, window, shape)
    limit = np.array([source.grid.width_px, source.grid.height_px])
    low = np.clip(np.floor(xy.min(axis=(0, 1))) - 2, 0, limit - 1).astype(int)
    high = np.clip(np.ceil(xy.max(axis=(0, 1))) + 3, low + 1, limit).astype(int)
    # Read at about the resolution of the result, from an overview if the file has one.
    shrink = max(1.0, float(np.sqrt(np.prod(high - low) / math.prod(shape))))
    size = np.maximum(1, np.round((high - low) / shrink)).astype(int)
    bands = _read(source, low, high - low, size, palette)
    at = (xy - low + 0.5) * (size / (high - low)) - 0.5
    colour = _stretched(np.ascontiguousarray(np.moveaxis(bands, 0, -1)))
    return np.asarray(cv2.remap(colour, at.astype(np.float32), None, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE))


def _file_pixels(of_file: Grid, grid: Grid, window: Window, shape: tuple[int, int]) -> Array:
    """(h, w, 2) pixels of the file at the centres of the result's pixels."""
    y, x = (
        first + (np.arange(count) + 0.5) * length / count - 0.5
        for first, length, count in zip(
            (window.y0, window.x0), (window.height_px, window.width_px), shape, strict=True
        )
    )
    return warp_between(grid, of_file)(np.stack(np.meshgrid(x, y), axis=-1))


def _read(
    source: Source, low: NDArray[np.intp], extent: NDArray[np.intp], size: NDArray[np.intp], palette: Rgb | None
) -> NDArray[np.generic]:
    """(3, h, w) bands of a part of the file, from (x, y) ``low``, resampled to ``size`` (x, y)."""
    from rasterio.enums import Resampling
    from rasterio.windows import Window as RasterWindow

    part = RasterWindow(*(int(v) for v in (*low, *extent)))
    how = Resampling.average if palette is None else Resampling.nearest
    bands = [1] if palette is not None else [1, 2, 3]
    with map_errors("map", source.path):
        data = source.dataset.read(
            bands, window=part, out_shape=(len(bands), int(size[1]), int(size[0])), resampling=how
        )
    return np.asarray(data if palette is None else palette[:, data[0]])


def _stretched(colour: NDArray[np.generic]) -> Rgb:
    """Bands (h, w, 3) as uint8, all stretched alike."""
    if colour.dtype == np.uint8:
        return np.asarray(colour, np.uint8)
    values = np.asarray(colour, np.float64)
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, STRETCH_PERCENT) if known.size else (0.0, 1.0)
    scaled = (np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) * (255.0 / max(high - low, 1e-30))
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
