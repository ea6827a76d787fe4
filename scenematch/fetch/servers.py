"""Map servers as rasters that GDAL opens: tiles by a template, WMS and WMTS, on the grid that suits a place.

GDAL asks for the pictures. What is asked here is which layer, coordinate system and level: of a service by the
capabilities in which it describes itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, urlencode, urlsplit, urlunsplit
from xml.etree import ElementTree as Xml
from xml.sax.saxutils import escape

from engine.errors import MapError, OptionError
from scenematch.fetch.crs import chosen_crs, chosen_name, code_of, crs_of, is_known
from scenematch.fetch.place import Bounds, Place, Wanted
from scenematch.fetch.urls import PLACEHOLDER, shown, user_agent

if TYPE_CHECKING:
    from pyproj import CRS

FINE_ENOUGH = 1.02
"""Levels of tiles are so seldom as fine as asked that this much coarser counts as such."""
TILE_PX = 256
FORMATS = ("image/png", "image/jpeg", "image/webp")
"""Of pictures that are read, the first that is offered is asked for: PNG loses nothing and can be transparent."""
_HALF_WORLD_M = math.pi * 6378137.0
_MAX_SIDE_PX = 2**31  # of GDAL's rasters
_MAX_WMS_PX = 1024  # of a piece that a WMS draws, if it allows so much
_HREF = "{http://www.w3.org/1999/xlink}href"
_OWN_WORDS = ("service", "request", "version", "layer", "layers", "format", "styles", "crs", "srs")
_STATED = ("Title", "Fees", "AccessConstraints")


@dataclass(frozen=True, slots=True)
class Access:
    """How a server is asked.

    Attributes:
        timeout_s: of a request.
        cache: folder of what was fetched.
    """

    timeout_s: float
    cache: Path

    def elements(self) -> dict[str, Any]:
        """What GDAL's descriptions of services have in common."""
        return {
            "BandsCount": 4,
            "ZeroBlockHttpCodes": "204,404,410",
            "MaxConnections": 1,
            "Timeout": math.ceil(self.timeout_s),
            "UserAgent": user_agent(),
            "Cache": {"Path": self.cache},
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """The part of a server's raster that becomes the map.

    Attributes:
        kind: "XYZ", "WMS" or "WMTS".
        level: the zoom level; of a WMS or WMTS the coordinate system.
        source: what GDAL opens.
        overview: of the source's levels, None the finest.
        offset_px: column and row of the map in it.
        size_px: width and height of the map.
        tile_px: width and height of what is asked for at a time.
        corner: x and y of the north-western corner of the map.
        step: size of a pixel in x and y.
        crs: of the map.
        gsd_m_per_px: on the ground, in the middle.
        states: what the server says of itself, by name.
    """

    kind: str
    level: str
    source: str
    overview: int | None = None
    offset_px: tuple[int, int] = (0, 0)
    size_px: tuple[int, int]
    tile_px: tuple[int, int]
    corner: tuple[float, float]
    step: tuple[float, float]
    crs: CRS
    gsd_m_per_px: float
    states: Mapping[str, str] = field(default_factory=dict)

    @property
    def tiles(self) -> int:
        """How many pictures are asked for, of a WMTS about."""
        (width, height), (across, down) = self.size_px, self.tile_px
        return math.ceil(width / across) * math.ceil(height / down)

    @property
    def bounds(self) -> Bounds:
        """Outer edges of the map."""
        (x, y), (width, height) = self.corner, self.size_px
        return x, y - height * self.step[1], x + width * self.step[0], y


def plan(url: str, wanted: Wanted, tile_px: int, access: Access) -> Grid:
    """What is to be asked for; a service is asked for its capabilities first.

    Raises:
        OptionError: the address or what was asked for cannot be, or there are more pieces than allowed.
        MapError: the server refuses, or describes itself as no service that is read.
    """
    if is_template(url):
        grid = _plan_xyz(url, wanted, tile_px, access)
    else:
        root = _capabilities(url, access)
        service = root.tag.rpartition("}")[2]
        grid = (_plan_wmts if service == "Capabilities" else _plan_wms)(root, url, wanted, access)
    if grid.tiles > wanted.max_tiles:
        raise OptionError(
            f"max_tiles: expected at most {wanted.max_tiles} tiles, but the area has {grid.tiles}; choose a "
            "smaller `radius_m` or a larger `gsd_m_per_px`, or allow them if the server's terms do"
        )
    return grid


# ------------------------------------------------------------------------------------------------------ tiles


def is_template(url: str) -> bool:
    """Whether a source is a template of tiles, and not a service that describes itself."""
    return bool(PLACEHOLDER.search(url))


def check_template(url: str) -> None:
    """Refuse a template that does not name a tile.

    Raises:
        OptionError: a placeholder is unknown, or one is missing.
    """
    if sorted(PLACEHOLDER.findall(url)) not in (["q"], ["x", "y", "z"], ["-y", "x", "z"]):
        raise OptionError(
            "source: expected {z}, {x} and {y} (or {-y}), or {q}, in a template of tiles, got "
            f"{shown(url)!r}"
        )


def _plan_xyz(template: str, wanted: Wanted, tile_px: int, access: Access) -> Grid:
    """The tiles of a template over a place, in Web Mercator."""
    check_template(template)
    crs, place = crs_of("EPSG:3857"), wanted.place
    deepest = (_MAX_SIDE_PX // tile_px - 1).bit_length() - 1
    steps = [2.0 * _HALF_WORLD_M / (tile_px << zoom) for zoom in range(deepest + 1)]
    fine = [z for z, s in enumerate(steps) if place.gsd_m_per_px((s, s), crs) <= wanted.gsd_m_per_px * FINE_ENOUGH]
    zoom = min(fine, default=deepest)
    named = {"z": "${z}", "x": "${x}", "y": "${y}", "-y": "${y}", "q": "${quadkey}"}
    half = _HALF_WORLD_M
    window = {
        "UpperLeftX": -half, "UpperLeftY": half, "LowerRightX": half, "LowerRightY": -half, "TileLevel": zoom,
        "TileCountX": 1, "TileCountY": 1, "YOrigin": "bottom" if "{-y}" in template else "top",
    }  # fmt: skip
    service = 'Service name="VirtualEarth"' if "{q}" in template else 'Service name="TMS"'
    source = _xml(
        "GDAL_WMS",
        {
            service: {"ServerUrl": PLACEHOLDER.sub(lambda name: named[name[1]], template)},
            "DataWindow": window, "Projection": "EPSG:3857", "BlockSizeX": tile_px, "BlockSizeY": tile_px,
            "OverviewCount": 0,
        } | access.elements(),
    )  # fmt: skip
    side, step = tile_px << zoom, steps[zoom]
    return _part_of("XYZ", str(zoom), source, (-half, half), (step, step), place, crs, (side, side), tile_px)


def _part_of(
    kind: str,
    level: str,
    source: str,
    corner: tuple[float, float],
    step: tuple[float, float],
    place: Place,
    crs: CRS,
    sides_px: tuple[int, int],
    multiple_px: int = 1,
    **rest: Any,
) -> Grid:
    """The part of a raster over a place, from one multiple of some pixels to another.

    Raises:
        MapError: the raster has nothing there.
    """
    west, south, east, north = place.bounds(crs)
    edge = 1e-6  # of a pixel, beyond which bounds reach into the next one
    first = [(west - corner[0]) / step[0], (corner[1] - north) / step[1]]
    last = [(east - corner[0]) / step[0], (corner[1] - south) / step[1]]
    begin = [max(0, math.floor(v / multiple_px + edge)) * multiple_px for v in first]
    ends = [
        min(side, math.ceil(v / multiple_px - edge) * multiple_px) for v, side in zip(last, sides_px, strict=True)
    ]
    if ends[0] <= begin[0] or ends[1] <= begin[1]:
        raise MapError(f"source: the server has no tiles there on its level {level!r}")
    return Grid(
        kind=kind,
        level=level,
        source=source,
        offset_px=(begin[0], begin[1]),
        size_px=(ends[0] - begin[0], ends[1] - begin[1]),
        tile_px=(TILE_PX, TILE_PX) if multiple_px == 1 else (multiple_px, multiple_px),
        corner=(corner[0] + begin[0] * step[0], corner[1] - begin[1] * step[1]),
        step=step,
        crs=crs,
        gsd_m_per_px=place.gsd_m_per_px(step, crs),
        **rest,
    )


# --------------------------------------------------------------------------------------------------- services


def _capabilities(url: str, access: Access) -> Xml.Element:
    """The document in which a service describes itself.

    Raises:
        MapError: there is none, or it is of no service that is read.
    """
    from http.client import HTTPException
    from urllib.error import HTTPError, URLError
    from urllib.request import Request, urlopen

    asked = url
    if not url.partition("?")[0].lower().endswith(".xml"):
        service = _query_value(url, "service") or ("WMTS" if "wmts" in url.lower() else "WMS")
        asked = _with_query(url, {"SERVICE": service.upper(), "REQUEST": "GetCapabilities"})
    try:
        with urlopen(Request(asked, headers={"User-Agent": user_agent()}), timeout=access.timeout_s) as answer:
            root = Xml.fromstring(answer.read())
    except HTTPError as error:
        with error:
            raise MapError(f"{shown(asked)}: the server answers {error.code} {error.reason}") from None
    except (URLError, OSError, HTTPException, ValueError) as error:
        raise MapError(f"{shown(asked)}: cannot be asked: {shown(str(getattr(error, 'reason', error)))}") from None
    except Xml.ParseError:
        root = None
    if root is None or root.tag.rpartition("}")[2] not in (
        "WMS_Capabilities",
        "WMT_MS_Capabilities",
        "Capabilities",
    ):
        raise MapError(f"{shown(asked)}: expected the capabilities of a WMS or WMTS, got something else")
    return root


def _plan_wms(root: Xml.Element, url: str, wanted: Wanted, access: Access) -> Grid:
    """A map that the server draws on a grid in pixels of the size asked for."""
    layers = {name: layer for layer in root.iterfind(".//{*}Layer") if (name := _text(layer, "Name"))}
    leaves = [name for name, layer in layers.items() if layer.find("{*}Layer") is None]
    asked = wanted.layer or _query_value(url, "layers")
    names = (asked or chosen_name("layer", None, leaves, "one that the server has")).split(",")
    for name in names:
        chosen_name("layer", name, list(layers), "one that the server has")
    offered = [
        c for tag in ("CRS", "SRS") for e in root.iterfind(f".//{{*}}{tag}") for c in (e.text or "").split()
    ]
    code, place = chosen_crs(wanted.crs, list(dict.fromkeys(offered)), wanted.place), wanted.place
    kind = _chosen_format(
        wanted.image_format or _query_value(url, "format"), root.iterfind(".//{*}GetMap/{*}Format")
    )
    crs, version = crs_of(code), root.get("version", "1.3.0")
    new = version.startswith("1.3")
    north_first = new and code.startswith("EPSG:") and crs.axis_info[0].direction.lower() == "north"
    corner, step, size = _grid(place, crs, wanted.gsd_m_per_px)
    piece = [
        _piece_px(side, root.findtext(f".//{{*}}{tag}"))
        for side, tag in zip(size, ("MaxWidth", "MaxHeight"), strict=True)
    ]
    service = {
        "Version": version, "ServerUrl": _with_query(url, {}, without=_OWN_WORDS).rstrip("?") + "?",
        "CRS" if new else "SRS": code, "Layers": ",".join(names), "Styles": _query_value(url, "styles") or "",
        "ImageFormat": kind, "Transparent": "TRUE" if "png" in kind else "FALSE",
        "BBoxOrder": "yxYX" if north_first else "xyXY",
    }  # fmt: skip
    window = {
        "UpperLeftX": corner[0], "UpperLeftY": corner[1], "LowerRightX": corner[0] + size[0] * step[0],
        "LowerRightY": corner[1] - size[1] * step[1], "SizeX": size[0], "SizeY": size[1],
    }  # fmt: skip
    source = _xml(
        "GDAL_WMS",
        {
            'Service name="WMS"': service, "DataWindow": window, "Projection": crs.to_string(),
            "BlockSizeX": piece[0], "BlockSizeY": piece[1], "OverviewCount": 0,
        } | access.elements(),
    )  # fmt: skip
    credited = dict.fromkeys(_text(one, "Title") for one in root.iterfind(".//{*}Attribution"))
    states = _stated(root.find("{*}Service")) | ({"Attribution": "; ".join(credited)} if credited else {})
    return Grid(
        kind="WMS", level=code, source=source, size_px=size, tile_px=(piece[0], piece[1]), corner=corner,
        step=step, crs=crs, gsd_m_per_px=place.gsd_m_per_px(step, crs), states=states,
    )  # fmt: skip


def _grid(
    place: Place, crs: CRS, gsd_m_per_px: float
) -> tuple[tuple[float, float], tuple[float, float], tuple[int, int]]:
    """Corner, step and size of a grid over a place, whose pixels begin at multiples of their size."""
    west, south, east, north = place.bounds(crs)
    metres = place.metres_per_unit(crs)
    step = gsd_m_per_px / metres[0], gsd_m_per_px / metres[1]
    x, y = math.floor(west / step[0]), math.ceil(north / step[1])
    size = math.ceil(east / step[0]) - x, y - math.floor(south / step[1])
    return (x * step[0], y * step[1]), step, size


def _piece_px(side: int, stated: str | None) -> int:
    """Side of a piece, so that all are of about one size."""
    most = min(_MAX_WMS_PX, int(stated)) if stated and stated.strip().isdecimal() and int(stated) else _MAX_WMS_PX
    return math.ceil(side / math.ceil(side / most))


def _plan_wmts(root: Xml.Element, url: str, wanted: Wanted, access: Access) -> Grid:
    """The level of a WMTS that is fine enough, as GDAL reads it."""
    import rasterio
    from rasterio.errors import RasterioError

    layers = {_text(layer, "Identifier"): layer for layer in root.iterfind("{*}Contents/{*}Layer")}
    asked = wanted.layer or _query_value(url, "layer")
    name = chosen_name("layer", asked, list(layers), "one that the server has")
    linked = [_text(link, "TileMatrixSet") for link in layers[name].iterfind("{*}TileMatrixSetLink")]
    sets: dict[str, str] = {}
    for one in root.iterfind("{*}Contents/{*}TileMatrixSet"):
        code = code_of(_text(one, "SupportedCRS"))
        if _text(one, "Identifier") in linked and is_known(code):
            sets.setdefault(code, _text(one, "Identifier"))
    code = chosen_crs(wanted.crs, list(sets), wanted.place)
    document = url if url.partition("?")[0].lower().endswith(".xml") else _with_query(
        url, {"SERVICE": "WMTS", "REQUEST": "GetCapabilities"})  # fmt: skip
    source = _xml(
        "GDAL_WMTS",
        {
            "GetCapabilitiesUrl": document, "ExtraQueryParameters": _extra_query(root, url), "Layer": name,
            "TileMatrixSet": sets[code],
            "Format": _chosen_format(wanted.image_format, layers[name].iterfind("{*}Format")),
        } | access.elements(),
    )  # fmt: skip
    crs, place = crs_of(code), wanted.place
    try:
        with rasterio.open(source) as raster:
            t, sizes = raster.transform, (raster.width, raster.height)
            factors = [1, *raster.overviews(1)]
    except RasterioError as error:
        raise MapError(f"{shown(url)}: cannot be read as a WMTS: {shown(reason_of(error))}") from None
    fine = [
        k for k, f in enumerate(factors)
        if place.gsd_m_per_px((t.a * f, -t.e * f), crs) <= wanted.gsd_m_per_px * FINE_ENOUGH
    ]  # fmt: skip
    chosen = max(fine, default=0)
    step = t.a * factors[chosen], -t.e * factors[chosen]
    size = sizes[0] // factors[chosen], sizes[1] // factors[chosen]
    overview, states = chosen - 1 if chosen else None, _stated(root.find("{*}ServiceIdentification"))
    return _part_of("WMTS", code, source, (t.c, t.f), step, place, crs, size, overview=overview, states=states)


def _extra_query(root: Xml.Element, url: str) -> str:
    """What the user's address has in its query besides, such as a key: for the same host, and no other."""
    elements = [*root.iterfind(".//{*}Operation[@name='GetTile']//{*}Get"), *root.iterfind(".//{*}ResourceURL")]
    hosts = {urlsplit(one.get(_HREF) or one.get("template", "")).netloc for one in elements} - {""}
    if not hosts <= {urlsplit(url).netloc}:
        return ""
    return urlencode([pair for pair in parse_qsl(urlsplit(url).query) if pair[0].lower() not in _OWN_WORDS])


def reason_of(error: BaseException) -> str:
    """What GDAL says was wrong, in one line: rasterio hides it behind a cause of causes."""
    texts = [" ".join(str(error).split())]
    while error.__cause__ is not None:
        error = error.__cause__
        texts.append(" ".join(str(error).split()))
    return next((text for text in texts[1:] if "HTTP status" in text or "exception" in text.lower()), texts[-1])


def _chosen_format(asked: str | None, elements: Any) -> str:
    """The format of the pictures: the one that was asked for, else the first of :data:`FORMATS`."""
    offered = [(e.text or "").strip() for e in elements]
    readable = [name for name in offered if name.split(";")[0].strip() in FORMATS]
    if asked is None and readable:
        return min(readable, key=lambda name: (FORMATS.index(name.split(";")[0].strip()), len(name)))
    return chosen_name("image_format", asked, readable, "a format that the server offers and that is read")


def _with_query(url: str, values: Mapping[str, str], *, without: Sequence[str] = ()) -> str:
    """A URL with further query parameters; those of the same names, in any case, and ``without`` leave it."""
    parts = urlsplit(url)
    dropped = {name.lower() for name in (*values, *without)}
    kept = [pair for pair in parse_qsl(parts.query, keep_blank_values=True) if pair[0].lower() not in dropped]
    return urlunsplit(
        parts._replace(query=urlencode([*kept, *values.items()], safe=":,/", quote_via=quote), fragment="")
    )


def _query_value(url: str, name: str) -> str | None:
    """The value of a query parameter, by its name in any case; None where it is missing or empty."""
    return next((value for key, value in parse_qsl(urlsplit(url).query) if key.lower() == name.lower()), None)


def _text(element: Xml.Element, tag: str) -> str:
    return " ".join((element.findtext(f"{{*}}{tag}") or "").split())


def _stated(service: Xml.Element | None) -> dict[str, str]:
    """What a service says of itself and of its use."""
    return {} if service is None else {name: text for name in _STATED if (text := _text(service, name))}


def _xml(tag: str, values: Mapping[str, Any]) -> str:
    """A description that GDAL opens; empty values are left out."""
    inner = "".join(
        _xml(name, value) if isinstance(value, Mapping) else f"<{name}>{escape(str(value))}</{name}>"
        for name, value in values.items()
        if value != ""
    )
    return f"<{tag}>{inner}</{tag.split()[0]}>"
