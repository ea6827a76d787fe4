"""Sources of a map: a file, copied to a metric grid if necessary, or checked arrays."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import DtypeError, MapError, ShapeError
from engine.maps.grids import Array, Grid, earth_crs
from engine.maps.metric_copy import ProgressCallback, is_large, needs_copy, open_metric_copy
from engine.maps.rasters import Gray, GrayReader, Mask, Source


def open_readable(
    source: Source, cache_dir: str | os.PathLike[str] | None, on_copy: ProgressCallback | None
) -> tuple[Source, GrayReader, dict[str, Any]]:
    """The source or its metric copy, the reader of that, and facts about the source.

    Raises:
        MapError: the file cannot be read.
    """
    if not needs_copy(source):
        reader = GrayReader(source)
        return source, reader, _facts(source, reader.invalid_share)
    original = None if is_large(source.grid) else GrayReader(source)
    copy = open_metric_copy(source, original, cache_dir, on_copy)
    reader = GrayReader(copy, find_collar=False)
    return copy, reader, _facts(source, (original or reader).invalid_share)


def _facts(source: Source, nodata_share: float) -> dict[str, Any]:
    """Facts about the file for :meth:`engine.OrthoMap.info`."""
    return {
        "path": str(source.path),
        "driver": source.dataset.driver,
        "bands": source.dataset.count,
        "dtype": source.dataset.dtypes[0],
        "source_size_px": [source.grid.width_px, source.grid.height_px],
        "source_nodata_share": nodata_share,
        "resampled": not source.grid.is_metric,
    }


def check_arrays(gray: Gray, valid: Mask, heights: NDArray[np.float32] | None) -> None:
    """Refuse arrays that do not form a map.

    Args:
        gray: (H, W) uint8.
        valid: (H, W) bool.
        heights: (H, W), or None.

    Raises:
        ShapeError: an array has another shape.
        DtypeError: ``gray`` is not uint8.
    """
    if gray.ndim != 2 or 0 in gray.shape:
        raise ShapeError(f"gray: expected (H, W) with at least one pixel, got {gray.shape}")
    if gray.dtype != np.uint8:
        raise DtypeError(f"gray: expected uint8, got {gray.dtype}")
    for name, array in (("valid", valid), ("surface_m", heights)):
        if array is not None and array.shape != gray.shape:
            raise ShapeError(f"{name}: expected the shape of gray {gray.shape}, got {array.shape}")


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
