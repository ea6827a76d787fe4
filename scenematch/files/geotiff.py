"""Write GeoTIFF files from an array and its affine transform."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.errors import DtypeError, MapError, OptionError, ShapeError

if TYPE_CHECKING:
    from pyproj import CRS

_DTYPES = ("uint8", "uint16", "int16", "float32", "float64")


def write_geotiff(
    path: str | Path,
    array: NDArray[Any],
    pixel_to_crs: ArrayLike,
    crs: int | CRS,
    nodata: float | None = None,
    *,
    tags: Mapping[str, object] | None = None,
) -> None:
    """Write a tiled, losslessly compressed GeoTIFF.

    Convention:
        ``pixel_to_crs`` (2, 3) maps (x, y, 1), with pixel centres at integers, to the CRS. GeoTIFF's origin is the
        corner of the top-left pixel; the offset of half a pixel is applied here.

    Args:
        path: the file, overwritten if it exists.
        array: (H, W) or (H, W, 3) of uint8, uint16, int16, float32 or float64.
        pixel_to_crs: (2, 3) affine transform to units of the CRS.
        crs: EPSG code of the CRS, or the CRS.
        nodata: the value of pixels without data, or None.
        tags: metadata items, such as :data:`engine.maps.rasters.GEOREFERENCE_TAG`.

    Raises:
        ShapeError: an argument has the wrong shape.
        DtypeError: the element type is not one of those above.
        OptionError: the affine transform is not finite, or is singular.
        MapError: the EPSG code is unknown, or the file cannot be written.
    """
    array, affine = np.asarray(array), np.asarray(pixel_to_crs, dtype=np.float64)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3) or 0 in array.shape:
        raise ShapeError(f"array: expected (H, W) or (H, W, 3) with at least one pixel, got {array.shape}")
    if array.dtype.name not in _DTYPES:
        raise DtypeError(f"array: expected one of {', '.join(_DTYPES)}, got {array.dtype}")
    if affine.shape != (2, 3):
        raise ShapeError(f"pixel_to_crs: expected (2, 3), got {affine.shape}")
    if not np.isfinite(affine).all() or np.linalg.det(affine[:, :2]) == 0.0:
        raise OptionError(f"pixel_to_crs: expected a finite, invertible affine transform, got {affine.tolist()}")
    corner = affine.copy()
    corner[:, 2] -= 0.5 * (affine[:, 0] + affine[:, 1])
    _write(Path(path), array if array.ndim == 3 else array[:, :, None], corner, crs, nodata, tags or {})


def _write(
    path: Path,
    bands: NDArray[Any],
    corner: NDArray[np.float64],
    crs: int | CRS,
    nodata: float | None,
    tags: Mapping[str, object],
) -> None:
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.transform import Affine

    profile: dict[str, Any] = {
        "driver": "GTiff",
        "height": bands.shape[0],
        "width": bands.shape[1],
        "count": bands.shape[2],
        "dtype": bands.dtype.name,
        "transform": Affine(*corner.ravel().tolist()),
        "nodata": nodata,
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
        "compress": "deflate",
        "predictor": 3 if bands.dtype.kind == "f" else 2,
        "BIGTIFF": "IF_SAFER",
    }
    if bands.shape[2] == 3:
        profile["photometric"] = "RGB"
    try:
        known = rasterio.CRS.from_epsg(crs) if isinstance(crs, int) else rasterio.CRS.from_wkt(crs.to_wkt())
        with rasterio.open(path, "w", crs=known, **profile) as file:
            file.write(np.moveaxis(bands, 2, 0))
            if tags:
                file.update_tags(**{name: str(value) for name, value in tags.items()})
    except (RasterioError, OSError, ValueError) as error:
        raise MapError(f"{path}: cannot be written: {str(error).splitlines()[0]}") from None
