"""Tile caches: a folder of pictures named z/x/y.png, as tile servers and mirrors have them, read as one raster.

A tile's name gives its position. So a folder of 100,000 tiles is listed, not opened: only the first tile's size is
read, and each other tile is decoded, and its size checked, when its pixels are read.

Convention:
    Web Mercator (EPSG:3857). Zoom level z has 2^z x 2^z tiles. Column x counts from 180 degrees west, row y from
    the north. In a folder with a ``tilemapresource.xml``, which TMS writes, files count rows from the south.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from engine.errors import MapError

Pixels = NDArray[np.uint8]

ENDINGS = ("png", "jpg", "jpeg", "webp")
"""Of a tile's name. The format is found by the first bytes: mirrors write JPEG into files called png."""
FORMATS = ("PNG", "JPEG", "WEBP")
MAX_ZOOM = 30
MAX_SIDE_PX = 1_000_000
"""Largest side of the map that the tiles span."""
RESOURCE = "tilemapresource.xml"
_MERCATOR_CODES = (
    "3857",
    "3785",
    "900913",
    "41001",
    "102100",
    "102113",
)  # current and former codes of Web Mercator
_HALF_WORLD_M = math.pi * 6378137.0
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # Pillow's, of eight bits or fewer
_CACHE_BYTES = 64 << 20  # of decoded tiles, which adjacent windows share


class _Part(NamedTuple):
    """A window as rasterio has it."""

    col_off: float
    row_off: float
    width: float
    height: float


@dataclass(frozen=True, eq=False)
class _Zoom:
    """The tiles of one zoom level.

    Attributes:
        zoom: the level.
        corner: column and row, from the north, of the first tile of the map.
        kinds: (rows, columns) index into :data:`ENDINGS` plus 1; 0 where there is no tile.
    """

    zoom: int
    corner: tuple[int, int]
    kinds: Pixels

    def kind_of(self, column: int, row: int) -> int:
        """Of a tile by its column and row on the level, from the north."""
        return int(self.kinds[row - self.corner[1], column - self.corner[0]])


