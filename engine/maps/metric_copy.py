"""The metric copy of a map, used for matching: north-up in UTM, created once and cached on disk.

A map in degrees, rotated or with oblong pixels is resampled; a large one without overviews gets them. A copy is
one GeoTIFF, renamed when it is complete, with its size and time noted beside it: one that was changed or cut off
is created again.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from engine.errors import MapError
from engine.maps.grids import Grid, Warp, by_corner, warp_between, wgs84, window_about
from engine.maps.rasters import BLOCK_PX, Gray, GrayReader, Mask, Source, is_large, map_errors, open_source
from engine.maps.tiles import tiles_under
from engine.runtime.cache_folder import cache_folder, replaced
from engine.values import Window

GRID_VERSION = 2
"""Part of the key of cached copies; raise it with every change in how they are created."""
FACTORS = [2, 4, 8, 16, 32]
"""Of the overviews of a large copy. The file is padded to a multiple, so that their pixels lie on the levels'."""
MAX_SIDE_PX = 1_000_000
"""Largest side of a copy."""
ProgressCallback = Callable[[int, int], None]
"""Called while a copy is created, with the number of pixels done and in all."""
_Block = tuple[Window, Gray]


def _metric_grid(source: Grid) -> Grid:
    """The north-up UTM grid (zone of the source's centre) that covers it in the finer of its two steps."""
    from pyproj import CRS

    lon, lat = source.pixels_of(wgs84())[0](source.centre_px)
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    utm = CRS.from_epsg((32600 if lat >= 0 else 32700) + zone)
    to_utm = source.pixels_of(utm)[0]
    near = to_utm(source.centre_px + np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]]))
    outline = to_utm(source.points())
    low, high = outline.min(axis=0), outline.max(axis=0)
    with np.errstate(invalid="ignore"):  # outside UTM's range coordinates are infinite, and refused below
        step = float(min(np.linalg.norm(near[1] - near[0]), np.linalg.norm(near[3] - near[2])))
        size = (high - low) / step
    if not (np.isfinite(size).all() and size.max() <= MAX_SIDE_PX):
        raise MapError(f"map: expected at most {MAX_SIDE_PX} px a side on a UTM grid, got {size} of {step:.3g} m")
    matrix = np.array([[step, 0.0, low[0] + step / 2.0], [0.0, -step, high[1] - step / 2.0]])
    return Grid(math.ceil(size[0] - 1e-6), math.ceil(size[1] - 1e-6), matrix, utm)


def _copied(reader: GrayReader, source: Grid, grid: Grid) -> Iterator[_Block]:
    """The copy block by block, as (2, h, w) grey and alpha."""
    whole = Window(0, 0, grid.width_px, grid.height_px)
    warp = warp_between(grid, source)
    for window in tiles_under(whole, BLOCK_PX, (grid.height_px, grid.width_px)):
        gray, valid = reader.read(window) if grid is source else _resampled(reader, source, warp, window)
        yield window, np.stack([gray, valid.astype(np.uint8) * 255])


