"""The metric copy of a map: resampled once onto a north-up UTM grid, and kept in a cache for the next time."""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from engine.errors import MapError
from engine.grids import Grid, Warp, apply_affine, wgs84
from engine.rasters import MEMORY_LIMIT_PX, Gray, GrayReader, Source, map_errors, open_source
from engine.types import Window

MAX_SIDE_PX = 1_000_000
GRID_VERSION = 1
"""Part of the key of cached grids; to be raised with every change of how they are made."""


def _metric_grid(source: Grid) -> Grid:
    """The north-up UTM grid (zone of the source's centre) that covers it in the finer of its two steps."""
    from pyproj import CRS

    lon, lat = source.pixels_of(wgs84())[0](source.centre_px)
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


def open_metric_copy(source: Source, reader: GrayReader, cache_dir: str | os.PathLike[str] | None) -> Source:
    """The source on its metric grid, from the cache where it was made before.

    The key is the SHA-256 of the content of the file and of the files beside it that GDAL uses, of the
    georeference, and of the version of this format. A cached file that does not fit or cannot be read is made
    anew; where the cache cannot be written, the copy lives in the temporary directory as long as the map.
    """
    grid = _metric_grid(source.grid)
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
