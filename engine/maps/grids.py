"""Georeferencing of pixels: coordinate systems, affine transforms, grids and polynomial transforms between them.

Convention:
    ``pixel_to_crs`` is a (2, 3) affine matrix that takes pixels (x, y), centres at integers, to coordinates
    (easting, northing) or (longitude, latitude).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial.polynomial import polyvander2d
from numpy.typing import NDArray

from engine.errors import MapError
from engine.geo import LocalFrame
from engine.values import Window

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

Array = NDArray[np.float64]
Function = Callable[[Array], Array]

WARP_MARGIN = 0.5
"""Polynomial transforms extend beyond the map by this share of its longer side; farther out they are exact."""


class Warp:
    """A transform of the plane by polynomials that were checked against the exact function.

    PROJ, and the conversion from the tangent plane to the ellipsoid, take a fraction of a millisecond a call. Over
    one map both are so smooth that polynomials of degree 5 follow them to micrometres. If any point of a call is
    outside ``box``, or if the fit misses ``tolerance``, all points take the exact function.

    Args:
        exact: function of points (..., 2) to points (..., 2).
        box: (2, 2) low and high corner of the polynomials' domain.
        tolerance: largest error of a coordinate, in the units of the result.
    """

    def __init__(self, exact: Function, box: Array, tolerance: float) -> None:
        self._exact = exact
        self._centre, self._half = (box[0] + box[1]) / 2.0, (box[1] - box[0]) / 2.0
        chebyshev = np.cos(np.pi * (np.arange(14.0) + 0.5) / 14.0)  # nodes that spread the error evenly
        nodes, between = square_points(chebyshev), square_points(np.linspace(-1.0, 1.0, 17))
        values = exact(self._centre + self._half * nodes)
        self._coefficients: Array | None = None
        if np.isfinite(values).all():
            fitted = np.linalg.lstsq(_powers(nodes), values, rcond=None)[0]
            error = _powers(between) @ fitted - exact(self._centre + self._half * between)
            if np.abs(error).max() <= tolerance:  # not if NaN
                self._coefficients = np.ascontiguousarray(fitted.reshape(6, 6, 2))

    def __call__(self, points: Array) -> Array:
        """Transform points.

        Args:
            points: (..., 2).

        Returns:
            (..., 2).
        """
        from engine.kernels.map_points import polynomials  # numba takes a while to import

        if self._coefficients is not None:
            flat = np.ascontiguousarray(points, np.float64).reshape(-1, 2)
            out = np.empty_like(flat)
            if polynomials(flat, self._centre, self._half, self._coefficients, out):
                return out.reshape(points.shape)
        return self._exact(points)


def _powers(points: Array) -> Array:
    """(N, 36) products of powers of x and of y up to the fifth."""
    return np.asarray(polyvander2d(points[:, 0], points[:, 1], [5, 5]), np.float64)


def square_points(x: Array) -> Array:
    """All points whose coordinates are two of these numbers, row by row.

    Args:
        x: (N,).

    Returns:
        (N ** 2, 2).
    """
    return np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)


def apply_affine(matrix: Array, points: Array) -> Array:
    """Apply an affine transform.

    Args:
        matrix: (2, 3).
        points: (..., 2).

    Returns:
        (..., 2).
    """
    return np.asarray(points @ matrix[:, :2].T + matrix[:, 2])


def invert_affine(matrix: Array) -> Array:
    """Invert an affine transform.

    Args:
        matrix: (2, 3), its linear part invertible.

    Returns:
        (2, 3).
    """
    linear = np.linalg.inv(matrix[:, :2])
    return np.column_stack([linear, -linear @ matrix[:, 2]])


def earth_crs(value: Any, argument: str) -> CRS:
    """The horizontal part of a coordinate reference system of the Earth.

    Args:
        value: anything that pyproj takes.
        argument: its name in messages.

    Raises:
        MapError: it is not such a system.
    """
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    try:
        crs = CRS.from_user_input(value)
        crs = crs.sub_crs_list[0] if crs.is_compound else crs
        if not (crs.is_geographic or crs.is_projected):
            raise MapError(f"{argument}: expected a CRS on the Earth, got {crs.type_name} {crs.name!r}")
        crs = crs.to_2d() if len(crs.axis_info) > 2 else crs
        Transformer.from_crs(crs, 4326)
    except ProjError as error:
        reason = str(error).splitlines()[0]
        raise MapError(f"{argument}: expected a coordinate reference system of the Earth: {reason}") from None
    return crs


def wgs84() -> CRS:
    """Longitude and latitude in degrees on the ellipsoid of GNSS, EPSG:4326."""
    from pyproj import CRS

    return CRS.from_epsg(4326)


@lru_cache(maxsize=16)  # making one takes tens of milliseconds
def _transformer(source: CRS, target: CRS) -> Transformer:
    from pyproj import Transformer

    return Transformer.from_crs(source, target, always_xy=True)


@dataclass(frozen=True, eq=False)
class Grid:
    """A raster grid with its georeference.

    Attributes:
        width_px: columns.
        height_px: rows.
        pixel_to_crs: (2, 3), integer pixels are centres.
        crs: of these coordinates.
    """

    width_px: int
    height_px: int
    pixel_to_crs: Array
    crs: CRS

    @property
    def area_px(self) -> int:
        """Number of pixels."""
        return self.width_px * self.height_px

    @property
    def centre_px(self) -> Array:
        """(2,) middle of the picture."""
        return np.array([(self.width_px - 1) / 2.0, (self.height_px - 1) / 2.0])

    def pixels_of(self, other: CRS) -> tuple[Function, Function]:
        """Exact functions (..., 2) to (..., 2): coordinates of another CRS from pixels, and pixels from these."""
        forward, backward = _transformer(self.crs, other), _transformer(other, self.crs)
        crs_to_pixel = invert_affine(self.pixel_to_crs)
        centre_x = apply_affine(self.pixel_to_crs, self.centre_px)[0]

        def there(pixels: Array) -> Array:
            at = apply_affine(self.pixel_to_crs, pixels)
            return np.asarray(np.stack(forward.transform(at[..., 0], at[..., 1]), axis=-1), np.float64)

        def back(points: Array) -> Array:
            x, y = backward.transform(points[..., 0], points[..., 1])
            if self.crs.is_geographic:  # a map across the antimeridian continues beyond 180 degrees
                x = centre_x + (np.asarray(x) - centre_x + 180.0) % 360.0 - 180.0
            return apply_affine(crs_to_pixel, np.stack([x, y], axis=-1))

        return there, back

    def box(self, margin: float = 0.0) -> Array:
        """Bounding box of the outer edges.

        Args:
            margin: added to each side, as a share of the longer side.

        Returns:
            (2, 2) low and high corner in pixels.
        """
        grow = 0.5 + margin * max(self.width_px, self.height_px)
        return np.array([[-grow, -grow], [self.width_px - 1 + grow, self.height_px - 1 + grow]])

    def points(self, count: int = 33) -> Array:
        """Points spread evenly over the picture, including its outer edges.

        Args:
            count: along each side.

        Returns:
            (count ** 2, 2) pixels.
        """
        low, high = self.box()
        unit = square_points(np.linspace(-1.0, 1.0, count))
        return np.asarray((low + high) / 2.0 + (high - low) / 2.0 * unit)

    @property
    def is_metric(self) -> bool:
        """Whether it can be matched without resampling: projected, north-up, square on the ground to 1 %."""
        linear = self.pixel_to_crs[:, :2]
        step = np.abs(linear).max()
        upright = linear[0, 0] > 0 and linear[1, 1] < 0 and abs(linear[[0, 1], [1, 0]]).max() < 1e-3 * step
        if self.crs.is_geographic or not upright:
            return False
        lon, lat = self.pixels_of(wgs84())[0](self.centre_px + np.array([[0, 0], [1, 0], [0, 1]])).T
        steps_m = np.linalg.norm(LocalFrame(lat[0], lon[0]).enu_from_geodetic(lat[1:], lon[1:]), axis=1)
        return bool(steps_m.max() <= 1.01 * steps_m.min())


def part_grid(own: Grid, part: Window, shape: tuple[int, int]) -> Grid:
    """The grid of a window of another grid, decimated to ``shape`` (rows, columns)."""
    scale = np.array([part.width_px, part.height_px]) / shape[::-1]
    # Pixel x of the decimated copy covers the other grid's pixels around corner + (x + 0.5) * scale - 0.5.
    first = np.array([part.x0, part.y0]) + 0.5 * scale - 0.5
    matrix = np.column_stack([own.pixel_to_crs[:, :2] * scale, apply_affine(own.pixel_to_crs, first)])
    return Grid(shape[1], shape[0], matrix, own.crs)


def by_corner(grid: Grid) -> Array:
    """GDAL's affine of a grid, from the outer corner of its first pixel.

    Args:
        grid: whose pixels are centres.

    Returns:
        (6,) as :class:`affine.Affine` takes them.
    """
    corner = apply_affine(grid.pixel_to_crs, np.array([-0.5, -0.5]))
    return np.column_stack([grid.pixel_to_crs[:, :2], corner]).ravel()


def metric_grid(shape: tuple[int, ...], matrix: Array, crs: Any) -> Grid:
    """The grid of arrays.

    Args:
        shape: (H, W).
        matrix: (2, 3) affine from pixels to the CRS.
        crs: anything that pyproj takes.

    Returns:
        Grid: metric and north-up.

    Raises:
        MapError: the grid is not metric and north-up.
    """
    if matrix.shape != (2, 3) or not np.isfinite(matrix).all() or np.linalg.det(matrix[:, :2]) == 0.0:
        raise MapError(f"pixel_to_crs: expected a finite, invertible (2, 3), got {matrix.tolist()}")
    grid = Grid(shape[1], shape[0], matrix, earth_crs(crs, "crs"))
    if not grid.is_metric:
        raise MapError(f"pixel_to_crs: expected a square north-up grid in a projected CRS, got {grid.crs.name!r}")
    return grid


def warp_between(grid: Grid, other: Grid) -> Warp:
    """The transform from pixels of a grid to pixels of another, to a hundredth of a pixel."""
    to_other = other.pixels_of(grid.crs)[1]
    return Warp(lambda xy: to_other(apply_affine(grid.pixel_to_crs, xy)), grid.box(WARP_MARGIN), tolerance=0.01)


def window_about(points: Array, shape: tuple[int, ...], margin_px: int) -> Window | None:
    """The whole pixels of a picture around points, with a margin.

    Args:
        points: (N, 2) in pixels of the picture, finite.
        shape: (rows, columns) of the picture, to which the result is clipped.
        margin_px: added on each side.

    Returns:
        Window | None: None if the picture has no pixel there.
    """
    if len(points) == 0:
        return None
    limit = shape[::-1]
    low = np.clip(np.floor(points.min(axis=0)) - margin_px, 0, limit).astype(int)
    high = np.clip(np.ceil(points.max(axis=0)) + margin_px + 1, 0, limit).astype(int)
    return Window(*low.tolist(), *(high - low).tolist()) if (high > low).all() else None


def overlap(grid: Grid, other: Grid) -> Window | None:
    """The part of another grid that a grid covers, widened by two pixels; None if they do not overlap."""
    points = warp_between(grid, other)(grid.points())
    return window_about(points[np.isfinite(points).all(axis=1)], (other.height_px, other.width_px), margin_px=2)
