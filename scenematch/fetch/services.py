"""Services that describe themselves: their capabilities, and which coordinate system and format are chosen."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, urlencode, urlsplit, urlunsplit
from xml.etree import ElementTree as Xml

from engine.errors import MapError, OptionError
from scenematch.fetch.client import Client, shown
from scenematch.fetch.mosaic import Place

if TYPE_CHECKING:
    from pyproj import CRS

FORMATS = ("image/png", "image/jpeg", "image/webp")
"""Of pictures that are read, the first that is offered is asked for: PNG loses nothing and can be transparent."""
BYTES_PER_PX = {"image/png": 2.0}
"""Of aerial pictures, roughly; of other formats 0.5."""
_MERCATOR = ("EPSG:3857", "EPSG:900913", "EPSG:102100")
_DEGREES = ("CRS:84", "OGC:CRS84", "EPSG:4326")
_ROOTS = ("WMS_Capabilities", "WMT_MS_Capabilities", "Capabilities")  # of WMS 1.3.0, 1.1.1, and WMTS
_STATED = ("Title", "Fees", "AccessConstraints")


def with_query(url: str, values: Mapping[str, str], *, without: Sequence[str] = ()) -> str:
    """A URL with further query parameters; those of the same names, in any case, and ``without`` leave it."""
    parts = urlsplit(url)
    dropped = {name.lower() for name in (*values, *without)}
    kept = [pair for pair in parse_qsl(parts.query, keep_blank_values=True) if pair[0].lower() not in dropped]
    query = urlencode([*kept, *values.items()], safe=":,/", quote_via=quote)
    return urlunsplit(parts._replace(query=query, fragment=""))


def query_value(url: str, name: str) -> str | None:
    """The value of a query parameter, by its name in any case; None where it is missing or empty."""
    pairs = parse_qsl(urlsplit(url).query)
    return next((value for key, value in pairs if key.lower() == name.lower()), None)


def capabilities(client: Client, url: str) -> Xml.Element:
    """The document in which a service describes itself.

    Raises:
        MapError: there is none, or it is of no service that is read.
    """
    answer = client.get(url)
    if answer is None:
        raise MapError(f"{shown(url)}: the server has nothing there (404); expected the capabilities of a service")
    try:
        root = Xml.fromstring(answer.content)
    except Xml.ParseError:
        root = None
    if root is None or root.tag.rpartition("}")[2] not in _ROOTS:
        raise MapError(f"{shown(url)}: expected the capabilities of a WMS or WMTS, got {snippet(answer.content)}")
    return root


def snippet(content: bytes) -> str:
    """What a person reads of an answer that was expected to be something else: its text, in quotes and cut off."""
    text = content[:4000].decode("utf-8", "replace")
    with suppress(Xml.ParseError):
        text = " ".join(Xml.fromstring(content).itertext())
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return repr(text[:200] + "..." * (len(text) > 200)) if text else "nothing"


def stated(service: Xml.Element | None) -> dict[str, str]:
    """What a service says of itself and of its use."""
    if service is None:
        return {}
    texts = {name: " ".join((service.findtext(f"{{*}}{name}") or "").split()) for name in _STATED}
    return {name: text for name, text in texts.items() if text}


def names_of(elements: Iterable[Xml.Element], tag: str) -> list[str]:
    """The texts of a child of each element, without those that lack it."""
    return [text.strip() for text in (element.findtext(f"{{*}}{tag}") for element in elements) if text]


def chosen_name(argument: str, asked: str | None, offered: Sequence[str], what: str) -> str:
    """A name among those that a service offers: the one that was asked for, else the only one.

    Raises:
        OptionError: it is not offered, or none was asked for and several are.
    """
    if asked is None and len(offered) == 1:
        return offered[0]
    if asked is None or asked not in offered:
        listed = ", ".join(offered[:20]) + (f" and {len(offered) - 20} more" if len(offered) > 20 else "")
        raise OptionError(f"{argument}: expected {what}, {listed or 'none'}, got {asked or 'none'}")
    return asked


def code_of(name: str) -> str:
    """EPSG:N of the ways in which services write it; others as they are."""
    parts = name.strip().split(":")
    if parts[0].lower() == "urn" and len(parts) >= 4:  # urn:ogc:def:crs:EPSG:6.18:3857, or with the version empty
        authority = parts[4]
        return "CRS:84" if parts[-1] == "CRS84" else f"{authority.upper()}:{parts[-1]}"
    if "/def/crs/" in name:  # http://www.opengis.net/def/crs/EPSG/0/3857
        authority, _, number = name.strip().split("/")[-3:]
        return "CRS:84" if number == "CRS84" else f"{authority.upper()}:{number}"
    return name.strip().upper()


def crs_of(code: str) -> CRS:
    """The coordinate system of a code.

    Raises:
        MapError: PROJ does not know it.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    known = {"CRS:84": "OGC:CRS84", "EPSG:900913": "EPSG:3857", "EPSG:102100": "EPSG:3857"}
    try:
        return CRS.from_user_input(known.get(code, code))
    except CRSError:
        raise MapError(f"crs: expected a coordinate system that PROJ knows, got {code!r}") from None


