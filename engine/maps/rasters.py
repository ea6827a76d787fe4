"""Raster files: opening, georeference and grey values.

Convention:
    GDAL's origin, the outer corner of the first pixel, is converted in :func:`_centred`; a :class:`Source` has the
    pixels of :mod:`engine.maps.grids`, centres at integers.

Nodata is what the file marks (tag, mask, alpha, NaN). A file without marks may still have a collar, which counts
as nodata: pixels whose bands are all exactly 0, or all the largest value, connected to the picture's border and
covering more than :data:`COLLAR_SHARE` of it in total. Dark pixels inside do not count.
"""

from __future__ import annotations

import math
import os
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import MapError
from engine.maps.grids import Array, Grid, earth_crs, wgs84
from engine.maps.raster_formats import local_path, open_raster
from engine.values import Window

if TYPE_CHECKING:
    from pyproj import CRS

Gray = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Bounds = tuple[float, float, float, float]
"""West, south, east, north."""

DTYPES = "uint8", "uint16", "int16", "float32", "float64"
"""Element types of a map."""
COLLAR_SHARE = 0.005
STRETCH_PERCENT = (2.0, 98.0)
_GDAL_CACHE_BYTES = 128 * 2**20  # GDAL's own cache is a twentieth of the machine's memory
MEMORY_LIMIT_PX = 256 * 2**20
"""Grey maps of up to this many pixels are held in memory; larger ones are read window by window."""
COARSE_LIMIT_PX = 16 * 2**20
"""Of those the first level of up to this many pixels, and the coarser ones, are held in memory."""
BLOCK_PX = 1024
"""A whole file is read in strips of so many rows, and copied in blocks with this side."""
OVERVIEW_PX = math.isqrt(COARSE_LIMIT_PX)
"""Stretch and collar are found on a copy of at most this many pixels a side."""


def is_large(area_px: int) -> bool:
    """Whether a map of so many pixels is read window by window instead of held in memory."""
    return area_px > MEMORY_LIMIT_PX


@dataclass(frozen=True, eq=False)
class Source:
    """An open raster file and its grid."""

    path: Path
    dataset: Any
    grid: Grid


