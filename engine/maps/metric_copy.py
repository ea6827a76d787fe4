"""The metric copy of a map, used for matching: north-up in UTM, created once and cached on disk.

A map in degrees, rotated or with oblong pixels is resampled; a large one without overviews gets them. A copy is a
folder of tiles. Each is written and renamed in one step, and a list records the hash of its content, so that an
interrupted copy can continue and a damaged tile is created again.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from engine.errors import MapError
from engine.maps import xyz_tiles
from engine.maps.grids import Grid, Warp, apply_affine, wgs84, window_about
from engine.maps.rasters import MEMORY_LIMIT_PX, Gray, GrayReader, Source, map_errors, open_source, stored_levels
from engine.maps.tiles import within
from engine.runtime.cache_folder import cache_folder
from engine.values import Window

GRID_VERSION = 1
"""Part of the key of cached copies; raise it with every change in how they are created."""
TILE_PX = 8192
"""Side of the tiles of a copy; those of a large one have overviews down to a thirty-second."""
COARSEST_PX = 16384
"""A large file whose smallest overview has a longer side than this is copied."""
LIST = "tiles.txt"
"""In the folder of a copy: a line per tile, its name and its SHA-256, or "-" if it has no valid pixel."""
ProgressCallback = Callable[[int, int], None]
"""Called while a copy is created, with the number of pixels done and in all."""
_Block = tuple[Window, Gray]
_CACHED_HASH_BYTES = 1 << 22  # the hashes of larger files are cached by size and time
_FACTORS = [2, 4, 8, 16, 32]


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
    with np.errstate(invalid="ignore"):  # outside UTM's range coordinates are infinite, and refused below
        step = float(min(np.linalg.norm(near[1] - near[0]), np.linalg.norm(near[3] - near[2])))
        size = (high - low) / step
    if not (np.isfinite(size).all() and size.max() <= xyz_tiles.MAX_SIDE_PX):
        raise MapError(
            f"map: expected at most {xyz_tiles.MAX_SIDE_PX} px a side on a UTM grid, got {size} of {step:.3g} m"
        )
    matrix = np.array([[step, 0.0, low[0] + step / 2.0], [0.0, -step, high[1] - step / 2.0]])
    return Grid(math.ceil(size[0] - 1e-6), math.ceil(size[1] - 1e-6), matrix, utm)


def is_large(grid: Grid) -> bool:
    """Whether a map on this grid is read window by window instead of held in memory."""
    return grid.width_px * grid.height_px > MEMORY_LIMIT_PX


def needs_copy(source: Source) -> bool:
    """Whether a map needs a copy: its grid is not metric, or it is large without overviews."""
    grid = source.grid
    if not grid.is_metric:
        return True
    longest_px = max(grid.width_px, grid.height_px) >> stored_levels(source)[-1]
    return is_large(grid) and longest_px > COARSEST_PX


def _blocks(part: Window, block_px: int = 1024) -> Iterator[Window]:
    """Windows that cover a window, row by row; the last ones are smaller."""
    for y0 in range(part.y0, part.y1, block_px):
        for x0 in range(part.x0, part.x1, block_px):
            yield Window(x0, y0, min(block_px, part.x1 - x0), min(block_px, part.y1 - y0))


def _copied(reader: GrayReader, source: Grid, grid: Grid, part: Window) -> Iterator[_Block]:
    """Blocks of a part of the copy's grid as (2, h, w) grey and alpha."""
    if grid is not source:
        yield from _resampled(reader, source, grid, part)
        return
    for window in _blocks(part):
        gray, valid = reader.read(window)
        yield window, np.stack([gray, valid.astype(np.uint8) * 255])


