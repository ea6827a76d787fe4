"""The surface model of a map: its heights at map pixels, and the bare ground below roofs and crowns."""

from __future__ import annotations

import math
import threading
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from engine.errors import MapError
from engine.maps.grids import Array, Grid, Warp, overlap, part_grid, square_points, warp_between
from engine.maps.rasters import COARSE_LIMIT_PX, MEMORY_LIMIT_PX, Source, map_errors
from engine.maps.tiles import TILE_PX
from engine.values import Window

Heights = NDArray[np.float32]

SURFACE_LIMIT_PX = MEMORY_LIMIT_PX // np.dtype(np.float32).itemsize
"""Surfaces of up to this many pixels are held in memory; a height takes the memory of so many grey values."""
HEIGHT_RANGE_M = (-1000.0, 20000.0)
"""Surface heights outside are nodata, whether tagged or not (-9999, -32768, 3e38)."""
GROUND_PERCENT = 20.0
"""Percentile of the surface used as the ground level."""
_POINTS = square_points(np.linspace(-1.0, 1.0, 15))
"""Sample positions of a plane fit, relative to half the side of the square."""
_ROUNDS = 8
_ON_PLANE_M = 0.3  # residual below which a height counts as on the plane


class HeightTiles:
    """Heights of a large surface model, read from the file on demand.

    Args:
        source: the model.
        part: window of it, in its pixels, whose heights these are.
        grid: of the map.
    """

    def __init__(self, source: Source, part: Window, grid: Grid) -> None:
        self._source, self._part, self._lock = source, part, threading.Lock()
        self._tile = lru_cache(COARSE_LIMIT_PX // TILE_PX**2)(self._read)
        self._shape = (part.height_px, part.width_px)
        self._from_map = warp_between(grid, part_grid(source.grid, part, self._shape))

    def sample(self, map_xy: Array) -> Array:
        """Bilinear heights.

        Args:
            map_xy: (..., 2) pixels of the map.

        Returns:
            (...,) metres, NaN outside and next to nodata.
        """
        at = self._from_map(map_xy.reshape(-1, 2))
        out, last = np.full(len(at), np.nan), np.array(self._shape[::-1]) - 1
        inside = np.flatnonzero(((at >= -0.5) & (at <= last + 0.5)).all(axis=1))
        column, row = (np.clip(at[inside], 0, last) // TILE_PX).astype(np.intp).T
        for x, y in {*zip(column.tolist(), row.tolist(), strict=True)}:
            here = inside[(column == x) & (row == y)]
            out[here] = _bilinear(self._tile(x, y), at[here] - [x * TILE_PX, y * TILE_PX])
        return out.reshape(map_xy.shape[:-1])

    def _read(self, column: int, row: int) -> Heights:
        """The heights of a tile, with the first column and row of those behind it."""
        x, y = column * TILE_PX, row * TILE_PX
        size = min(TILE_PX + 1, self._shape[0] - y), min(TILE_PX + 1, self._shape[1] - x)
        window = Window(self._part.x0 + x, self._part.y0 + y, size[1], size[0])
        with self._lock:  # a GDAL dataset serves one thread at a time
            return read_heights(self._source, window, size)


class SurfaceModel:
    """Heights on their own grid.

    Args:
        heights_m: (H, W) float32, contiguous, NaN where unknown.
        from_map: from pixels of the map to those of the heights.
        tiles: the same surface with more pixels, if it is too large to be held in memory.
    """

    def __init__(self, heights_m: Heights, from_map: Warp, tiles: HeightTiles | None = None) -> None:
        self._heights_m, self._from_map, self._tiles = heights_m, from_map, tiles

    @property
    def reads_files(self) -> bool:
        """Whether heights are read from the file whenever they are needed."""
        return self._tiles is not None

    def overview(self, map_xy: Array) -> Array:
        """Heights for samples spread over the whole map, from those in memory.

        Args:
            map_xy: (..., 2) pixels of the map.

        Returns:
            (...,) metres, as :meth:`sample`.
        """
        at = self._from_map(map_xy)
        return _bilinear(self._heights_m, at.reshape(-1, 2)).reshape(at.shape[:-1])

    def sample(self, map_xy: Array) -> Array:
        """Bilinear heights.

        Args:
            map_xy: (..., 2) pixels of the map.

        Returns:
            (...,) metres, NaN outside and next to nodata.
        """
        return self.overview(map_xy) if self._tiles is None else self._tiles.sample(map_xy)

    def ground_at(self, map_xy: Array, reach_px: float) -> float | None:
        """Level of the plane with a fifth of the surface below it in a square about one map pixel.

        Args:
            map_xy: (2,) the square's middle.
            reach_px: half its side.

        Returns:
            Metres at the middle; None if less than half of the square is known.
        """
        from engine.kernels.lower_plane import lower_plane  # numba takes a while to import

        heights_m = self.sample(map_xy + _POINTS * reach_px)
        plane, known = lower_plane(_POINTS, heights_m, GROUND_PERCENT / 100.0, _ON_PLANE_M, _ROUNDS)
        return None if 2 * known < len(_POINTS) else float(plane[0])

    @property
    def range_m(self) -> tuple[float, float]:
        """Lowest and highest known height; for a large surface those of its averages."""
        return float(np.nanmin(self._heights_m)), float(np.nanmax(self._heights_m))


def _bilinear(heights_m: Heights, at: Array) -> Array:
    """Heights (N,) at places (N, 2) in pixels of a grid, NaN outside and next to nodata."""
    from engine.kernels.map_points import bilinear_heights  # numba takes a while to import

    out = np.empty(len(at))
    bilinear_heights(heights_m, np.ascontiguousarray(at, np.float64), out)
    return out


def open_surface(source: Source, grid: Grid) -> tuple[SurfaceModel, Grid]:
    """The surface under a map and its grid: in memory, or read tile by tile if it is large.

    Args:
        source: the model.
        grid: of the map.

    Raises:
        MapError: it cannot be read, or does not overlap the map.
    """
    part = surface_part(source, grid)
    tiles = HeightTiles(source, part, grid) if part.area_px > SURFACE_LIMIT_PX else None
    heights, surface_grid = read_surface(source, grid, SURFACE_LIMIT_PX if tiles is None else COARSE_LIMIT_PX)
    return SurfaceModel(heights, warp_between(grid, surface_grid), tiles), surface_grid


def read_surface(source: Source, grid: Grid, limit_px: int = SURFACE_LIMIT_PX) -> tuple[Heights, Grid]:
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
    if np.dtype(dtypes[0]).kind not in "iuf":
        raise MapError(f"surface: expected heights as real numbers, got {dtypes[0]} in {source.path}")
    if len(dtypes) >= 3 and set(dtypes) == {"uint8"}:  # the map given twice: its red would become relief
        raise MapError(
            f"surface: expected one band of heights, got a picture of {len(dtypes)} bands, {source.path}"
        )
    part = overlap(grid, source.grid)
    if part is None:
        raise MapError(f"surface: expected one that overlaps the map, got {source.path}")
    return part


def read_heights(source: Source, part: Window, shape: tuple[int, int]) -> Heights:
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

    with map_errors("surface", source.path):
        data = source.dataset.read(
            1, window=part.slices, out_shape=shape, masked=True, resampling=Resampling.average
        )
    heights = data.astype(np.float32).filled(np.nan) * source.dataset.scales[0] + source.dataset.offsets[0]
    heights[~((heights > HEIGHT_RANGE_M[0]) & (heights < HEIGHT_RANGE_M[1]))] = np.nan
    return np.asarray(heights, np.float32)
