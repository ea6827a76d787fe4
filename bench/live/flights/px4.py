"""``python -m bench.live.flights.px4 FLIGHT BUILD``: PX4 with simulated hardware (SIH), the bridge and a town.

BUILD is the folder of a build of PX4 for SITL, with ``bin/px4`` in it, best of ``px4_sitl_sih`` without lockstep.
The flight is that of :mod:`bench.live.flights.arducopter`, in OFFBOARD, and so is its report, made from PX4's own
log, which the extra ``logs`` reads.
"""

from __future__ import annotations

import contextlib
import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pymavlink import mavutil

from bench.live.flights.arducopter import (
    DELAY_MS,
    FLIGHT_S,
    LoggedPilot,
    Track,
    endure,
    launch,
    parser_of,
    planned,
    report,
    sitl_bridge,
)
from bench.live.flights.bridge import Bridge
from bench.live.flights.faults import Fault
from bench.live.flights.fly import conditions
from bench.live.flights.recorded import recorded
from bench.live.flights.sitl import Motion
from engine.geo import LocalFrame

_OFFBOARD = (1.0, 6.0)  # custom mode enabled, PX4's main mode
_INT32, _REAL32 = 6, 9
_WIND = {"SIH_WIND_N": 0.87, "SIH_WIND_E": 0.5}
_CLIMB_S = 150.0
_OWN = {
    "SDLOG_PROFILE": 131,
    "EKF2_GPS_CTRL": 7,
    "NAV_DLL_ACT": 0,
    "NAV_RCL_ACT": 0,
    "COM_RC_IN_MODE": 4,
    "CBRK_SUPPLY_CHK": 894281,
}
"""Parameters of the flight; the bridge's file switches the receiver off, this program only after the climb."""


class Px4Pilot(LoggedPilot):
    """A pilot of PX4."""

    def meet(self, fault: Fault, *, is_over: bool) -> None:
        """Let the simulated vehicle feel what of a fault concerns it."""
        if fault.wind_mps is not None:
            for name, share in _WIND.items():
                self.link.mav.param_set_send(1, 1, name.encode(), fault.wind_mps * share, _REAL32)
        if fault.kind == "fixes not used":
            for name in ("EKF2_EV_CTRL", "EKF2_AGP0_CTRL"):
                self.set_integer(name, int(is_over))

    def set_integer(self, name: str, value: int) -> None:
        """Set a parameter of whole numbers, whose bits PX4 takes for those of a float."""
        bits = struct.unpack("<f", struct.pack("<i", value))[0]
        self.link.mav.param_set_send(1, 1, name.encode(), bits, _INT32)


@contextlib.contextmanager
def simulator(build: Path, folder: Path, place: LocalFrame, message: str, wind_mps: float) -> Iterator[None]:
    """PX4 with fresh parameters, and the camera."""
    run, pipe, fault_file = folder / "px4", folder / "camera", folder / "fault"
    run.mkdir(exist_ok=True)
    for old in (run / "parameters.bson", run / "parameters_backup.bson", fault_file, pipe):
        old.unlink(missing_ok=True)
    os.mkfifo(pipe)
    command = [sys.executable, "-m", "scenematch", "bridge", "mavlink", "--force", "--firmware", "px4"]
    written = ["--settings", f"mavlink.message={message}", "--write-params", str(run / "scenematch.params")]
    subprocess.run([*command, *written], check=True)
    lines = (run / "scenematch.params").read_text(encoding="ascii").splitlines()
    values = dict(line.split("\t")[2:4] for line in lines if not line.startswith("#")) | _OWN
    values |= {"SIH_KDV": 0.3, **{name: wind_mps * share for name, share in _WIND.items()}}
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


