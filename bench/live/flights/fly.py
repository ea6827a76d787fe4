"""``python -m bench.live.flights.fly FLIGHT``: the bridge beside an autopilot, scored against the flight's truth.

Alone it starts the bridge as a separate process with ``--supervise`` beside a stand-in autopilot, and does to them
what :mod:`bench.live.flights.faults` lists; FLIGHT, a folder, is drawn if it is missing: a generated town with the
paper's flight over it. The stand-in has no estimator: the figures describe the fixes, not an EKF.

``--port N`` flies beside a bridge of your own on that port, without faults; it takes off when the bridge listens,
where the first picture was taken. ``--sitl ADDRESS`` flies ArduPilot's simulator there instead of the stand-in,
along the same course (:mod:`bench.live.flights.sitl`), beside a bridge of your own too. With either FLIGHT may be
a video with DJI's subtitles beside it.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from bench.live.bridge_counts import free_port
from bench.live.flights.faults import FAULTS, FLIGHT_S, Fault, events
from bench.live.flights.recorded import captured_s, off_m, recorded
from bench.live.flights.sitl import fly_sitl
from bench.live.standin import MS, Agenda, RealClock, S, Standin, State
from engine.errors import EngineError
from scenematch.runs.simulation import write_flight
from scenematch.simulator import plan_flight

RATE_HZ = 5.0
FAR_M = 5.0
FIRMWARES = {"ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, "px4": mavlink.MAV_AUTOPILOT_PX4}
_LAST_ANSWER_S = 1.0  # the answer to the last picture comes after the flight
Fixes = list[tuple[float, float, float]]
"""Arrival of each, seconds after the first picture; error in metres; age in milliseconds."""


class Bridge:
    """The bridge's process, its worker and its camera, killed and started together.

    Args:
        folder: of the flight.
        port: to listen on.
        method, message: of the fixes.
        camera: the source of its pictures; if empty, those of the flight.
        more: further options of the bridge.
    """

    def __init__(
        self,
        folder: Path,
        port: int,
        method: str,
        message: str,
        camera: str | None = None,
        more: Sequence[str] = (),
    ) -> None:
        start = recorded(folder)[1]
        self._begin, self.fault_file = folder / "begin", folder / "fault"
        for old in (self._begin, self.fault_file):
            old.unlink(missing_ok=True)
        own = f"{folder / 'frames'} {self._begin} {self.fault_file} {RATE_HZ}"
        camera = camera or f"exec:{sys.executable} -m bench.live.flights.camera {own}"
        self._command = [
            sys.executable, "-m", "scenematch", "bridge", "mavlink", "--supervise", "--method", method,
            "--connect", f"udpin:127.0.0.1:{port}", "--map", str(folder / "map.tif"),
            "--surface", str(folder / "dsm.tif"), "--camera", str(folder / "camera.yaml"),
            "--camera-source", camera, "--start", f"{start.lat_deg},{start.lon_deg},15",
            "--settings", f"mavlink.message={message}", *more,
        ]  # fmt: skip
        # An installation brings its bytecode along.
        self._environment = {name: v for name, v in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        self._log = (folder / "bridge.log").open("w", encoding="utf-8")
        self.start()

    def start(self) -> None:
        """Start it in its own process group."""
        self._process = subprocess.Popen(
            self._command, stdout=self._log, stderr=self._log, env=self._environment, start_new_session=True
        )

    def film_from(self, begin_ns: int) -> None:
        """Let the camera show the flight from then on."""
        self._begin.write_text(str(begin_ns), encoding="ascii")

    def is_running(self) -> bool:
        """Whether it is still running."""
        return self._process.poll() is None

    def kill(self) -> None:
        """All of it."""
        with contextlib.suppress(ProcessLookupError):  # it has already ended
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def kill_worker(self) -> None:
        """Kill only the worker that matches."""
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children")
        os.kill(int(children.read_text(encoding="ascii").split()[-1]), signal.SIGKILL)


def wait_for_bridge(port: int, is_running: Callable[[], bool] = lambda: True) -> None:
    """Wait until a UDP port of loopback is open: what is sent to a closed one is refused.

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


def fly(
    flight: Path,
    port: int,
    firmware: str = "ardupilot",
    *,
    bridge: Bridge | None = None,
    faults: Sequence[Fault] = (),
) -> Fixes:
    """Fly the stand-in once a bridge listens; without one given, it is somebody else's."""
    motion, place, duration_s = recorded(flight)
    wait_for_bridge(port, lambda: bridge is None or bridge.is_running())
    clock = RealClock()
    begin_ns, fixes = clock(), []
    if bridge is not None:
        bridge.film_from(begin_ns)

    def now(time_s: float) -> State:
        return motion(time_s - begin_ns * 1e-9)

    def on_fix(fix: Any, arrived_ns: int) -> None:
        age_ms = arrived_ns * 1e-6 - captured_s(fix) * 1e3
        fixes.append(((arrived_ns - begin_ns) * 1e-9, off_m(fix, now, pilot), age_ms))

    agenda = Agenda(clock)
    pilot = Standin(agenda, port, now, place, on_fix, firmware=FIRMWARES[firmware])
    agenda.every(2 * MS, pilot.poll, clock())
    for begin_s, is_over, fault in events(faults):
        assert bridge is not None
        agenda.at(begin_ns + round(begin_s * S), partial(change, fault, bridge, pilot, is_over=is_over))
    agenda.run(begin_ns + round((duration_s + _LAST_ANSWER_S) * S))
    pilot.close()
    return fixes