def is_known(code: str) -> bool:
    """Whether PROJ knows the coordinate system of a code."""
    try:
        crs_of(code)
    except MapError:
        return False
    return True


def _reaches(code: str, place: Place) -> bool:
    """Whether a coordinate system is one for a place, by the area that its authority states."""
    if not is_known(code):
        return False
    area = crs_of(code).area_of_use
    if area is None:
        return True
    west, east = area.west, area.east
    across = place.lon_deg >= west or place.lon_deg <= east  # of an area over 180 degrees
    inside = west <= place.lon_deg <= east if west <= east else across
    return bool(inside and area.south <= place.lat_deg <= area.north)


def is_north_first(crs: CRS) -> bool:
    """Whether the authority gives the first axis of a coordinate system northwards."""
    return bool(crs.axis_info) and crs.axis_info[0].direction.lower() == "north"


def chosen_crs(asked: str | None, offered: Sequence[str], place: Place) -> str:
    """The code of a coordinate system that is offered: the one asked for, else one in metres at the place.

    The UTM zone comes first, then Web Mercator, then any other but degrees; only what PROJ knows, and what is made
    for that part of the Earth.

    Raises:
        OptionError: the one that was asked for is not offered, or none is that will do.
    """
    codes = [code_of(name) for name in offered]
    if asked is not None or not codes:
        return chosen_name("crs", None if asked is None else code_of(asked), codes, "one that the server offers")
    zone = int(((place.lon_deg + 180.0) % 360.0) // 6.0) + 1
    bases = (32600, 25800, 26900) if place.lat_deg >= 0.0 else (32700,)  # WGS84, ETRS89, NAD83
    utm = tuple(f"EPSG:{base + zone}" for base in bases)
    others = [code for code in codes if code not in _DEGREES]
    ordered = (code for code in (*utm, *_MERCATOR, *others, *_DEGREES) if code in codes)
    chosen = next((code for code in ordered if _reaches(code, place)), None)
    if chosen is None:
        listed = ", ".join(codes[:20]) + (f" and {len(codes) - 20} more" if len(codes) > 20 else "")
        raise OptionError(
            f"crs: expected one for {place.lat_deg:g},{place.lon_deg:g} that PROJ knows, got {listed}; "
            "one of them is used where it is asked for"
        )
    return chosen


def chosen_format(asked: str | None, offered: Sequence[str]) -> str:
    """The format of the pictures: the one that was asked for, else the first of :data:`FORMATS`.

    Raises:
        OptionError: it is not offered, or none that is read.
    """
    readable = [name for name in offered if name.split(";")[0].strip() in FORMATS]
    if asked is None and readable:
        return min(readable, key=lambda name: (FORMATS.index(name.split(";")[0].strip()), len(name)))
    return chosen_name("image_format", asked, readable, "a format that the server offers and that is read")


def check_covers(box: Sequence[float] | None, place: Place) -> None:
    """Refuse a place outside the bounds that a layer states.

    Args:
        box: west, south, east, north in degrees; None is everywhere.
        place: where.

    Raises:
        OptionError: it is outside.
    """
    if box is None or not all(map(math.isfinite, box)):
        return
    west, south, east, north = box
    if not (west <= place.lon_deg <= east and south <= place.lat_deg <= north):
        raise OptionError(
            f"around: expected a place that the layer covers, {south:g} to {north:g} north and {west:g} to "
            f"{east:g} east, got {place.lat_deg:g},{place.lon_deg:g}"
        )


def numbers(text: str | None) -> list[float]:
    """The numbers in a text; empty where there are none.

    Raises:
        MapError: a word is none.
    """
    try:
        return [float(word) for word in (text or "").split()]
    except ValueError:
        raise MapError(f"source: expected numbers in the server's capabilities, got {text!r}") from None


def attribute_numbers(element: Any, names: Sequence[str]) -> list[float]:
    """The attributes of an element as numbers."""
    return numbers(" ".join(element.get(name, "") for name in names))
