"""Raster files: what may be opened, where it lies on the Earth, its grey values, and a metric copy of it.

Convention:
    ``pixel_to_crs`` is a (2, 3) affine matrix that takes pixels (x, y), centres at integers, to coordinates
    (easting, northing) or (longitude, latitude). GDAL's corner origin is left behind in :func:`_centred`.

Nodata is what the file says (tag, mask, alpha, NaN). A file that says nothing may still have a collar: pixels
whose bands are all exactly 0, or all exactly the largest value, that hang together with the border of the
picture and jointly cover more than :data:`COLLAR_SHARE` of it, count as nodata. Dark pixels inside do not.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import tempfile
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import MapError
from engine.geo import LocalFrame
from engine.types import Window

if TYPE_CHECKING:
    from pyproj import CRS

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Function = Callable[[Array], Array]

SIGNATURES = (
    ("GTiff", (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")),
    ("PNG", (b"\x89PNG",)),
    ("JPEG", (b"\xff\xd8\xff",)),
    ("JP2OpenJPEG", (b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51")),
    ("BMP", (b"BM",)),
    ("WEBP", (b"RIFF",)),
)
"""GDAL drivers that may open a file, and how its content must begin; the ending of its name does not count.

A VRT is not among them: it can point to any file or address.
"""
DTYPES = ("uint8", "uint16", "int16", "float32", "float64")
COLLAR_SHARE = 0.005
STRETCH_PERCENT = (2.0, 98.0)
OVERVIEW_PX = 4096
"""Stretch and collar are found on a copy of at most this many pixels a side."""
MEMORY_LIMIT_PX = 256 * 2**20
"""Grey maps of up to this many pixels are held in memory; larger ones are read window by window."""
MAX_SIDE_PX = 1_000_000
WARP_MARGIN = 0.5
"""Fast transforms reach this share of the map's longer side beyond its edges; further out they are exact."""
HEIGHT_RANGE_M = (-1000.0, 20000.0)
"""Surface heights outside are nodata, whether tagged or not (-9999, -32768, 3e38)."""
GRID_VERSION = 1
"""Part of the key of cached grids; to be raised with every change of how they are made."""


class Warp:
    """A smooth map of the plane by polynomials that were checked against the exact function.

    PROJ and the way from the tangent plane to the ellipsoid take a fraction of a millisecond a call. Over one
    map both are so smooth that polynomials of degree 5 follow them to micrometres. Points outside ``box``, and
    all points where the fit misses ``tolerance``, take the exact function.
    """

    def __init__(self, exact: Function, box: Array, tolerance: float) -> None:
        self._exact = exact
        self._centre, self._half = (box[0] + box[1]) / 2.0, (box[1] - box[0]) / 2.0
        nodes = _lattice(np.cos(np.pi * (np.arange(14.0) + 0.5) / 14.0))  # Chebyshev's keep the error even
        terms = (_powers(nodes[:, 0])[:, :, None] * _powers(nodes[:, 1])[:, None, :]).reshape(len(nodes), 36)
        values = exact(self._centre + self._half * nodes)
        self._coefficients: Array = np.zeros((6, 12))
        self.fitted = bool(np.isfinite(values).all())
        if self.fitted:
            self._coefficients[:] = np.linalg.lstsq(terms, values, rcond=None)[0].reshape(6, 12)
            check = _lattice(np.linspace(-1.0, 1.0, 17))
            error = self._polynomial(check) - exact(self._centre + self._half * check)
            self.fitted = bool(np.abs(error).max() <= tolerance)  # NaN compares as not fitted

    def _polynomial(self, unit: Array) -> Array:
        over_y = (_powers(unit[..., 0]) @ self._coefficients).reshape(*unit.shape[:-1], 6, 2)
        return np.asarray((over_y * _powers(unit[..., 1])[..., None]).sum(axis=-2))

    def __call__(self, points: Array) -> Array:
        """The images (..., 2) of points (..., 2)."""
        unit = (points - self._centre) / self._half
        if self.fitted and (np.abs(unit) <= 1.0).all():
            return self._polynomial(unit)
        return self._exact(points)

    def on_grid(self, x: Array, y: Array) -> Array:
        """The images (len(y), len(x), 2) of all pairs of columns and rows."""
        if not self.fitted:
            return self._exact(np.stack(np.meshgrid(x, y), axis=-1))
        in_x, in_y = (_powers((v - c) / h) for v, c, h in zip((x, y), self._centre, self._half, strict=True))
        cubes = self._coefficients.reshape(6, 6, 2)
        return np.stack([in_y @ cubes[..., k].T @ in_x.T for k in (0, 1)], axis=-1)


