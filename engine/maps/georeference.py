"""Coordinates of a map: pixels to local east and north, and to latitude and longitude, and back.

Convention:
    East and north are metres in the plane tangent to WGS84 at the centre of the map, :attr:`Georeference.frame`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from engine.errors import MapError
from engine.geo import LocalFrame
from engine.maps.grids import WARP_MARGIN, Array, Grid, Warp, wgs84

GSD_RANGE_M = (1e-3, 1e3)


class Georeference:
    """Coordinates of the pixels of a metric grid, by polynomials that are exact to 0.1 mm and 1e-4 px.

    Attributes:
        grid: in use.
        width_px, height_px: columns and rows.
        crs: of the grid.
        frame: local east-north-up; its origin is the centre of the map.
        gsd_m_per_px: true metres on the ground per pixel at the centre: the square root of a pixel's area.
        bounds_deg: west, south, east, north of the outer edges.

    Raises:
        MapError: the ground sample distance is out of range.
    """

    def __init__(self, grid: Grid) -> None:
        self.width_px, self.height_px, self.crs, self.grid = grid.width_px, grid.height_px, grid.crs, grid
        self._to_geodetic, self._from_geodetic = grid.pixels_of(wgs84())
        lon_deg, lat_deg = self._to_geodetic(grid.centre_px)
        self.frame = LocalFrame(float(lat_deg), float(lon_deg))
        box = grid.box(WARP_MARGIN)
        self._to_enu = Warp(self._exact_enu, box, tolerance=1e-4)
        enu = self._to_enu(np.stack(np.meshgrid(box[:, 0], box[:, 1]), axis=-1).reshape(-1, 2))
        self._from_enu = Warp(self._exact_pixel, np.stack([enu.min(axis=0), enu.max(axis=0)]), tolerance=1e-4)
        self._lonlat = Warp(self._to_geodetic, box, tolerance=1e-9)  # degrees: 0.1 mm
        self.gsd_m_per_px = math.sqrt(abs(np.linalg.det(self.enu_jacobian(grid.centre_px))))
        if not GSD_RANGE_M[0] <= self.gsd_m_per_px <= GSD_RANGE_M[1]:
            raise MapError(f"map: expected 1 mm to 1 km a pixel, got {self.gsd_m_per_px:.3g} m; is its CRS right?")
        lonlat = self._to_geodetic(grid.points())
        (west, south), (east, north) = lonlat.min(axis=0), lonlat.max(axis=0)
        self.bounds_deg = (float(west), float(south), float(east), float(north))

    def _exact_enu(self, xy_px: Array) -> Array:
        lonlat = self._to_geodetic(xy_px)
        return self.frame.enu_from_geodetic(lonlat[..., 1], lonlat[..., 0])

    def _exact_pixel(self, en_m: Array) -> Array:
        lat, lon = self.frame.geodetic_from_enu(en_m[..., 0], en_m[..., 1])
        return self._from_geodetic(np.stack([lon, lat], axis=-1))

    def enu_from_pixel(self, xy_px: ArrayLike) -> Array:
        """Local coordinates of pixels.

        Args:
            xy_px: (..., 2) pixels of the map.

        Returns:
            (..., 2) east and north in metres.
        """
        return self._to_enu(np.asarray(xy_px, np.float64))

    def pixel_from_enu(self, en_m: ArrayLike) -> Array:
        """Pixels of local coordinates.

        Args:
            en_m: (..., 2) east and north.

        Returns:
            (..., 2) pixels of the map.
        """
        return self._from_enu(np.asarray(en_m, np.float64))

    def enu_jacobian(self, xy_px: ArrayLike) -> Array:
        """Jacobian of the local coordinates by the pixel.

        It includes the ground sample distance, the point scale of the projection and the meridian convergence.

        Args:
            xy_px: (2,) pixel of the map.

        Returns:
            (2, 2) d(east, north) / d(x, y) in metres per pixel.
        """
        half_steps = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        right, left, below, above = self._to_enu(np.asarray(xy_px, np.float64) + half_steps)
        return np.column_stack([right - left, below - above])

    def geodetic_from_pixel(self, xy_px: ArrayLike) -> tuple[Array, Array]:
        """Geodetic coordinates of pixels.

        Args:
            xy_px: (..., 2) pixels of the map.

        Returns:
            WGS84 latitude and longitude in degrees, (...,) each.
        """
        lonlat = self._lonlat(np.asarray(xy_px, np.float64))
        return lonlat[..., 1], lonlat[..., 0]

    def pixel_from_geodetic(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """Pixels of geodetic coordinates.

        Args:
            lat_deg: (...,) WGS84.
            lon_deg: (...,) WGS84.

        Returns:
            (..., 2) pixels of the map.
        """
        lat, lon = np.broadcast_arrays(np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64))
        return self._from_geodetic(np.stack([lon, lat], axis=-1))
