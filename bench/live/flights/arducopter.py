"""``python -m bench.live.flights.arducopter FLIGHT SITL``: ArduCopter's simulator, the bridge and a drawn town.

SITL is the program ``arducopter`` in its source tree, of which it takes the default parameters. It climbs on GNSS,
selects the fixes, switches the receiver off and flies the paper's course over a drawn town for so long, in wind.
With ``--faults`` the bridge is killed and the camera covered, frozen and shifted; with ``--drifts`` wind carries
the vehicle away until the EKF lets go of its position, or the EKF leaves fixes out. ``--boots`` flies so often
beside one bridge: the simulator ends in the air and is started anew. What the EKF and the fixes were off is from
SITL's own log.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from pymavlink import mavutil

from bench.live.bridge_counts import free_port
from bench.live.flights.bridge import Bridge, change
from bench.live.flights.faults import Fault, events
from bench.live.flights.fly import FAR_M, conditions
from bench.live.flights.recorded import recorded
from bench.live.flights.sitl import Motion, Pilot, climb
from engine.geo import LocalFrame
from scenematch.files.stamps import GPS_EPOCH_S, GPS_WEEK_S
from scenematch.report.loop_record import rms
from scenematch.runs.simulation import write_flight
from scenematch.simulator import plan_flight

RATE_HZ, FLIGHT_S = 5.0, 145.0  # of the course
DELAY_MS = 80.0
_PILOT_AT = "udpin:127.0.0.1:14552"
FAULTS = (
    Fault("bridge killed", 30.0, 3.0),
    Fault("worker killed", 60.0),
    Fault("camera covered", 90.0, 10.0),
    Fault("picture frozen", 130.0, 6.0),
    Fault("camera covered", 165.0, 20.0),
    Fault("bridge killed", 215.0, 15.0),
    Fault("map shifted", 270.0, 20.0),
)
DRIFTS = (
    Fault("camera covered", 15.0, 20.0, 2.0),
    Fault("camera covered", 60.0, 20.0, 4.0),
    Fault("camera covered", 105.0, 20.0, 8.0),
    Fault("fixes not used", 150.0, 12.0),
)
_AFTER_S = 30.0  # from the last fault to the end
Track = NDArray[np.float64]
"""(N, 3 or 4) seconds since the simulator's start, metres east and north, and when a fix came."""


def sitl_bridge(
    folder: Path, port: int, method: str, message: str, *, realtime: bool, firmware: str = "ardupilot"
) -> Bridge:
    """The bridge with the camera over the town."""
    settings = [f"input.exposure_to_grab_ms={DELAY_MS}", *["bridge.realtime=true"] * realtime, *_receiver(message)]
    more = [word for setting in settings for word in ("--settings", setting)] + ["--firmware", firmware]
    return Bridge(folder, port, method, message, f"exec:cat {folder / 'camera'}", more)


def _receiver(message: str) -> list[str]:
    """The setting for fixes that pose as a second receiver, which is used once the first is off."""
    return ["mavlink.gps_id=1"] if message == "gps_input" else []


class LoggedPilot(Pilot):
    """A pilot that knows the simulator's time, which falls behind this machine's if that is loaded."""

    def __init__(self, link: Any, place: LocalFrame) -> None:
        super().__init__(link, place)
        self.times_s: list[tuple[float, float]] = []  # of this machine's monotonic clock, and the simulator's
        self.since_1970_s = 0.0  # of the monotonic clock's zero, by the simulator's first dated message

    def take(self, message: Any) -> None:
        """Note what a message says, and when."""
        if message.get_type() == "GLOBAL_POSITION_INT":
            self.times_s.append((time.monotonic(), message.time_boot_ms * 1e-3))
        elif message.get_type() == "SYSTEM_TIME" and message.time_unix_usec and not self.since_1970_s:
            self.since_1970_s = message.time_unix_usec * 1e-6 - time.monotonic()
        super().take(message)


