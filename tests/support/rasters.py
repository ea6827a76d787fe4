"""Small rasters in files."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from rasterio.windows import Window as RasterWindow

from engine import OrthoMap, Window


def whole(site: OrthoMap, level: int = 0) -> Window:
    """All of a level of a map."""
    rows, columns = site.level_shape(level)
    return Window(0, 0, columns, rows)


def from_corner(pixel_to_crs: Any) -> Affine:
    """The transform of a file, which counts from the corner of the first pixel, not from its centre."""
    return Affine(*np.ravel(pixel_to_crs)) @ Affine.translation(-0.5, -0.5)


def write_raster(
    path: Path, data: Any, *, colorinterp: Any = None, colormap: Any = None, tags: Any = None, **profile: Any
) -> Path:
    """Write (H, W) or (N, H, W), a GeoTIFF unless its profile says otherwise."""
    data = np.asarray(data)
    data = data[None] if data.ndim == 2 else data
    count, height, width = data.shape
    settings = {"driver": "GTiff", "dtype": data.dtype, **profile}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a picture without georeference is meant
        with rasterio.open(path, "w", width=width, height=height, count=count, **settings) as dataset:
            if colorinterp:
                dataset.colorinterp = colorinterp
            if colormap:
                dataset.write_colormap(1, colormap)
            if tags:
                dataset.update_tags(**tags)
            dataset.write(data)
    return path


def write_sparse(path: Path, data: Any, left_top: Any, side_px: int, resampling: Any, **profile: Any) -> Path:
    """Write a sparse GeoTIFF of ``side_px`` squared with overviews: (H, W) at a column and row, else nodata."""
    height, width = data.shape
    settings = {"driver": "GTiff", "dtype": "uint8", "count": 1, "nodata": 0, "width": side_px, "height": side_px}
    settings |= {"tiled": True, "sparse_ok": True, "compress": "deflate"}
    with rasterio.Env(SPARSE_OK_OVERVIEW="ON"), rasterio.open(path, "w", **settings, **profile) as dataset:
        dataset.write(data, 1, window=RasterWindow(*left_top, width, height))
        dataset.build_overviews([2, 4, 8, 16, 32], resampling)
    return path