def fly(pilot: Px4Pilot, motion: Motion, duration_s: float, bridge: Bridge, faults: tuple[Fault, ...]) -> float:
    """Climb by the receiver, switch it off, and fly the course over and over.

    Returns:
        PX4's time at which the receiver was switched off.
    """
    first, asked_s, begin = motion(0.0), 0.0, time.monotonic()
    while pilot.height_m < first.height_m - 2.0 or not pilot.has_fixes:
        if time.monotonic() - begin > _CLIMB_S:
            raise SystemExit(f"at {pilot.height_m:.0f} m after {_CLIMB_S:g} s: {pilot.texts[-5:]}")
        asked_s = follow(pilot, lambda _: first, begin, asked_s)
        if not pilot.armed and pilot.mode == "OFFBOARD":
            pilot.command(mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    pilot.set_integer("EKF2_GPS_CTRL", 0)
    pilot.part, begin = "course", time.monotonic()
    begin_s = pilot.times_s[-1][1]

    def steer(_: float) -> None:
        nonlocal asked_s
        asked_s = follow(pilot, motion, begin, asked_s)

    endure(pilot, bridge, faults, duration_s, steer)
    return begin_s


def read_log(log: Path, place: LocalFrame) -> list[Track]:
    """The truth, the EKF and the fixes by their time of capture, of a ULog; these with when they came.

    PX4 stamps GLOBAL_POSITION_SENSOR by its arrival: the capture is what EKF2 takes for it.
    """
    from pyulog import ULog

    positions = ("vehicle_global_position_groundtruth", "vehicle_global_position", "aux_global_position")
    read = ULog(str(log), [*positions, "vehicle_local_position", "vehicle_visual_odometry"])
    data = {each.name: each.data for each in read.data_list}
    tracks = []
    for name in positions:
        if (known := data.get(name)) is not None:
            east_north = place.enu_from_geodetic(known["lat"], known["lon"])
            tracks.append(np.column_stack([known["timestamp"] * 1e-6, east_north]))
    if len(tracks) > 2:
        delay_s = np.array([read.initial_parameters["EKF2_AGP0_DELAY"] * 1e-3, 0.0, 0.0])
        return [*tracks[:2], np.column_stack([tracks[2] - delay_s, tracks[2][:, 0]])]
    origin, fixes = data["vehicle_local_position"], data["vehicle_visual_odometry"]
    frame = LocalFrame(origin["ref_lat"][-1], origin["ref_lon"][-1])
    lat_deg, lon_deg = frame.geodetic_from_enu(fixes["position[1]"], fixes["position[0]"])
    east_north = place.enu_from_geodetic(lat_deg, lon_deg)
    stamps_s = fixes["timestamp_sample"] * 1e-6, fixes["timestamp"] * 1e-6
    return [*tracks, np.column_stack([stamps_s[0], east_north, stamps_s[1]])]


def main() -> None:
    """Fly, and print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("build", type=Path)
    parser.add_argument("--message", choices=("odometry", "global_position_sensor"), default="odometry")
    arguments, before = parser.parse_args(), os.getloadavg()[0]
    folder, faults, seconds = planned(arguments)
    motion, place, _ = recorded(folder)
    with (
        simulator(arguments.build.absolute(), folder, place, arguments.message, arguments.wind_mps),
        contextlib.ExitStack() as stack,
    ):
        bridge = sitl_bridge(folder, 14540, arguments.method, arguments.message, realtime=True, firmware="px4")
        stack.callback(bridge.kill)
        link = mavutil.mavlink_connection("udpin:127.0.0.1:14550", source_system=255)
        link.wait_heartbeat()
        pilot = Px4Pilot(link, place)
        begin_s = fly(pilot, motion, seconds, bridge, faults)
    print(f"{arguments.method}, {arguments.message}, wind {arguments.wind_mps:g} m/s, {conditions(before)}\n")
    tracks = read_log(max((folder / "px4").rglob("*.ulg"), key=os.path.getmtime), place)
    print(report(tracks, begin_s, seconds, faults))


if __name__ == "__main__":
    main()