@contextlib.contextmanager
def simulator(
    sitl: Path, folder: Path, place: LocalFrame, port: int, message: str, wind_mps: float
) -> Iterator[Path]:
    """SITL with fresh parameters, and the camera; yields the folder of SITL's logs."""
    run, pipe, fault_file = folder / "sitl", folder / "camera", folder / "fault"
    run.mkdir(exist_ok=True)
    fault_file.unlink(missing_ok=True)
    pipe.unlink(missing_ok=True)
    os.mkfifo(pipe)
    for log in (run / "logs").glob("*.BIN"):
        log.unlink()
    sent = [f"mavlink.message={message}", *_receiver(message)]
    settings = ["parameters.takeoff=gnss", "parameters.delay_ms=100", *sent]
    command = [sys.executable, "-m", "scenematch", "bridge", "mavlink", "--force"]
    written = [part for setting in settings for part in ("--settings", setting)]
    subprocess.run([*command, *written, "--write-params", str(run / "scenematch.param")], check=True)
    (run / "world.parm").write_text(
        f"SIM_WIND_SPD {wind_mps}\nSIM_WIND_DIR 210\nLOG_DISARMED 1\n", encoding="ascii"
    )
    defaults = [sitl.parents[3] / "Tools/autotest/default_params/copter.parm", "scenematch.param", "world.parm"]
    ports = [f"--serial{k}=udpclient:127.0.0.1:{number}" for k, number in enumerate((port, 14551, 14552))]
    home = f"{place.lat_deg:.7f},{place.lon_deg:.7f},0,0"
    arguments = ["-S", "-w", "--model", "quad", "--speedup", "1", "--home", home, *ports]
    camera = [sys.executable, "-m", "bench.live.flights.town_camera", folder, pipe, fault_file]
    with (run / "sitl.log").open("w") as log, contextlib.ExitStack() as world:
        parameters = ["--defaults", ",".join(map(str, defaults))]
        launch(world, [*camera, "--delay-ms", DELAY_MS], stdout=log, stderr=log)
        launch(world, [sitl, *arguments, *parameters], cwd=run, stdout=log, stderr=log)
        yield run / "logs"


def launch(world: contextlib.ExitStack, command: Sequence[object], **how: Any) -> None:
    """Start a program that lasts as long as the world; what flies does not wait for other work."""
    process = subprocess.Popen(["chrt", "--rr", "1", *map(str, command)], **how)
    world.callback(process.wait)
    world.callback(process.kill)


def fly(
    pilot: LoggedPilot,
    motion: Motion,
    duration_s: float,
    bridge: Bridge,
    faults: tuple[Fault, ...],
    message: str,
) -> float:
    """Fly the course over and over; enter GUIDED again where a failsafe took over.

    Returns:
        The simulator's time at which the receiver was switched off.
    """
    climb(pilot, motion(0.0).height_m)
    if not _receiver(message):
        pilot.select(is_fixes=True)
    pilot.listen(10.0)
    pilot.link.param_set_send("SIM_GPS1_ENABLE", 0.0)
    pilot.part, asked_s = "course", 0.0
    begin_s = pilot.times_s[-1][1]

    def steer(gone_s: float) -> None:
        nonlocal asked_s
        if pilot.mode != "GUIDED" and gone_s - asked_s > 1.0:
            asked_s = gone_s
            pilot.link.set_mode("GUIDED")
        pilot.go_to(motion(gone_s % FLIGHT_S))
        pilot.listen(0.1)

    endure(pilot, bridge, faults, duration_s, steer)
    return begin_s


def endure(
    pilot: Pilot, bridge: Bridge, faults: Sequence[Fault], duration_s: float, steer: Callable[[float], None]
) -> None:
    """Steer for so long, by the seconds that are gone, with faults."""
    due, begin = events(faults), time.monotonic()
    while (gone_s := time.monotonic() - begin) < duration_s:
        while due and due[0][0] <= gone_s:
            _, is_over, fault = due.pop(0)
            pilot.say(f"{fault.name} {'over' if is_over else 'begins'}")
            pilot.meet(fault, is_over=is_over)
            change(fault, bridge, is_over=is_over)
        steer(gone_s)


