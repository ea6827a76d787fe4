"""Small rasters in files."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.enums import Resampling


def write_raster(
    path: Path, data: Any, *, colorinterp: Any = None, colormap: Any = None, tags: Any = None, overviews: Any = (),
    **profile: Any,
) -> Path:  # fmt: skip
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
            if overviews:
                dataset.build_overviews(list(overviews), Resampling.average)
    return path