class TileCache:
    """A folder of tiles with the part of rasterio's interface that :class:`engine.maps.rasters.GrayReader` uses.

    The deepest zoom level is the map, from its first column and row to its last. A coarser one serves as an
    overview if it has a tile over each of the deepest; what no tile of the deepest covers is nodata on it too.

    Args:
        folder: of the zoom levels.
        levels: zoom levels by how many levels they are coarser than the deepest.
        tile_px: side of a tile, a multiple of the coarsest level's factor.
        south_up: whether rows are named from the south.
    """

    count, dtypes, scales, offsets = 4, ("uint8",) * 4, (1.0,) * 4, (0.0,) * 4

    def __init__(self, folder: Path, levels: Mapping[int, _Zoom], tile_px: int, *, south_up: bool) -> None:
        from rasterio import Affine
        from rasterio.crs import CRS
        from rasterio.enums import ColorInterp, MaskFlags

        self._folder, self._tile_px, self._south_up = folder, tile_px, south_up
        self._levels, deepest = levels, levels[0]
        self.driver = "TMS" if south_up else "XYZ"
        rows, columns = deepest.kinds.shape
        self.width, self.height = columns * tile_px, rows * tile_px
        self._corner_px = np.array(deepest.corner) * tile_px
        step = 2.0 * _HALF_WORLD_M / (tile_px << deepest.zoom)
        x, y = self._corner_px * step
        self.transform = Affine(step, 0.0, x - _HALF_WORLD_M, 0.0, -step, _HALF_WORLD_M - y)
        self.crs = CRS.from_epsg(3857)
        self.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
        self.mask_flag_enums = ([MaskFlags.per_dataset, MaskFlags.alpha],) * 4
        self._cached: OrderedDict[tuple[int, int, int], Pixels] = OrderedDict()
        self._last: tuple[Any, Pixels] | None = None  # bands and alpha are read in turn

    def overviews(self, _band: int) -> list[int]:
        """Factors of the coarser levels."""
        return [1 << level for level in sorted(self._levels) if level > 0]

    def tags(self) -> dict[str, str]:
        """No metadata items."""
        return {}

    def fingerprint(self) -> bytes:
        """Names, sizes and times of the map's tiles, as a hash that changes when one of them does."""
        digest = hashlib.sha256(f"{self.driver} {self._tile_px}".encode())
        deepest = self._levels[0]
        for row, column in np.argwhere(deepest.kinds):
            path = self._path(deepest, deepest.corner[0] + int(column), deepest.corner[1] + int(row))
            found = path.stat()
            digest.update(f"{path} {found.st_size} {found.st_mtime_ns}\n".encode())
        return digest.digest()

    def read(
        self, bands: Sequence[int], window: Any = None, out_shape: Sequence[int] | None = None, **_how: Any
    ) -> Pixels:
        """Read a window, by the nearest pixels of the level that fits ``out_shape`` best.

        Args:
            bands: numbers from 1.
            window: as rasterio's; None is the whole map.
            out_shape: of the result, its last two entries rows and columns; None is the window's.
            **_how: other options of rasterio, ignored.

        Returns:
            (N, h, w) uint8.

        Raises:
            MapError: a tile cannot be decoded, or is of another size than the first.
        """
        rgba = self._pixels(window, out_shape)
        return np.ascontiguousarray(np.moveaxis(rgba[..., [band - 1 for band in bands]], -1, 0))

    def dataset_mask(self, window: Any = None, out_shape: Sequence[int] | None = None) -> Pixels:
        """Alpha of a window.

        Args:
            window: as rasterio's; None is the whole map.
            out_shape: rows and columns of the result; None is the window's.

        Returns:
            (h, w) uint8.

        Raises:
            MapError: as :meth:`read`.
        """
        return self._pixels(window, out_shape)[..., 3]

    def _pixels(self, window: Any, out_shape: Sequence[int] | None) -> Pixels:
        """(h, w, 4) red, green, blue and alpha; 0 where there is no tile."""
        part = _Part(0, 0, self.width, self.height) if window is None else window
        part = _Part(part.col_off, part.row_off, part.width, part.height)
        height, width = out_shape[-2:] if out_shape is not None else (int(part.height), int(part.width))
        if self._last is None or self._last[0] != (part, height, width):
            self._last = ((part, height, width), self._assembled(part, height, width))
        return self._last[1]

    def _assembled(self, part: _Part, height: int, width: int) -> Pixels:
        """The same, of the tiles."""
        shrink = min(part.width / width, part.height / height)
        level = max(one for one in self._levels if one == 0 or 1 << one <= shrink)
        at, scale = self._levels[level], 1 << level
        # The level's pixels are aligned with the map's, because a tile is a whole number of them.
        x = np.floor((part.col_off + (np.arange(width) + 0.5) * part.width / width) / scale).astype(np.intp)
        y = np.floor((part.row_off + (np.arange(height) + 0.5) * part.height / height) / scale).astype(np.intp)
        columns, x_in = np.divmod(x + self._corner_px[0] // scale, self._tile_px)
        rows, y_in = np.divmod(y + self._corner_px[1] // scale, self._tile_px)
        out = np.zeros((height, width, 4), np.uint8)
        for row in np.unique(rows).tolist():
            down = slice(*np.searchsorted(rows, (row, row + 1)).tolist())
            for column in np.unique(columns).tolist():
                if at.kind_of(column, row) > 0:
                    across = slice(*np.searchsorted(columns, (column, column + 1)).tolist())
                    out[down, across] = self._tile(at, column, row)[np.ix_(y_in[down], x_in[across])]
        if level > 0:
            there = self._levels[0].kinds > 0
            out[~there[np.ix_(y * scale // self._tile_px, x * scale // self._tile_px)]] = 0
        return out

    def _path(self, at: _Zoom, column: int, row: int) -> Path:
        named = (1 << at.zoom) - 1 - row if self._south_up else row
        ending = ENDINGS[at.kind_of(column, row) - 1]
        return self._folder / str(at.zoom) / str(column) / f"{named}.{ending}"

    def _tile(self, at: _Zoom, column: int, row: int) -> Pixels:
        """A decoded tile, from the cache or from its file."""
        key = (at.zoom, column, row)
        tile = self._cached.pop(key, None)
        if tile is None:
            tile = _decoded(self._path(at, column, row), self._tile_px)
        self._cached[key] = tile
        if len(self._cached) * tile.nbytes > _CACHE_BYTES:
            self._cached.popitem(last=False)
        return tile


def _decoded(path: Path, tile_px: int) -> Pixels:
    """Red, green, blue and alpha (T, T, 4) of a tile; zeros for an empty file, which marks a gap."""
    if path.stat().st_size == 0:
        return np.zeros((tile_px, tile_px, 4), np.uint8)
    with _picture(path, "map") as picture:
        size, mode = picture.size, picture.mode
        if size == (tile_px, tile_px) and mode in _MODES:
            return np.asarray(picture.convert("RGBA"))
    raise MapError(
        f"map: expected tiles of {tile_px} x {tile_px} px and 8 bits, as the first one, got {size[0]} x {size[1]} "
        f"px of mode {mode} in {path}"
    )


@contextmanager
def _picture(path: Path, argument: str) -> Iterator[Any]:
    """The picture in a tile's file; a damaged or truncated one raises MapError."""
    from PIL import Image

    try:
        with Image.open(path, formats=FORMATS) as picture:
            yield picture
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise MapError(f"{argument}: cannot read the tile {path}: {' '.join(str(error).split())}") from None


# --------------------------------------------------------------------------------------------------- opening


def is_tile_cache(folder: Path) -> bool:
    """Whether a folder holds tiles by the layout z/x/y."""
    return any(next(_tiles_in(path), None) for path in _zoom_folders(folder).values())


def open_tile_cache(folder: Path, argument: str) -> TileCache:
    """List a folder of tiles and read the size of the first one.

    Args:
        folder: one for which :func:`is_tile_cache` holds.
        argument: its name in messages.

    Raises:
        MapError: the tiles are of another projection, outside their zoom level or too far apart, or the first one
            is no square picture.
    """
    south_up = _follows_tms(folder, argument)
    listed = {zoom: _listed(path) for zoom, path in _zoom_folders(folder).items()}
    listed = {zoom: tiles for zoom, tiles in listed.items() if len(tiles)}
    deepest = max(listed)
    limit = 1 << deepest
    paths = (folder / str(deepest) / str(x) / f"{y}.{ENDINGS[kind]}" for x, y, kind in listed[deepest].tolist())
    if (listed[deepest][:, :2] >= limit).any():
        worst = next(path for path in paths if max(int(path.parent.name), int(path.stem)) >= limit)
        raise MapError(
            f"{argument}: expected columns and rows below {limit} on zoom level {deepest}, as z/x/y, got {worst}"
        )
    tile_px = _first_side_px(paths, folder, argument)
    tiles = {zoom: _from_north(some, zoom) if south_up else some for zoom, some in listed.items()}
    low, high = tiles[deepest][:, :2].min(axis=0), tiles[deepest][:, :2].max(axis=0)
    longest_px = int((high - low).max() + 1) * tile_px
    if longest_px > MAX_SIDE_PX:
        raise MapError(
            f"{argument}: expected tiles of one region, at most {MAX_SIDE_PX:,} px a side, got {longest_px:,} px "
            f"from the first to the last on zoom level {deepest} of {folder}"
        )
    levels = {}
    for coarser in (deepest - zoom for zoom in tiles if tile_px % (1 << deepest - zoom) == 0):
        level = _zoom_of(deepest - coarser, tiles[deepest - coarser], low >> coarser, high >> coarser)
        x, y = ((tiles[deepest][:, :2] >> coarser) - level.corner).T
        if level.kinds[y, x].all():  # an overview with gaps of its own is none
            levels[coarser] = level
    return TileCache(folder, levels, tile_px, south_up=south_up)


def _zoom_of(zoom: int, tiles: NDArray[np.int64], low: NDArray[np.int64], high: NDArray[np.int64]) -> _Zoom:
    """The zoom level of the tiles (N, 3) from one column and row to another."""
    columns, rows = (high - low + 1).tolist()
    kinds = np.zeros((rows, columns), np.uint8)
    x, y, kind = tiles[((tiles[:, :2] >= low) & (tiles[:, :2] <= high)).all(axis=1)].T
    kinds[y - low[1], x - low[0]] = kind + 1
    return _Zoom(zoom, (int(low[0]), int(low[1])), kinds)


def _from_north(tiles: NDArray[np.int64], zoom: int) -> NDArray[np.int64]:
    """Tiles (N, 3) whose rows were counted from the south."""
    x, y, kind = tiles.T
    return np.stack([x, (1 << zoom) - 1 - y, kind], axis=1)


def _listed(folder: Path) -> NDArray[np.int64]:
    """(N, 3) tiles of a zoom level in the order of their names: column, row as named, index of the ending."""
    found = np.array(list(_tiles_in(folder)), np.int64).reshape(-1, 3)
    return found[np.lexsort(found.T[::-1])]


def _zoom_folders(folder: Path) -> dict[int, Path]:
    return {zoom: path for zoom, path in _numbered(folder) if zoom <= MAX_ZOOM and path.is_dir()}


def _numbered(folder: Path) -> Iterator[tuple[int, Path]]:
    """Entries of a folder that are named by a whole number."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if _is_number(entry.name):
                yield int(entry.name), Path(entry.path)


def _is_number(name: str) -> bool:
    """Whether it is a whole number as it would be printed, so that the name can be restored from it."""
    return name.isascii() and name.isdecimal() and len(name) < 11 and (name == "0" or name[0] != "0")


def _tiles_in(folder: Path) -> Iterator[tuple[int, int, int]]:
    """Column, row as named, and index of the ending of each tile of a zoom level."""
    for column, path in _numbered(folder):
        if path.is_dir():
            with os.scandir(path) as entries:
                for entry in entries:
                    row, _, ending = entry.name.partition(".")
                    if ending in ENDINGS and _is_number(row):
                        yield column, int(row), ENDINGS.index(ending)


def _first_side_px(paths: Iterable[Path], folder: Path, argument: str) -> int:
    """Side of the first tile that is not empty.

    Raises:
        MapError: it is no square picture, or all are empty.
    """
    for path in paths:
        if path.stat().st_size > 0:
            with _picture(path, argument) as picture:
                width, height = picture.size
            if width != height:
                raise MapError(f"{argument}: expected square tiles, got {width} x {height} px in {path}")
            return int(width)
    raise MapError(f"{argument}: expected tiles with a picture in {folder}, got empty files only")


def _follows_tms(folder: Path, argument: str) -> bool:
    """Whether rows count from the south: whether the folder has a description as TMS writes it.

    Raises:
        MapError: it cannot be read, or names another projection.
    """
    path = folder / RESOURCE
    if not path.is_file():
        return False
    try:
        projection = (Xml.fromstring(path.read_bytes()).findtext("SRS") or "").strip()
    except Xml.ParseError as error:
        raise MapError(f"{argument}: cannot read {path}: {error}") from None
    if not projection.endswith(_MERCATOR_CODES):
        raise MapError(f"{argument}: expected tiles in Web Mercator (EPSG:3857), got {projection!r} in {path}")
    return True
