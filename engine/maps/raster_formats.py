"""Raster files that may be opened: a local file by its first bytes, or a folder of tiles as one picture.

A folder of tiles becomes the text of a VRT, GDAL's mosaic format. A user's VRT is not read: it could warp, compute
and fetch.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np

from engine.errors import MapError

DRIVERS = ["GTiff", "PNG", "JPEG", "JP2OpenJPEG", "BMP", "WEBP"]
"""GDAL's drivers of a file; it tells them by a file's first bytes, whatever its extension."""
DATABASES = ["MBTiles", "GPKG"]
"""Those of files that hold tiles."""
NO_TILES = (".ovr", ".msk", ".aux", ".part")
"""Extensions of side files and partial files, which are not tiles of a folder."""
OWN_TAGS = "SCENEMATCH_"
"""Prefix of this project's metadata items; a folder of tiles has the items that all its tiles share."""
OFF_GRID_PX = 0.05
"""Largest offset of a tile from whole pixels of the first tile's grid; a larger one would need resampling."""


class NoRasterError(MapError):
    """A licence, a world file, an index: not every file of a folder is a tile."""


@dataclass(frozen=True)
class _Tile:
    """Properties of a tile in a mosaic."""

    path: Path
    size: tuple[int, int]
    transform: Any
    crs: Any
    kind: tuple[int, str, str, float, float]  # bands in use, element type by GDAL, nodata, scale and offset
    block: tuple[int, int]
    overviews: tuple[int, ...]
    own_tags: frozenset[tuple[str, str]]  # metadata items of this project


def local_path(path: str | os.PathLike[str], argument: str) -> Path:
    """The absolute path of a local file or folder.

    Raises:
        MapError: it is a URL, or does not exist.
    """
    text = os.fspath(path)
    if not text or "://" in text or text.startswith("/vsi"):
        raise MapError(f"{argument}: expected the path of a local file, got {text!r}")
    found = Path(text).absolute()
    if not (found.is_file() or found.is_dir()):
        what = "is no file" if found.exists() else "does not exist"
        raise MapError(f"{argument}: expected a local file, but {text!r} {what}")
    return found


def open_raster(path: Path, argument: str) -> Any:
    """Open a file, or a folder of tiles as one picture.

    Returns:
        rasterio's dataset.

    Raises:
        MapError: it is not a raster, or its tiles do not fit together.
    """
    import rasterio

    if path.is_dir():
        return rasterio.open(vrt_of_folder(path, argument), driver="VRT")
    return _open_file(path, DRIVERS + DATABASES, argument)


def _open_file(file: Path, drivers: list[str], argument: str) -> Any:
    from rasterio import DatasetReader
    from rasterio.errors import RasterioIOError

    try:
        return DatasetReader(file, driver=drivers)  # rasterio.open takes one driver or all
    except RasterioIOError as error:
        if "not recognized" not in str(error):
            raise
    raise NoRasterError(
        f"{argument}: expected a raster file ({', '.join(drivers)}), got {file}, which is none of these; "
        "of a VRT give the folder of its tiles, or a GeoTIFF by gdal_translate"
    )


def vrt_of_folder(folder: Path, argument: str) -> str:
    """The text of a VRT that joins the tiles of a folder; pixels without a tile are nodata.

    Raises:
        MapError: there are none, or they differ in CRS, pixel size, bands or element type, or are not on one grid.
    """
    tiles = _tiles_in(folder, argument)
    if not tiles:
        raise MapError(
            f"{argument}: expected georeferenced raster files in the folder {folder}, found none; "
            "of web tiles (z/x/y.png) give MBTiles or a GeoTIFF"
        )
    first = tiles[0]
    for tile in tiles[1:]:
        _check_beside(first, tile, argument)
    corners = np.array([_position(first, tile, argument) for tile in tiles])
    low, high = corners.min(axis=0), (corners + [tile.size for tile in tiles]).max(axis=0)
    transform = _moved(first.transform, *low.tolist())
    return _vrt_text(tiles, (corners - low).tolist(), (high - low).tolist(), transform)


def _moved(transform: Any, x: int, y: int) -> list[float]:
    """GDAL's six numbers of a transform with its origin moved by (x, y) pixels."""
    a, b, c, d, e, f = list(transform)[:6]
    return [c + a * x + b * y, a, b, f + d * x + e * y, d, e]


def _tiles_in(folder: Path, argument: str) -> list[_Tile]:
    """The tiles of a folder, by name."""
    tiles = []
    for file in sorted(folder.iterdir()):
        if file.is_file() and file.suffix.lower() not in NO_TILES and not file.name.startswith("."):
            with contextlib.suppress(NoRasterError), _open_file(file, DRIVERS, argument) as dataset:
                tiles.append(_tile_of(dataset, file, argument))
    return tiles