def _resampled(reader: GrayReader, source: Grid, warp: Warp, window: Window) -> tuple[Gray, Mask]:
    """A block of the copy: grey is cubic, and valid if all pixels that it is made of are."""
    import cv2

    rows, columns = np.mgrid[window.slices]
    at = np.nan_to_num(warp(np.stack([columns, rows], axis=-1)), nan=-9.0, posinf=-9.0, neginf=-9.0)
    seen = window_about(at.reshape(-1, 2), (source.height_px, source.width_px), margin_px=3)
    if seen is None:
        return np.zeros(at.shape[:2], np.uint8), np.zeros(at.shape[:2], np.bool_)
    gray, valid = reader.read(seen)
    x, y = np.moveaxis((at - [seen.x0, seen.y0]).astype(np.float32), -1, 0)
    # One pixel eroded plus the reach of bilinear make up the reach of cubic.
    solid = cv2.erode(valid.astype(np.uint8) * 255, np.ones((3, 3), np.uint8))
    cubic = cv2.remap(gray, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    linear = cv2.remap(solid, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = ((at >= -0.5) & (at <= [source.width_px - 0.5, source.height_px - 0.5])).all(axis=-1)
    return np.asarray(cubic, np.uint8), (np.asarray(linear) == 255) & inside


def open_readable(
    source: Source, cache_dir: str | os.PathLike[str] | None, on_copy: ProgressCallback | None
) -> tuple[Source, GrayReader, dict[str, Any]]:
    """The source or its metric copy, the reader of that, and facts about the source.

    Raises:
        MapError: the file cannot be read.
    """
    original = None if is_large(source.grid.area_px) else GrayReader(source)
    smallest_px = source.grid.area_px // max([1, *source.dataset.overviews(1)]) ** 2
    if not source.grid.is_metric or is_large(smallest_px):
        used = open_metric_copy(source, original, cache_dir, on_copy)
        reader = GrayReader(used, find_collar=False)
    else:
        used, reader = source, original or GrayReader(source)
    facts = {
        "path": str(source.path),
        "driver": source.dataset.driver,
        "bands": source.dataset.count,
        "dtype": source.dataset.dtypes[0],
        "source_size_px": [source.grid.width_px, source.grid.height_px],
        "source_nodata_share": (original or reader).invalid_share,
        "resampled": not source.grid.is_metric,
    }
    return used, reader, facts


def open_metric_copy(
    source: Source,
    reader: GrayReader | None,
    cache_dir: str | os.PathLike[str] | None,
    on_progress: ProgressCallback | None = None,
) -> Source:
    """The source on its metric grid, from the cache if it has a copy.

    The key is a hash of the names, sizes and times of the file and of those beside it that GDAL uses, of the
    georeference, and of the version of this format. If the cache cannot be written, the copy stays in the
    temporary directory while the map is open.

    Args:
        source: the map.
        reader: of its pixels, None to create one if it is needed.
        cache_dir: folder of the copies; None for the user's cache.
        on_progress: called while a copy is created, not if there is one already.
    """
    grid = source.grid if source.grid.is_metric else _metric_grid(source.grid)
    cache = cache_folder() if cache_dir is None else Path(cache_dir)
    name = Path(_key(source), "map.tif")
    try:
        return _built(cache / name, source, reader, grid, on_progress)
    except OSError:
        folder = tempfile.mkdtemp(prefix="scenematch-")
    with map_errors("map", source.path):
        copy = _built(Path(folder) / name, source, reader, grid, on_progress)
    weakref.finalize(copy, shutil.rmtree, folder, ignore_errors=True)
    return copy


def _key(source: Source) -> str:
    digest = hashlib.sha256(f"{GRID_VERSION} {source.grid.crs.to_wkt()}".encode())
    digest.update(source.grid.pixel_to_crs.tobytes())
    if source.dataset.driver == "VRT":
        digest.update(source.dataset.name.encode())  # its XML: the positions of the tiles
    for name in source.dataset.files:
        digest.update(f"{Path(name).name} {_state(Path(name))}".encode())
    return digest.hexdigest()


def _state(path: Path) -> str:
    """Size and time of a file, as text; those of a file that changed differ."""
    found = path.stat()
    return f"{found.st_size} {found.st_mtime_ns}"


def _built(
    path: Path, source: Source, reader: GrayReader | None, grid: Grid, on_progress: ProgressCallback | None
) -> Source:
    """The copy in a file, after it was written if it is missing or is not as it was left.

    Raises:
        OSError: it cannot be written.
    """
    noted = path.with_suffix(".state")
    left = noted.read_text("ascii", "replace") if noted.is_file() else ""
    if not path.is_file() or _state(path) != left:
        report = on_progress or (lambda done_px, all_px: None)
        report(0, grid.area_px)  # before the file is read for the first time
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as part:
            _write(part, grid, _copied(reader or GrayReader(source), source.grid, grid), report)
        noted.write_text(_state(path), "ascii")
    copy = open_source(path)
    return replace(copy, grid=replace(copy.grid, width_px=grid.width_px, height_px=grid.height_px))


def _write(path: Path, grid: Grid, blocks: Iterable[_Block], report: ProgressCallback) -> None:
    """Write a copy as a GeoTIFF without its empty blocks; one of a large map has overviews.

    Raises:
        OSError: it cannot be written.
    """
    import rasterio
    from rasterio import Affine
    from rasterio.enums import ColorInterp, Resampling

    width_px, height_px = (-(-n // FACTORS[-1]) * FACTORS[-1] for n in (grid.width_px, grid.height_px))
    done_px = 0
    profile = {"driver": "GTiff", "dtype": "uint8", "count": 2, "crs": grid.crs.to_wkt(), "bigtiff": "if_safer"}
    profile |= {"tiled": True, "compress": "deflate", "width": width_px, "height": height_px}
    profile |= {"transform": Affine(*by_corner(grid)), "sparse_ok": True}
    with rasterio.Env(SPARSE_OK_OVERVIEW="ON"), rasterio.open(path, "w", **profile) as dataset:
        dataset.colorinterp = (ColorInterp.gray, ColorInterp.alpha)
        for window, block in blocks:
            dataset.write(block, window=window.slices)
            done_px += window.area_px
            report(done_px, grid.area_px)
        if is_large(grid.area_px):
            dataset.build_overviews(FACTORS, Resampling.average)
