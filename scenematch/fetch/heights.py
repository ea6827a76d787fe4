"""Fetch surface models for a map: cut them from one file, or from one-degree files like Copernicus GLO-30's.

Heights are copied in their own grid without resampling, since the engine reads any grid. From remote files
(cloud-optimised GeoTIFFs) only the needed byte ranges are read.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import MapError, OptionError
from engine.geo import Array
from engine.maps.rasters import open_source, vertical_datum
from scenematch.fetch.grid import Bounds, reason_of
from scenematch.fetch.urls import PLACEHOLDER, check_url, shown, user_agent
from scenematch.files.geotiff import write_geotiff

if TYPE_CHECKING:
    from pyproj import CRS

NODATA = -32768.0
GLO30, GLO30_DATUM = "Copernicus_DSM", "EPSG:3855"
"""Part of the names of Copernicus' files; their heights are above the geoid EGM2008."""
GLO30_SLOPE_SIGMA_DEG = 0.5
"""Two heights of GLO-30 differ by less than 2 m from the truth in 90 % (its specification): 1.2 m over 150 m."""
_MARGIN_PX = 2
_MARGIN_DEG = 0.001  # GLO-30's files begin and end half a pixel off whole degrees


@dataclass(frozen=True, slots=True)
class Heights:
    """The part of a surface model under a map.

    Attributes:
        heights_m: (H, W) float32, NaN where unknown.
        pixel_to_crs: (2, 3) affine transform from pixel centres (x, y, 1).
        crs: compound if the vertical datum is known.
        datum: name of the vertical datum; None if it is unknown.
    """

    heights_m: NDArray[np.float32]
    pixel_to_crs: Array
    crs: CRS
    datum: str | None


def files_for(template: str, bounds_deg: Bounds) -> list[str]:
    """The files or URLs of a source of heights for an area.

    Args:
        template: one file or URL, or many, with ``{lat}`` and ``{lon}`` for the degrees of their south-western
            corner, such as N48 and E016.
        bounds_deg: west, south, east, north.

    Raises:
        OptionError: a placeholder is unknown or missing, or the URL is invalid.
    """
    names = set(PLACEHOLDER.findall(template))
    stray = set("{}") & set(PLACEHOLDER.sub("", template))
    if stray or names not in (set(), {"lat", "lon"}):
        raise OptionError(
            f"surface: expected {{lat}} and {{lon}} as placeholders, or none, in {shown(template)!r}"
        )
    if "://" in template:
        check_url("surface", template)
    if not names:
        return [template]
    west, south, east, north = bounds_deg
    rows = range(math.floor(south - _MARGIN_DEG), math.floor(north + _MARGIN_DEG) + 1)
    columns = range(math.floor(west - _MARGIN_DEG), math.floor(east + _MARGIN_DEG) + 1)
    return [
        template.format(lat=f"{'SN'[lat >= 0]}{abs(lat):02d}", lon=f"{'WE'[lon >= 0]}{abs(lon):03d}")
        for lat in rows
        for lon in columns
    ]


def read_part(
    files: Sequence[str], map_bounds: Bounds, map_crs: CRS, datum: str | None, timeout_s: float
) -> Heights:
    """Heights under a map.

    Args:
        files: local files or URLs; if there are several, missing ones are gaps such as the sea.
        map_bounds: of the map, in its CRS.
        map_crs: its CRS.
        datum: code of the vertical datum; None uses the files' own, else EGM2008 for names like GLO-30's.
        timeout_s: of a server, without a byte.

    Raises:
        OptionError: the datum is not vertical in metres, or contradicts the files'.
        MapError: no file has heights there, or one cannot be read.
    """
    import rasterio

    settings = {
        "GDAL_HTTP_USERAGENT": user_agent(),
        "GDAL_HTTP_MAX_RETRY": 3,
        "GDAL_HTTP_RETRY_DELAY": 2,
        "GDAL_HTTP_CONNECTTIMEOUT": math.ceil(timeout_s),
        "GDAL_HTTP_LOW_SPEED_TIME": math.ceil(timeout_s),  # without a byte; the whole transfer may take longer
        "GDAL_HTTP_LOW_SPEED_LIMIT": 1,
        "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",  # no requests for side files
    }
    with rasterio.Env(**settings), ExitStack() as opened:
        found = {shown(file): _opened(file) for file in files}
        datasets = {name: opened.enter_context(data) for name, data in found.items() if data is not None}
        if not datasets:
            raise MapError(f"surface: expected a file of heights, but there is no {' and no '.join(found)}")
        return _joined(datasets, map_bounds, map_crs, datum)


