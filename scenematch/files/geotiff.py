"""Write GeoTIFF files from an array and its affine transform."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.errors import MapError
from engine.runtime.cache_folder import replaced

if TYPE_CHECKING:
    from pyproj import CRS


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
        array: (H, W) or (H, W, 3) of numbers, or (H, W, 4) with an alpha.
        pixel_to_crs: (2, 3) affine transform to units of the CRS.
        crs: EPSG code of the CRS, or the CRS.
        nodata: the value of pixels without data, or None.
        tags: metadata items, such as :data:`engine.maps.accuracy.GEOREFERENCE_TAG`.

    Raises:
        MapError: the EPSG code is unknown, or the file cannot be written.
    """
    import rasterio
    from rasterio.errors import RasterioError

    corner = np.array(pixel_to_crs, np.float64)
    corner[:, 2] -= 0.5 * (corner[:, 0] + corner[:, 1])
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
    colours = {3: {"photometric": "RGB"}, 4: {"photometric": "RGB", "alpha": "yes"}}
    return profile | colours.get(count, {})
