"""Tiles by a template with zoom level, column and row: XYZ, TMS and quadkeys, in Web Mercator."""

from __future__ import annotations

import math

from engine.errors import OptionError
from scenematch.fetch.client import PLACEHOLDER, shown
from scenematch.fetch.mosaic import (
    Level,
    Mosaic,
    Wanted,
    check_count,
    fine_enough,
    mosaic_of,
    tiles_over,
)

MAX_ZOOM = 24
_HALF_WORLD_M = math.pi * 6378137.0
_KNOWN = ("z", "x", "y", "-y", "q")


def is_template(url: str) -> bool:
    """Whether a source is a template of tiles, and not a service that describes itself."""
    return bool(PLACEHOLDER.search(url))


def check_template(url: str) -> None:
    """Refuse a template that does not name a tile.

    Raises:
        OptionError: a placeholder is unknown, or one is missing.
    """
    names = PLACEHOLDER.findall(url)
    unknown = [name for name in names if name not in _KNOWN]
    if unknown:
        raise OptionError(
            f"source: expected {{z}}, {{x}} and {{y}} (or {{-y}}), or {{q}}, in a template of tiles, got "
            f"{{{unknown[0]}}} in {shown(url)!r}"
        )
    if not ("q" in names or ({"z", "x"} <= set(names) and {"y", "-y"} & set(names))):
        raise OptionError(
            f"source: expected {{z}}, {{x}} and {{y}}, or {{q}}, in a template of tiles, got {shown(url)!r}"
        )


def tile_url(template: str, zoom: int, column: int, row: int) -> str:
    """The address of a tile.

    Args:
        template: it, checked.
        zoom: of the tile.
        column: from the west.
        row: from the north.
    """
    values = {
        "z": str(zoom),
        "x": str(column),
        "y": str(row),
        "-y": str((1 << zoom) - 1 - row),
        "q": "".join(str((column >> n & 1) | (row >> n & 1) << 1) for n in reversed(range(zoom))),
    }
    return PLACEHOLDER.sub(lambda name: values[name[1]], template)


def plan_xyz(template: str, wanted: Wanted, tile_px: int) -> Mosaic:
    """The tiles of a template over a place.

    Args:
        template: such as ``https://host/{z}/{x}/{y}.png``.
        wanted: where, and how fine.
        tile_px: side of a tile.

    Raises:
        OptionError: the template or the place cannot be, or there are more tiles.
    """
    from pyproj import CRS

    check_template(template)
    crs = CRS.from_epsg(3857)
    corner = (-_HALF_WORLD_M, _HALF_WORLD_M)
    levels = []
    for zoom in range(MAX_ZOOM + 1):
        step = 2.0 * _HALF_WORLD_M / (tile_px << zoom)
        levels.append(Level(str(zoom), corner, (step, step), (tile_px, tile_px), 1 << zoom, 1 << zoom))
    level = fine_enough(levels, wanted.gsd_m_per_px, wanted.place.metres_per_unit(crs))
    part = tiles_over(level, wanted.place.bounds(crs))
    check_count(part, wanted.max_tiles)
    return mosaic_of(
        level,
        part,
        crs,
        wanted.place,
        lambda column, row: tile_url(template, int(level.name), column, row),
        kind="XYZ",
        gaps=True,
        bytes_per_px=2.0 if ".png" in template.lower() else 0.5,
    )
