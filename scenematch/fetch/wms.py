"""WMS 1.1.1 and 1.3.0: a map drawn by the server on the grid that is asked for, in pieces."""

from __future__ import annotations

import math
from collections.abc import Iterator
from xml.etree import ElementTree as Xml

from engine.errors import OptionError
from scenematch.fetch.mosaic import (
    Level,
    Mosaic,
    Part,
    Place,
    Wanted,
    check_count,
    mosaic_of,
)
from scenematch.fetch.services import (
    BYTES_PER_PX,
    attribute_numbers,
    check_covers,
    chosen_crs,
    chosen_format,
    chosen_name,
    crs_of,
    is_north_first,
    names_of,
    numbers,
    query_value,
    stated,
    with_query,
)

PIECE_PX = 1024
"""Largest side of a piece; a server may allow less."""
_Path = tuple[Xml.Element, ...]  # a layer and those around it, the innermost last


def plan_wms(root: Xml.Element, url: str, wanted: Wanted) -> Mosaic:
    """The pieces of a map by a WMS.

    Args:
        root: its capabilities.
        url: its address, as the user named it; what else is in the query is kept.
        wanted: where, how fine, and what of it.

    Raises:
        OptionError: what was asked for is not offered there, or there are more pieces.
        MapError: the capabilities cannot be understood.
    """
    paths = _asked_layers(root, wanted.layer or query_value(url, "layers"))
    for path in paths:
        check_covers(_box(path), wanted.place)
    code = chosen_crs(wanted.crs, _offered_crs(paths), wanted.place)
    formats = [e.text.strip() for e in root.iterfind("{*}Capability/{*}Request/{*}GetMap/{*}Format") if e.text]
    kind = chosen_format(wanted.image_format or query_value(url, "format"), formats)
    service = root.find("{*}Service")
    level = _grid(wanted.place, code, wanted.gsd_m_per_px, _most_px(service))
    part = Part(0, 0, level.columns, level.rows)
    check_count(part, wanted.max_tiles)
    names = ",".join(name for path in paths for name in names_of(path[-1:], "Name"))
    request = _get_map(url, root.get("version", "1.3.0"), names, code, kind, level.tile_px)
    north_first = "CRS" in request and code.startswith("EPSG:") and is_north_first(crs_of(code))

    def url_of(column: int, row: int) -> str:
        west, north = level.corner_of(column, row)
        east, south = west + level.tile_px[0] * level.step[0], north - level.tile_px[1] * level.step[1]
        box = (south, west, north, east) if north_first else (west, south, east, north)
        return with_query(url, request | {"BBOX": ",".join(map(repr, box))}, without=("srs", "crs"))

    bytes_per_px = BYTES_PER_PX.get(kind.split(";")[0], 0.5)
    rest = {"kind": "WMS", "gaps": False, "bytes_per_px": bytes_per_px, "states": _states(service, paths)}
    return mosaic_of(level, part, crs_of(code), wanted.place, url_of, **rest)


def _asked_layers(root: Xml.Element, asked: str | None) -> list[_Path]:
    """The layers that were asked for, or the only one that has a name.

    Raises:
        OptionError: one is not there, or several are and none was asked for.
    """
    found = {name: path for path in _layers(root) for name in names_of(path[-1:], "Name")}
    leaves = [name for name, path in found.items() if path[-1].find("{*}Layer") is None]
    if asked is None:
        return [found[chosen_name("layer", None, leaves, "one that the server has")]]
    unknown = [name for name in asked.split(",") if name not in found]
    if unknown:
        chosen_name("layer", unknown[0], list(found), "one that the server has")
    return [found[name] for name in asked.split(",")]


def _layers(root: Xml.Element) -> Iterator[_Path]:
    """Every layer with those around it, from which it inherits."""
    pending: list[_Path] = [(layer,) for layer in root.iterfind("{*}Capability/{*}Layer")]
    while pending:
        path = pending.pop(0)
        yield path
        pending = [(*path, inner) for inner in path[-1].iterfind("{*}Layer")] + pending


def _offered_crs(paths: list[_Path]) -> list[str]:
    """The codes that all of some layers offer, in the order of the first."""
    offered = [
        [code for layer in path for tag in ("CRS", "SRS") for e in layer.iterfind(f"{{*}}{tag}")
         for code in (e.text or "").split()]
        for path in paths
    ]  # fmt: skip
    return [code for code in dict.fromkeys(offered[0]) if all(code in codes for codes in offered)]


def _box(path: _Path) -> list[float] | None:
    """West, south, east, north in degrees that a layer states or inherits."""
    for layer in reversed(path):
        box = layer.find("{*}EX_GeographicBoundingBox")
        if box is not None:
            tags = ("westBoundLongitude", "southBoundLatitude", "eastBoundLongitude", "northBoundLatitude")
            found = numbers(" ".join(box.findtext(f"{{*}}{tag}") or "" for tag in tags))
        else:
            box = layer.find("{*}LatLonBoundingBox")
            found = [] if box is None else attribute_numbers(box, ("minx", "miny", "maxx", "maxy"))
        if len(found) == 4:
            return found
    return None


def _most_px(service: Xml.Element | None) -> tuple[int, int]:
    """Largest width and height of a piece."""
    if service is None:
        return PIECE_PX, PIECE_PX
    width, height = (numbers(service.findtext(f"{{*}}{tag}")) for tag in ("MaxWidth", "MaxHeight"))
    return tuple(min(PIECE_PX, int(most[0])) if most and most[0] >= 1 else PIECE_PX for most in (width, height))  # type: ignore[return-value]


def _grid(place: Place, code: str, gsd_m_per_px: float, most_px: tuple[int, int]) -> Level:
    """The grid of the map, whose pixels begin at multiples of their size, in pieces of one size."""
    crs = crs_of(code)
    west, south, east, north = place.bounds(crs)
    metres = place.metres_per_unit(crs)
    step = gsd_m_per_px / metres[0], gsd_m_per_px / metres[1]
    x0, y0 = math.floor(west / step[0]), math.ceil(north / step[1])
    width, height = math.ceil(east / step[0]) - x0, y0 - math.floor(south / step[1])
    columns, rows = math.ceil(width / most_px[0]), math.ceil(height / most_px[1])
    piece_px = math.ceil(width / columns), math.ceil(height / rows)
    return Level(code, (x0 * step[0], y0 * step[1]), step, piece_px, columns, rows)


def _get_map(url: str, version: str, names: str, code: str, kind: str, size: tuple[int, int]) -> dict[str, str]:
    """The query of a GetMap, without the box."""
    if version not in ("1.1.0", "1.1.1", "1.3.0"):
        raise OptionError(f"source: expected a WMS of version 1.1.0, 1.1.1 or 1.3.0, got {version!r}")
    return {
        "SERVICE": "WMS",
        "REQUEST": "GetMap",
        "VERSION": version,
        "LAYERS": names,
        "STYLES": query_value(url, "styles") or "",
        "CRS" if version == "1.3.0" else "SRS": code,
        "WIDTH": str(size[0]),
        "HEIGHT": str(size[1]),
        "FORMAT": kind,
        "TRANSPARENT": "TRUE" if kind.startswith("image/png") else "FALSE",
    }


def _states(service: Xml.Element | None, paths: list[_Path]) -> dict[str, str]:
    """What the server says of itself, and whom its layers credit."""
    credits_ = [
        title for path in paths for layer in path for title in names_of(layer.iterfind("{*}Attribution"), "Title")
    ]
    return stated(service) | ({"Attribution": "; ".join(dict.fromkeys(credits_))} if credits_ else {})
