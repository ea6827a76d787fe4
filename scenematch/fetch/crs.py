"""Coordinate systems of services: parse their codes, and choose one for a place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from engine.errors import MapError, OptionError
from scenematch.fetch.grid import Place

if TYPE_CHECKING:
    from pyproj import CRS

_MERCATOR = ("EPSG:3857", "EPSG:900913", "EPSG:102100")
_DEGREES = ("CRS:84", "OGC:CRS84", "EPSG:4326")


def chosen_name(argument: str, asked: str | None, offered: Sequence[str], what: str) -> str:
    """Choose a name that a service offers: the requested one, else the only one.

    Raises:
        OptionError: it is not offered, or several are and none was requested.
    """
    if asked is None and len(offered) == 1:
        return offered[0]
    if asked is None or asked not in offered:
        raise OptionError(f"{argument}: expected {what}, {_listed(offered) or 'none'}, got {asked or 'none'}")
    return asked


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")


def code_of(name: str) -> str:
    """EPSG:N from any spelling that services use; other codes unchanged."""
    parts = name.strip().split(":")
    if parts[0].lower() == "urn" and len(parts) > 4:  # urn:ogc:def:crs:EPSG:6.18:3857, or with the version empty
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
    """Whether a coordinate system covers a place, by the area that its authority states."""
    if not is_known(code):
        return False
    area = crs_of(code).area_of_use
    if area is None:
        return True
    west, east = area.west, area.east
    across = place.lon_deg >= west or place.lon_deg <= east  # of an area over 180 degrees
    inside = west <= place.lon_deg <= east if west <= east else across
    return bool(inside and area.south <= place.lat_deg <= area.north)


def chosen_crs(asked: str | None, offered: Sequence[str], place: Place) -> str:
    """Choose an offered coordinate system: the requested one, else one in metres at the place.

    Prefers the UTM zone, then Web Mercator, then any other except degrees; only those that PROJ knows and that
    cover that part of the Earth.

    Raises:
        OptionError: the requested one is not offered, or none is suitable.
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
        raise OptionError(
            f"crs: expected one for {place.lat_deg:g},{place.lon_deg:g} that PROJ knows, got {_listed(codes)}; "
            "name one of them to use it"
        )
    return chosen
