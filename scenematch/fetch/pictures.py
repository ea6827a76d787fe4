"""Download a server's pictures into one GeoTIFF, one request at a time; keep them until it is complete."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import MapError
from engine.runtime.cache_folder import replaced
from scenematch.fetch.grid import Grid, reason_of
from scenematch.fetch.urls import shown
from scenematch.files.geotiff import tiled_profile

ATTEMPTS = 5
"""Attempts per picture before the fetch fails."""
FIRST_WAIT_S = 2.0
"""Pause before the second attempt; doubled for each further one."""
_OPAQUE = 128
"""Least alpha of a valid pixel, as when maps are read."""
_CACHED = re.compile(r"[0-9a-f]{32}")  # names of GDAL's cached files
_STATUS = re.compile(r"HTTP status code: (\d+), error: (.*?)\.?(?: Add the HTTP|$)")
_BUSY = re.compile(r"HTTP status code: (429|5\d\d)|timed? ?out|reset by peer|Empty reply", re.IGNORECASE)


def fetch_pictures(
    grid: Grid,
    out: Path,
    tags: Mapping[str, object],
    *,
    url: str,
    cached: int,
    pause_s: float,
    say: Callable[[str], None],
) -> Iterator[int]:
    """Write a tiled, losslessly compressed GeoTIFF with a mask of where the server has pictures.

    Args:
        grid: the raster to fetch.
        out: the file, replaced in one step.
        tags: metadata items.
        url: of the server, for messages.
        cached: number of pictures left by an earlier fetch, which are read without a pause.
        pause_s: between two requests.
        say: receives one line for a person while waiting for a server.

    Yields:
        For each picture, its number of pixels with data.

    Raises:
        MapError: the server refuses, has no data there or sends something else, or the file cannot be written.
    """
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.windows import Window

    level = {} if grid.overview is None else {"overview_level": grid.overview}
    (left, top), (step_x, step_y), (width, height) = grid.corner, grid.step, grid.size_px
    corner = np.array([[step_x, 0.0, left], [0.0, -step_y, top]])
    profile = tiled_profile((height, width, 3), "uint8", corner, grid.crs)
    (across, down), known = grid.tile_px, 0
    places = [(x, y) for y in range(0, height, down) for x in range(0, width, across)]
    try:
        with (
            replaced(out) as part,
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            rasterio.open(grid.source, **level) as source,
            rasterio.open(part, "w", **profile) as file,
        ):
            for k, (x, y) in enumerate(places):
                time.sleep(pause_s * (k > cached))
                size = min(across, width - x), min(down, height - y)
                rgba = _read(source, Window(grid.offset_px[0] + x, grid.offset_px[1] + y, *size), url, say)
                valid = rgba[3] >= _OPAQUE
                file.write(rgba[:3] * valid, window=Window(x, y, *size))
                file.write_mask(valid * np.uint8(255), window=Window(x, y, *size))
                known += int(valid.sum())
                yield int(valid.sum())
            _check_known(known, grid)
            file.update_tags(**{name: str(value) for name, value in tags.items()})
    except (RasterioError, OSError) as error:
        raise MapError(f"{out}: cannot be written: {str(error).splitlines()[0]}") from None


def _check_known(known: int, grid: Grid) -> None:
    if known == 0:
        raise MapError(
            f"source: the server has no data there on level {grid.level!r}, {grid.gsd_m_per_px:.3g} m/px; "
            "it may have some with a larger `gsd_m_per_px`"
        )


def _read(source: Any, window: Any, url: str, say: Callable[[str], None]) -> NDArray[np.uint8]:
    """(4, h, w) red, green, blue and alpha; a busy server is asked again."""
    from rasterio.errors import RasterioError

    for attempt in range(ATTEMPTS):
        try:
            return np.asarray(source.read(window=window))
        except RasterioError as error:
            reason = reason_of(error)
        if attempt == ATTEMPTS - 1 or not _BUSY.search(reason):
            break
        wait_s = FIRST_WAIT_S * 2.0**attempt
        say(f"{shown(url)}: {_told(reason)}; waiting {wait_s:.0f} s")
        time.sleep(wait_s)
    raise MapError(f"{shown(url)}: {_told(reason)}" + (f", at attempt {attempt + 1}" if attempt else ""))


def _told(reason: str) -> str:
    """GDAL's error, for a person."""
    status = _STATUS.search(reason)
    if status is None:
        if "not recognized" in reason:
            return "expected pictures, got something else"
        return shown(reason.removeprefix("GDALWMS: "))
    code, text = status.groups()
    if code == "0":
        return shown(text)
    more = ": access denied (the key is missing or wrong, or its terms forbid this)"
    return f"the server answers {code}{more if code in ('401', '403') else ''}"


def kept_pictures(folder: Path) -> list[Path]:
    """Files that an earlier fetch left in a folder."""
    return [file for file in folder.rglob("*") if file.is_file() and _CACHED.fullmatch(file.name)]


def remove_pictures(folder: Path, *, all_of_them: bool) -> None:
    """Remove the cached files if requested, and empty folders."""
    for file in kept_pictures(folder) if all_of_them else ():
        file.unlink()
    inner_first = sorted(folder.rglob("*"), reverse=True)
    for path in (*inner_first, folder):
        if path.is_dir() and not any(path.iterdir()):
            path.rmdir()
