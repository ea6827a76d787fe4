"""Mosaicking: the tiles of a map are merged into one GeoTIFF strip by strip, so that size does not matter."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from engine.errors import MapError, OptionError
from engine.maps.raster_formats import driver_of
from engine.maps.rasters import palette_of

_STRIP_PX = 512


@dataclass(frozen=True, slots=True)
class MosaicTile:
    """A north-up image of a part of the map; edges are those of the outer pixels, in the mosaic's CRS.

    Attributes:
        path: the image, uint8.
        left: western edge.
        top: northern edge.
        right: eastern edge.
        bottom: southern edge.
    """

    path: Path
    left: float
    top: float
    right: float
    bottom: float


@dataclass(frozen=True, slots=True)
class Mosaic:
    """Pieces of one map; where two overlap, the later one counts.

    Attributes:
        tiles: at least one.
        epsg: EPSG code of their coordinates.
    """

    tiles: Sequence[MosaicTile]
    epsg: int


def write_mosaic(path: Path, mosaic: Mosaic) -> None:
    """Write the pieces as one tiled GeoTIFF with their median pixel, resampled where theirs is another.

    What no piece covers is marked by a mask.

    Raises:
        MapError: a piece cannot be read, or the file cannot be written.
        OptionError: a piece has no area, or is no picture of 8 bits.
    """
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.transform import Affine

    try:
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
            step_x, step_y = np.median([_pixel(tile) for tile in mosaic.tiles], axis=0)
            left, top = min(p.left for p in mosaic.tiles), max(p.top for p in mosaic.tiles)
            right, bottom = max(p.right for p in mosaic.tiles), min(p.bottom for p in mosaic.tiles)
            width, height = math.ceil((right - left) / step_x - 1e-6), math.ceil((top - bottom) / step_y - 1e-6)
            transform = Affine(step_x, 0.0, left, 0.0, -step_y, top)
            profile: dict[str, Any] = {
                "driver": "GTiff", "width": width, "height": height, "count": 3, "dtype": "uint8", "tiled": True,
                "crs": rasterio.CRS.from_epsg(mosaic.epsg), "transform": transform,
                "photometric": "RGB", "BIGTIFF": "IF_SAFER", "SPARSE_OK": "TRUE",
            }  # fmt: skip
            with rasterio.open(path, "w", **profile) as file:
                for tile in mosaic.tiles:
                    corner = (round((tile.left - left) / step_x), round((top - tile.top) / step_y))
                    size = (round((tile.right - tile.left) / step_x), round((tile.top - tile.bottom) / step_y))
                    _paste(file, tile, corner, size)
    except OptionError:
        raise
    except (RasterioError, OSError, ValueError) as error:
        raise MapError(f"{path}: cannot be mosaicked: {str(error).splitlines()[0]}") from None


def size_px(path: Path) -> tuple[int, int]:
    """Width and height of an image in pixels.

    Raises:
        MapError: it cannot be read.
    """
    from rasterio.errors import RasterioError

    try:
        with _open(path) as source:
            return source.width, source.height
    except (RasterioError, OSError) as error:
        raise MapError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None


def own_edges(path: Path, epsg: int) -> tuple[float, float, float, float] | None:
    """Left, top, right and bottom of the file's own georeference, or None where its CRS is another."""
    with _open(path) as source:
        if source.crs is None or source.crs.to_epsg() != epsg:
            return None
        bounds = source.bounds
        return bounds.left, bounds.top, bounds.right, bounds.bottom


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    """Open an image by the format of its content; a VRT is refused, since it could refer to any file or URL."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    driver = driver_of(path, "map")
    if driver == "VRT":
        raise MapError(f"{path}: expected a picture, got a VRT")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, driver=driver) as source:
            yield source


def _pixel(tile: MosaicTile) -> tuple[float, float]:
    """Pixel width and height in units of the mosaic's CRS."""
    if not (tile.left < tile.right and tile.bottom < tile.top):
        raise OptionError(f"{tile.path}: expected left < right and bottom < top, got {tile}")
    with _open(tile.path) as source:
        if source.dtypes[0] != "uint8":
            raise OptionError(f"{tile.path}: expected pixels of uint8, got {source.dtypes[0]}")
        return (tile.right - tile.left) / source.width, (tile.top - tile.bottom) / source.height


def _paste(file: Any, tile: MosaicTile, corner: tuple[int, int], size: tuple[int, int]) -> None:
    """Resample and write one tile, a strip at a time."""
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    width, height = min(size[0], file.width - corner[0]), min(size[1], file.height - corner[1])
    with _open(tile.path) as source:
        bands, colours = [1, 2, 3] if source.count >= 3 else [1, 1, 1], palette_of(source)
        how = Resampling.bilinear if colours is None else Resampling.nearest  # a mean of two indices is no colour
        scale_x, scale_y = source.width / size[0], source.height / size[1]
        for row in range(0, height, _STRIP_PX):
            rows = min(_STRIP_PX, height - row)
            window = Window(0, row * scale_y, width * scale_x, rows * scale_y)
            data = source.read(bands, window=window, out_shape=(3, rows, width), resampling=how)
            data = data if colours is None else colours[:, data[0]]
            target = Window(corner[0], corner[1] + row, width, rows)
            file.write(data, window=target)
            file.write_mask(np.full((rows, width), 255, np.uint8), window=target)
