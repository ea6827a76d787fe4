"""Colours of a map window for pictures, read from the map's file in any grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engine.maps.grids import by_corner, part_grid
from engine.maps.rasters import STRETCH_PERCENT, map_errors, palette_of, stretched
from engine.orthomap import OrthoMap
from engine.values import Window

Rgb = NDArray[np.uint8]


def map_colours(site: OrthoMap, window: Window, shape: tuple[int, int]) -> Rgb | None:
    """Colours of a window; None if the map has no file, or that no three bands and no colour table.

    Args:
        site: the map.
        window: in full-resolution pixels, inside the map.
        shape: rows and columns of the result.

    Returns:
        (h, w, 3) RGB; undefined on nodata. Bands other than uint8 are stretched between two percentiles.

    Raises:
        MapError: the file cannot be read.
    """
    from rasterio import Affine
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    source = site.open_file()
    if source is None:
        return None
    palette = palette_of(source.dataset)
    if source.dataset.count < 3 and palette is None:
        return None
    given, wanted = source.grid, part_grid(site.grid, window, shape)
    view = {
        "src_crs": given.crs.to_wkt(), "src_transform": Affine(*by_corner(given)),
        "crs": wanted.crs.to_wkt(), "transform": Affine(*by_corner(wanted)),
        "height": shape[0], "width": shape[1],
        "resampling": Resampling.bilinear if palette is None else Resampling.nearest,
    }  # fmt: skip
    with map_errors("map", source.path), WarpedVRT(source.dataset, **view) as warped:
        bands = warped.read([1, 2, 3] if palette is None else [1])
    return _stretched(np.moveaxis(bands if palette is None else palette[:, bands[0]], 0, -1))


def _stretched(colour: NDArray[np.generic]) -> Rgb:
    """Bands (h, w, 3) as uint8, all stretched alike."""
    if colour.dtype == np.uint8:
        return np.ascontiguousarray(colour, np.uint8)
    values = np.asarray(colour, np.float64)
    known = values[np.isfinite(values)]
    return stretched(values, np.percentile(known, STRETCH_PERCENT) if known.size else np.array([0.0, 1.0]))