def _opened(file: str) -> Any:
    """Open a file of heights; None if it does not exist."""
    import rasterio
    from rasterio.errors import RasterioError

    if "://" not in file:
        if not Path(file).exists():
            return None
        return open_source(file, "surface").dataset
    try:
        return rasterio.open(f"/vsicurl/{file}", driver="GTiff")
    except RasterioError as error:
        reason = reason_of(error)
    if reason.endswith(("HTTP response code: 404", "HTTP response code: 410")):
        return None
    raise MapError(f"{shown(file)}: cannot be read as a GeoTIFF in byte ranges: {shown(reason)}")


def _joined(datasets: Mapping[str, Any], map_bounds: Bounds, map_crs: CRS, datum: str | None) -> Heights:
    """The part of all datasets, by their names, under a map, on the grid of the first one."""
    from pyproj.crs import CompoundCRS
    from rasterio.enums import Resampling
    from rasterio.errors import RasterioError
    from rasterio.merge import merge

    name, first = next(iter(datasets.items()))
    horizontal, own = _horizontal(first, name), vertical_datum(first)
    vertical = _vertical(name, own, datum)
    box = _grid_box(first, name, horizontal, map_bounds, map_crs)
    right, down = first.transform.a, first.transform.e
    how = {"nodata": NODATA, "dtype": "float32", "indexes": [1], "resampling": Resampling.bilinear}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PendingDeprecationWarning)  # rasterio's own, of affine 3
            data, _ = merge(list(datasets.values()), bounds=box, res=(right, -down), **how)
    except (RasterioError, OSError, ValueError) as error:
        raise MapError(f"surface: cannot read {name}: {shown(str(error).splitlines()[0])}") from None
    heights = np.where(data[0] == NODATA, np.nan, data[0] * first.scales[0] + first.offsets[0]).astype(np.float32)
    if not np.isfinite(heights).any():
        raise MapError(f"surface: expected heights under the map, got none in {name}")
    affine = np.array([[right, 0.0, box[0] + 0.5 * right], [0.0, down, box[3] + 0.5 * down]])
    if vertical is None:
        return Heights(heights, affine, _crs(first), own)
    compound = CompoundCRS(f"{horizontal.name} + {vertical.name}", [horizontal, vertical])
    return Heights(heights, affine, compound, str(vertical.name))


def _crs(dataset: Any) -> CRS:
    from pyproj import CRS

    return CRS.from_wkt(dataset.crs.to_wkt())


def _horizontal(dataset: Any, name: str) -> CRS:
    """The horizontal part of a dataset's CRS.

    Raises:
        MapError: it names none.
    """
    if not dataset.crs:
        raise MapError(f"surface: {name} names no CRS")
    crs = _crs(dataset)
    return crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()


def _grid_box(dataset: Any, name: str, crs: CRS, map_bounds: Bounds, map_crs: CRS) -> Bounds:
    """The bounds of a map in a dataset's CRS, widened to whole pixels of its grid and a margin.

    Raises:
        MapError: the grid is rotated.
    """
    from pyproj import Transformer

    t = dataset.transform
    if t.b or t.d or t.a <= 0.0 or t.e >= 0.0:
        raise MapError(f"surface: expected a north-up grid, got a rotated one in {name}")
    west, south, east, north = Transformer.from_crs(map_crs, crs, always_xy=True).transform_bounds(*map_bounds)
    x0, y0 = math.floor((west - t.c) / t.a) - _MARGIN_PX, math.floor((north - t.f) / t.e) - _MARGIN_PX
    x1, y1 = math.ceil((east - t.c) / t.a) + _MARGIN_PX, math.ceil((south - t.f) / t.e) + _MARGIN_PX
    return t.c + x0 * t.a, t.f + y1 * t.e, t.c + x1 * t.a, t.f + y0 * t.e


def _vertical(name: str, own: str | None, datum: str | None) -> CRS | None:
    """The vertical CRS for a file that states none.

    Raises:
        OptionError: the datum is not vertical in metres, or the file states its own.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if datum is None:
        return CRS.from_user_input(GLO30_DATUM) if own is None and GLO30 in name else None
    try:
        found = CRS.from_user_input(datum)
    except CRSError:
        found = None
    if found is None or not found.is_vertical or found.axis_info[0].unit_conversion_factor != 1.0:
        raise OptionError(
            f"surface_datum: expected a vertical datum in metres, such as {GLO30_DATUM} for EGM2008, got {datum!r}"
        )
    if own is not None:
        raise OptionError(f"surface_datum: expected none, since {name} says {own!r}, got {datum!r}")
    return found


def write_heights(heights: Heights, out: Path, tags: Mapping[str, object]) -> None:
    """Write a tiled, losslessly compressed GeoTIFF of heights.

    Args:
        heights: the heights.
        out: the file, replaced in one step.
        tags: metadata items.

    Raises:
        MapError: it cannot be written.
    """
    known_m = np.nan_to_num(heights.heights_m, nan=NODATA)
    write_geotiff(out, known_m, heights.pixel_to_crs, heights.crs, NODATA, tags=tags)
