"""The MAVLink bridge in real time: the built-in flight by the real matcher, beside a stand-in autopilot."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bench.live.bridge_counts import Growth, Received, free_port, place_off_m
from bench.live.endless import Course, draw, there_and_back, warm
from bench.live.standin import MS, Agenda, RealClock, S, Standin, State
from engine import Navigator
from scenematch.bridges.links import Connection
from scenematch.bridges.mavlink import MavlinkBridge
from scenematch.bridges.mavlink_out import MavlinkOptions


def minutes_real(minutes: float, method: str) -> dict[str, Any]:
    """The built-in flight, forth and back, by the real matcher on the machine's own clock."""
    course = draw(150, dive_m=0.0, rate_hz=5.0)
    matcher = warm(course, method)
    motion = _motion_of(course)
    clock, growth = RealClock(), Growth()
    agenda = Agenda(clock)
    begin_ns = clock() + 3 * S
    received = Received.room(begin_ns, round(minutes * 300))
    ages: list[float] = []
    errors: list[float] = []
    port, load_before = free_port(), os.getloadavg()[0]

    def told(seconds: float) -> State:
        return motion(max(0.0, seconds - begin_ns * 1e-9))

    def on_fix(message: Any, arrived_ns: int) -> None:
        number = received.take(message, arrived_ns, pilot)
        if number is not None:
            ages.append((arrived_ns - received.captured_ns(number)) * 1e-6)
            errors.append(place_off_m(message, replace(told(0.0), **_true_place(course, number)), pilot))

    connection, options = Connection("udpin", "127.0.0.1", port), MavlinkOptions()
    with MavlinkBridge(connection, lambda prior: Navigator(matcher, prior), options, course.start) as bridge:
        pilot = Standin(agenda, port, told, course.site.frame, on_fix, lambda _: None)
        agenda.every(2 * MS, pilot.poll, clock())

        def submit(number: int = 0) -> None:
            bridge.submit(np.asarray(course.frame(number).image), received.captured_ns(number))
            if number % 20 == 0:
                growth.look(pilot.messages, collect=False)
            if number + 1 < len(received.count):
                agenda.at(received.captured_ns(number + 1), lambda: submit(number + 1))

        agenda.at(received.captured_ns(0), submit)
        agenda.run(begin_ns + round(minutes * 60 * S))
        status = bridge.status
        pilot.close()
    return {
        "method": method,
        "seconds": minutes * 60,
        "messages": pilot.messages,
        "frames": len(received.count),
        "arrived": int(received.count.sum()),
        "twice": int((received.count > 1).sum()),
        "foreign": received.foreign,
        "refused": status.refused,
        "withheld": status.withheld,
        "least_hz": received.least_hz(25, np.arange(len(received.count)) >= 10),
        "age_ms": [float(np.percentile(ages, level)) for level in (50, 99)],
        "stamp_off_ms": received.stamp_off_ms,
        "rms_m": float(np.sqrt(np.mean(np.square(errors)))),
        "worst_m": float(max(errors)),
        "steps": int((np.diff(received.counter[received.count > 0]) % 256).sum()),
        "load": [load_before, os.getloadavg()[0]],
        "growth": growth.rows(),
    }


def _true_place(course: Course, number: int) -> dict[str, float]:
    east_m, north_m = course.places_m[there_and_back(number, len(course.frames))[0]]
    return {"east_m": float(east_m), "north_m": float(north_m)}


def _motion_of(course: Course) -> Callable[[float], State]:
    """The course's telemetry at any second, forth and back, straight between its frames."""
    frames, count = course.frames, len(course.frames)
    columns = [
        course.places_m[:, 0], course.places_m[:, 1], [f.height_agl_m for f in frames],
        [f.roll_deg for f in frames], [f.pitch_deg for f in frames],
        np.rad2deg(np.unwrap(np.deg2rad([f.heading_deg for f in frames]))),
        [f.east_velocity_mps or 0.0 for f in frames], [f.north_velocity_mps or 0.0 for f in frames],
    ]  # fmt: skip

    def motion(seconds: float) -> State:
        phase = seconds * 1e9 / course.step_ns % (2 * count - 2)
        back = phase > count - 1
        index = 2 * count - 2 - phase if back else phase
        values = [float(np.interp(index, np.arange(count), column)) for column in columns]
        sign = -1.0 if back else 1.0
        return State(*values[:6], sign * values[6], sign * values[7])

    return motion
