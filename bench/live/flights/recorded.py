"""Where the vehicle of a recorded flight was, and how far from there a fix is.

A flight is a folder with ``telemetry.csv`` and a ``truth.csv`` with attitude, as ``scenematch simulate`` writes
them, or a video with DJI's ``.SRT`` beside it, whose positions, heights and gimbal angles count. If truth has no
heights above ground, those of the telemetry count.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.live.standin import Standin, State
from engine.errors import TelemetryError
from engine.geo import LocalFrame
from scenematch.files.flight import open_flight
from scenematch.files.telemetry import TelemetryRow, read_telemetry
from scenematch.files.truth import Truth, read_truth


def recorded(flight: Path) -> tuple[Callable[[float], State], LocalFrame, float]:
    """Where the vehicle of a flight was so long after its first picture, about where, how long.

    Raises:
        TelemetryError: a file cannot be read, or it does not say where the vehicle was.
    """
    rows, first_ns = _states(flight)
    place = LocalFrame(rows[0].lat_deg, rows[0].lon_deg)
    east_north = np.array([place.enu_from_geodetic(row.lat_deg, row.lon_deg)[:2] for row in rows])
    time_s = np.array([(row.timestamp_ns - first_ns) * 1e-9 for row in rows])
    headings = np.rad2deg(np.unwrap(np.deg2rad([row.heading_deg for row in rows])))
    attitude = [[row.height_agl_m, row.roll_deg or 0.0, row.pitch_deg or 0.0] for row in rows]
    columns = np.column_stack([east_north, attitude, headings, _velocity(time_s, east_north)]).astype(float)

    def motion(seconds: float) -> State:
        return State(*(float(np.interp(seconds, time_s, column)) for column in columns.T))

    return motion, place, float(time_s[-1])


def _states(flight: Path) -> tuple[Sequence[Any], int]:
    """The states of a folder's truth or a video's subtitles, and the stamp of the first picture."""
    if flight.is_dir():
        telemetry = read_telemetry(flight / "telemetry.csv")
        return _true_states(flight, telemetry), telemetry[0].timestamp_ns
    rows = open_flight(flight).rows
    known = [row for row in rows if None not in (row.lat_deg, row.height_agl_m, row.heading_deg)]
    if not known:
        raise TelemetryError(f"{flight}: expected subtitles beside it with position, rel_alt and gimbal, got none")
    return known, rows[0].timestamp_ns


def _true_states(flight: Path, telemetry: Sequence[TelemetryRow]) -> list[Truth]:
    """The truth of a folder; a truth of altitudes above the sea alone has the telemetry's heights above ground."""
    rows = read_truth(flight / "truth.csv")
    if any(row.heading_deg is None for row in rows):
        raise TelemetryError(f"{flight / 'truth.csv'}: expected a heading_deg in every row")
    sources: tuple[Sequence[Truth | TelemetryRow], ...] = (rows, telemetry)
    known = next(filter(None, ([row for row in each if row.height_agl_m is not None] for each in sources)), None)
    if known is None:
        raise TelemetryError(f"{flight}: expected height_agl_m in truth.csv or telemetry.csv, got none in either")
    stamps_ns = [row.timestamp_ns for row in rows]
    heights_m = np.interp(
        stamps_ns, [row.timestamp_ns for row in known], [row.height_agl_m or 0.0 for row in known]
    )
    return [replace(row, height_agl_m=float(height_m)) for row, height_m in zip(rows, heights_m, strict=True)]


def _velocity(time_s: NDArray[np.float64], east_north: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean over a second: subtitles have positions to 0.1 m, thirty a second."""
    before_s, after_s = (np.clip(time_s + by_s, time_s[0], time_s[-1]) for by_s in (-0.5, 0.5))
    moved = [np.interp(after_s, time_s, axis) - np.interp(before_s, time_s, axis) for axis in east_north.T]
    return np.column_stack(moved) / (after_s - before_s)[:, None]


def captured_s(message: Any) -> float:
    """When the picture of a fix was taken, on the machine's clock."""
    kind = message.get_type()
    captured_us = message.usec if kind == "VISION_POSITION_ESTIMATE" else message.time_usec
    return (captured_us - (message.processing_time if kind == "GLOBAL_POSITION_SENSOR" else 0)) * 1e-6


def off_m(message: Any, motion: Callable[[float], State], pilot: Standin) -> float:
    """How far a fix is from where the vehicle was when its picture was taken."""
    if message.get_type() in ("GPS_INPUT", "GLOBAL_POSITION_SENSOR"):
        east, north = pilot.place.enu_from_geodetic(message.lat * 1e-7, message.lon * 1e-7)[:2]
    else:  # about the autopilot's origin, which after a restart is the one that the bridge has set
        about = pilot.place
        if pilot.origin is not None:
            about = LocalFrame(pilot.origin[0] * 1e-7, pilot.origin[1] * 1e-7)
        lat_deg, lon_deg = about.geodetic_from_enu(message.y, message.x)
        east, north = pilot.place.enu_from_geodetic(lat_deg, lon_deg)[:2]
    was = motion(captured_s(message))
    return math.hypot(east - was.east_m, north - was.north_m)
