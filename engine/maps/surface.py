"""The surface model of a map: its heights at map pixels, and the bare ground below roofs and crowns."""

from __future__ import annotations

import threading
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from engine.maps.grids import Array, Grid, Warp, square_lattice, warp_between
from engine.maps.heights import SURFACE_LIMIT_PX, part_grid, read_heights, read_surface, surface_part
from engine.maps.rasters import COARSE_LIMIT_PX, Source
from engine.maps.tiles import TILE_PX
from engine.values import Window

Heights = NDArray[np.float32]

GROUND_PERCENT = 20.0
"""Percentile of the surface used as the ground level."""
MAX_SPAN = 6
"""Lookups that span fewer tiles than this per side are read as one patch."""
MAX_PATCHES = 16
"""Number of patches that are cached, of at most 9 MiB each."""
_LATTICE = square_lattice(np.linspace(-1.0, 1.0, 15))
"""Sample positions of a plane fit, relative to half the side of the square."""
_ROUNDS = 8
_ON_PLANE_M = 0.3  # residual below which a height counts as on the plane


class HeightTiles:
    """Heights of a large surface model, indexed like an array (H, W) and read from the file on demand.

    Args:
        source: the model.
        part: window of it, in its pixels, that is indexed.
    """

    def __init__(self, source: Source, part: Window) -> None:
        self._source, self._part, self._lock = source, part, threading.Lock()
        self._patch = lru_cache(MAX_PATCHES)(self._read)
        self.shape = (part.height_px, part.width_px)

    def __getitem__(self, index: tuple[NDArray[np.intp], NDArray[np.intp]]) -> Heights:
        rows, columns = index
        if rows.size == 0:
            return np.empty(rows.shape, np.float32)
        y0, x0, y1, x1 = (int(v) // TILE_PX for v in (rows.min(), columns.min(), rows.max(), columns.max()))
        if max(y1 - y0, x1 - x0) < MAX_SPAN:
            return self._patch(y0, x0, y1, x1)[rows - y0 * TILE_PX, columns - x0 * TILE_PX]
        out = np.empty(rows.shape, np.float32)
        tiles = (rows // TILE_PX << 32) + columns // TILE_PX
        for y, x in (divmod(int(tile), 1 << 32) for tile in np.unique(tiles)):
            here = tiles == (y << 32) + x
            out[here] = self._patch(y, x, y, x)[rows[here] - y * TILE_PX, columns[here] - x * TILE_PX]
        return out

    def _read(self, top: int, left: int, bottom: int, right: int) -> Heights:
        """The heights from one row and column of tiles to another."""
        y, x = top * TILE_PX, left * TILE_PX
        size = min((bottom + 1) * TILE_PX, self.shape[0]) - y, min((right + 1) * TILE_PX, self.shape[1]) - x
        window = Window(self._part.x0 + x, self._part.y0 + y, size[1], size[0])
        with self._lock:  # a GDAL dataset serves one thread at a time
            return read_heights(self._source, window, size)


class SurfaceModel:
    """Heights on their own grid.

    Args:
        heights_m: (H, W), NaN where unknown.
        from_map: from pixels of the map to those of the heights.
        decimated: the same surface with fewer pixels, if it is too large to be sampled as a whole.
    """

    def __init__(
        self, heights_m: Heights | HeightTiles, from_map: Warp, decimated: SurfaceModel | None = None
    ) -> None:
        if isinstance(heights_m, np.ndarray):  # the loops are compiled for one type
            heights_m = np.ascontiguousarray(heights_m, np.float32)
        self._heights_m, self._from_map, self._decimated = heights_m, from_map, decimated

    @property
    def reads_files(self) -> bool:
        """Whether heights are read from the file whenever they are needed."""
        return isinstance(self._heights_m, HeightTiles)

    def overview(self, map_xy: Array) -> Array:
        """Heights for samples spread over the whole map, from the decimated surface if there is one.

        Args:
            map_xy: (..., 2) pixels of the map.

        Returns:
            (...,) metres, as :meth:`sample`.
        """
        return (self._decimated or self).sample(map_xy)

    def sample(self, map_xy: Array) -> Array:
        """Bilinear heights.

        Args:
            map_xy: (..., 2) pixels of the map.

        Returns:
            (...,) metres, NaN outside and next to nodata.
        """
        at = self._from_map(map_xy)
        if isinstance(self._heights_m, np.ndarray):
            from engine.kernels.map_points import bilinear_heights  # numba takes a while to import

            out = np.empty(at.shape[:-1])
            bilinear_heights(self._heights_m, np.ascontiguousarray(at, np.float64).reshape(-1, 2), out.reshape(-1))
            return out
        height, width = self._heights_m.shape
        x0, x1, u, in_x = _neighbours(at[..., 0], width)
        y0, y1, v, in_y = _neighbours(at[..., 1], height)
        grid = self._heights_m
        top = grid[y0, x0] * (1.0 - u) + grid[y0, x1] * u
        bottom = grid[y1, x0] * (1.0 - u) + grid[y1, x1] * u
        return np.where(in_x & in_y, top * (1.0 - v) + bottom * v, np.nan)

    def ground_plane(self, map_xy: Array, reach_px: float) -> tuple[float, Array] | None:
        """The plane with a fifth of the surface below it in a square about one map pixel (2,).

        Args:
            map_xy: (2,) the square's middle.
            reach_px: half its side.

        Returns:
            The plane's level at the middle and its slope (2,) in metres up per map pixel x and y; None if less
            than half of the square is known.
        """
        from engine.kernels.lower_plane import lower_plane  # numba takes a while to import

        heights_m = self.sample(map_xy + _LATTICE * reach_px)
        plane, known = lower_plane(_LATTICE, heights_m, GROUND_PERCENT / 100.0, _ON_PLANE_M, _ROUNDS)
        if 2 * known < len(_LATTICE):
            return None
        return float(plane[0]), plane[1:] / reach_px

    @property
    def range_m(self) -> tuple[float, float]:
        """Lowest and highest known height; for a large surface those of its averages."""
        if not isinstance(self._heights_m, np.ndarray):
            assert self._decimated is not None  # a surface read in tiles has one
            return self._decimated.range_m
        return float(np.nanmin(self._heights_m)), float(np.nanmax(self._heights_m))


def _neighbours(at: Array, size: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, NDArray[np.bool_]]:
    """Indices before and after places along one axis, the share of the latter, and which places are inside."""
    inside = (at >= -0.5) & (at <= size - 0.5)
    at = np.clip(np.where(inside, at, 0.0), 0.0, size - 1.0)
    low = at.astype(np.intp)
    return low, np.minimum(low + 1, size - 1), at - low, inside


def open_surface(source: Source, grid: Grid) -> tuple[SurfaceModel, Grid]:
    """The surface under a map and its grid: in memory, or read tile by tile if it is large.

    Args:
        source: the model.
        grid: of the map.

    Raises:
        MapError: it cannot be read, or does not overlap the map.
    """
    part = surface_part(source, grid)
    large = part.area_px > SURFACE_LIMIT_PX
    heights, surface_grid = read_surface(source, grid, COARSE_LIMIT_PX if large else SURFACE_LIMIT_PX)
    surface = SurfaceModel(heights, warp_between(grid, surface_grid))
    if large:
        tiles = HeightTiles(source, part)
        surface = SurfaceModel(tiles, warp_between(grid, part_grid(source.grid, part, tiles.shape)), surface)
    return surface, surface_grid
