"""``python -m bench.live.flights.fly FLIGHT``: an autopilot beside a bridge of your own, along a recorded flight.

``--port N`` is a stand-in that speaks to the bridge on that port. It takes off when the bridge listens, where the
first picture was taken, and scores the fixes against the flight's truth; it has no estimator. ``--sitl ADDRESS``
flies ArduPilot's simulator there (:mod:`bench.live.flights.sitl`). FLIGHT is a folder, or a video with DJI's
subtitles beside it.
"""

from __future__ import annotations

import argparse
import os
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from bench.live.flights.recorded import captured_s, off_m, recorded
from bench.live.flights.sitl import fly_sitl
from bench.live.standin import MS, Agenda, RealClock, S, Standin, State
from engine.errors import EngineError
from scenematch.report.loop_record import rms

FAR_M = 5.0
FIRMWARES = {"ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, "px4": mavlink.MAV_AUTOPILOT_PX4}
_LAST_ANSWER_S = 1.0  # the answer to the last picture comes after the flight
Fixes = list[tuple[float, float]]
"""Error of each in metres; its age on arrival in milliseconds."""


def wait_for_bridge(port: int) -> None:
    """Wait until a UDP port of loopback is open: what is sent to a closed one is refused."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("127.0.0.1", port))
        while True:
            try:
                probe.send(b"")
                time.sleep(0.01)
                probe.send(b"")
                return
            except ConnectionRefusedError:
                time.sleep(0.02)


def fly(flight: Path, port: int, firmware: str = "ardupilot") -> Fixes:
    """Fly the stand-in once a bridge listens."""
    motion, place, duration_s = recorded(flight)
    wait_for_bridge(port)
    clock = RealClock()
    begin_ns, fixes = clock(), []

    def now(time_s: float) -> State:
        return motion(time_s - begin_ns * 1e-9)

    def on_fix(fix: Any, arrived_ns: int) -> None:
        fixes.append((off_m(fix, now, pilot), arrived_ns * 1e-6 - captured_s(fix) * 1e3))

    agenda = Agenda(clock)
    pilot = Standin(agenda, port, now, place, on_fix, firmware=FIRMWARES[firmware])
    agenda.every(2 * MS, pilot.poll, clock())
    agenda.run(begin_ns + round((duration_s + _LAST_ANSWER_S) * S))
    pilot.close()
    return fixes


def report(fixes: Fixes, begun: str) -> str:
    """A table of the fixes."""
    if not fixes:
        return f"{begun}\n\nno fixes"
    off, age_ms = np.array(fixes).T
    lines = [
        begun, "", "| fixes | RMS m | median m | worst m | beyond 5 m | age p50, p99 ms |",
        "|---|---|---|---|---|---|",
        f"| {len(off)} | {rms(off):.2f} | {np.median(off):.2f} | {off.max():.2f} "
        f"| {(off > FAR_M).sum()} | {np.median(age_ms):.0f}, {np.percentile(age_ms, 99):.0f} |",
    ]  # fmt: skip
    return "\n".join(lines)


def conditions(before: float) -> str:
    """Today, and the machine's load before the flight and now."""
    load = f"load {before:.1f} before, {os.getloadavg()[0]:.1f} after, {os.cpu_count()} cores"
    return f"{time.strftime('%Y-%m-%d')}, {load}"


def main() -> None:
    """Fly, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path)
    beside = parser.add_mutually_exclusive_group(required=True)
    beside.add_argument("--port", type=int, help="of the bridge")
    beside.add_argument("--sitl", metavar="ADDRESS", help="of SITL, such as udpin:127.0.0.1:14552")
    parser.add_argument("--firmware", choices=FIRMWARES, default="ardupilot", help="of the stand-in")
    arguments = parser.parse_args()
    flight, before = arguments.flight.absolute(), os.getloadavg()[0]
    try:
        if arguments.sitl is not None:
            fly_sitl(arguments.sitl, *recorded(flight))
            return
        print(f"waits for a bridge on UDP port {arguments.port} of this machine", flush=True)
        fixes = fly(flight, arguments.port, arguments.firmware)
    except EngineError as error:
        parser.error(str(error))
    print(report(fixes, ", ".join([flight.name, arguments.firmware, conditions(before)])))


if __name__ == "__main__":
    main()