def _powers(x: Array) -> Array:
    powers = np.ones((*np.shape(x), 6))
    for k in range(1, 6):  # products: ten times as fast as ** on some hundred points, a little slower on one
        np.multiply(powers[..., k - 1], x, out=powers[..., k])
    return powers


def _lattice(x: Array) -> Array:
    return np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)


def apply_affine(matrix: Array, points: Array) -> Array:
    """M (2, 3) on points (..., 2)."""
    return np.asarray(points @ matrix[:, :2].T + matrix[:, 2])


def invert_affine(matrix: Array) -> Array:
    """The (2, 3) matrix that undoes another."""
    linear = np.linalg.inv(matrix[:, :2])
    return np.column_stack([linear, -linear @ matrix[:, 2]])


def earth_crs(value: Any, argument: str) -> CRS:
    """The horizontal part of whatever pyproj takes for a coordinate reference system of the Earth.

    Raises:
        MapError: it is none, or is not tied to the Earth.
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


@dataclass(frozen=True, eq=False)
class Grid:
    """Pixels and where they lie.

    Attributes:
        width_px: columns.
        height_px: rows.
        pixel_to_crs: (2, 3), integer pixels are centres.
        crs: what the coordinates mean.
    """

    width_px: int
    height_px: int
    pixel_to_crs: Array
    crs: CRS

    @property
    def centre_px(self) -> Array:
        """Middle of the picture."""
        return np.array([(self.width_px - 1) / 2.0, (self.height_px - 1) / 2.0])

    def pixels_of(self, other: CRS) -> tuple[Function, Function]:
        """Exact functions: coordinates (x, y) of another CRS from pixels, and pixels from those coordinates."""
        from pyproj import Transformer

        forward = Transformer.from_crs(self.crs, other, always_xy=True)
        backward = Transformer.from_crs(other, self.crs, always_xy=True)
        crs_to_pixel = invert_affine(self.pixel_to_crs)
        centre_x = apply_affine(self.pixel_to_crs, self.centre_px)[0]

        def there(pixels: Array) -> Array:
            at = apply_affine(self.pixel_to_crs, pixels)
            return np.asarray(np.stack(forward.transform(at[..., 0], at[..., 1]), axis=-1), np.float64)

        def back(points: Array) -> Array:
            x, y = backward.transform(points[..., 0], points[..., 1])
            if self.crs.is_geographic:  # a map across the antimeridian counts on beyond 180 degrees
                x = centre_x + (np.asarray(x) - centre_x + 180.0) % 360.0 - 180.0
            return apply_affine(crs_to_pixel, np.stack([x, y], axis=-1))

        return there, back

    def box(self, margin: float = 0.0) -> Array:
        """Corners (2, 2), low and high, of the outer edges widened by a share of the longer side."""
        grow = 0.5 + margin * max(self.width_px, self.height_px)
        return np.array([[-grow, -grow], [self.width_px - 1 + grow, self.height_px - 1 + grow]])

    def lattice(self, count: int = 33) -> Array:
        """Points (count ** 2, 2) spread over the picture, its outer edges included."""
        low, high = self.box()
        unit = _lattice(np.linspace(-1.0, 1.0, count))
        return np.asarray((low + high) / 2.0 + (high - low) / 2.0 * unit)

    @property
    def is_metric(self) -> bool:
        """Whether it can serve as a map as it is: projected, rows to the north, square on the ground to 1 %."""
        linear = self.pixel_to_crs[:, :2]
        step = np.abs(linear).max()
        upright = linear[0, 0] > 0 and linear[1, 1] < 0 and abs(linear[[0, 1], [1, 0]]).max() < 1e-3 * step
        if self.crs.is_geographic or not upright:
            return False
        lon, lat = np.moveaxis(
            self.pixels_of(_wgs84())[0](self.centre_px + np.array([[0, 0], [1, 0], [0, 1]])), -1, 0
        )
        with np.errstate(invalid="ignore"):
            steps_m = np.linalg.norm(LocalFrame(lat[0], lon[0]).enu_from_geodetic(lat[1:], lon[1:]), axis=1)
        return bool(steps_m.max() <= 1.01 * steps_m.min())


def warp_between(grid: Grid, other: Grid) -> Warp:
    """Pixels of another grid from pixels of a grid, to a hundredth of a pixel."""
    to_crs = grid.pixels_of(other.crs)[0]
    to_pixel = invert_affine(other.pixel_to_crs)
    return Warp(lambda xy: apply_affine(to_pixel, to_crs(xy)), grid.box(WARP_MARGIN), tolerance=0.01)


def _wgs84() -> CRS:
    from pyproj import CRS

    return CRS.from_epsg(4326)


@dataclass(frozen=True, eq=False)
class Source:
    """An open raster file and its grid."""

    path: Path
    dataset: Any
    grid: Grid


@contextmanager
def map_errors(argument: str, path: Path) -> Iterator[None]:
    """Turn what rasterio raises into one line."""
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            yield
        except (RasterioError, OSError, ValueError) as error:
            reason = str(error.__cause__ or error).splitlines()[0]
            raise MapError(f"{argument}: cannot read {path}: {reason}") from None


def open_source(
    path: str | os.PathLike[str],
    argument: str = "map",
    *,
    bounds_deg: tuple[float, float, float, float] | None = None,
    crs: Any = None,
) -> Source:
    """Open a local raster file and find where it lies.

    Args:
        path: a GeoTIFF, or a picture; GDAL reads a world file beside it.
        argument: what a message calls the file.
        bounds_deg: west, south, east, north of the outer edges of a picture without georeference, whose rows
            and columns run evenly in ``crs`` (EPSG:4326 unless given; EPSG:3857 for a screenshot of a web map).
        crs: coordinate reference system of a file that names none; else that of a ``.prj`` beside it.

    Raises:
        MapError: the file is missing, is no raster that may be opened, or cannot be placed on the Earth.
    """
    import rasterio

    file = _local_file(path, argument)
    with map_errors(argument, file):
        dataset = rasterio.open(file, driver=_driver(file, argument))
        transform, own_crs = dataset.transform, dataset.crs
    width, height = dataset.width, dataset.height
    own = None if transform.is_identity else _centred(transform)
    if bounds_deg is not None:
        if own is not None:
            raise MapError(f"bounds_deg: expected none for a file with a georeference of its own, {file}")
        found = earth_crs(crs if crs is not None else "EPSG:4326", "crs")
        matrix = _from_bounds(bounds_deg, found, width, height)
    elif own is not None:
        found, matrix = _crs_of(file, argument, own_crs, crs), own
    else:
        raise MapError(
            f"{argument}: {file} is a picture without georeference; give bounds_deg=(west, south, east, "
            "north), or a world file and its CRS (control points and RPCs are not used: gdalwarp them first)"
        )
    return Source(file, dataset, _checked(Grid(width, height, matrix, found), argument, file))


def _checked(grid: Grid, argument: str, file: Path) -> Grid:
    matrix = grid.pixel_to_crs
    determinant = np.linalg.det(matrix[:, :2]) if np.isfinite(matrix).all() else 0.0
    if determinant == 0.0:
        raise MapError(f"{argument}: expected a finite, invertible geotransform, got {matrix.tolist()} in {file}")
    lon, lat = grid.pixels_of(_wgs84())[0](grid.centre_px)
    if not (abs(lat) <= 90.0 and abs(lon) <= 540.0):  # NaN and infinity fail too
        raise MapError(f"{argument}: the centre of {file} lies outside its CRS {grid.crs.name!r}")
    return grid


def _local_file(path: str | os.PathLike[str], argument: str) -> Path:
    text = os.fspath(path)
    if "://" in text or text.startswith("/vsi"):
        raise MapError(f"{argument}: expected the path of a local file, got {text!r}")
    file = Path(text).absolute()
    if not file.is_file():
        what = "is a directory" if file.is_dir() else "is no file" if file.exists() else "does not exist"
        raise MapError(f"{argument}: expected a local file, but {text!r} {what}")
    return file


def _driver(file: Path, argument: str) -> str:
    with file.open("rb") as stream:
        head = stream.read(1024)
    for driver, starts in SIGNATURES:
        if head.startswith(starts):
            return driver
    got = (
        "a VRT, which can point anywhere: write it out with gdal_translate"
        if b"<VRTDataset" in head
        else "neither"
    )
    formats = ", ".join(driver for driver, _ in SIGNATURES)
    raise MapError(f"{argument}: expected a raster file of {formats}; {file} is {got}")


def _centred(transform: Any) -> Array:
    """The one place where GDAL's origin, the outer corner of the first pixel, moves to that pixel's centre."""
    a, b, c, d, e, f = list(transform)[:6]
    return np.array([[a, b, c + (a + b) / 2.0], [d, e, f + (d + e) / 2.0]])


def _crs_of(file: Path, argument: str, own: Any, given: Any) -> CRS:
    beside = file.with_suffix(".prj")
    if own:
        found = earth_crs(own.to_wkt(), argument)
        if given is not None and not earth_crs(given, "crs").equals(found, ignore_axis_order=True):
            raise MapError(f"crs: expected none, since {file} says {found.name!r}, got {given!r}")
        return found
    if given is not None:
        return earth_crs(given, "crs")
    if beside.is_file():
        return earth_crs(beside.read_text(encoding="utf-8", errors="replace"), argument)
    raise MapError(
        f"{argument}: {file} names no CRS; give crs=, such as 'EPSG:32636', or put {beside.name} beside it"
    )


def _from_bounds(bounds_deg: tuple[float, float, float, float], crs: CRS, width: int, height: int) -> Array:
    from pyproj import Transformer

    west, south, east, north = bounds_deg
    if not (-180 <= west < east <= 540 and -90 <= south < north <= 90):  # NaN fails too
        raise MapError(f"bounds_deg: expected west < east and south < north in degrees, got {tuple(bounds_deg)}")
    to_crs = Transformer.from_crs(4326, crs, always_xy=True)
    x, y = to_crs.transform(np.array([west, east, west, east]), np.array([north, south, south, north]))
    step_x, step_y = (x[1] - x[0]) / width, (y[1] - y[0]) / height
    slant_x, slant_y = np.abs([x[2] - x[0], x[3] - x[1]]).max(), np.abs([y[3] - y[0], y[2] - y[1]]).max()
    if not (slant_x <= step_x / 2 and slant_y <= -step_y / 2):
        raise MapError(
            f"bounds_deg: the corners are no rectangle in crs {crs.name!r}; expected one of its own bounds"
        )
    return np.array([[step_x, 0.0, x[0] + step_x / 2.0], [0.0, step_y, y[0] + step_y / 2.0]])


class GrayReader:
    """Grey values and validity of a raster, window by window.

    Colour becomes ITU-R BT.601 luma of the first three bands; a colour table is expanded first. Element types
    other than uint8 are stretched linearly between two percentiles of the valid pixels.

    Raises:
        MapError: an element type that is no picture, pixels that cannot be read, or none that is valid.
    """

    def __init__(self, source: Source, *, find_collar: bool = True) -> None:
        self._source, self._lock = source, threading.Lock()
        dataset = source.dataset
        self.dtype = dataset.dtypes[0]
        if self.dtype not in DTYPES:
            raise MapError(f"map: expected pixels of {', '.join(DTYPES)}, got {self.dtype} in {source.path}")
        self._bands = [1, 2, 3] if dataset.count >= 3 else [1]
        self._palette = _palette(dataset)
        shrink = max(1.0, max(dataset.width, dataset.height) / OVERVIEW_PX)
        size = (math.ceil(dataset.height / shrink), math.ceil(dataset.width / shrink))
        data, valid = self._read(Window(0, 0, dataset.width, dataset.height), size)
        self._collars = _collars(data) if find_collar and valid.all() else {}
        for value, area in self._collars.items():
            valid &= ~((data == value).all(axis=0) & area)
        self.invalid_share = 1.0 - float(valid.mean())
        if not valid.any():
            raise MapError(f"map: expected at least one valid pixel, got only nodata in {source.path}")
        self._limits: Array | None = None
        if data.dtype != np.uint8:
            self._limits = np.percentile(_luma(data)[valid], STRETCH_PERCENT)

    def _read(self, window: Window, size: tuple[int, int]) -> tuple[NDArray[Any], Mask]:
        from rasterio.windows import Window as RasterWindow

        crop = RasterWindow(window.x0, window.y0, window.width_px, window.height_px)
        with self._lock, map_errors("map", self._source.path):  # a GDAL dataset serves one thread at a time
            data = self._source.dataset.read(self._bands, window=crop, out_shape=(len(self._bands), *size))
            mask = self._source.dataset.dataset_mask(window=crop, out_shape=size)
        if self._palette is not None:
            data = self._palette[:, data[0]]
        return data, (mask >= 128) & np.isfinite(data).all(axis=0)

    def read(self, window: Window) -> tuple[Gray, Mask]:
        """Grey values and validity (h, w) of a window that lies inside."""
        data, valid = self._read(window, (window.height_px, window.width_px))
        for value, area in self._collars.items():
            height, width = area.shape
            y = (np.arange(window.y0, window.y0 + window.height_px) + 0.5) * height / self._source.grid.height_px
            x = (np.arange(window.x0, window.x0 + window.width_px) + 0.5) * width / self._source.grid.width_px
            valid &= ~((data == value).all(axis=0) & area[np.ix_(y.astype(int), x.astype(int))])
        luma = _luma(data)
        if self._limits is None:
            return luma, valid
        low, high = self._limits
        scaled = (np.nan_to_num(luma, nan=low, posinf=high, neginf=low) - low) * (255.0 / max(high - low, 1e-30))
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8), valid


def _palette(dataset: Any) -> Gray | None:
    """(3, N) colours of a colour table, or None."""
    if dataset.count != 1 or dataset.colorinterp[0].name != "palette":
        return None
    table = np.zeros((3, int(np.iinfo(dataset.dtypes[0]).max) + 1), np.uint8)
    for index, colour in dataset.colormap(1).items():
        table[:, index] = colour[:3]
    return table


def _luma(data: NDArray[Any]) -> NDArray[Any]:
    """(h, w) of bands (1 or 3, h, w): uint8 stays uint8, everything else becomes float32."""
    import cv2

    data = data if data.dtype == np.uint8 else data.astype(np.float32)
    if len(data) == 1:
        return np.asarray(data[0])
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(np.moveaxis(data, 0, -1)), cv2.COLOR_RGB2GRAY))


def _collars(data: NDArray[Any]) -> dict[float, Mask]:
    """For pure black and pure white: the area that hangs together with the border.

    It is widened by a pixel, because the border of a collar falls between the pixels of a thinned copy.
    """
    import cv2

    found: dict[float, Mask] = {}
    for value in (0, np.iinfo(data.dtype).max) if data.dtype.kind in "ui" else (0,):
        count, labels = cv2.connectedComponents((data == value).all(axis=0).astype(np.uint8), connectivity=4)
        touches = np.zeros(count, np.bool_)
        touches[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
        touches[0] = False  # label 0 is everything of another colour
        area = touches[labels]
        if area.mean() > COLLAR_SHARE:
            found[float(value)] = cv2.dilate(area.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return found


def metric_grid(source: Grid) -> Grid:
    """The north-up UTM grid (zone of the source's centre) that covers it in the finer of its two steps."""
    from pyproj import CRS

    lon, lat = source.pixels_of(_wgs84())[0](source.centre_px)
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    utm = CRS.from_epsg((32600 if lat >= 0 else 32700) + zone)
    to_utm = source.pixels_of(utm)[0]
    near = to_utm(source.centre_px + np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]]))
    outline = to_utm(source.lattice())
    low, high = outline.min(axis=0), outline.max(axis=0)
    with np.errstate(invalid="ignore"):  # places that UTM cannot show are infinite; the check below refuses them
        step = float(min(np.linalg.norm(near[1] - near[0]), np.linalg.norm(near[3] - near[2])))
        size = (high - low) / step
    if not (np.isfinite(size).all() and size.max() <= MAX_SIDE_PX):
        raise MapError(f"map: expected at most {MAX_SIDE_PX} px a side on a UTM grid, got {size} of {step:.3g} m")
    matrix = np.array([[step, 0.0, low[0] + step / 2.0], [0.0, -step, high[1] - step / 2.0]])
    return Grid(math.ceil(size[0] - 1e-6), math.ceil(size[1] - 1e-6), matrix, utm)


