"""Tiles by a template with zoom level, column and row: XYZ, TMS and quadkeys, in Web Mercator."""

from __future__ import annotations

import math

from engine.errors import OptionError
from scenematch.fetch.crs import crs_of
from scenematch.fetch.grid import FINE_ENOUGH, Access, Grid, gdal_xml, part_of
from scenematch.fetch.place import Wanted
from scenematch.fetch.urls import PLACEHOLDER, shown

_MAX_SIDE_PX = 2**31  # of GDAL's rasters


def is_template(url: str) -> bool:
    """Whether a source is a template of tiles, and not a service that describes itself."""
    return bool(PLACEHOLDER.search(url))


def plan_xyz(template: str, wanted: Wanted, tile_px: int, access: Access) -> Grid:
    """The tiles of a template over a place, in Web Mercator.

    Raises:
        OptionError: a placeholder of the template is unknown, or one is missing.
    """
    if sorted(PLACEHOLDER.findall(template)) not in (["q"], ["x", "y", "z"], ["-y", "x", "z"]):
        expected = "{z}, {x} and {y} (or {-y}), or {q}, in a template of tiles"
        raise OptionError(f"source: expected {expected}, got {shown(template)!r}")
    crs, place = crs_of("EPSG:3857"), wanted.place
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
        } | access.elements(),
    )  # fmt: skip
    side, step = tile_px << zoom, steps[zoom]
    return part_of("XYZ", str(zoom), source, (-half, half), (step, step), place, crs, (side, side), tile_px)
