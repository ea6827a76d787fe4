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
        positions = _plan_positions(content) if content.get("fileType") == "Plan" else _line_positions(content)
        route = np.array(positions, np.float64).reshape(-1, 2)
    except FileNotFoundError:
        raise TelemetryError(f"route: no such file: {path}") from None
    except OSError as error:
        raise TelemetryError(f"route: {path} cannot be read: {error.strerror}") from None
    except _MALFORMED:
        raise TelemetryError(f"route: {path}: expected one GeoJSON LineString, or a QGroundControl plan") from None
    if len(route) < 2:
        raise TelemetryError(f"route: {path}: expected two or more waypoints, got {len(route)}")
    if not (np.abs(route) <= (90.0, 360.0)).all():  # NaN fails too
        raise TelemetryError(f"route: {path}: expected latitudes within 90 and longitudes within 360 degrees")
    return route


_MALFORMED = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, RecursionError)


def _line_positions(content: Any) -> list[Any]:
    """Latitude and longitude of the only LineString."""
    (line,) = _lines(content)
    return [point[1::-1] for point in line]


def _lines(content: Any) -> list[Any]:
    """Coordinates of all LineStrings, at any depth."""
    kind = content.get("type")
    if kind == "LineString":
        return [content["coordinates"]]
    if kind == "Feature":
        return _lines(content.get("geometry") or {})
    return [line for one in content.get("features", ()) for line in _lines(one)]


def _plan_positions(plan: Any) -> list[Any]:
    """Latitude and longitude of what a plan flies to, and of its home where it returns there."""
    mission = plan["mission"]
    positions = []
    for item in _simple_items(mission["items"]):
        command, params = item.get("command"), item.get("params")
        if command == _RETURN_COMMAND:
            positions.append(mission["plannedHomePosition"][:2])
        # Neither, or 0 and 0, is at the vehicle's current position, like a take-off.
        elif command in _WAYPOINT_COMMANDS and None not in params[4:6] and any(params[4:6]):
            positions.append(params[4:6])
    return positions


def _simple_items(items: Any) -> list[Any]:
    """The simple items of a mission, including those inside surveys."""
    found = []
    for item in items:
        nested = item.get("TransectStyleComplexItem", item).get("Items")
        found += [item] if nested is None else _simple_items(nested)
    return found
