"""Fly a simulated ArduCopter (SITL) along a recorded course with GNSS off; compare its EKF with its true state."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from bench.live.flights.faults import Fault
from bench.live.standin import State
from engine.geo import LocalFrame
from scenematch.report.loop_record import rms

Motion = Callable[[float], State]
RATES_HZ = {
    mavlink.MAVLINK_MSG_ID_SIM_STATE: 25,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 25,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1,
}
_PATIENCE_S = 240.0  # to arm, and to climb
_LANDING_S = 600.0  # that a vehicle may take to come home and down by itself
_IGNORED = 0x9C0  # of POSITION_TARGET_TYPEMASK: the accelerations and the yaw's rate


class Pilot:
    """One flight, by one link."""

    def __init__(self, link: Any, place: LocalFrame) -> None:
        self.link, self.place, self.part = link, place, "ground"
        self.errors_m: dict[str, list[float]] = {}
        self.height_m, self.armed, self.mode, self.texts = 0.0, False, "", []
        self._estimate: tuple[float, float] | None = None

    @property
    def has_fixes(self) -> bool:
        """Whether the bridge has said that fixes begin."""
        return any("fixes begin" in text for text in self.texts)

    @property
    def is_steered(self) -> bool:
        """Whether the vehicle still takes targets: armed in GUIDED, or not heard yet."""
        return not self.mode or (self.mode == "GUIDED" and self.armed)

    def listen(self, seconds: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Handle messages until the time is over, or until something is so."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not done():
            message = self.link.recv_match(blocking=True, timeout=0.05)
            if message is not None and message.get_srcSystem() == 1:
                self.take(message)
        return done()

    def command(self, number: int, *values: float) -> None:
        """Send a COMMAND_LONG."""
        self.link.mav.command_long_send(1, 1, number, 0, *values, *[0.0] * (7 - len(values)))

    def go_to(self, state: State) -> None:
        """Send a target: position, velocity, heading."""
        lat_deg, lon_deg = self.place.geodetic_from_enu(state.east_m, state.north_m)
        self.link.mav.set_position_target_global_int_send(
            0, 1, 1, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, _IGNORED, round(float(lat_deg) * 1e7),
            round(float(lon_deg) * 1e7), state.height_m, state.north_mps, state.east_mps, 0.0, 0.0, 0.0, 0.0,
            math.radians(state.heading_deg), 0.0,
        )  # fmt: skip

    def select(self, *, is_fixes: bool) -> None:
        """Let the EKF use the fixes, or the receiver (source sets 2 and 1)."""
        self.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 2.0 if is_fixes else 1.0)

    def meet(self, fault: Fault, *, is_over: bool) -> None:
        """Let the simulated vehicle feel what of a fault concerns it."""
        if fault.wind_mps is not None:
            self.link.param_set_send("SIM_WIND_SPD", fault.wind_mps)
        if fault.kind == "fixes not used":
            self.select(is_fixes=is_over)

    def take(self, message: Any) -> None:
        """Note what a message of the vehicle says."""
        kind = message.get_type()
        if kind == "SIM_STATE" and self._estimate is not None:
            true = self._metres(message.lat_int, message.lon_int)
            self.errors_m.setdefault(self.part, []).append(math.dist(true, self._estimate))
        elif kind == "GLOBAL_POSITION_INT" and message.lat:  # zero before there is a position
            self._estimate, self.height_m = self._metres(message.lat, message.lon), message.relative_alt * 1e-3
        elif kind == "HEARTBEAT" and message.get_srcComponent() == 1:
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            if (mode := mavutil.mode_string_v10(message)) != self.mode:
                self.mode = mode
                self.say(f"mode {mode}")
        elif kind == "STATUSTEXT":
            self.texts.append(message.text)
            self.say(f"text: {message.text}")

    def _metres(self, lat_1e7: int, lon_1e7: int) -> tuple[float, float]:
        east_m, north_m = self.place.enu_from_geodetic(lat_1e7 * 1e-7, lon_1e7 * 1e-7)[:2]
        return float(east_m), float(north_m)

    def say(self, text: str) -> None:
        """Print a line with the part of the flight."""
        print(f"{time.strftime('%H:%M:%S')} {self.part}: {text}", flush=True)


def take_off(pilot: Pilot, height_m: float) -> None:
    """Arm in GUIDED and climb by the receiver.

    Raises:
        SystemExit: it did not arm or climb.
    """
    deadline = time.monotonic() + _PATIENCE_S
    while not pilot.armed and time.monotonic() < deadline:
        pilot.link.set_mode("GUIDED")
        pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        pilot.listen(2.0, lambda: pilot.armed)
    pilot.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m)
    if not (pilot.armed and pilot.listen(_PATIENCE_S, lambda: pilot.height_m > height_m - 1.0)):
        raise SystemExit(f"not at {height_m:.0f} m after {_PATIENCE_S:g} s: {pilot.texts[-3:]}")


def climb(pilot: Pilot, height_m: float) -> None:
    """Take off by the receiver and wait for the bridge's fixes.

    Raises:
        SystemExit: it did not take off, or the bridge sent no fixes.
    """
    for message_id, rate_hz in RATES_HZ.items():
        pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / rate_hz)
    take_off(pilot, height_m)
    if not pilot.listen(60.0, lambda: pilot.has_fixes):
        raise SystemExit("no fixes within a minute")


def follow(pilot: Pilot, motion: Motion, seconds: float) -> bool:
    """Send ten targets a second; returns whether the vehicle took them to the end."""
    begin = time.monotonic()
    while pilot.is_steered and (gone_s := time.monotonic() - begin) < seconds:
        pilot.go_to(motion(gone_s))
        pilot.listen(0.1)
    return pilot.is_steered


def fly(pilot: Pilot, motion: Motion, duration_s: float, hold_s: float) -> None:
    """Fly the course on the fixes, with a hold before and after it; if a failsafe takes over, await the landing.

    Raises:
        SystemExit: it did not take off, or the bridge sent no fixes.
    """
    first, last = (replace(motion(time_s), east_mps=0.0, north_mps=0.0) for time_s in (0.0, duration_s))
    climb(pilot, first.height_m)
    legs: tuple[tuple[str, Motion, float], ...] = (
        ("hold, GNSS", lambda _: first, 10.0),
        ("hold, fixes", lambda _: first, 5.0),
        ("hold, GNSS off", lambda _: first, hold_s),
        ("course, GNSS off", motion, duration_s),
        ("hold at the end, GNSS off", lambda _: last, hold_s),
    )
    for part, course, seconds in legs:
        pilot.part = part
        if part == "hold, fixes":
            pilot.select(is_fixes=True)
        elif part == "hold, GNSS off":
            pilot.link.param_set_send("SIM_GPS1_ENABLE", 0.0)
        if not follow(pilot, course, seconds):
            pilot.part = f"{pilot.mode} by itself"
            landed = pilot.listen(_LANDING_S, lambda: not pilot.armed)
            pilot.say("landed" if landed else f"still armed after {_LANDING_S:g} s, at {pilot.height_m:.0f} m")
            return


def report(pilot: Pilot) -> str:
    """A table of the parts."""
    lines = ["| part | states | EKF to truth, RMS m | worst m |", "|---|---|---|---|"]
    for part, errors in pilot.errors_m.items():
        lines.append(f"| {part} | {len(errors)} | {rms(np.array(errors)):.2f} | {max(errors):.2f} |")
    return "\n".join(lines)


def fly_sitl(address: str, motion: Motion, place: LocalFrame, duration_s: float, hold_s: float = 30.0) -> None:
    """Fly what waits at an address, and print the table, also of a flight that ended early."""
    link = mavutil.mavlink_connection(address, source_system=255)
    link.wait_heartbeat()
    pilot = Pilot(link, place)
    try:
        fly(pilot, motion, duration_s, hold_s)
    finally:
        print(report(pilot), flush=True)
