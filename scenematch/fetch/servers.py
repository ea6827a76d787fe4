"""Map servers as rasters that GDAL opens: tiles by a template, WMS and WMTS, on the grid that suits a place.

GDAL requests the pictures. This module chooses layer, coordinate system and level, from the service's
capabilities.
"""

from __future__ import annotations

import math

from engine.errors import OptionError
from scenematch.fetch.crs import crs_of
from scenematch.fetch.grid import FINE_ENOUGH, Grid, Wanted, gdal_xml, part_of
from scenematch.fetch.services import capabilities
from scenematch.fetch.urls import PLACEHOLDER, shown
from scenematch.fetch.wms import plan_wms
from scenematch.fetch.wmts import plan_wmts

_MAX_SIDE_PX = 2**31  # of GDAL's rasters


def plan(url: str, wanted: Wanted) -> Grid:
    """Plan the requests; a service is first asked for its capabilities.

    Raises:
        OptionError: the address or the request is invalid, or there are more pieces than allowed.
        MapError: the server refuses, or is not a supported service.
    """
    if is_template(url):
        grid = plan_tiles(url, wanted)
    else:
        root = capabilities(url, wanted.settings.timeout_s)
        service = root.tag.rpartition("}")[2]
        grid = (plan_wmts if service == "Capabilities" else plan_wms)(root, url, wanted)
    most = wanted.settings.max_tiles
    if grid.tiles > most:
        raise OptionError(
            f"max_tiles: expected at most {most} tiles, but the area has {grid.tiles}; choose a "
            "smaller `radius_m` or a larger `gsd_m_per_px`, or allow them if the server's terms do"
        )
    return grid


def is_template(url: str) -> bool:
    """Whether a source is a template of tiles, and not a service that describes itself."""
    return bool(PLACEHOLDER.search(url))


def plan_tiles(template: str, wanted: Wanted) -> Grid:
    """The tiles of a template over a place, in Web Mercator: XYZ, TMS or quadkeys.

    Raises:
        OptionError: a placeholder of the template is unknown, or one is missing.
    """
    if sorted(PLACEHOLDER.findall(template)) not in (["q"], ["x", "y", "z"], ["-y", "x", "z"]):
        expected = "{z}, {x} and {y} (or {-y}), or {q}, in a template of tiles"
        raise OptionError(f"source: expected {expected}, got {shown(template)!r}")
    crs, place, tile_px = crs_of("EPSG:3857"), wanted.place, wanted.settings.tile_px
    half = math.pi * 6378137.0  # of the world's side in metres
    deepest = (_MAX_SIDE_PX // tile_px - 1).bit_length() - 1
    steps = [2.0 * half / (tile_px << zoom) for zoom in range(deepest + 1)]
    fine = [z for z, s in enumerate(steps) if place.gsd_m_per_px((s, s), crs) <= wanted.gsd_m_per_px * FINE_ENOUGH]
    zoom = min(fine, default=deepest)
    named = {"z": "${z}", "x": "${x}", "y": "${y}", "-y": "${y}", "q": "${quadkey}"}
    window = {
        "UpperLeftX": -half, "UpperLeftY": half, "LowerRightX": half, "LowerRightY": -half, "TileLevel": zoom,
        "TileCountX": 1, "TileCountY": 1, "YOrigin": "bottom" if "{-y}" in template else "top",
    }  # fmt: skip
    service = 'Service name="VirtualEarth"' if "{q}" in template else 'Service name="TMS"'
    source = gdal_xml(
        "GDAL_WMS",
        {
            service: {"ServerUrl": PLACEHOLDER.sub(lambda name: named[name[1]], template)},
            "DataWindow": window, "Projection": "EPSG:3857", "BlockSizeX": tile_px, "BlockSizeY": tile_px,
            "OverviewCount": 0,
        } | wanted.elements(),
    )  # fmt: skip
    side, step = tile_px << zoom, steps[zoom]
    return part_of("XYZ", str(zoom), source, (-half, half), (step, step), place, crs, (side, side), tile_px)
