"""Tile caches: a folder of pictures named z/x/y.png, as tile servers and mirrors have them, described for GDAL.

GDAL's driver for tile servers reads such a folder: a missing or empty file is nodata, a damaged one an error. A
tile's name gives its position, so a folder of 100,000 tiles is listed, not opened.

Convention:
    Web Mercator (EPSG:3857). Zoom level z has 2^z x 2^z tiles. Column x counts from 180 degrees west, row y from
    the north. In a folder with a ``tilemapresource.xml``, which TMS writes, files count rows from the south.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from engine.errors import MapError
from engine.geo import WGS84_A_M

Tiles = dict[int, NDArray[np.int64]]
"""Column, row as named, and index of the ending, (N, 3) by zoom level."""

ENDINGS = ("png", "jpg", "jpeg", "webp")
"""Of a tile's name. The format is found by the first bytes: mirrors write JPEG into files called png."""
FORMATS = ("PNG", "JPEG", "WEBP")
DRIVER = "WMS"
"""GDAL's, of no other map."""
MAX_ZOOM = 30
MAX_SIDE_PX = 1_000_000
"""Largest side of a map."""
RESOURCE = "tilemapresource.xml"
_MERCATOR_CODES = ("3857", "3785", "900913", "41001", "102100", "102113")  # of Web Mercator, now and formerly
_HALF_WORLD_M = math.pi * WGS84_A_M
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # Pillow's, of eight bits or fewer
_NUMBER = re.compile("0|[1-9][0-9]{0,9}")  # as it is printed, so that the name can be restored from it
_TILE = re.compile(rf"({_NUMBER.pattern})\.({'|'.join(ENDINGS)})")
_NO_TILE_CODES = "200,204,404"  # of HTTP; of a file, 200 says that it is empty


def is_tile_cache(folder: Path) -> bool:
    """Whether a folder holds tiles by the layout z/x/y."""
    return any(next(_tiles_in(path), None) for path in _zoom_folders(folder).values())


def fingerprint(folder: Path) -> bytes:
    """Names, sizes and times of the map's tiles, as a hash that changes when one of them does."""
    listed = _listed(folder)
    deepest, digest = max(listed), hashlib.sha256()
    for path in _paths(folder, deepest, listed[deepest]):
        found = path.stat()
        digest.update(f"{path} {found.st_size} {found.st_mtime_ns}\n".encode())
    return digest.digest()


def description_of(folder: Path, argument: str) -> str:
    """The folder as GDAL's driver for tile servers takes it.

    The deepest zoom level is the map, from its first column and row to its last. If rows count from the north,
    coarser levels are its overviews as long as they, and the map, are complete; the map then begins where the
    coarsest one's tile does.

    Args:
        folder: one for which :func:`is_tile_cache` holds.
        argument: its name in messages.

    Raises:
        MapError: the tiles are of another projection, outside their zoom level, too far apart or of several
            endings, or the first one is no square picture of eight bits.
    """
    south_up, listed = _follows_tms(folder, argument), _listed(folder)
    zoom = max(listed)
    limit = 1 << zoom
    if (listed[zoom][:, :2] >= limit).any():
        paths = _paths(folder, zoom, listed[zoom])
        worst = next(path for path in paths if max(int(path.parent.name), int(path.stem)) >= limit)
        raise MapError(
            f"{argument}: expected columns and rows below {limit} on zoom level {zoom}, as z/x/y, got {worst}"
        )
    endings = sorted({ENDINGS[kind] for kind in listed[zoom][:, 2]})
    if len(endings) > 1:
        raise MapError(f"{argument}: expected tiles of one ending, got {' and '.join(endings)} in {folder}")
    tile_px = _first_side_px(folder, zoom, listed[zoom], argument)
    places = {level: _from_north(tiles, level) if south_up else tiles[:, :2] for level, tiles in listed.items()}
    low, high = places[zoom].min(axis=0), places[zoom].max(axis=0)
    longest_px = int((high - low).max() + 1) * tile_px
    if longest_px > MAX_SIDE_PX:
        raise MapError(
            f"{argument}: expected tiles of one region, at most {MAX_SIDE_PX:,} px a side, got {longest_px:,} px "
            f"from the first to the last on zoom level {zoom} of {folder}"
        )
    coarser, template = 0, f"{folder.absolute().as_uri()}/${{z}}/${{x}}/${{y}}.{endings[0]}"
    if not south_up:  # GDAL aligns overviews with the north
        levels = itertools.takewhile(
            lambda k: zoom - k in places and _is_complete(places[zoom - k], low >> k, high >> k), range(zoom)
        )
        coarser = max(len(list(levels)) - 1, 0)
    low = low >> coarser << coarser
    return _xml(template, zoom, (*low.tolist(), *(high + 1).tolist()), tile_px, coarser, south_up=south_up)


