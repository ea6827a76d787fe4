"""A pilot who flies a simulated ArduCopter (SITL) along a video's subtitles with GNSS off, and measures it.

``python -m bench.live.fly_sitl VIDEO [--link udpin:127.0.0.1:14552]``, beside SITL with the parameters of ``bridge
mavlink --settings parameters.takeoff=gnss --write-params FILE``, the bridge and its camera
(:mod:`bench.live.video_camera`). It arms in GUIDED, climbs to the first height on the receiver, waits for fixes,
selects them (source set 2), switches the simulated receiver off, holds, flies the subtitles' positions at their
own pace, and holds again. Where a failsafe takes over (LAND, RTL), it steers no more and ends when the vehicle has
landed and disarmed. Of each part it prints how far the estimate was from SITL's own true state, both as they
arrive here.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from bench.live.fly_standin import recorded
from bench.live.standin import State
from engine.geo import LocalFrame

RATES_HZ = {
    mavlink.MAVLINK_MSG_ID_SIM_STATE: 25,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 25,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 4,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2,
}
_LANDING_S = 600.0  # that a vehicle may take to come home and down by itself
_ABSOLUTE = mavlink.EKF_POS_HORIZ_ABS
_IGNORED = (
    mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
)


class TakenOverError(Exception):
    """The vehicle follows no targets any more: a failsafe changed its mode, or it has disarmed."""


class Pilot:
    """One flight, by one link."""

    def __init__(self, link: Any, place: LocalFrame, course: NDArray[np.float64]) -> None:
        self.link, self.place, self.course, self.part = link, place, course, "ground"
        self.errors_m: dict[str, list[float]] = {}
        self.off_course_m: dict[str, list[float]] = {}
        self.flags: dict[str, Counter[int]] = {}
        self.variances: dict[str, list[float]] = {}
        self.height_m, self.armed, self.mode, self.texts, self.fix_type = 0.0, False, "", [], 0
        self._estimate: tuple[float, float] | None = None

    @property
    def is_steered(self) -> bool:
        """Whether the vehicle still takes targets: armed in GUIDED, or not heard yet."""
        return not self.mode or (self.mode == "GUIDED" and self.armed)

    def listen(self, seconds: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Take what comes until the time is over, or until something is so."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = self.link.recv_match(blocking=True, timeout=0.05)
            if message is not None and message.get_srcSystem() == 1:
                self.take(message)
            if done():
                return True
        return False

    def command(self, number: int, *values: float) -> None:
        """A COMMAND_LONG."""
        self.link.mav.command_long_send(1, 1, number, 0, *values, *[0.0] * (7 - len(values)))

    def go_to(self, state: State) -> None:
        """A target in GUIDED: position, velocity, heading."""
        lat_deg, lon_deg = self.place.geodetic_from_enu(state.east_m, state.north_m)
        self.link.mav.set_position_target_global_int_send(
            0, 1, 1, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, _IGNORED, round(float(lat_deg) * 1e7),
            round(float(lon_deg) * 1e7), state.height_m, state.north_mps, state.east_mps, 0.0, 0.0, 0.0, 0.0,
            math.radians(state.heading_deg), 0.0,
        )  # fmt: skip

    def take(self, message: Any) -> None:
        """Note what a message of the vehicle says."""
        kind = message.get_type()
        if kind == "SIM_STATE":
            self._compare(message)
        elif kind == "GLOBAL_POSITION_INT" and message.lat:  # zero before there is a position
            self._estimate, self.height_m = self._metres(message.lat, message.lon), message.relative_alt * 1e-3
        elif kind == "EKF_STATUS_REPORT":
            self.flags.setdefault(self.part, Counter())[message.flags] += 1
            self.variances.setdefault(self.part, []).append(message.pos_horiz_variance)
        elif kind == "GPS_RAW_INT":
            self.fix_type = message.fix_type
        elif kind == "HEARTBEAT" and message.get_srcComponent() == 1:
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            mode = mavutil.mode_string_v10(message)
            if mode != self.mode:
                self.say(f"mode {mode}")
            self.mode = mode
        elif kind == "STATUSTEXT":
            self.texts.append(message.text)
            self.say(f"text: {message.text}")

    def _metres(self, lat_1e7: int, lon_1e7: int) -> tuple[float, float]:
        east_m, north_m = self.place.enu_from_geodetic(lat_1e7 * 1e-7, lon_1e7 * 1e-7)[:2]
        return float(east_m), float(north_m)

    def _compare(self, message: Any) -> None:
        true = self._metres(message.lat_int, message.lon_int)
        if self._estimate is not None:
            self.errors_m.setdefault(self.part, []).append(math.dist(true, self._estimate))
        off_m = np.hypot(*(self.course - true).T).min()
        self.off_course_m.setdefault(self.part, []).append(float(off_m))

    def say(self, text: str) -> None:
        """One line, with the part of the flight."""
        print(f"{time.strftime('%H:%M:%S')} {self.part}: {text}", flush=True)


def take_off(pilot: Pilot, height_m: float) -> None:
    """Arm in GUIDED and climb.

    Raises:
        SystemExit: it did not arm or climb.
    """
    deadline = time.monotonic() + 240.0
    while not pilot.armed and time.monotonic() < deadline:
        pilot.link.set_mode("GUIDED")
        pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        pilot.listen(2.0, lambda: pilot.armed)
    if not pilot.armed:
        raise SystemExit(f"not armed after 240 s: {pilot.texts[-3:]}")
    pilot.part = "climb, GNSS"
    pilot.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m)
    if not pilot.listen(180.0, lambda: pilot.height_m > height_m - 1.0):
        raise SystemExit(f"after 180 s at {pilot.height_m:.0f} m, not at {height_m:.0f} m")


def fly_course(pilot: Pilot, motion: Callable[[float], State], seconds: float, *, still: bool = False) -> None:
    """Send ten targets a second; ``still`` holds the first of them.

    Raises:
        TakenOverError: the vehicle does not take them any more.
    """
    begin = time.monotonic()
    while (gone := time.monotonic() - begin) < seconds:
        if not pilot.is_steered:
            raise TakenOverError
        state = motion(0.0 if still else gone)
        velocity = (0.0, 0.0) if still else (state.east_mps, state.north_mps)
        pilot.go_to(replace(state, east_mps=velocity[0], north_mps=velocity[1]))
        pilot.listen(0.1)


def await_landing(pilot: Pilot) -> None:
    """Listen until a vehicle that nobody steers any more is down and disarmed."""
    pilot.part = f"{pilot.mode} by itself"
    landed = pilot.listen(_LANDING_S, lambda: not pilot.armed)
    pilot.say("landed" if landed else f"still armed after {_LANDING_S:g} s, at {pilot.height_m:.0f} m")


def fly(pilot: Pilot, motion: Callable[[float], State], duration_s: float, hold_s: float) -> None:
    """The whole flight, or up to where the vehicle has landed by itself."""
    try:
        fly_parts(pilot, motion, duration_s, hold_s)
    except TakenOverError:
        await_landing(pilot)


def fly_parts(pilot: Pilot, motion: Callable[[float], State], duration_s: float, hold_s: float) -> None:
    """The whole flight.

    Raises:
        TakenOverError: the vehicle did not take its targets up to the end.
    """
    for message_id, rate_hz in RATES_HZ.items():
        pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / rate_hz)
    take_off(pilot, motion(0.0).height_m)
    pilot.part = "hold, GNSS"
    if not pilot.listen(60.0, lambda: any("fixes begin" in text for text in pilot.texts)):
        raise SystemExit("no fixes within a minute")
    fly_course(pilot, motion, 10.0, still=True)
    pilot.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 2.0)
    pilot.part = "hold, fixes"
    fly_course(pilot, motion, 5.0, still=True)
    pilot.link.param_set_send("SIM_GPS1_ENABLE", 0.0)
    pilot.part = "hold, GNSS off"
    fly_course(pilot, motion, hold_s, still=True)
    pilot.say(f"receiver's fix type {pilot.fix_type}")
    pilot.part = "course, GNSS off"
    fly_course(pilot, motion, duration_s)
    pilot.part = "hold at the end, GNSS off"
    fly_course(pilot, lambda _: motion(duration_s), hold_s, still=True)


def report(pilot: Pilot) -> str:
    """A line for each part."""
    lines = []
    for part, errors in pilot.errors_m.items():
        off = np.asarray(errors)
        line = f"{part}: {len(off)} states, EKF to truth median {np.median(off):.2f}, RMS "
        line += f"{np.sqrt((off**2).mean()):.2f}, worst {off.max():.2f} m"
        course = np.asarray(pilot.off_course_m[part])
        line += f"; truth beside the course median {np.median(course):.2f}, worst {course.max():.2f} m"
        if flags := pilot.flags.get(part):
            known = sum(count for flag, count in flags.items() if flag & _ABSOLUTE) / flags.total()
            line += f"; absolute position {known:.0%}, position variance at most {max(pilot.variances[part]):.2f}"
        lines.append(line)
    return "\n".join(lines)


def main() -> None:
    """Fly, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("video", type=Path)
    parser.add_argument("--link", default="udpin:127.0.0.1:14552")
    parser.add_argument("--hold-s", type=float, default=30.0)
    arguments = parser.parse_args()
    motion, place, duration_s = recorded(arguments.video)
    link = mavutil.mavlink_connection(arguments.link, source_system=255)
    link.wait_heartbeat()
    states = [motion(time_s) for time_s in np.arange(0.0, duration_s, 0.05)]
    pilot = Pilot(link, place, np.array([[state.east_m, state.north_m] for state in states]))
    try:
        fly(pilot, motion, duration_s, arguments.hold_s)
    finally:
        print(report(pilot), flush=True)


if __name__ == "__main__":
    main()
