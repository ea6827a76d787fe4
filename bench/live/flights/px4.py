"""``python -m bench.live.flights.px4 FLIGHT BUILD``: PX4 with simulated hardware (SIH), the bridge and a town.

BUILD is the folder of a build of PX4 for SITL, with ``bin/px4`` in it, best of ``px4_sitl_sih`` without lockstep.
The flight is that of :mod:`bench.live.flights.arducopter`, in OFFBOARD; EKF and truth are compared by PX4's own
stamps. A fault's row has the time from its end to the bridge's "fixes begin" on the ground station.
"""

from __future__ import annotations

import contextlib
import math
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import mavutil

from bench.live.flights.arducopter import DELAY_MS, endure, launch, off_m, parser_of, planned, sitl_bridge
from bench.live.flights.faults import Fault
from bench.live.flights.fly import FLIGHT_S, Bridge, conditions
from bench.live.flights.recorded import recorded
from bench.live.flights.sitl import Motion, Pilot
from engine.geo import LocalFrame

_OFFBOARD = (1.0, 6.0)  # custom mode enabled, PX4's main mode
_INT32 = 6
_CLIMB_S = 150.0
_OWN = {"EKF2_GPS_CTRL": 7, "NAV_DLL_ACT": 0, "NAV_RCL_ACT": 0, "COM_RC_IN_MODE": 4, "CBRK_SUPPLY_CHK": 894281}
"""Parameters of the flight; the bridge's file switches the receiver off, this program only after the climb."""


class Px4Pilot(Pilot):
    """A pilot that keeps the EKF's positions and the true ones with PX4's stamps."""

    def __init__(self, link: Any, place: LocalFrame) -> None:
        super().__init__(link, place)
        self.tracks: dict[str, list[tuple[float, float, float]]] = {"EKF": [], "truth": []}
        self.begun_s: list[float] = []  # when fixes began

    def take(self, message: Any) -> None:
        """Note what a message says, and when."""
        kind = message.get_type()
        if kind == "HIL_STATE_QUATERNION":
            self.tracks["truth"].append((message.time_usec * 1e-6, *self._metres(message.lat, message.lon)))
            return
        if kind == "GLOBAL_POSITION_INT":
            self.tracks["EKF"].append((message.time_boot_ms * 1e-3, *self._metres(message.lat, message.lon)))
        elif kind == "STATUSTEXT" and "fixes begin" in message.text:
            self.begun_s.append(time.monotonic())
        super().take(message)


@contextlib.contextmanager
def simulator(build: Path, folder: Path, place: LocalFrame, wind_mps: float) -> Iterator[None]:
    """PX4 with fresh parameters, and the camera."""
    run, pipe, fault_file = folder / "px4", folder / "camera", folder / "fault"
    run.mkdir(exist_ok=True)
    for old in (run / "parameters.bson", run / "parameters_backup.bson", fault_file, pipe):
        old.unlink(missing_ok=True)
    os.mkfifo(pipe)
    command = [sys.executable, "-m", "scenematch", "bridge", "mavlink", "--force", "--firmware", "px4"]
    written = ["--settings", "mavlink.message=odometry", "--write-params", str(run / "scenematch.params")]
    subprocess.run([*command, *written], check=True)
    lines = (run / "scenematch.params").read_text(encoding="ascii").splitlines()
    values = dict(line.split("\t")[2:4] for line in lines if not line.startswith("#")) | _OWN
    values |= {"SIH_KDV": 0.3, "SIH_WIND_N": wind_mps * 0.87, "SIH_WIND_E": wind_mps * 0.5}
    environment = os.environ | {f"PX4_PARAM_{name}": str(value) for name, value in values.items()}
    environment |= {"PX4_SYS_AUTOSTART": "10040", "PX4_SIM_MODEL": "sihsim_quadx", "PX4_HOME_ALT": "0"}
    environment |= {"PX4_HOME_LAT": str(place.lat_deg), "PX4_HOME_LON": str(place.lon_deg)}
    own = [sys.executable, "-m", "bench.live.flights.town_camera", folder, pipe, fault_file]
    camera = [*own, "--delay-ms", DELAY_MS, "--link", "udpin:127.0.0.1:19410"]
    px4 = [build / "bin" / "px4", "-d", "-w", run, build / "etc"]
    with (run / "px4.log").open("w") as log, contextlib.ExitStack() as world:
        for program in (camera, px4):
            launch(world, program, stdout=log, stderr=log, env=environment)
        yield


