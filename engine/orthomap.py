"""The map: a georeferenced picture in grey with its pyramid, optionally with a surface model.

Convention:
    Pixels (x, y) have their centres at integers, the origin at the centre of the top-left pixel. East and north
    are metres in the plane tangent to WGS84 at the centre of the map, ``OrthoMap.frame``. Pixel x_L of pyramid
    level L covers the full-resolution pixels around x_0 = (x_L + 0.5) 2^L - 0.5.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from engine.errors import MapError
from engine.maps.accuracy import GEOREFERENCE_TAG, SLOPE_TAG, stated_sigma
from engine.maps.georeference import Georeference
from engine.maps.grids import Array, Grid, metric_grid, warp_between
from engine.maps.metric_copy import ProgressCallback, open_readable
from engine.maps.pyramid import Pyramid, check_arrays
from engine.maps.rasters import Bounds, Gray, GrayReader, Mask, Source, open_source, vertical_datum
from engine.maps.surface import GROUND_PERCENT, SurfaceModel, open_surface
from engine.values import Window

if TYPE_CHECKING:
    from pyproj import CRS

GROUND_REACH_M = 30.0
"""Half the side of the square to which the ground is fitted: wider than a house, narrower than a hill."""
SEARCH_LIMIT_PX = 1 << 29
"""Largest map, in pixels, that is searched as a whole if the position is unknown."""
_MIN_KNOWN = 100  # known heights needed to determine the ground level


class OrthoMap(Georeference):
    """A map that frames are matched against, created by :meth:`open` or :meth:`from_arrays`.

    Attributes:
        name: name of the file.
        width_px, height_px: columns and rows.
        crs, source_crs: of the metric grid in use, and of the file.
        frame: local east-north-up; its origin is the centre of the map.
        gsd_m_per_px: true metres on the ground per pixel at the centre: the square root of a pixel's area.
        bounds_deg: west, south, east, north of the outer edges.
        has_surface: whether it has a surface model.
        ground_m: ground level in the surface's datum: the 20th percentile of the surface over the valid map, below
            most roofs and crowns; 0.0 without a surface.
        levels: number of levels of the pyramid.
        open_file: opens the map's file again, such as for its colours; None for a map of arrays.
        georeference_sigma_m: georeferencing accuracy, one standard deviation per axis; None if unknown.
        surface_datum: vertical datum of the surface, as its file names it; None unless that is above the sea.
        slope_sigma_deg: slope accuracy of the surface under a frame, one standard deviation; None if unknown.
    """

    def __init__(
        self,
        name: str,
        grid: Grid,
        pixels: GrayReader | tuple[Gray, Mask],
        source_crs: CRS,
        facts: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(grid)
        self.name, self.source_crs, self._facts = name, source_crs, facts or {}
        self.open_file: Callable[[], Source] | None = None
        self._surface: SurfaceModel | None = None
        self.has_surface, self.ground_m = False, 0.0
        self.surface_datum: str | None = None
        self.georeference_sigma_m: float | None = None
        self.slope_sigma_deg: float | None = None
        self._pyramid = Pyramid(grid.width_px, grid.height_px, pixels)
        self.levels = self._pyramid.levels

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        surface: str | os.PathLike[str] | None = None,
        *,
        bounds_deg: Bounds | None = None,
        bounds_crs: Bounds | None = None,
        crs: Any = None,
        cache_dir: str | os.PathLike[str] | None = None,
        georeference_sigma_m: float | None = None,
        slope_sigma_deg: float | None = None,
        on_copy: ProgressCallback | None = None,
    ) -> OrthoMap:
        """Open a GeoTIFF, or a picture with given bounds, with an optional surface model.

        A geographic, rotated or non-square raster is resampled once to a north-up UTM grid, and cached.

        Args:
            path: the map; see :func:`engine.maps.rasters.open_source` for what may be opened.
            surface: heights in any grid and CRS.
            bounds_deg: west, south, east, north of the outer edges of a picture without georeference.
            bounds_crs: the same in the units of ``crs``.
            crs: used if the file names none.
            cache_dir: None is ``$XDG_CACHE_HOME/scenematch``, else ``~/.cache/scenematch``.
            georeference_sigma_m: georeferencing accuracy; None takes it from the file's metadata.
            slope_sigma_deg: slope accuracy; None takes it from the surface file's metadata.
            on_copy: called while a resampled copy is created.

        Raises:
            MapError: a file cannot be read, has no georeference or another than that given, or the surface does
                not overlap the map.
            OptionError: an accuracy is not a number above 0.
        """
        opened = partial(open_source, path, bounds_deg=bounds_deg, bounds_crs=bounds_crs, crs=crs)
        original = opened()
        used, reader, facts = open_readable(original, cache_dir, on_copy)
        facts["surface_path"] = None if surface is None else os.fspath(surface)
        site = cls(original.path.name, used.grid, reader, original.grid.crs, facts)
        heights_file = None if surface is None else open_source(surface, "surface")
        site.open_file = opened
        site.georeference_sigma_m = stated_sigma(georeference_sigma_m, original, GEOREFERENCE_TAG)
        site.slope_sigma_deg = stated_sigma(slope_sigma_deg, heights_file, SLOPE_TAG)
        if heights_file is not None:
            site._attach(*open_surface(heights_file, site.grid))
            site.surface_datum = vertical_datum(heights_file.dataset)
        return site

    @classmethod
    def from_arrays(
        cls,
        gray: Gray,
        pixel_to_crs: ArrayLike,
        crs: Any,
        *,
        surface_m: ArrayLike | None = None,
        valid: Mask | None = None,
        georeference_sigma_m: float | None = None,
        slope_sigma_deg: float | None = None,
    ) -> OrthoMap:
        """A map without a file, for simulators and tests.

        Args:
            gray: (H, W) uint8.
            pixel_to_crs: (2, 3) affine from pixels, centres at integers, to a projected north-up grid.
            crs: anything that pyproj takes.
            surface_m: (H, W) heights, NaN where unknown.
            valid: (H, W) bool; None means all.
            georeference_sigma_m: georeferencing accuracy, None if unknown.
            slope_sigma_deg: slope accuracy, None if unknown.

        Returns:
            OrthoMap: without a file; do not change the arrays while it is in use.

        Raises:
            OptionError: an accuracy is not a number above 0.
            ShapeError: an array does not have the shape of the map.
            DtypeError: ``gray`` is not uint8.
            MapError: the grid is not metric and north-up.
        """
        mask = np.ones(gray.shape, np.bool_) if valid is None else np.asarray(valid, np.bool_)
        heights = None if surface_m is None else np.ascontiguousarray(surface_m, np.float32)
        check_arrays(gray, mask, heights)
        grid = metric_grid(gray.shape, np.asarray(pixel_to_crs, np.float64), crs)
        site = cls("arrays", grid, (gray, mask), grid.crs)
        site.georeference_sigma_m = stated_sigma(georeference_sigma_m, None, GEOREFERENCE_TAG)
        site.slope_sigma_deg = stated_sigma(slope_sigma_deg, None, SLOPE_TAG)
        if heights is not None:
            site._attach(SurfaceModel(heights, warp_between(grid, grid)), grid)
        return site

    def _attach(self, surface: SurfaceModel, surface_grid: Grid) -> None:
        known = self._known_heights(surface, self.grid.points(257))
        if known.size < _MIN_KNOWN:  # a surface of a small part of the map, or a map of small parts
            to_map = warp_between(surface_grid, self.grid)
            known = self._known_heights(surface, to_map(surface_grid.points(257)))
        if known.size == 0:
            raise MapError("surface: expected known heights under the valid part of the map, got none")
        self._surface, self.has_surface = surface, True
        self.ground_m = float(np.percentile(known, GROUND_PERCENT))

    def _known_heights(self, surface: SurfaceModel, xy_px: Array) -> Array:
        """The surface's heights at those pixels (N, 2) at which surface and map are both known."""
        last = np.array([self.width_px - 1, self.height_px - 1])
        xy = np.rint(xy_px)
        xy = np.clip(xy, 0, last)[((xy >= -1) & (xy <= last + 1)).all(axis=1)]
        heights = surface.overview(xy)
        return np.asarray(heights[np.isfinite(heights) & self._pyramid.valid_at(xy)])

    @property
    def is_large(self) -> bool:
        """Whether it is read from its file window by window instead of held in memory."""
        return self._pyramid.is_large

    @property
    def reads_files(self) -> bool:
        """Whether pixels or heights are read from files whenever they are needed."""
        return self.is_large or (self._surface is not None and self._surface.reads_files)

    @property
    def is_searchable(self) -> bool:
        """Whether it is small enough to be searched as a whole."""
        return self.grid.area_px <= SEARCH_LIMIT_PX

    @property
    def size_km(self) -> str:
        """Width and height on the ground, as text."""
        return " x ".join(f"{n * self.gsd_m_per_px / 1e3:.3g}" for n in (self.width_px, self.height_px)) + " km"

    @property
    def inner_px(self) -> Array:
        """(2,) the middle pixel if it is valid, else the valid pixel farthest from any nodata."""
        middle = self.grid.centre_px
        return middle if bool(self._pyramid.valid_at(middle)) else self._pyramid.innermost_px()

    def gray(self, window: Window, level: int = 0) -> Gray:
        """Grey values of a window.

        Args:
            window: in pixels of the level.
            level: of the pyramid.

        Returns:
            (h, w) uint8, a copy; undefined where the window is not valid.

        Raises:
            OptionError: the window is empty or not inside, or there is no such level.
        """
        return self._pyramid.crop(window, level)[0].copy()

    def valid(self, window: Window, level: int = 0) -> Mask:
        """Validity of a window.

        Args:
            window: in pixels of the level.
            level: of the pyramid.

        Returns:
            (h, w) bool, a copy; False on nodata.

        Raises:
            OptionError: as :meth:`gray`.
        """
        return self._pyramid.crop(window, level)[1].copy()

    def level_shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        return self._pyramid.shape(level)

    def level_from_full(self, xy_px: ArrayLike, level: int) -> Array:
        """Pixels of a level from pixels of the full map.

        Args:
            xy_px: (..., 2) pixels of the map.
            level: of the pyramid.

        Returns:
            (..., 2) pixels of the level.
        """
        return (np.asarray(xy_px, np.float64) + 0.5) / 2.0**level - 0.5

    def full_from_level(self, xy_px: ArrayLike, level: int) -> Array:
        """Pixels of the full map from pixels of a level.

        Args:
            xy_px: (..., 2) pixels of the level.
            level: of the pyramid.

        Returns:
            (..., 2) pixels of the map.
        """
        return (np.asarray(xy_px, np.float64) + 0.5) * 2.0**level - 0.5

    def surface_at(self, xy_px: ArrayLike) -> Array:
        """Bilinear heights of the surface.

        Args:
            xy_px: (..., 2) pixels of the map.

        Returns:
            (...,) metres in the surface's datum; ``ground_m`` outside the surface and next to its nodata, 0.0
            without a surface.
        """
        xy = np.asarray(xy_px, np.float64)
        if self._surface is None:
            return np.zeros(xy.shape[:-1])
        heights = self._surface.sample(xy)
        return np.where(np.isnan(heights), self.ground_m, heights)

    def surface_points(self, xy_px: ArrayLike) -> Array:
        """Points of the surface.

        Args:
            xy_px: (N, 2) pixels of the map.

        Returns:
            (N, 3) metres east and north of the map's origin, and height as by :meth:`surface_at`.
        """
        return np.column_stack([self.enu_from_pixel(xy_px), self.surface_at(xy_px)])

    def ground_at(self, xy_px: ArrayLike) -> float:
        """Height of the bare ground at one pixel, on a plane about it that has a fifth of the surface below it.

        This puts it below roofs and crowns but, unlike a plain percentile, not below the middle of a slope.

        Args:
            xy_px: (2,) pixel of the map.

        Returns:
            Metres in the surface's datum; ``ground_m`` if less than half of the square is known, 0.0 without a
            surface.
        """
        level_m = None
        if self._surface is not None:
            level_m = self._surface.ground_at(np.asarray(xy_px, np.float64), GROUND_REACH_M / self.gsd_m_per_px)
        return self.ground_m if level_m is None else level_m

    def roughness_weight_at(self, xy_px: ArrayLike, reach_px: float) -> Array:
        """Weight of pixels by the roughness of the surface: 1 on level ground, less at walls, edges and crowns.

        The weight is one half if heights ``reach_px`` away differ by a metre.

        Args:
            xy_px: (..., 2) pixels of the map.
            reach_px: distance along x and y at which heights are compared.

        Returns:
            (...,) in (0, 1]; 1 without a surface.
        """
        xy = np.asarray(xy_px, np.float64)
        if self._surface is None:
            return np.ones(xy.shape[:-1])
        about = reach_px * np.array([(0.0, 0.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)])
        heights = self.surface_at(xy[..., None, :] + about)
        return np.asarray(1.0 / (1.0 + np.ptp(heights, axis=-1) ** 2))

    def info(self) -> dict[str, Any]:
        """Facts about the map as JSON; ``convergence_deg`` is the true heading of the map's upward direction."""
        east, north = -self.enu_jacobian(self.grid.centre_px)[:, 1]
        surface = self._surface
        return {
            "name": self.name,
            **self._facts,
            "width_px": self.width_px,
            "height_px": self.height_px,
            "levels": self.levels,
            "crs": self.crs.to_string(),
            "source_crs": self.source_crs.to_string(),
            "gsd_m_per_px": self.gsd_m_per_px,
            "bounds_deg": list(self.bounds_deg),
            "origin_lat_deg": self.frame.lat_deg,
            "origin_lon_deg": self.frame.lon_deg,
            "convergence_deg": math.degrees(math.atan2(east, north)),
            "nodata_share": self._pyramid.nodata_share,
            "surface_range_m": None if surface is None else list(surface.range_m),
            "surface_datum": self.surface_datum,
            "ground_m": self.ground_m,
            "georeference_sigma_m": self.georeference_sigma_m,
            "slope_sigma_deg": self.slope_sigma_deg,
        }
