"""Planned routes: a LineString of GeoJSON, or the waypoints of a QGroundControl plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError

_PLACES = (16, 17, 18, 19, 21, 22, 31, 82)  # MAVLink commands that go to the latitude and longitude they carry
_RETURN = 20
_DEGREES_BELOW = 1e9
_MAX_FILE_BYTES = 64 << 20


def read_route(path: str | Path) -> NDArray[np.float64]:
    """(N, 2) latitude and longitude in degrees of the waypoints, N at least 2.

    Heights in the file are not looked at. Of GeoJSON there must be one LineString, alone or in a Feature or a
    FeatureCollection. Of a plan the mission counts: take-off, waypoints, splines, loiters, surveys, landing, and
    the return to the planned home position.

    Raises:
        TelemetryError: the file is not one of the two, or holds no route.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise TelemetryError(f"route: {path}: expected at most {_MAX_FILE_BYTES >> 20} MiB")
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise TelemetryError(f"route: no such file: {path}") from None
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise TelemetryError(f"route: {path} cannot be read as JSON: {reason}") from None
    try:
        places = _places(content)
    except TelemetryError as error:
        raise TelemetryError(f"route: {path}: {error}") from None
    if len(places) < 2:
        raise TelemetryError(f"route: {path}: expected two or more waypoints, got {len(places)}")
    return np.array(places, dtype=np.float64)


def _places(content: Any) -> list[tuple[float, float]]:
    if isinstance(content, dict) and content.get("fileType") == "Plan":
        return _plan_places(content)
    lines = list(_lines(content))
    if len(lines) != 1:
        kinds = "a GeoJSON LineString or a QGroundControl plan"
        raise TelemetryError(f"expected one route, {kinds}, got {len(lines)}")
    return [_place(point[1::-1], point) for point in map(_numbers, lines[0])]


def _lines(content: Any) -> list[list[Any]]:
    """The coordinates of all LineStrings."""
    if not isinstance(content, dict):
        return []
    kind = content.get("type")
    if kind == "LineString" and isinstance(content.get("coordinates"), list):
        return [content["coordinates"]]
    if kind == "Feature":
        return _lines(content.get("geometry"))
    if kind == "FeatureCollection" and isinstance(content.get("features"), list):
        return [line for one in content["features"] for line in _lines(one)]
    return []


def _numbers(point: Any) -> list[Any]:
    if not isinstance(point, list) or len(point) < 2:
        raise TelemetryError(f"expected a position [lon, lat], got {str(point)[:60]}")
    return point


def _place(lat_lon: list[Any], shown: Any) -> tuple[float, float]:
    """Latitude and longitude that can be on the Earth."""
    for value in lat_lon:
        # Compared before it is converted: JSON has whole numbers that no float holds, and Python's reads NaN.
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < _DEGREES_BELOW:
            raise TelemetryError(f"expected a latitude and a longitude in degrees, got {str(shown)[:60]}")
    lat, lon = float(lat_lon[0]), float(lat_lon[1])
    if abs(lat) > 90.0 or abs(lon) > 360.0:
        raise TelemetryError(
            f"expected a latitude within 90 and a longitude within 360 degrees, got {lat:g}, {lon:g}"
        )
    return lat, lon


def _plan_places(plan: dict[str, Any]) -> list[tuple[float, float]]:
    mission = plan.get("mission")
    if not isinstance(mission, dict) or not isinstance(mission.get("items"), list):
        raise TelemetryError("expected a plan with mission.items")
    places: list[tuple[float, float]] = []
    for item in _simple_items(mission["items"]):
        if item.get("command") == _RETURN and isinstance(mission.get("plannedHomePosition"), list):
            home = _numbers(mission["plannedHomePosition"])
            places.append(_place(home[:2], home))
        params = item.get("params")
        if item.get("command") not in _PLACES or not isinstance(params, list) or len(params) < 6:
            continue
        if params[4] is None or params[5] is None or (params[4] == 0 and params[5] == 0):
            continue  # at the place where the vehicle is, such as a take-off
        places.append(_place(params[4:6], params))
    return places


def _simple_items(items: list[Any]) -> list[dict[str, Any]]:
    """The items that go somewhere, those of surveys among them."""
    found: list[dict[str, Any]] = []
    for item in items:
        if not isinstance(item, dict):
            raise TelemetryError(f"expected mission items that are objects, got {str(item)[:60]}")
        inside = item.get("TransectStyleComplexItem")
        inside = inside.get("Items") if isinstance(inside, dict) else item.get("Items")
        if isinstance(inside, list):
            found += _simple_items(inside)
        else:
            found.append(item)
    return found