def fly_with_faults(folder: Path, method: str, message: str) -> Fixes:
    """Start the bridge, fly with all faults, and end it."""
    bridge = Bridge(folder, port := free_port(), method, message)
    try:
        return fly(folder, port, bridge=bridge, faults=FAULTS)
    finally:
        bridge.kill()


def change(fault: Fault, bridge: Bridge, pilot: Standin | None = None, *, is_over: bool) -> None:
    """Begin or end a fault; what passes at once has no end."""
    if is_over and not fault.seconds:
        return
    if fault.kind == "bridge killed":
        bridge.start() if is_over else bridge.kill()
    elif fault.kind == "worker killed":
        bridge.kill_worker()
    elif fault.kind.startswith("autopilot"):
        assert pilot is not None
        if fault.kind == "autopilot restarted":
            pilot.restart()
        elif not is_over:
            pilot.fall_silent(fault.seconds)
    else:
        bridge.fault_file.write_text("" if is_over else fault.kind, encoding="ascii")


def report(fixes: Fixes, begun: str, faults: Sequence[Fault] = ()) -> str:
    """A table of the fixes, and one of the faults."""
    if not fixes:
        return f"{begun}\n\nno fixes"
    arrived_s, off, age_ms = np.array(fixes).T
    lines = [
        begun, "", "| fixes | RMS m | median m | worst m | beyond 5 m | age p50, p99 ms |",
        "|---|---|---|---|---|---|",
        f"| {len(off)} | {np.sqrt((off**2).mean()):.2f} | {np.median(off):.2f} | {off.max():.2f} "
        f"| {(off > FAR_M).sum()} | {np.median(age_ms):.0f}, {np.percentile(age_ms, 99):.0f} |",
    ]  # fmt: skip
    if not faults:
        return "\n".join(lines)
    titles = ("fault", "first fix after its end s", "off by m", "longest silence from its begin s")
    lines += ["", f"| {' | '.join(titles)} |", "|---|---|---|---|"]
    for fault, until_s in zip(faults, (*(fault.begin_s for fault in faults[1:]), FLIGHT_S), strict=True):
        after = np.flatnonzero((arrived_s >= fault.end_s) & (arrived_s < until_s))
        row = f"{arrived_s[after[0]] - fault.end_s:.2f} | {off[after[0]]:.2f}" if len(after) else "none |"
        silence_s = longest_silence_s(arrived_s, fault.begin_s, until_s)
        lines.append(f"| {fault.name} | {row} | {silence_s:.1f} |")
    return "\n".join(lines)


def longest_silence_s(arrived_s: NDArray[np.float64], begin_s: float, end_s: float) -> float:
    """A fix already under way when a fault began says nothing about the time after it; the gaps do."""
    within = arrived_s[(arrived_s > begin_s) & (arrived_s < end_s)]
    return float(np.diff([begin_s, *within, end_s]).max())


def conditions(before: float) -> str:
    """Today, and the machine's load before the flight and now."""
    load = f"load {before:.1f} before, {os.getloadavg()[0]:.1f} after, {os.cpu_count()} cores"
    return f"{time.strftime('%Y-%m-%d')}, {load}"


def main() -> None:
    """Fly, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--method", choices=("auto", "ncc"), default="auto")
    parser.add_argument("--message", default="vision_position_estimate")
    parser.add_argument("--town", type=int, default=1, help="which town is drawn")
    beside = parser.add_mutually_exclusive_group()
    beside.add_argument("--port", type=int, help="of a bridge of your own")
    beside.add_argument("--sitl", metavar="ADDRESS", help="of SITL, such as udpin:127.0.0.1:14552")
    parser.add_argument("--firmware", choices=FIRMWARES, default="ardupilot", help="of the stand-in, with --port")
    arguments = parser.parse_args()
    flight, before = arguments.flight.absolute(), os.getloadavg()[0]
    try:
        if arguments.sitl is not None:
            fly_sitl(arguments.sitl, *recorded(flight))
            return
        if arguments.port is not None:
            print(f"waits for a bridge on UDP port {arguments.port} of this machine", flush=True)
            fixes, faults = fly(flight, arguments.port, arguments.firmware), ()
        else:
            if not flight.exists():
                frames = round(FLIGHT_S * RATE_HZ)
                write_flight(flight, plan_flight(arguments.town, frames=frames, rate_hz=RATE_HZ))
            fixes, faults = fly_with_faults(flight, arguments.method, arguments.message), FAULTS
    except EngineError as error:
        parser.error(str(error))
    what = [arguments.method, arguments.message] if faults else [flight.name, arguments.firmware]
    print(report(fixes, ", ".join([*what, conditions(before)]), faults))


if __name__ == "__main__":
    main()
