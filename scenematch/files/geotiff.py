"""Write GeoTIFF files from an array and its affine transform."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.errors import DtypeError, MapError, OptionError, ShapeError
from engine.runtime.cache_folder import replaced

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
        path: the file, replaced in one step if it exists.
        array: (H, W) or (H, W, 3) of uint8, uint16, int16, float32 or float64.
        pixel_to_crs: (2, 3) affine transform to units of the CRS.
        crs: EPSG code of the CRS, or the CRS.
        nodata: the value of pixels without data, or None.
        tags: metadata items, such as :data:`engine.maps.accuracy.GEOREFERENCE_TAG`.

    Raises:
        ShapeError: an argument has the wrong shape.
        DtypeError: the element type is not one of those above.
        OptionError: the affine transform is not finite, or is singular.
        MapError: the EPSG code is unknown, or the file cannot be written.
    """
    import rasterio
    from rasterio.errors import RasterioError

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
    bands = array if array.ndim == 3 else array[:, :, None]
    try:
        profile = tiled_profile(bands.shape, bands.dtype.name, corner, crs)
        with replaced(Path(path)) as part, rasterio.open(part, "w", nodata=nodata, **profile) as file:
            file.write(np.moveaxis(bands, 2, 0))
            if tags:
                file.update_tags(**{name: str(value) for name, value in tags.items()})
    except (RasterioError, OSError, ValueError) as error:
        raise MapError(f"{path}: cannot be written: {str(error).splitlines()[0]}") from None


def tiled_profile(
    shape: tuple[int, ...], dtype: str, pixel_corner_to_crs: NDArray[np.float64], crs: int | CRS
) -> dict[str, Any]:
    """What rasterio needs to create a tiled, losslessly compressed GeoTIFF.

    Args:
        shape: rows, columns and bands.
        dtype: of the pixels.
        pixel_corner_to_crs: (2, 3) affine transform from (x, y, 1), with pixel corners at integers.
        crs: EPSG code of the CRS, or the CRS.

    Raises:
        CRSError: rasterio's, a ValueError: the EPSG code is unknown.
    """
    import rasterio
    from rasterio.transform import Affine

    height, width, count = shape
    profile = {
        "driver": "GTiff", "width": width, "height": height, "count": count, "dtype": dtype,
        "crs": rasterio.CRS.from_epsg(crs) if isinstance(crs, int) else rasterio.CRS.from_wkt(crs.to_wkt()),
        "transform": Affine(*pixel_corner_to_crs.ravel().tolist()),
        "tiled": True, "blockxsize": 256, "blockysize": 256, "BIGTIFF": "IF_SAFER",
        "compress": "deflate", "predictor": 3 if dtype.startswith("float") else 2,
    }  # fmt: skip
    return profile | {"photometric": "RGB"} if count == 3 else profile