def _tile_of(dataset: Any, file: Path, argument: str) -> _Tile:
    if dataset.transform.is_identity:
        raise MapError(f"{argument}: expected a georeference in every tile of a folder, got none in {file}")
    if dataset.colorinterp[0].name == "palette":
        raise MapError(f"{argument}: expected tiles without a colour table, got one in {file}")
    bands, dtype = 3 if dataset.count >= 3 else 1, dataset.dtypes[0]
    gdal_type = "Byte" if dtype == "uint8" else dtype  # GDAL takes the others in small letters too
    return _Tile(
        path=file,
        size=(dataset.width, dataset.height),
        transform=dataset.transform,
        crs=dataset.crs,
        kind=(bands, gdal_type, str(dataset.nodata), dataset.scales[0], dataset.offsets[0]),
        block=dataset.block_shapes[0],
        overviews=tuple(dataset.overviews(1)),
        own_tags=frozenset((k, v) for k, v in dataset.tags().items() if k.startswith(OWN_TAGS)),
    )


def _check_beside(first: _Tile, tile: _Tile, argument: str) -> None:
    own, other = ([at.a, at.b, at.d, at.e] for at in (first.transform, tile.transform))
    same_pixel = np.allclose(own, other, rtol=0.0, atol=1e-7 * max(map(abs, own)))
    for name, one, another, same in (
        ("CRS", first.crs, tile.crs, first.crs == tile.crs),
        ("size of a pixel", own, other, same_pixel),
        ("bands, element type, nodata, scale and offset", first.kind, tile.kind, first.kind == tile.kind),
    ):
        if not same:
            found = f"{one} in {first.path.name} and {another} in {tile.path}"
            raise MapError(f"{argument}: expected tiles of one {name}, got {found}")


def _position(first: _Tile, tile: _Tile, argument: str) -> tuple[int, int]:
    """Column and row in the first tile's grid at which another tile begins."""
    a, b, c, d, e, f = list(first.transform)[:6]
    x, y = np.linalg.solve([[a, b], [d, e]], [tile.transform.c - c, tile.transform.f - f])
    if max(abs(x - round(x)), abs(y - round(y))) > OFF_GRID_PX:
        off = f"{x - round(x):+.2f}, {y - round(y):+.2f} px"
        raise MapError(
            f"{argument}: expected tiles of one grid, got {tile.path} {off} off that of {first.path.name}"
        )
    return round(x), round(y)


def _vrt_text(
    tiles: Sequence[_Tile], corners: Sequence[Sequence[int]], size: Sequence[int], transform: Sequence[float]
) -> str:
    """The VRT of tiles by their top-left corners.

    Pixels without a tile have the tiles' nodata value. Without one, a mask band joins the tiles' masks; for tiles
    with a nodata value GDAL would read the masks in pieces of the wrong width.
    """
    bands, dtype, nodata, scale, offset = tiles[0].kind
    root = Xml.Element("VRTDataset", rasterXSize=str(size[0]), rasterYSize=str(size[1]))
    if tiles[0].crs is not None:
        Xml.SubElement(root, "SRS").text = tiles[0].crs.to_wkt()
    Xml.SubElement(root, "GeoTransform").text = ", ".join(repr(v) for v in transform)
    metadata = Xml.SubElement(root, "Metadata")
    for key, value in sorted(frozenset.intersection(*(tile.own_tags for tile in tiles))):
        Xml.SubElement(metadata, "MDI", key=key).text = value
    factors = max(tiles, key=lambda tile: tile.size[0] * tile.size[1]).overviews
    if factors:  # those that a smaller tile lacks GDAL computes while reading
        Xml.SubElement(root, "OverviewList", resampling="average").text = " ".join(map(str, factors))
    for band in range(1, bands + 1):
        element = Xml.SubElement(root, "VRTRasterBand", dataType=dtype, band=str(band))
        Xml.SubElement(element, "ColorInterp").text = ("Red", "Green", "Blue")[band - 1] if bands == 3 else "Gray"
        Xml.SubElement(element, "Scale").text, Xml.SubElement(element, "Offset").text = repr(scale), repr(offset)
        if nodata != "None":
            Xml.SubElement(element, "NoDataValue").text = nodata
        _add_sources(element, tiles, corners, str(band))
    if nodata == "None":
        mask = Xml.SubElement(Xml.SubElement(root, "MaskBand"), "VRTRasterBand", dataType="Byte")
        _add_sources(mask, tiles, corners, "mask,1")
    return Xml.tostring(root, encoding="unicode")


def _add_sources(
    element: Xml.Element, tiles: Sequence[_Tile], corners: Sequence[Sequence[int]], band: str
) -> None:
    nodata = element.findtext("NoDataValue")
    for tile, (x, y) in zip(tiles, corners, strict=True):
        width, height = (str(n) for n in tile.size)
        source = Xml.SubElement(element, "SimpleSource" if nodata is None else "ComplexSource")
        Xml.SubElement(source, "SourceFilename", relativeToVRT="0").text = str(tile.path)
        Xml.SubElement(source, "SourceBand").text = band
        if "mask" not in band:  # so that a tile is opened only when it is read
            rows, columns = (str(n) for n in tile.block)
            of = {"RasterXSize": width, "RasterYSize": height, "BlockXSize": columns, "BlockYSize": rows}
            Xml.SubElement(source, "SourceProperties", of | {"DataType": tile.kind[1]})
        Xml.SubElement(source, "SrcRect", xOff="0", yOff="0", xSize=width, ySize=height)
        Xml.SubElement(source, "DstRect", xOff=str(x), yOff=str(y), xSize=width, ySize=height)
        if nodata is not None:  # so that one tile's nodata does not hide another's pixels
            Xml.SubElement(source, "NODATA").text = nodata