@contextmanager
def map_errors(argument: str, path: Path) -> Iterator[None]:
    """Turn rasterio's errors into one line, and keep GDAL's block cache small while it reads."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            with rasterio.Env(GDAL_CACHEMAX=_GDAL_CACHE_BYTES):
                yield
        except (RasterioError, OSError, ValueError) as error:
            reason = str(error.__cause__ or error).splitlines()[0]
            raise MapError(f"{argument}: cannot read {path}: {reason}") from None


def open_source(
    path: str | os.PathLike[str],
    argument: str = "map",
    *,
    bounds_deg: Bounds | None = None,
    bounds_crs: Bounds | None = None,
    crs: Any = None,
) -> Source:
    """Open a local raster with its georeference.

    Args:
        path: a GeoTIFF, a picture (GDAL reads a world file beside it), MBTiles, a GeoPackage, or a folder
            of georeferenced tiles.
        argument: name of the file in messages.
        bounds_deg: west, south, east, north of the outer edges of a picture without georeference, whose rows
            and columns run evenly in ``crs`` (EPSG:4326 unless given; EPSG:3857 for a screenshot of a web map).
        bounds_crs: the same in the units of ``crs``.
        crs: coordinate reference system, if the file names none; None takes that of a ``.prj`` beside it.

    Raises:
        MapError: the file is missing, is not a supported raster, or cannot be placed on the Earth.
    """
    file = local_path(path, argument)
    with map_errors(argument, file):
        dataset = open_raster(file, argument)
        transform, own_crs = dataset.transform, dataset.crs
    if dataset.count == 0:
        names = ", ".join(name.rpartition(":")[2] for name in dataset.subdatasets)
        raise MapError(f"{argument}: expected a GeoPackage with one raster, got {names} in {file}")
    size = dataset.width, dataset.height
    if not transform.is_identity:
        for name, bounds in (("bounds_deg", bounds_deg), ("bounds_crs", bounds_crs)):
            if bounds is not None:
                raise MapError(f"{name}: expected none for a file with a georeference of its own, {file}")
        grid = Grid(*size, _centred(transform), _crs_of(file, argument, own_crs, crs))
    elif bounds_deg is not None or bounds_crs is not None:
        found = earth_crs(crs if crs is not None else "EPSG:4326", "crs")
        edges = bounds_crs if bounds_deg is None else _from_degrees(bounds_deg, found, *size)
        assert edges is not None  # one of the two was given
        grid = Grid(*size, _from_edges(edges, *size), found)
    else:
        raise MapError(
            f"{argument}: {file} is a picture without georeference; give `bounds_deg` (west, south, east, "
            "north), or a world file and its CRS (control points and RPCs are not used: gdalwarp them first)"
        )
    return Source(file, dataset, _checked(grid, argument, file))


def vertical_datum(dataset: Any) -> str | None:
    """Name of the system in which a dataset's heights are metres above the sea; None if it names no such one.

    Only a compound CRS does, such as EPSG:32636+5773; heights above the ellipsoid are the third axis of another.
    """
    from pyproj import CRS

    crs = CRS.from_wkt(dataset.crs.to_wkt()) if dataset.crs else None
    vertical = next((part for part in crs.sub_crs_list if part.is_vertical), None) if crs is not None else None
    if vertical is None or "ellips" in vertical.name.lower():  # although older files state it as a datum
        return None
    axis = vertical.axis_info[0]
    return str(vertical.name) if axis.direction == "up" and axis.unit_conversion_factor == 1.0 else None


def _checked(grid: Grid, argument: str, file: Path) -> Grid:
    matrix = grid.pixel_to_crs
    determinant = np.linalg.det(matrix[:, :2]) if np.isfinite(matrix).all() else 0.0
    if determinant == 0.0:
        raise MapError(f"{argument}: expected a finite, invertible geotransform, got {matrix.tolist()} in {file}")
    lon, lat = grid.pixels_of(wgs84())[0](grid.centre_px)
    if not (abs(lat) <= 90.0 and abs(lon) <= 540.0):  # NaN and infinity fail too
        raise MapError(f"{argument}: the centre of {file} lies outside its CRS {grid.crs.name!r}")
    return grid


def _centred(transform: Any) -> Array:
    """The only conversion of GDAL's origin, the outer corner of the first pixel, to that pixel's centre."""
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
        f"{argument}: {file} names no CRS; give `crs`, such as EPSG:32636, or put {beside.name} beside it"
    )


def _from_degrees(bounds_deg: Bounds, crs: CRS, width: int, height: int) -> Bounds:
    """The outer edges in the units of the CRS, if the picture is upright there."""
    from pyproj import Transformer

    west, south, east, north = bounds_deg
    if not (-180 <= west < east <= 540 and -90 <= south < north <= 90):  # NaN fails too
        raise MapError(f"bounds_deg: expected west < east and south < north in degrees, got {tuple(bounds_deg)}")
    to_crs = Transformer.from_crs(4326, crs, always_xy=True)
    x, y = to_crs.transform(*np.meshgrid([west, east], [north, south]))  # (2, 2) each, corners as in the picture
    step_x, step_y = (x[0, 1] - x[0, 0]) / width, (y[0, 0] - y[1, 0]) / height
    if not (np.ptp(x, axis=0).max() <= step_x / 2 and np.ptp(y, axis=1).max() <= step_y / 2):
        raise MapError(
            f"bounds_deg: expected a rectangle in crs {crs.name!r}, in its own units; the corners form none"
        )
    return float(x[0, 0]), float(y[1, 0]), float(x[0, 1]), float(y[0, 0])


def _from_edges(bounds: Bounds, width: int, height: int) -> Array:
    """The affine of pixel centres from the outer edges."""
    west, south, east, north = bounds
    return _centred(((east - west) / width, 0.0, west, 0.0, (south - north) / height, north))


class GrayReader:
    """Grey values and validity of a raster, window by window.

    Colour becomes ITU-R BT.601 luma of the first three bands; a colour table is expanded first. Element types
    other than uint8 are stretched linearly between two percentiles of the valid pixels.

    Raises:
        MapError: an unsupported element type, pixels that cannot be read, or none that is valid.
    """

    def __init__(self, source: Source, *, find_collar: bool = True) -> None:
        self._source, self._lock = source, threading.Lock()
        dataset, grid = source.dataset, source.grid  # a copy's file is padded beyond its grid
        dtype = dataset.dtypes[0]
        if dtype not in DTYPES:
            raise MapError(f"map: expected pixels of {', '.join(DTYPES)}, got {dtype} in {source.path}")
        self._bands = [1, 2, 3] if dataset.count >= 3 else [1]
        self._palette = palette_of(dataset)
        shrink = max(1.0, max(grid.width_px, grid.height_px) / OVERVIEW_PX)
        size = (math.ceil(grid.height_px / shrink), math.ceil(grid.width_px / shrink))
        data, valid = self._read(Window(0, 0, grid.width_px, grid.height_px), size)
        self._collars = _collars(data) if find_collar and valid.all() else {}
        for value, area in self._collars.items():
            valid &= ~((data == value).all(axis=0) & area)
        self.invalid_share = 1.0 - float(valid.mean())
        if not valid.any():
            raise MapError(f"map: expected at least one valid pixel, got only nodata in {source.path}")
        is_gray = data.dtype == np.uint8
        self._limits = None if is_gray else np.percentile(_luma(data)[valid], STRETCH_PERCENT)

    def _read(self, window: Window, size: tuple[int, int], *, smooth: bool = False) -> tuple[NDArray[Any], Mask]:
        """Bands and validity of a window in pixels of the file, resampled to ``size`` (rows, columns)."""
        from rasterio.enums import Resampling

        # GDAL reads the best overview; its pixels are offset from the level's if the size is not a multiple.
        how = Resampling.average if smooth and self._palette is None else Resampling.nearest
        shape = (len(self._bands), *size)
        with self._lock, map_errors("map", self._source.path):  # a GDAL dataset serves one thread at a time
            data = self._source.dataset.read(self._bands, window=window.slices, out_shape=shape, resampling=how)
            mask = self._source.dataset.dataset_mask(window=window.slices, out_shape=size)
        if self._palette is not None:
            data = self._palette[:, data[0]]
        valid = np.asarray(mask >= 128)
        return data, valid & np.isfinite(data).all(axis=0) if data.dtype.kind == "f" else valid

    def read(self, window: Window, level: int = 0) -> tuple[Gray, Mask]:
        """Read a window.

        Args:
            window: in pixels of the level, inside it.
            level: of the map's pyramid, averaged by GDAL from the file's nearest overview.

        Returns:
            (h, w) uint8 grey and (h, w) bool validity.

        Raises:
            MapError: the file cannot be read.
        """
        full = Window(*(v << level for v in (window.x0, window.y0, window.width_px, window.height_px)))
        data, valid = self._read(full, (window.height_px, window.width_px), smooth=level > 0)
        for value, area in self._collars.items():
            height, width = area.shape
            grid, scale = self._source.grid, 2.0**level
            y = (np.arange(window.y0, window.y1) + 0.5) * scale * height / grid.height_px
            x = (np.arange(window.x0, window.x1) + 0.5) * scale * width / grid.width_px
            valid &= ~((data == value).all(axis=0) & area[np.ix_(y.astype(int), x.astype(int))])
        luma = _luma(data)
        gray = luma if self._limits is None else stretched(luma, self._limits)
        return gray, valid


def palette_of(dataset: Any) -> Gray | None:
    """Find the colour table of a raster.

    Args:
        dataset: an open raster.

    Returns:
        (3, N) uint8 red, green and blue by index, or None without a table.
    """
    if dataset.count != 1 or dataset.colorinterp[0].name != "palette":
        return None
    table = np.zeros((3, int(np.iinfo(dataset.dtypes[0]).max) + 1), np.uint8)
    for index, colour in dataset.colormap(1).items():
        table[:, index] = colour[:3]
    return table


def stretched(values: NDArray[Any], limits: Array) -> Gray:
    """Values as grey levels.

    Args:
        values: of any shape; NaN is the lower limit.
        limits: (2,) values that become 0 and 255.

    Returns:
        The same shape, uint8.
    """
    low, high = limits
    scaled = (np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) * (255.0 / max(high - low, 1e-30))
    return np.asarray(np.clip(np.rint(scaled), 0, 255), np.uint8)


def _luma(data: NDArray[Any]) -> NDArray[Any]:
    """(h, w) of bands (1 or 3, h, w): uint8 stays uint8, everything else becomes float32."""
    import cv2

    data = data if data.dtype == np.uint8 else data.astype(np.float32)
    if len(data) == 1:
        return np.asarray(data[0])
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(np.moveaxis(data, 0, -1)), cv2.COLOR_RGB2GRAY))


def _collars(data: NDArray[Any]) -> dict[float, Mask]:
    """For pure black and pure white: the area connected to the border, by value.

    It is dilated by a pixel, because the border of a collar falls between the pixels of a decimated copy.
    """
    import cv2

    found: dict[float, Mask] = {}
    for value in (0, np.iinfo(data.dtype).max) if data.dtype.kind in "ui" else (0,):
        count, labels = cv2.connectedComponents((data == value).all(axis=0).astype(np.uint8), connectivity=4)
        touches = np.zeros(count, np.bool_)
        touches[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
        touches[0] = False  # label 0 is every other colour
        area = touches[labels]
        if area.mean() > COLLAR_SHARE:
            found[float(value)] = cv2.dilate(area.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return found