def _resampled(
    reader: GrayReader, source: Grid, grid: Grid, block_px: int = 1024
) -> Iterator[tuple[Window, Gray]]:
    """Blocks of the metric grid as (2, h, w) grey and alpha; grey is cubic, alpha 255 where all of it is valid."""
    import cv2

    to_source = source.pixels_of(grid.crs)[1]
    warp = Warp(lambda xy: to_source(apply_affine(grid.pixel_to_crs, xy)), grid.box(), tolerance=0.005)
    limit = np.array([source.width_px, source.height_px])
    for y0 in range(0, grid.height_px, block_px):
        for x0 in range(0, grid.width_px, block_px):
            window = Window(x0, y0, min(block_px, grid.width_px - x0), min(block_px, grid.height_px - y0))
            columns = np.arange(x0, x0 + window.width_px, dtype=np.float64)
            rows = np.arange(y0, y0 + window.height_px, dtype=np.float64)
            at = np.nan_to_num(warp.on_grid(columns, rows), nan=-9.0, posinf=-9.0, neginf=-9.0)
            low = np.clip(np.floor(at.min(axis=(0, 1))) - 3, 0, limit).astype(int)
            high = np.clip(np.ceil(at.max(axis=(0, 1))) + 4, 0, limit).astype(int)
            block = np.zeros((2, window.height_px, window.width_px), np.uint8)
            if (high > low).all():
                gray, valid = reader.read(Window(*low.tolist(), *(high - low).tolist()))
                x, y = np.moveaxis((at - low).astype(np.float32), -1, 0)
                # One pixel eroded plus the reach of bilinear make up the reach of cubic.
                solid = cv2.erode(valid.astype(np.uint8) * 255, np.ones((3, 3), np.uint8))
                block[0] = cv2.remap(gray, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
                solid = cv2.remap(solid, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                inside = ((at >= -0.5) & (at <= limit - 0.5)).all(axis=-1)
                block[1] = np.where((np.asarray(solid) == 255) & inside, 255, 0)
            yield window, block


def metric_copy(source: Source, reader: GrayReader, cache_dir: str | os.PathLike[str] | None) -> Source:
    """The source on its metric grid, from the cache where it was made before.

    The key is the SHA-256 of the content of the file and of the files beside it that GDAL uses, of the
    georeference, and of the version of this format. A cached file that does not fit or cannot be read is made
    anew; where the cache cannot be written, the copy lives in the temporary directory as long as the map.
    """
    grid = metric_grid(source.grid)
    default = os.path.join(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "scenematch")
    target = Path(cache_dir if cache_dir is not None else default) / f"{_key(source)}.tif"
    cached = _cached(target, grid)
    if cached is not None:
        return cached
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        return _written(target, reader, source.grid, grid)
    except OSError:
        folder = tempfile.mkdtemp(prefix="scenematch-")
    with map_errors("map", source.path):
        copy = _written(Path(folder) / target.name, reader, source.grid, grid)
    weakref.finalize(copy, shutil.rmtree, folder, ignore_errors=True)
    return copy


def _key(source: Source) -> str:
    digest = hashlib.sha256(f"{GRID_VERSION} {source.grid.crs.to_wkt()}".encode())
    digest.update(source.grid.pixel_to_crs.tobytes())
    for name in source.dataset.files:
        with open(name, "rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def _cached(path: Path, grid: Grid) -> Source | None:
    """The cached file, or None where it is missing, broken or of another grid."""
    try:
        source = open_source(path)
        same = np.allclose(source.grid.pixel_to_crs, grid.pixel_to_crs, rtol=0, atol=1e-6)
        size = (source.grid.width_px, source.grid.height_px)
        if not same or size != (grid.width_px, grid.height_px) or source.dataset.count != 2:
            return None
        with map_errors("map", path):  # a file cut short shows in its last rows
            whole = size[0] * size[1] <= MEMORY_LIMIT_PX
            source.dataset.read(window=((0 if whole else size[1] - 1, size[1]), (0, size[0])))
    except (MapError, OSError):
        return None
    return source


def _written(target: Path, reader: GrayReader, source: Grid, grid: Grid) -> Source:
    """Write the metric grid beside its place and move it there in one step.

    Raises:
        OSError: it cannot be written.
    """
    import rasterio
    from rasterio.enums import ColorInterp
    from rasterio.windows import Window as RasterWindow

    (a, _, c), (_, e, f) = grid.pixel_to_crs
    profile = {"driver": "GTiff", "dtype": "uint8", "count": 2, "crs": grid.crs.to_wkt(), "bigtiff": "if_safer"}
    profile |= {"tiled": True, "compress": "deflate", "width": grid.width_px, "height": grid.height_px}
    profile["transform"] = rasterio.Affine(a, 0.0, c - a / 2.0, 0.0, e, f - e / 2.0)
    handle, name = tempfile.mkstemp(suffix=".tif", dir=target.parent)
    os.close(handle)
    try:
        with rasterio.open(name, "w", **profile) as dataset:
            dataset.colorinterp = (ColorInterp.gray, ColorInterp.alpha)
            for window, block in _resampled(reader, source, grid):
                place = RasterWindow(window.x0, window.y0, window.width_px, window.height_px)
                dataset.write(block, window=place)
        os.replace(name, target)
    finally:
        Path(name).unlink(missing_ok=True)
    copy = _cached(target, grid)
    if copy is None:
        raise OSError(f"{target} could not be read back")
    return copy


def _overlap(grid: Grid, other: Grid) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First pixel (x, y), and the one past the last, of another grid under a grid, widened by two."""
    points = warp_between(grid, other)(grid.lattice())
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return np.zeros(2, np.intp), np.zeros(2, np.intp)
    limit = np.array([other.width_px, other.height_px])
    low = np.clip(np.floor(points.min(axis=0)) - 2, 0, limit).astype(np.intp)
    return low, np.clip(np.ceil(points.max(axis=0)) + 3, 0, limit).astype(np.intp)


def read_surface(source: Source, grid: Grid) -> tuple[NDArray[np.float32], Grid]:
    """Heights (NaN where unknown) and grid of the part of a surface model that lies under a map.

    It is thinned by averages where it would not fit in memory.

    Raises:
        MapError: it cannot be read, or lies elsewhere.
    """
    from rasterio.enums import Resampling
    from rasterio.windows import Window as RasterWindow

    dataset, own = source.dataset, source.grid
    if np.dtype(dataset.dtypes[0]).kind not in "iuf":
        raise MapError(f"surface: expected heights as real numbers, got {dataset.dtypes[0]} in {source.path}")
    low, high = _overlap(grid, own)
    if not (high > low).all():
        raise MapError(f"surface: expected one that overlaps the map, got {source.path}")
    size = high - low
    thin = max(1.0, math.sqrt(float(size.prod()) / (MEMORY_LIMIT_PX // 4)))
    shape = tuple(int(v) for v in np.ceil(size / thin)[::-1])
    with map_errors("surface", source.path):
        data = dataset.read(
            1,
            window=RasterWindow(*low.tolist(), *size.tolist()),
            out_shape=shape,
            masked=True,
            resampling=Resampling.nearest if thin == 1.0 else Resampling.average,
        )
    heights = data.astype(np.float32).filled(np.nan) * dataset.scales[0] + dataset.offsets[0]
    heights[~((heights > HEIGHT_RANGE_M[0]) & (heights < HEIGHT_RANGE_M[1]))] = np.nan
    scale = size / np.array(shape[::-1])
    # Pixel x of the thinned copy covers the file's pixels around low + (x + 0.5) * scale - 0.5.
    crop_to_file = np.column_stack([np.diag(scale), low + 0.5 * scale - 0.5])
    linear = own.pixel_to_crs[:, :2] @ crop_to_file[:, :2]
    origin = apply_affine(own.pixel_to_crs, crop_to_file[:, 2])
    crop = Grid(shape[1], shape[0], np.column_stack([linear, origin]), own.crs)
    return heights.astype(np.float32), crop
