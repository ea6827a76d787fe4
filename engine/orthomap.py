"""The map: a georeferenced picture in grey with its pyramid, optionally with a surface model.

Convention:
    Pixels (x, y) have their centres at integers, the origin at the centre of the top-left pixel. East and north
    are metres in the plane tangent to WGS84 at the centre of the map, ``OrthoMap.frame``. Pixel x_L of pyramid
    level L covers the full-resolution pixels around x_0 = (x_L + 0.5) 2^L - 0.5.
"""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from engine.errors import DtypeError, MapError, ShapeError
from engine.geo import LocalFrame
from engine.maps.grids import WARP_MARGIN, Array, Grid, Warp, earth_crs, warp_between
from engine.maps.metric_copy import ProgressCallback, is_large, needs_copy, open_metric_copy
from engine.maps.pyramid import ArrayReader, Pyramid, Reader
from engine.maps.rasters import GEOREFERENCE_TAG, SLOPE_TAG, Gray, GrayReader, Mask, open_source, stated_sigma
from engine.maps.surface import GROUND_PERCENT, SurfaceModel, open_surface
from engine.values import Window

if TYPE_CHECKING:
    from pyproj import CRS

GSD_RANGE_M = (1e-3, 1e3)
GROUND_REACH_M = 30.0
"""So far about a place its ground is looked for: wider than a house, narrower than a hill."""
SEARCH_LIMIT_PX = 1 << 29
"""A map of up to this many pixels may be searched as a whole, where nothing is known of the place."""
_MIN_KNOWN = 100  # places at which the ground's level is taken
_ROUGH_M = 1.0  # heights about a place that differ by this much halve its weight


