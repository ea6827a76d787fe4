"""Read planned routes: a GeoJSON LineString, or the waypoints of a QGroundControl plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError

_WAYPOINT_COMMANDS = (16, 17, 18, 19, 21, 22, 31, 82)  # MAV_CMD_NAV_* that fly to a latitude and longitude
_RETURN_COMMAND = 20
_MAX_NUMBER = 1e9


def read_route(path: str | Path) -> NDArray[np.float64]:
    """Read the waypoints of a route; heights are ignored.

    GeoJSON must contain exactly one LineString, alone or in a Feature or FeatureCollection. From a plan, the
        mission is read: take-off, waypoints, splines, loiters, surveys, landing, and the return to the planned
            home.

    Args:
        path: the file.

    Returns:
        (N, 2) WGS84 latitude and longitude in degrees, N at least 2.

    Raises:
        TelemetryError: the file is neither of the two formats, or contains no route.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise TelemetryError(f"route: no such file: {path}") from None
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise TelemetryError(f"route: {path} cannot be read as JSON: {reason}") from None
    try:
        positions = _positions(content)
    except TelemetryError as error:
        raise TelemetryError(f"route: {path}: {error}") from None
    if len(positions) < 2:
        raise TelemetryError(f"route: {path}: expected two or more waypoints, got {len(positions)}")
    return np.array(positions, dtype=np.float64)


def _positions(content: Any) -> list[tuple[float, float]]:
    if isinstance(content, dict) and content.get("fileType") == "Plan":
        return _plan_positions(content)
    lines = list(_lines(content))
    if len(lines) != 1:
        kinds = "a GeoJSON LineString or a QGroundControl plan"
        raise TelemetryError(f"expected one route, {kinds}, got {len(lines)}")
    return [_position(point[1::-1], point) for point in map(_numbers, lines[0])]


def _lines(content: Any) -> list[list[Any]]:
    """Coordinates of all LineStrings, at any depth."""
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


def _position(lat_lon: list[Any], source: Any) -> tuple[float, float]:
    """Check that two values are a latitude and a longitude in degrees."""
    for value in lat_lon:
        # Checked before conversion: JSON allows integers beyond floats, and Python's parser accepts NaN.
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < _MAX_NUMBER:
            raise TelemetryError(f"expected a latitude and a longitude in degrees, got {str(source)[:60]}")
    lat, lon = float(lat_lon[0]), float(lat_lon[1])
    if abs(lat) > 90.0 or abs(lon) > 360.0:
        raise TelemetryError(
            f"expected a latitude within 90 and a longitude within 360 degrees, got {lat:g}, {lon:g}"
        )
    return lat, lon


def _plan_positions(plan: dict[str, Any]) -> list[tuple[float, float]]:
    mission = plan.get("mission")
    if not isinstance(mission, dict) or not isinstance(mission.get("items"), list):
        raise TelemetryError("expected a plan with mission.items")
    positions: list[tuple[float, float]] = []
    for item in _simple_items(mission["items"]):
        if item.get("command") == _RETURN_COMMAND and isinstance(mission.get("plannedHomePosition"), list):
            home = _numbers(mission["plannedHomePosition"])
            positions.append(_position(home[:2], home))
        params = item.get("params")
        if item.get("command") not in _WAYPOINT_COMMANDS or not isinstance(params, list) or len(params) < 6:
            continue
        if params[4] is None or params[5] is None or (params[4] == 0 and params[5] == 0):
            continue  # at the vehicle's current position, like a take-off
        positions.append(_position(params[4:6], params))
    return positions


def _simple_items(items: list[Any]) -> list[dict[str, Any]]:
    """The simple items of a mission, including those inside surveys."""
    found: list[dict[str, Any]] = []
    for item in items:
        if not isinstance(item, dict):
            raise TelemetryError(f"expected mission items that are objects, got {str(item)[:60]}")
        nested = item.get("TransectStyleComplexItem")
        nested = nested.get("Items") if isinstance(nested, dict) else item.get("Items")
        if isinstance(nested, list):
            found += _simple_items(nested)
        else:
            found.append(item)
    return found