def _resampled(reader: GrayReader, source: Grid, grid: Grid, part: Window) -> Iterator[_Block]:
    """The same, resampled: grey is cubic, alpha 255 where all of it is valid."""
    import cv2

    to_source = source.pixels_of(grid.crs)[1]
    warp = Warp(lambda xy: to_source(apply_affine(grid.pixel_to_crs, xy)), grid.box(), tolerance=0.005)
    for window in _blocks(part):
        columns = np.arange(window.x0, window.x1, dtype=np.float64)
        rows = np.arange(window.y0, window.y1, dtype=np.float64)
        at = np.nan_to_num(warp.on_grid(columns, rows), nan=-9.0, posinf=-9.0, neginf=-9.0)
        seen = window_about(at.reshape(-1, 2), (source.height_px, source.width_px), margin_px=3)
        block = np.zeros((2, window.height_px, window.width_px), np.uint8)
        if seen is not None:
            gray, valid = reader.read(seen)
            x, y = np.moveaxis((at - [seen.x0, seen.y0]).astype(np.float32), -1, 0)
            # One pixel eroded plus the reach of bilinear make up the reach of cubic.
            solid = cv2.erode(valid.astype(np.uint8) * 255, np.ones((3, 3), np.uint8))
            block[0] = cv2.remap(gray, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            solid = cv2.remap(solid, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            inside = ((at >= -0.5) & (at <= [source.width_px - 0.5, source.height_px - 0.5])).all(axis=-1)
            block[1] = np.where((np.asarray(solid) == 255) & inside, 255, 0)
        yield window, block


class _Progress:
    """Counts and reports the finished pixels of a copy."""

    def __init__(self, grid: Grid, on_progress: ProgressCallback | None) -> None:
        self._done_px, self._all_px, self._on_progress = 0, grid.width_px * grid.height_px, on_progress

    def add(self, count_px: int, *, quietly: bool = False) -> None:
        self._done_px += count_px
        if self._on_progress is not None and not quietly:
            self._on_progress(self._done_px, self._all_px)


def open_metric_copy(
    source: Source,
    reader: GrayReader | None,
    cache_dir: str | os.PathLike[str] | None,
    on_progress: ProgressCallback | None = None,
) -> Source:
    """The source on its metric grid, from the cache if it has a copy.

    The key is the SHA-256 of the content of the file and of the files beside it that GDAL uses, of the
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
    name = _key(source, cache)
    try:
        return _built(cache / name, source, reader, grid, on_progress)
    except OSError:
        folder = tempfile.mkdtemp(prefix="scenematch-")
    with map_errors("map", source.path):
        copy = _built(Path(folder) / name, source, reader, grid, on_progress)
    weakref.finalize(copy, shutil.rmtree, folder, ignore_errors=True)
    return copy


def _key(source: Source, cache: Path) -> str:
    digest = hashlib.sha256(f"{GRID_VERSION} {source.grid.crs.to_wkt()}".encode())
    digest.update(source.grid.pixel_to_crs.tobytes())
    if source.dataset.driver == xyz_tiles.DRIVER:  # reading all files only for the key would take too long
        digest.update(xyz_tiles.fingerprint(source.path))
        return digest.hexdigest()
    if source.dataset.driver == "VRT":
        digest.update(source.dataset.name.encode())  # its XML: the positions of the tiles
    for name in source.dataset.files:
        digest.update(bytes.fromhex(_file_hash(Path(name), cache)))
    return digest.hexdigest()


def _file_hash(path: Path, cache: Path) -> str:
    """SHA-256 of a file's content; for a large file cached while its size and time stay the same."""
    found = path.stat()
    identity = hashlib.sha256(f"{path.absolute()} {found.st_size} {found.st_mtime_ns} {found.st_ino}".encode())
    note = cache / "hashes" / identity.hexdigest()
    if found.st_size > _CACHED_HASH_BYTES and note.is_file() and note.stat().st_size == 64:
        return note.read_text(encoding="ascii")
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    if found.st_size > _CACHED_HASH_BYTES:
        with contextlib.suppress(OSError):
            note.parent.mkdir(parents=True, exist_ok=True)
            note.write_text(digest, encoding="ascii")
    return digest


def _built(
    folder: Path, source: Source, reader: GrayReader | None, grid: Grid, on_progress: ProgressCallback | None
) -> Source:
    """The copy in a folder, after tiles that are missing or differ from the list were written.

    Raises:
        OSError: a tile cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    listed, progress = _read_list(folder / LIST), _Progress(grid, on_progress)
    tiles = list(_blocks(Window(0, 0, grid.width_px, grid.height_px), TILE_PX))
    for tile in tiles:
        target = folder / f"{tile.y0 // TILE_PX:04d}-{tile.x0 // TILE_PX:04d}.tif"
        if listed.get(target.name) == _state(target):
            progress.add(tile.area_px, quietly=True)
            continue
        progress.add(0)  # reports progress before the first block is done
        reader = reader or GrayReader(source)
        corner = tile in (tiles[0], tiles[-1])  # they define the extent of the grid
        blocks = _copied(reader, source.grid, grid, tile)
        _write(target, grid, tile, blocks, progress, is_corner=corner)
        with (folder / LIST).open("a", encoding="ascii") as stream:
            stream.write(f"{target.name} {_state(target)}\n")
    return open_source(folder)


def _state(tile: Path) -> str:
    """What the list records of a tile: its hash, or "-" if it has no file, since no pixel of it is valid."""
    return _file_hash(tile, tile.parent.parent) if tile.exists() else "-"


def _read_list(path: Path) -> dict[str, str]:
    """The recorded hash of each tile; the last of several lines counts, a truncated line does not."""
    if not path.is_file():
        return {}
    lines = (line.split() for line in path.read_text(encoding="ascii", errors="replace").splitlines())
    return {words[0]: words[1] for words in lines if len(words) == 2}


def _profile(grid: Grid, part: Window) -> dict[str, Any]:
    """Options of rasterio for the GeoTIFF of a part of the copy."""
    from rasterio import Affine

    (a, _, c), (_, e, f) = grid.pixel_to_crs
    x, y = c + a * (part.x0 - 0.5), f + e * (part.y0 - 0.5)
    profile = {"driver": "GTiff", "dtype": "uint8", "count": 2, "crs": grid.crs.to_wkt(), "bigtiff": "if_safer"}
    profile |= {"tiled": True, "compress": "deflate", "width": part.width_px, "height": part.height_px}
    return profile | {"transform": Affine(a, 0.0, x, 0.0, e, y)}


def _write(
    target: Path, grid: Grid, part: Window, blocks: Iterator[_Block], progress: _Progress, *, is_corner: bool
) -> None:
    """Write a part of the copy under a temporary name and rename it, if it has a valid pixel or is a corner.

    Raises:
        OSError: it cannot be written.
    """
    import rasterio
    from rasterio.enums import ColorInterp, Resampling

    handle, name = tempfile.mkstemp(suffix=".part", dir=target.parent)
    os.close(handle)
    is_kept = is_corner
    try:
        with rasterio.open(name, "w", **_profile(grid, part)) as dataset:
            dataset.colorinterp = (ColorInterp.gray, ColorInterp.alpha)
            for window, block in blocks:
                dataset.write(block, window=within(window, part))
                is_kept = is_kept or bool(block[1].any())
                progress.add(window.area_px)
            if is_large(grid):
                dataset.build_overviews(_FACTORS, Resampling.average)
        if is_kept:
            os.replace(name, target)
        else:
            target.unlink(missing_ok=True)
    finally:
        Path(name).unlink(missing_ok=True)