class OrthoMap:
    """A map that frames are matched against; made by :meth:`open` or :meth:`from_arrays`.

    Attributes:
        name: name of the file.
        width_px, height_px: columns and rows.
        crs, source_crs: of the metric grid in use, and of the file.
        frame: local east-north-up; its origin is the centre of the map.
        gsd_m_per_px: true metres on the ground per pixel at the centre: the root of the area of a pixel.
        bounds_deg: west, south, east, north of the outer edges.
        has_surface: whether it has one.
        ground_m: level of the ground in the surface's datum: the 20th percentile of the surface over the valid
            part of the map, below roofs and crowns but not at the bottom of a pit; 0.0 without a surface.
        levels: number of levels of the pyramid.
        georeference_sigma_m: one standard deviation of where the map lies, per axis; None where it does not say.
        slope_sigma_deg: the same of how far the ground under a frame leans against the surface.
    """

    georeference_sigma_m: float | None = None
    slope_sigma_deg: float | None = None

    def __init__(
        self, name: str, grid: Grid, reader: Reader, source_crs: CRS, facts: dict[str, Any] | None = None
    ) -> None:
        self.name, self.width_px, self.height_px = name, grid.width_px, grid.height_px
        self.crs, self.source_crs = grid.crs, source_crs
        self._grid, self._facts = grid, facts or {}
        self._surface: SurfaceModel | None = None
        self.has_surface, self.ground_m = False, 0.0
        self._to_geodetic, self._from_geodetic = grid.pixels_of(earth_crs("EPSG:4326", "crs"))
        lon_deg, lat_deg = self._to_geodetic(grid.centre_px)
        self.frame = LocalFrame(float(lat_deg), float(lon_deg))
        box = grid.box(WARP_MARGIN)
        self._to_enu = Warp(self._exact_enu, box, tolerance=1e-4)
        enu = self._to_enu(np.stack(np.meshgrid(box[:, 0], box[:, 1]), axis=-1).reshape(-1, 2))
        self._from_enu = Warp(self._exact_pixel, np.stack([enu.min(axis=0), enu.max(axis=0)]), tolerance=1e-4)
        self.gsd_m_per_px = math.sqrt(abs(np.linalg.det(self.enu_jacobian(grid.centre_px))))
        if not GSD_RANGE_M[0] <= self.gsd_m_per_px <= GSD_RANGE_M[1]:
            raise MapError(f"map: expected 1 mm to 1 km a pixel, got {self.gsd_m_per_px:.3g} m; is its CRS right?")
        lonlat = self._to_geodetic(grid.lattice())
        (west, south), (east, north) = lonlat.min(axis=0), lonlat.max(axis=0)
        self.bounds_deg = (float(west), float(south), float(east), float(north))
        self._pyramid = Pyramid(grid.width_px, grid.height_px, reader)
        self.levels = self._pyramid.levels

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        surface: str | os.PathLike[str] | None = None,
        *,
        bounds_deg: tuple[float, float, float, float] | None = None,
        crs: Any = None,
        cache_dir: str | os.PathLike[str] | None = None,
        georeference_sigma_m: float | None = None,
        slope_sigma_deg: float | None = None,
        on_copy: ProgressCallback | None = None,
    ) -> OrthoMap:
        """Open a GeoTIFF, or a picture whose place is given, with an optional surface model.

        A geographic, rotated or non-square raster is resampled once to a north-up UTM grid and kept in
        ``cache_dir`` (``$XDG_CACHE_HOME/scenematch``, else ``~/.cache/scenematch``).

        Args:
            path: the map; see :func:`engine.maps.rasters.open_source` for what may be opened.
            surface: heights in any grid and CRS.
            bounds_deg: west, south, east, north of the outer edges of a picture without georeference.
            crs: of a file that names none.
            cache_dir: where resampled maps are kept.
            georeference_sigma_m: how well the map lies; None takes what the file says, see
                :data:`engine.maps.rasters.GEOREFERENCE_TAG`.
            slope_sigma_deg: how well the surface leans; None takes what its file says.
            on_copy: called while a copy is made for the cache, with the pixels that it has and those that it will
                have.

        Raises:
            MapError: a file cannot be read or placed on the Earth, or the surface lies elsewhere.
            OptionError: an accuracy is not a number above 0.
        """
        original = used = open_source(path, bounds_deg=bounds_deg, crs=crs)
        copied = needs_copy(original)
        reader = None if copied and is_large(original.grid) else GrayReader(original)
        share = None if reader is None else reader.invalid_share
        if copied:
            used = open_metric_copy(original, reader, cache_dir, on_copy)
            reader = GrayReader(used, find_collar=False)
        assert reader is not None  # of the file or of its copy
        facts = {
            "path": str(original.path),
            "driver": original.dataset.driver,
            "bands": original.dataset.count,
            "dtype": original.dataset.dtypes[0],
            "source_size_px": [original.grid.width_px, original.grid.height_px],
            "source_nodata_share": reader.invalid_share if share is None else share,
            "resampled": not original.grid.is_metric,
            "surface_path": None if surface is None else os.fspath(surface),
        }
        site = cls(original.path.name, used.grid, reader, original.grid.crs, facts)
        site.georeference_sigma_m = stated_sigma(
            georeference_sigma_m, original, GEOREFERENCE_TAG, "georeference_sigma_m"
        )
        heights_file = None if surface is None else open_source(surface, "surface")
        site.slope_sigma_deg = stated_sigma(slope_sigma_deg, heights_file, SLOPE_TAG, "slope_sigma_deg")
        if heights_file is not None:
            site._attach(*open_surface(heights_file, site._grid))
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
            valid: (H, W) bool, all where None.
            georeference_sigma_m: how well the map lies, where that is known.
            slope_sigma_deg: how well the surface leans, where that is known.

        Raises:
            OptionError: an accuracy is not a number above 0.
            ShapeError: an array does not have the shape of the map.
            DtypeError: ``gray`` is not uint8.
            MapError: the grid is not metric and north-up.
        """
        if gray.ndim != 2 or 0 in gray.shape:
            raise ShapeError(f"gray: expected (H, W) with at least one pixel, got {gray.shape}")
        if gray.dtype != np.uint8:
            raise DtypeError(f"gray: expected uint8, got {gray.dtype}")
        mask = np.ones(gray.shape, np.bool_) if valid is None else np.asarray(valid, np.bool_)
        heights = None if surface_m is None else np.asarray(surface_m, np.float32)
        for name, array in (("valid", mask), ("surface_m", heights)):
            if array is not None and array.shape != gray.shape:
                raise ShapeError(f"{name}: expected the shape of gray {gray.shape}, got {array.shape}")
        matrix = np.asarray(pixel_to_crs, np.float64)
        if matrix.shape != (2, 3) or not np.isfinite(matrix).all() or np.linalg.det(matrix[:, :2]) == 0.0:
            raise MapError(f"pixel_to_crs: expected a finite, invertible (2, 3), got {matrix.tolist()}")
        grid = Grid(gray.shape[1], gray.shape[0], matrix, earth_crs(crs, "crs"))
        if not grid.is_metric:
            raise MapError(
                f"pixel_to_crs: expected a square north-up grid in a projected CRS, got {grid.crs.name!r}"
            )

        site = cls("arrays", grid, ArrayReader(gray, mask), grid.crs)
        site.georeference_sigma_m = stated_sigma(
            georeference_sigma_m, None, GEOREFERENCE_TAG, "georeference_sigma_m"
        )
        site.slope_sigma_deg = stated_sigma(slope_sigma_deg, None, SLOPE_TAG, "slope_sigma_deg")
        if heights is not None:
            site._attach(SurfaceModel(heights, warp_between(grid, grid)), grid)
        return site

    def _attach(self, surface: SurfaceModel, lies: Grid) -> None:
        known = self._known_heights(surface, self._grid.lattice(257))
        if known.size < _MIN_KNOWN:  # a surface of a small part of the map, or a map of small parts
            known = self._known_heights(surface, warp_between(lies, self._grid)(lies.lattice(257)))
        if known.size == 0:
            raise MapError("surface: expected known heights under the valid part of the map, got none")
        self._surface, self.has_surface = surface, True
        self.ground_m = float(np.percentile(known, GROUND_PERCENT))

    def _known_heights(self, surface: SurfaceModel, xy_px: Array) -> Array:
        """The surface's heights at those of the pixels (N, 2) where they and the map are known."""
        last = np.array([self.width_px - 1, self.height_px - 1])
        xy = np.rint(xy_px)
        xy = np.clip(xy, 0, last)[((xy >= -1) & (xy <= last + 1)).all(axis=1)]
        heights = surface.overview(xy)
        return np.asarray(heights[np.isfinite(heights) & self._pyramid.valid_at(xy)])

    @property
    def is_large(self) -> bool:
        """Whether it is read from its file part by part, instead of being held in memory."""
        return self._pyramid.is_large

    @property
    def is_searchable(self) -> bool:
        """Whether a frame may be looked for all over it."""
        return self.width_px * self.height_px <= SEARCH_LIMIT_PX

    @property
    def size_km(self) -> str:
        """Width and height on the ground, in words."""
        return " x ".join(f"{n * self.gsd_m_per_px / 1e3:.3g}" for n in (self.width_px, self.height_px)) + " km"

    @property
    def inner_px(self) -> Array:
        """A place (2,) with map all around: the middle where that is map, else the farthest from any nodata."""
        middle = np.array([self.width_px - 1, self.height_px - 1]) / 2.0
        return middle if bool(self._pyramid.valid_at(middle)) else self._pyramid.innermost_px()

    @property
    def fully_valid(self) -> bool:
        """Whether no pixel is nodata; of a large map only where its file cannot even say that one is."""
        return self._pyramid.fully_valid

    def gray(self, window: Window, level: int = 0) -> Gray:
        """Grey values (h, w) of a window in pixels of ``level``; without meaning where it is not valid.

        Raises:
            OptionError: the window is empty or does not lie inside, or there is no such level.
        """
        return self._pyramid.crop(window, level)[0].copy()

    def valid(self, window: Window, level: int = 0) -> Mask:
        """Where (h, w) a window holds map rather than nodata; raises as :meth:`gray`."""
        return self._pyramid.crop(window, level)[1].copy()

    def level_shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        return self._pyramid.shape(level)

    def level_from_full(self, xy_px: ArrayLike, level: int) -> Array:
        """Pixels (..., 2) of a level from pixels of the full map."""
        return (np.asarray(xy_px, np.float64) + 0.5) / 2.0**level - 0.5

    def full_from_level(self, xy_px: ArrayLike, level: int) -> Array:
        """Pixels (..., 2) of the full map from pixels of a level."""
        return (np.asarray(xy_px, np.float64) + 0.5) * 2.0**level - 0.5

    def surface_at(self, xy_px: ArrayLike) -> Array:
        """Height (...,) of the surface at pixels (..., 2), in the surface's datum.

        Bilinear; ``ground_m`` outside the surface and next to its nodata; 0.0 everywhere without a surface.
        """
        xy = np.asarray(xy_px, np.float64)
        if self._surface is None:
            return np.zeros(xy.shape[:-1])
        heights = self._surface.sample(xy)
        return np.where(np.isnan(heights), self.ground_m, heights)

    def ground_at(self, xy_px: ArrayLike) -> float:
        """Level of the bare ground at one pixel (2,), in the surface's datum; see :meth:`ground_plane`."""
        return self.ground_plane(xy_px, GROUND_REACH_M)[0]

    def ground_plane(self, xy_px: ArrayLike, reach_m: float) -> tuple[float, Array]:
        """The bare ground about one pixel (2,): the plane above a fifth of the surface there, below the rest.

        So it lies below roofs and crowns, and unlike a mere percentile not below the middle of a slope.

        Args:
            xy_px: place.
            reach_m: half the side of the square that is looked at.

        Returns:
            The level at the place in the surface's datum, and the slope (2,) in metres up per pixel x and y:
            ``ground_m`` and level where nothing is known there, 0.0 and level without a surface.
        """
        found = None
        if self._surface is not None:
            found = self._surface.ground_plane(np.asarray(xy_px, np.float64), reach_m / self.gsd_m_per_px)
        return found or (self.ground_m, np.zeros(2))

    def roughness_weight_at(self, xy_px: ArrayLike, reach_px: float) -> Array:
        """Weight (...,) of what is seen at pixels (..., 2): 1 on level ground, less at walls, edges and crowns.

        Where heights ``reach_px`` off differ from each other by a metre, what is seen may stand at either, and
        weighs half.
        """
        xy = np.asarray(xy_px, np.float64)
        if self._surface is None:
            return np.ones(xy.shape[:-1])
        about = [(0.0, 0.0), *((x, y) for x in (-reach_px, reach_px) for y in (-reach_px, reach_px))]
        heights = [self.surface_at(xy + np.array(step)) for step in about]
        return np.asarray(1.0 / (1.0 + (np.ptp(heights, axis=0) / _ROUGH_M) ** 2))

    def _exact_enu(self, xy_px: Array) -> Array:
        lonlat = self._to_geodetic(xy_px)
        with np.errstate(invalid="ignore"):  # far outside its CRS a pixel lies nowhere
            return self.frame.enu_from_geodetic(lonlat[..., 1], lonlat[..., 0])

    def _exact_pixel(self, en_m: Array) -> Array:
        with np.errstate(invalid="ignore"):
            lat, lon = self.frame.geodetic_from_enu(en_m[..., 0], en_m[..., 1])
        return self._from_geodetic(np.stack([lon, lat], axis=-1))

    def enu_from_pixel(self, xy_px: ArrayLike) -> Array:
        """East and north (..., 2) in metres of pixels (..., 2)."""
        return self._to_enu(np.asarray(xy_px, np.float64))

    def pixel_from_enu(self, en_m: ArrayLike) -> Array:
        """Pixels (..., 2) of east and north (..., 2) in metres."""
        return self._from_enu(np.asarray(en_m, np.float64))

    def enu_jacobian(self, xy_px: ArrayLike) -> Array:
        """d(east, north) / d(x, y) (2, 2) in metres per pixel at a pixel (2,).

        It carries the ground sample distance, the point scale of the projection and the meridian convergence.
        """
        half_steps = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        right, left, below, above = self._to_enu(np.asarray(xy_px, np.float64) + half_steps)
        return np.column_stack([right - left, below - above])

    def geodetic_from_pixel(self, xy_px: ArrayLike) -> tuple[Array, Array]:
        """WGS84 latitude and longitude in degrees of pixels (..., 2)."""
        lonlat = self._to_geodetic(np.asarray(xy_px, np.float64))
        return lonlat[..., 1], lonlat[..., 0]

    def pixel_from_geodetic(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """Pixels (..., 2) of WGS84 latitude and longitude in degrees."""
        lat, lon = np.broadcast_arrays(np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64))
        return self._from_geodetic(np.stack([lon, lat], axis=-1))

    @property
    def from_file(self) -> bool:
        """Whether the map was opened from a file; one of arrays in memory was not."""
        return "path" in self._facts

    def info(self) -> dict[str, Any]:
        """Facts about the map that JSON can hold; ``convergence_deg`` is the true heading of the map's up."""
        east, north = -self.enu_jacobian(self._grid.centre_px)[:, 1]
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
            "ground_m": self.ground_m,
            "georeference_sigma_m": self.georeference_sigma_m,
            "slope_sigma_deg": self.slope_sigma_deg,
        }
