"""A stand-in autopilot that flies a flight folder in real time, for a bridge beside it on the bench.

``python -m bench.live.fly_standin FLIGHT [--port N] [--firmware ardupilot|px4] [--seconds S]``, before or after
the bridge: it takes off when a bridge listens, where the first picture was taken. FLIGHT is a folder with a
``telemetry.csv`` and a ``truth.csv`` with attitude, as ``scenematch simulate`` writes them, or a video with DJI's
``.SRT`` beside it: it then flies the positions, the heights and the gimbal's angles of the subtitles. Where truth
has no heights above ground it flies those of the telemetry.
"""

from __future__ import annotations

import argparse
import math
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from bench.live.standin import MS, Agenda, RealClock, S, Standin, State
from engine.errors import EngineError, TelemetryError
from engine.geo import LocalFrame
from scenematch.files.flight import open_flight
from scenematch.files.telemetry import TelemetryRow, read_telemetry
from scenematch.files.truth import Truth, read_truth

FIRMWARES = {"ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, "px4": mavlink.MAV_AUTOPILOT_PX4}
_REPORT_S = 5.0
_LAST_ANSWER_S = 1.0  # the answer to the last picture comes after the flight


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


def wait_for_bridge(port: int, is_running: Callable[[], bool] = lambda: True) -> None:
    """Until somebody listens on a UDP port of loopback: what is sent to one that nobody has comes back refused.

    Raises:
        SystemExit: the bridge has ended.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("127.0.0.1", port))
        while is_running():
            try:
                probe.send(b"")
                time.sleep(0.01)
                probe.send(b"")
                return
            except ConnectionRefusedError:
                time.sleep(0.02)
    raise SystemExit("the bridge has ended before it listened")


def fly(flight: Path, port: int, firmware: str, seconds: float | None = None) -> dict[str, Any]:
    """Fly until the flight or the time is over; returns how many fixes came, and how far off half of them were."""
    motion, place, duration_s = recorded(flight)
    wait_for_bridge(port)
    clock = RealClock()
    begin_ns, errors = clock(), []

    def now(time_s: float) -> State:
        return motion(time_s - begin_ns * 1e-9)

    def on_fix(message: Any, arrived_ns: int) -> None:
        errors.append(off_m(message, now, pilot))

    agenda = Agenda(clock)
    pilot = Standin(agenda, port, now, place, on_fix, firmware=FIRMWARES[firmware])
    agenda.every(2 * MS, pilot.poll, clock())
    agenda.every(round(_REPORT_S * S), lambda: print(summary(errors), flush=True), clock() + round(_REPORT_S * S))
    try:
        end_s = duration_s + _LAST_ANSWER_S
        agenda.run(begin_ns + round((end_s if seconds is None else min(end_s, seconds)) * S))
    finally:
        pilot.close()
    return {"fixes": len(errors), "median_m": float(np.median(errors)) if errors else None}


def off_m(message: Any, motion: Callable[[float], State], pilot: Standin) -> float:
    """How far a fix is from where the vehicle was when its picture was taken."""
    kind = message.get_type()
    captured_us = message.usec if kind == "VISION_POSITION_ESTIMATE" else message.time_usec
    if kind == "GLOBAL_POSITION_SENSOR":
        captured_us -= message.processing_time
    if kind in ("GPS_INPUT", "GLOBAL_POSITION_SENSOR"):
        east, north = pilot.place.enu_from_geodetic(message.lat * 1e-7, message.lon * 1e-7)[:2]
    else:  # about the autopilot's origin, which after a restart is the one that the bridge has set
        about = pilot.place
        if pilot.origin is not None:
            about = LocalFrame(pilot.origin[0] * 1e-7, pilot.origin[1] * 1e-7)
        lat_deg, lon_deg = about.geodetic_from_enu(message.y, message.x)
        east, north = pilot.place.enu_from_geodetic(lat_deg, lon_deg)[:2]
    was = motion(captured_us * 1e-6)
    return math.hypot(east - was.east_m, north - was.north_m)


def summary(errors: list[float]) -> str:
    """One line."""
    return f"{len(errors)} fixes" + (f", half within {np.median(errors):.2f} m" if errors else "")


def main() -> None:
    """Fly, and print what came."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--port", type=int, default=14550)
    parser.add_argument("--firmware", choices=FIRMWARES, default="ardupilot")
    parser.add_argument("--seconds", type=float)
    arguments = parser.parse_args()
    print(f"waits for a bridge on UDP port {arguments.port} of this machine", flush=True)
    try:
        came = fly(arguments.flight, arguments.port, arguments.firmware, arguments.seconds)
    except EngineError as error:
        parser.error(str(error))
    print(f"landed; {came['fixes']} fixes" + (f", half within {came['median_m']:.2f} m" if came["fixes"] else ""))


if __name__ == "__main__":
    main()