def follow(pilot: Px4Pilot, motion: Motion, begin_s: float, asked_s: float) -> float:
    """Send one target; ask for OFFBOARD once a second where it was left. Returns when it was asked last."""
    now_s = time.monotonic()
    if pilot.mode != "OFFBOARD" and now_s - asked_s > 1.0:
        asked_s = now_s
        pilot.command(mavutil.mavlink.MAV_CMD_DO_SET_MODE, *_OFFBOARD)
    pilot.go_to(motion((now_s - begin_s) % FLIGHT_S))
    pilot.listen(0.1)
    return asked_s


def fly(
    pilot: Px4Pilot, motion: Motion, duration_s: float, bridge: Bridge, faults: tuple[Fault, ...]
) -> tuple[float, list[tuple[Fault, float]]]:
    """Climb by the receiver, switch it off, and fly the course over and over.

    Returns:
        PX4's time at which the receiver was switched off, and when each fault ended on this machine's clock.
    """
    first, asked_s, begin = motion(0.0), 0.0, time.monotonic()
    pilot.command(mavutil.mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 115, 40_000)
    while pilot.height_m < first.height_m - 2.0 or not pilot.begun_s:
        if time.monotonic() - begin > _CLIMB_S:
            raise SystemExit(f"at {pilot.height_m:.0f} m after {_CLIMB_S:g} s: {pilot.texts[-5:]}")
        asked_s = follow(pilot, lambda _: first, begin, asked_s)
        if not pilot.armed and pilot.mode == "OFFBOARD":
            pilot.command(mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    pilot.link.mav.param_set_send(1, 1, b"EKF2_GPS_CTRL", 0.0, _INT32)
    pilot.part, begin = "course", time.monotonic()
    begin_s = pilot.tracks["EKF"][-1][0]

    def steer(_: float) -> None:
        nonlocal asked_s
        asked_s = follow(pilot, motion, begin, asked_s)

    return begin_s, endure(pilot, bridge, faults, duration_s, steer)


def report(pilot: Px4Pilot, begin_s: float, ended: list[tuple[Fault, float]]) -> str:
    """A table of the flight without GNSS, and one of its faults."""
    ekf, truth = (np.array(pilot.tracks[name]) for name in ("EKF", "truth"))
    off = off_m(truth, ekf[(ekf[:, 0] > begin_s) & (ekf[:, 0] < truth[-1, 0])])
    lines = [f"EKF to truth, RMS and worst: {np.sqrt((off**2).mean()):.2f}, {off.max():.2f} m of {len(off)}", ""]
    lines += ["| fault | fixes begin after its end |", "|---|---|"] * bool(ended)
    firsts = defaultdict[str, list[str]](list)
    for (fault, end_s), until_s in zip(ended, [*(at_s for _, at_s in ended[1:]), math.inf], strict=True):
        after = [begun - end_s for begun in pilot.begun_s if end_s < begun < until_s]
        firsts[fault.name].append(f"{after[0]:.2f} s" if after else "none")
    return "\n".join([*lines, *(f"| {name} | {'; '.join(those)} |" for name, those in firsts.items())])


def main() -> None:
    """Fly, and print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("build", type=Path)
    arguments, before = parser.parse_args(), os.getloadavg()[0]
    folder, faults, seconds = planned(arguments)
    motion, place, _ = recorded(folder)
    with (
        simulator(arguments.build.absolute(), folder, place, arguments.wind_mps),
        contextlib.ExitStack() as stack,
    ):
        bridge = sitl_bridge(folder, 14540, arguments.method, "odometry", realtime=True, firmware="px4")
        stack.callback(bridge.kill)
        link = mavutil.mavlink_connection("udpin:127.0.0.1:14550", source_system=255)
        link.wait_heartbeat()
        pilot = Px4Pilot(link, place)
        begin_s, ended = fly(pilot, motion, seconds, bridge, faults)
    print(f"{arguments.method}, wind {arguments.wind_mps:g} m/s, {conditions(before)}\n")
    print(report(pilot, begin_s, ended))


if __name__ == "__main__":
    main()