def read_log(log: Path, pilot: LoggedPilot) -> tuple[Track, Track, Track]:
    """The truth, the EKF and the fixes by their time of capture, of SITL's log; these with when they came."""
    place, (here_s, there_s) = pilot.place, np.array(pilot.times_s).T
    lead_s = sliding_window_view(np.pad(there_s - here_s, 50, mode="edge"), 101).max(axis=1)  # of the quickest
    reader = mavutil.mavlink_connection(str(log))
    tracks: dict[str, list[tuple[float, ...]]] = {"SIM": [], "POS": [], "fixes": []}
    origin = place
    while (row := reader.recv_match(type=["SIM", "POS", "VISP", "GPS", "ORGN"])) is not None:
        kind = row.get_type()
        if kind == "ORGN":
            origin = LocalFrame(row.Lat, row.Lng) if row.Type == 0 else origin
        elif kind in tracks:
            tracks[kind].append((row.TimeUS * 1e-6, *place.enu_from_geodetic(row.Lat, row.Lng)[:2]))
        elif (fix := _fix_of(row, origin, pilot.since_1970_s)) is not None:
            captured_s, *at_deg = fix
            captured_s += float(np.interp(captured_s, here_s, lead_s))
            tracks["fixes"].append((captured_s, *place.enu_from_geodetic(*at_deg)[:2], row.TimeUS * 1e-6))
    widths = {"SIM": 3, "POS": 3, "fixes": 4}
    return tuple(np.array(tracks[kind]).reshape(-1, n) for kind, n in widths.items())  # type: ignore[return-value]


def _fix_of(row: Any, origin: LocalFrame, since_1970_s: float) -> tuple[float, float, float] | None:
    """Capture on this machine's clock, latitude and longitude of a row of VISP or GPS; None if it is no fix."""
    if row.get_type() == "VISP":  # without a position it says only that the camera works
        return None if row.Ign else (row.RTimeUS * 1e-6, *map(float, origin.geodetic_from_enu(row.PY, row.PX)))
    if row.I != 1 or row.Status < mavutil.mavlink.GPS_FIX_TYPE_3D_FIX:  # the first receiver is the simulator's
        return None
    return GPS_EPOCH_S + row.GWk * GPS_WEEK_S + row.GMS * 1e-3 - since_1970_s, row.Lat, row.Lng


def off_m(truth: Track, track: Track) -> NDArray[np.float64]:
    """How far a track is from the truth at its times."""
    true = np.column_stack([np.interp(track[:, 0], truth[:, 0], truth[:, k]) for k in (1, 2)])
    return np.asarray(np.hypot(*(track[:, 1:3] - true).T))


def longest_silence_s(arrived_s: NDArray[np.float64], begin_s: float, end_s: float) -> float:
    """The longest gap between fixes, or between one and the begin or end."""
    within = arrived_s[(arrived_s > begin_s) & (arrived_s < end_s)]
    return float(np.diff([begin_s, *within, end_s]).max())


def _rms_and_worst(off: NDArray[np.float64]) -> str:
    return f"{rms(off):.2f}, {off.max():.2f} m" if len(off) else "none"


