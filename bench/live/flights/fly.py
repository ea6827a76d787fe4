"""``python -m bench.live.flights.fly FOLDER [--method auto|ncc] [--message NAME] [--town SEED]``: fly, and score.

Creates FOLDER if it is missing: a generated town with the paper's flight over it. The bridge is a separate process
with ``--supervise``; :mod:`bench.live.flights.faults` lists the faults. The stand-in has no estimator: the figures
describe the fixes, not an EKF. Prints the tables of ``docs/results/vehicle.md``.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.live.bridge_counts import free_port
from bench.live.flights.faults import FAULTS, FLIGHT_S, Fault
from bench.live.fly_standin import off_m, recorded, wait_for_bridge
from bench.live.standin import MS, Agenda, RealClock, S, Standin, State
from scenematch.runs.simulation import write_flight
from scenematch.simulator import plan_flight

RATE_HZ = 5.0
FAR_M = 5.0


class Bridge:
    """The bridge's process, its worker and its camera, killed and started together."""

    def __init__(self, folder: Path, port: int, method: str, message: str) -> None:
        start = recorded(folder)[1]
        shown = f"{folder / 'frames'} {folder / 'begin'} {RATE_HZ}"
        camera = f"exec:{sys.executable} -m bench.live.flights.camera {shown}"
        self._command = [
            sys.executable, "-m", "scenematch.cli", "bridge", "mavlink", "--supervise", "--method", method,
            "--connect", f"udpin:127.0.0.1:{port}", "--map", str(folder / "map.tif"),
            "--surface", str(folder / "dsm.tif"), "--camera", str(folder / "camera.yaml"),
            "--camera-source", camera, "--start", f"{start.lat_deg},{start.lon_deg},15",
            "--settings", f"mavlink.message={message}",
        ]  # fmt: skip
        self._log = (folder / "bridge.log").open("w", encoding="utf-8")
        self.start()

    def start(self) -> None:
        """Start it in its own process group."""
        self._process = subprocess.Popen(self._command, stdout=self._log, stderr=self._log, start_new_session=True)

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


def fly(folder: Path, method: str, message: str) -> list[tuple[float, float, float]]:
    """Fly with all faults; returns each fix's arrival time, error and age."""
    motion, place, _ = recorded(folder)
    (folder / "begin").unlink(missing_ok=True)
    port, clock = free_port(), RealClock()
    bridge = Bridge(folder, port, method, message)
    fixes: list[tuple[float, float, float]] = []
    try:
        wait_for_bridge(port, bridge.is_running)
        begin_ns = clock()
        (folder / "begin").write_text(str(begin_ns), encoding="ascii")

        def now(time_s: float) -> State:
            return motion(time_s - begin_ns * 1e-9)

        def on_fix(fix: Any, arrived_ns: int) -> None:
            captured_us = fix.usec if fix.get_type() == "VISION_POSITION_ESTIMATE" else fix.time_usec
            fixes.append(
                ((arrived_ns - begin_ns) * 1e-9, off_m(fix, now, pilot), arrived_ns * 1e-6 - captured_us * 1e-3)
            )

        agenda = Agenda(clock)
        pilot = Standin(agenda, port, now, place, on_fix)
        agenda.every(2 * MS, pilot.poll, clock())
        for fault in FAULTS:
            plan(agenda, begin_ns, fault, bridge, pilot)
        agenda.run(begin_ns + round(FLIGHT_S * S))
        pilot.close()
    finally:
        bridge.kill()
    return fixes


def plan(agenda: Agenda, begin_ns: int, fault: Fault, bridge: Bridge, pilot: Standin) -> None:
    """Start a fault; the camera handles its own."""
    begin, end = (begin_ns + round(time_s * S) for time_s in (fault.begin_s, fault.end_s))
    if fault.kind == "bridge killed":
        agenda.at(begin, bridge.kill)
        agenda.at(end, bridge.start)
    elif fault.kind == "worker killed":
        agenda.at(begin, bridge.kill_worker)
    elif fault.kind == "autopilot silent":
        agenda.at(begin, lambda: pilot.fall_silent(fault.seconds))
    elif fault.kind == "autopilot restarted":
        agenda.at(begin, pilot.restart)


def report(fixes: list[tuple[float, float, float]], begun: str) -> str:
    """Two tables."""
    arrived_s, off, age_ms = np.array(fixes).T
    lines = [
        begun, "", "| fixes | RMS m | worst m | beyond 5 m | age p50, p99 ms |", "|---|---|---|---|---|",
        f"| {len(off)} | {np.sqrt((off**2).mean()):.2f} | {off.max():.2f} | {(off > FAR_M).sum()} "
        f"| {np.median(age_ms):.0f}, {np.percentile(age_ms, 99):.0f} |",
        "", "| fault | first fix after its end s | off by m | longest silence from its begin s |",
        "|---|---|---|---|",
    ]  # fmt: skip
    for fault, until_s in zip(FAULTS, (*(fault.begin_s for fault in FAULTS[1:]), FLIGHT_S), strict=True):
        after = np.flatnonzero((arrived_s >= fault.end_s) & (arrived_s < until_s))
        row = f"{arrived_s[after[0]] - fault.end_s:.2f} | {off[after[0]]:.2f}" if len(after) else "none |"
        silence_s = longest_silence_s(arrived_s, fault.begin_s, until_s)
        lines.append(f"| {fault.name} | {row} | {silence_s:.1f} |")
    return "\n".join(lines)


def longest_silence_s(arrived_s: NDArray[np.float64], begin_s: float, end_s: float) -> float:
    """A fix already under way when a fault began says nothing about the time after it; the gaps do."""
    within = arrived_s[(arrived_s > begin_s) & (arrived_s < end_s)]
    return float(np.diff([begin_s, *within, end_s]).max())


def draw(folder: Path, seed: int) -> None:
    """A town and the flight over it."""
    write_flight(folder, plan_flight(seed, frames=round(FLIGHT_S * RATE_HZ), rate_hz=RATE_HZ))


def main() -> None:
    """Fly, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--method", choices=("auto", "ncc"), default="auto")
    parser.add_argument("--message", default="vision_position_estimate")
    parser.add_argument("--town", type=int, default=1)
    arguments = parser.parse_args()
    if not arguments.folder.exists():
        draw(arguments.folder, arguments.town)
    before = os.getloadavg()[0]
    fixes = fly(arguments.folder.absolute(), arguments.method, arguments.message)
    load = f"load {before:.1f} before, {os.getloadavg()[0]:.1f} after, {os.cpu_count()} cores"
    print(report(fixes, f"{arguments.method}, {arguments.message}, {time.strftime('%Y-%m-%d')}, {load}"))


if __name__ == "__main__":
    main()
