"""WMTS 1.0.0: tiles of the levels that a server describes, by templates of addresses or by queries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import parse_qsl, quote, urljoin, urlsplit
from xml.etree import ElementTree as Xml

from engine.errors import MapError, OptionError
from scenematch.fetch.client import PLACEHOLDER, check_url
from scenematch.fetch.mosaic import (
    Level,
    Mosaic,
    Wanted,
    check_count,
    fine_enough,
    mosaic_of,
    tiles_over,
)
from scenematch.fetch.services import (
    BYTES_PER_PX,
    check_covers,
    chosen_crs,
    chosen_format,
    chosen_name,
    code_of,
    crs_of,
    is_known,
    is_north_first,
    names_of,
    numbers,
    query_value,
    stated,
    with_query,
)

_HREF = "{http://www.w3.org/1999/xlink}href"
_PIXEL_M = 0.00028  # of the screen that scale denominators are stated for


@dataclass(frozen=True, slots=True)
class _Chosen:
    """What of a layer is asked for."""

    layer: Xml.Element
    name: str
    matrix_set: str
    kind: str


def plan_wmts(root: Xml.Element, url: str, wanted: Wanted) -> Mosaic:
    """The tiles of a WMTS over a place.

    Args:
        root: its capabilities.
        url: their address, which others are relative to.
        wanted: where, how fine, and what of it.

    Raises:
        OptionError: what was asked for is not offered there, or there are more tiles.
        MapError: the capabilities cannot be understood.
    """
    layers = root.findall("{*}Contents/{*}Layer")
    asked = wanted.layer or query_value(url, "layer")
    name = chosen_name("layer", asked, names_of(layers, "Identifier"), "one that the server has")
    element = next(one for one in layers if (one.findtext("{*}Identifier") or "").strip() == name)
    box = [
        numbers(element.findtext(f"{{*}}WGS84BoundingBox/{{*}}{tag}")) for tag in ("LowerCorner", "UpperCorner")
    ]
    check_covers([*box[0], *box[1]] if all(len(corner) == 2 for corner in box) else None, wanted.place)
    sets = _matrix_sets(root, element)
    code = chosen_crs(wanted.crs, list(sets), wanted.place)
    matrix_set, levels = sets[code]
    kind = chosen_format(wanted.image_format, [e.text.strip() for e in element.iterfind("{*}Format") if e.text])
    level = fine_enough(levels, wanted.gsd_m_per_px, wanted.place.metres_per_unit(crs_of(code)))
    part = tiles_over(level, wanted.place.bounds(crs_of(code)))
    check_count(part, wanted.max_tiles)
    url_of = _address(url, _query_address(root, url), _Chosen(element, name, matrix_set, kind), level)
    bytes_per_px = BYTES_PER_PX.get(kind.split(";")[0], 0.5)
    states = stated(root.find("{*}ServiceIdentification"))
    rest = {"kind": "WMTS", "gaps": True, "bytes_per_px": bytes_per_px, "states": states}
    return mosaic_of(level, part, crs_of(code), wanted.place, url_of, **rest)


def _matrix_sets(root: Xml.Element, layer: Xml.Element) -> dict[str, tuple[str, list[Level]]]:
    """The sets of levels that a layer has, by the code of their coordinate system; of each known one the first."""
    linked = names_of(layer.iterfind("{*}TileMatrixSetLink"), "TileMatrixSet")
    found: dict[str, tuple[str, list[Level]]] = {}
    for element in root.iterfind("{*}Contents/{*}TileMatrixSet"):
        name = (element.findtext("{*}Identifier") or "").strip()
        code = code_of(element.findtext("{*}SupportedCRS") or "")
        if name in linked and code not in found and is_known(code):
            found[code] = (name, [_level(matrix, code) for matrix in element.iterfind("{*}TileMatrix")])
    return {code: (name, levels) for code, (name, levels) in found.items() if levels}


def _level(matrix: Xml.Element, code: str) -> Level:
    tags = ("ScaleDenominator", "TileWidth", "TileHeight", "MatrixWidth", "MatrixHeight")
    values = [numbers(matrix.findtext(f"{{*}}{tag}")) for tag in tags]
    corner = numbers(matrix.findtext("{*}TopLeftCorner"))
    name = (matrix.findtext("{*}Identifier") or "").strip()
    if any(len(value) != 1 or value[0] <= 0.0 for value in values) or len(corner) != 2:
        raise MapError(f"source: expected a scale, a corner and sizes of the tile matrix {name!r}, got others")
    crs = crs_of(code)
    x, y = reversed(corner) if is_north_first(crs) else corner
    ((scale,), *sizes) = values
    width, height, columns, rows = (int(size[0]) for size in sizes)
    step = scale * _PIXEL_M / _metres_per_unit(code)
    return Level(name, (x, y), (step, step), (width, height), columns, rows)


def _metres_per_unit(code: str) -> float:
    """Of a coordinate system as WMTS counts: a degree is one of the equator."""
    axis = crs_of(code).axis_info[0]
    return 6378137.0 * axis.unit_conversion_factor if "degree" in axis.unit_name else axis.unit_conversion_factor


def _query_address(root: Xml.Element, url: str) -> str:
    """Where tiles are asked for by queries: as the server states it, else where its capabilities are.

    What the user's address has in its query, such as a key, is kept at the same host and sent to no other.

    Raises:
        OptionError: it is no address.
    """
    path = "{*}OperationsMetadata/{*}Operation[@name='GetTile']/{*}DCP/{*}HTTP/{*}Get"
    stated_at = (get.get(_HREF, "") for get in root.iterfind(path) if _takes_queries(get))
    href = next((href for href in stated_at if href), None)
    if href is None:
        return url
    href = urljoin(url, href)
    check_url("source", href)
    if urlsplit(href).netloc != urlsplit(url).netloc:
        return href
    own = dict(parse_qsl(urlsplit(url).query, keep_blank_values=True))
    return with_query(href, {name: value for name, value in own.items() if query_value(href, name) is None})


def _takes_queries(get: Xml.Element) -> bool:
    """Whether an address takes queries: it says so, or says nothing."""
    ways = [(value.text or "").strip() for value in get.iterfind("{*}Constraint/{*}AllowedValues/{*}Value")]
    return not ways or "KVP" in ways


def _address(url: str, query_url: str, chosen: _Chosen, level: Level) -> Callable[[int, int], str]:
    """The function from column and row to the address of a tile: by a template if there is one, else by query.

    Raises:
        OptionError: the template needs a value that is not known.
    """
    style = next((s for s in chosen.layer.iterfind("{*}Style") if s.get("isDefault") == "true"), None)
    style = chosen.layer.find("{*}Style") if style is None else style
    values = {
        "Style": "" if style is None else (style.findtext("{*}Identifier") or "").strip(),
        "TileMatrixSet": chosen.matrix_set,
        "TileMatrix": level.name,
    }
    for dimension in chosen.layer.iterfind("{*}Dimension"):
        values[(dimension.findtext("{*}Identifier") or "").strip()] = (
            dimension.findtext("{*}Default") or ""
        ).strip()
    template = next(
        (
            resource.get("template", "")
            for resource in chosen.layer.iterfind("{*}ResourceURL")
            if resource.get("resourceType") == "tile" and resource.get("format") == chosen.kind
        ),
        None,
    )
    if template is None:
        fixed = {"SERVICE": "WMTS", "REQUEST": "GetTile", "VERSION": "1.0.0", "LAYER": chosen.name}
        fixed |= {name.upper(): value for name, value in values.items()} | {"FORMAT": chosen.kind}
        return lambda column, row: with_query(query_url, fixed | {"TILEROW": str(row), "TILECOL": str(column)})
    template = urljoin(url, template)
    check_url("source", template)
    known = {name.lower(): quote(value, safe=":") for name, value in values.items()}
    unknown = {n.lower() for n in PLACEHOLDER.findall(template)} - set(known) - {"tilerow", "tilecol"}
    if unknown:
        raise OptionError(
            f"source: the server's tiles have a value that is not known, {', '.join(sorted(unknown))}"
        )
    return lambda column, row: PLACEHOLDER.sub(
        lambda name: (known | {"tilerow": str(row), "tilecol": str(column)})[name[1].lower()], template
    )