def report(tracks: Sequence[Track], begin_s: float, duration_s: float, faults: tuple[Fault, ...]) -> str:
    """A table of the flight without GNSS, and one of its faults, by the truth, the EKF and the fixes of a log."""
    truth, ekf, fixes = (t[(t[:, 0] > begin_s) & (t[:, 0] < begin_s + duration_s)] for t in tracks)
    ekf_m, fixes_m = off_m(truth, ekf), off_m(truth, fixes)
    silence_s = longest_silence_s(fixes[:, 0], begin_s, begin_s + duration_s)
    ages_ms = (fixes[:, 3] - fixes[:, 0]) * 1e3 - DELAY_MS
    p50_ms, p99_ms = np.percentile(ages_ms, (50, 99)) if len(fixes) else (math.nan, math.nan)
    lines = [
        "| EKF to truth, RMS, worst | fixes | to truth, RMS, worst | beyond 5 m | longest gap | age p50, p99 |",
        "|---|---|---|---|---|---|",
        f"| {_rms_and_worst(ekf_m)} | {len(fixes)} | {_rms_and_worst(fixes_m)} "
        f"| {(fixes_m > FAR_M).sum()} | {silence_s:.1f} s | {p50_ms:.0f}, {p99_ms:.0f} ms |",
    ]
    for row, off in zip(fixes[fixes_m > FAR_M], fixes_m[fixes_m > FAR_M], strict=True):
        lines.append(f"\n{off:.1f} m off, {row[0] - begin_s:.1f} s after the receiver's end")
    if not faults:
        return "\n".join(lines)
    lines += ["", "| fault | EKF to truth, worst | drift; first fix after its end; then worst, longest gap |"]
    lines.append("|---|---|---|")
    worst_m, firsts = defaultdict[str, float](float), defaultdict[str, list[str]](list)
    for fault, until in zip(faults, [*[f.begin_s for f in faults[1:]], duration_s], strict=True):
        end_s = begin_s + fault.end_s
        during = (ekf[:, 0] >= begin_s + fault.begin_s) & (ekf[:, 0] < begin_s + until)
        after = np.flatnonzero((fixes[:, 0] > end_s) & (fixes[:, 0] < begin_s + until))
        moved = [[np.interp(t, truth[:, 0], truth[:, k]) for k in (1, 2)] for t in (end_s - 1.0, end_s)]
        worst_m[fault.name] = max(worst_m[fault.name], float(ekf_m[during].max()))
        found = "none"
        if len(after):
            first_s = fixes[after[0], 0]
            gap_s = longest_silence_s(fixes[:, 0], first_s, begin_s + until)
            found = f"{first_s - end_s:.2f} s; {fixes_m[after].max():.2f} m, {gap_s:.1f} s"
        firsts[fault.name].append(f"{math.dist(*moved):.1f} m/s; {found}")
    lines += [f"| {name} | {far_m:.2f} m | {' / '.join(firsts[name])} |" for name, far_m in worst_m.items()]
    return "\n".join(lines)


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """The options of every simulator's flight."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path, help="folder of the town; drawn if there is none")
    parser.add_argument("--method", choices=("auto", "ncc"), default="auto")
    parser.add_argument("--wind-mps", type=float, default=5.0)
    parser.add_argument("--seconds", type=float, default=300.0, help="without GNSS")
    rounds = parser.add_mutually_exclusive_group()
    rounds.add_argument("--faults", type=int, nargs="?", const=1, default=0, help="how often each")
    rounds.add_argument("--drifts", type=int, nargs="?", const=1, default=0, help="how often each")
    return parser


def planned(arguments: argparse.Namespace) -> tuple[Path, tuple[Fault, ...], float]:
    """The flight's folder, drawn if there is none, its faults, and its seconds without GNSS."""
    folder, kinds = arguments.flight.absolute(), DRIFTS if arguments.drifts else FAULTS
    rounds, round_s = range(arguments.drifts or arguments.faults), kinds[-1].end_s + _AFTER_S
    faults = tuple(replace(fault, begin_s=fault.begin_s + k * round_s) for k in rounds for fault in kinds)
    if not folder.exists():
        write_flight(folder, plan_flight(1, frames=round(FLIGHT_S * RATE_HZ), rate_hz=RATE_HZ))
    return folder, faults, len(rounds) * round_s if faults else arguments.seconds


def main() -> None:
    """Fly, and print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("sitl", type=Path, help="arducopter, in build/sitl/bin of ArduPilot")
    parser.add_argument("--message", default="vision_position_estimate")
    parser.add_argument("--realtime", action="store_true", help="bridge.realtime")
    parser.add_argument("--boots", type=int, default=1, help="flights, of one bridge")
    arguments, before, port = parser.parse_args(), os.getloadavg()[0], free_port()
    if not os.access(arguments.sitl, os.X_OK) or arguments.sitl.is_dir():
        parser.error(f"sitl: expected the program arducopter in build/sitl/bin, got {arguments.sitl}")
    folder, faults, seconds = planned(arguments)
    motion, place, _ = recorded(folder)
    bridge = sitl_bridge(folder, port, arguments.method, arguments.message, realtime=arguments.realtime)
    world = (arguments.sitl.absolute(), folder, place, port, arguments.message, arguments.wind_mps)
    with contextlib.ExitStack() as stack:
        stack.callback(bridge.kill)
        for _ in range(arguments.boots):
            with simulator(*world) as logs, contextlib.closing(mavutil.mavlink_connection(_PILOT_AT)) as link:
                link.wait_heartbeat()
                pilot = LoggedPilot(link, place)
                begin_s = fly(pilot, motion, seconds, bridge, faults, arguments.message)
                pilot.listen(2.0)
            what = f"{arguments.method}, {arguments.message}, wind {arguments.wind_mps:g} m/s"
            print(f"{what}, {conditions(before)}\n")
            tracks = read_log(max(logs.glob("*.BIN")), pilot)
            print(report(tracks, begin_s, seconds, faults), flush=True)


if __name__ == "__main__":
    main()