def _is_complete(places: NDArray[np.int64], low: NDArray[np.int64], high: NDArray[np.int64]) -> bool:
    """Whether a level has a tile at every place from one column and row to another."""
    inside = places[((places >= low) & (places <= high)).all(axis=1)]
    return len(np.unique(inside, axis=0)) == int(np.prod(high - low + 1))


def _xml(
    template: str, zoom: int, places: tuple[int, int, int, int], tile_px: int, coarser: int, *, south_up: bool
) -> str:
    """The description of the tiles from one column and row up to another."""
    tile_m = 2.0 * _HALF_WORLD_M / (1 << zoom)
    x0, y0, x1, y1 = places
    root = Xml.Element("GDAL_WMS")
    Xml.SubElement(Xml.SubElement(root, "Service", name="TMS"), "ServerUrl").text = template
    window = {
        "UpperLeftX": repr(x0 * tile_m - _HALF_WORLD_M), "UpperLeftY": repr(_HALF_WORLD_M - y0 * tile_m),
        "LowerRightX": repr(x1 * tile_m - _HALF_WORLD_M), "LowerRightY": repr(_HALF_WORLD_M - y1 * tile_m),
        "TileX": x0, "TileY": y1 - (1 << zoom) if south_up else y0, "TileLevel": zoom,  # minus the last row
        "SizeX": (x1 - x0) * tile_px, "SizeY": (y1 - y0) * tile_px, "YOrigin": "bottom" if south_up else "top",
    }  # fmt: skip
    whole = {
        "Projection": "EPSG:3857", "BlockSizeX": tile_px, "BlockSizeY": tile_px, "BandsCount": 4,
        "OverviewCount": coarser, "ZeroBlockHttpCodes": _NO_TILE_CODES,
    }  # fmt: skip
    for parent, values in ((Xml.SubElement(root, "DataWindow"), window), (root, whole)):
        for name, value in values.items():
            Xml.SubElement(parent, name).text = str(value)
    return Xml.tostring(root, encoding="unicode")


def _from_north(tiles: NDArray[np.int64], zoom: int) -> NDArray[np.int64]:
    """Places (N, 2) of tiles whose rows were counted from the south."""
    return np.stack([tiles[:, 0], (1 << zoom) - 1 - tiles[:, 1]], axis=1)


def _listed(folder: Path) -> Tiles:
    """The tiles of each zoom level that has any, in the order of their names."""
    found = {}
    for zoom, path in _zoom_folders(folder).items():
        tiles = np.array(list(_tiles_in(path)), np.int64).reshape(-1, 3)
        if len(tiles):
            found[zoom] = tiles[np.lexsort(tiles.T[::-1])]
    return found


def _paths(folder: Path, zoom: int, tiles: NDArray[np.int64]) -> Iterator[Path]:
    return (folder / str(zoom) / str(x) / f"{y}.{ENDINGS[kind]}" for x, y, kind in tiles.tolist())


def _zoom_folders(folder: Path) -> dict[int, Path]:
    return {zoom: path for zoom, path in _numbered(folder) if zoom <= MAX_ZOOM}


def _numbered(folder: Path) -> Iterator[tuple[int, Path]]:
    """Folders in a folder that are named by a whole number."""
    for path in folder.iterdir():
        if _NUMBER.fullmatch(path.name) and path.is_dir():
            yield int(path.name), path


def _tiles_in(folder: Path) -> Iterator[tuple[int, int, int]]:
    """Column, row as named, and index of the ending of each tile of a zoom level."""
    for column, path in _numbered(folder):
        for name in os.listdir(path):
            found = _TILE.fullmatch(name)
            if found:
                yield column, int(found[1]), ENDINGS.index(found[2])


def _first_side_px(folder: Path, zoom: int, tiles: NDArray[np.int64], argument: str) -> int:
    """Side of the first tile that is not empty.

    Raises:
        MapError: it is no square picture, or all are empty.
    """
    from PIL import Image

    for path in _paths(folder, zoom, tiles):
        if path.stat().st_size > 0:
            try:
                with Image.open(path, formats=FORMATS) as picture:
                    (width, height), mode = picture.size, picture.mode
            except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
                reason = " ".join(str(error).split())
                raise MapError(f"{argument}: cannot read the tile {path}: {reason}") from None
            if width != height or mode not in _MODES:
                what = f"{width} x {height} px of mode {mode}"
                raise MapError(f"{argument}: expected square tiles of 8 bits, got {what} in {path}")
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
