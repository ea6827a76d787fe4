"""The MAVLink bridge beside a stand-in autopilot: an hour at speed, in which everything goes wrong that can."""

from __future__ import annotations

import math
import random
import socket
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from bench import RESULTS
from bench.command import parser_on_one_thread
from bench.live.bridge_counts import RATE_NS, Received, free_port, growth_rows, place_off_m
from bench.live.growth import Growth
from bench.live.standin import MS, Agenda, Door, S, Standin, State, VirtualClock, circling
from bench.pages.text import fill, table
from engine.geo import LocalFrame
from engine.options import NavigatorOptions
from engine.values import Fix, Frame, NoFix, Reason, Timings, Window
from scenematch.bridges.links import Connection
from scenematch.bridges.mavlink import MavlinkBridge
from scenematch.bridges.mavlink_status import MIN_RATE_HZ
from scenematch.bridges.parameters import MavlinkOptions
from scenematch.bridges.vehicle import NedOrigin

PAGE = RESULTS / "mavlink.md"
PLACE = LocalFrame(33.64, 72.99)
CAMERA_MS = (45.0, 95.0)  # from exposure to the answer: the scripted matcher takes no time of its own
IMAGE = np.zeros((8, 8, 3), np.uint8)
SAMPLE = 10_000  # messages between two looks at the memory


# -------------------------------------------------------------------------------------- the hour at speed


@dataclass
class Script:
    """What goes wrong, at seconds from the beginning; everything else goes right."""

    seconds: int
    relocated: list[int] = field(init=False)
    excused: np.ndarray = field(init=False)  # (frames,) no fix is due

    def __post_init__(self) -> None:
        part = self.seconds / 20.0
        self.restart, self.flood, self.crash = part * 3, part * 9, part * 11
        self.silence, self.move = (part * 5, 8.0), (part * 17, 10.0)  # from, how long
        self.covered, self.poor = (part * 13, part * 0.5), (part * 15, part * 0.3)
        self.relocated = [round((k + 0.5) * part * 5) for k in range(20) if (k + 0.5) * part < self.seconds]
        self.excused = np.zeros(self.seconds * 5, bool)
        for begin, length in (
            (0.0, 4.0),
            (self.restart, 6.0),
            (self.silence[0], self.silence[1] + 3.0),
            (self.move[0], self.move[1] + 3.0),
            self.covered,
            self.poor,
            (self.crash, 0.4),
        ):
            self.excused[int(begin * 5) : int((begin + length) * 5) + 2] = True

    def outcome(self, number: int) -> str:
        """fix, poor, refused or crash."""
        second = number / 5.0
        if self.covered[0] <= second < sum(self.covered) or number % 50 == 49:
            return "refused"
        if self.poor[0] <= second < sum(self.poor):
            return "poor"
        return "crash" if number == int(self.crash * 5) else "fix"


class Scripted:
    """A navigator that knows the truth, or refuses as its script says; and holds the frame against the truth."""

    options = NavigatorOptions()
    reset_count = 0
    heading_off_deg = height_off_m = 0.0  # of all that the script makes, one after the other

    def __init__(self, script: Script, received: Received) -> None:
        self._script, self._received = script, received

    def update(self, frame: Frame, prior: object = None, budget: object = None) -> Fix | NoFix:
        number = round((frame.timestamp_ns - self._received.begin_ns) / (RATE_NS + 0.0))
        state = circling(frame.timestamp_ns * 1e-9)
        if not self._script.excused[number]:
            self._compare(frame, state)
        self.reset_count += number in self._script.relocated
        outcome = self._script.outcome(number)
        if outcome == "crash":
            raise RuntimeError("as the script says")
        if outcome == "refused":
            return NoFix(reason=Reason.NO_TEXTURE, timestamp_ns=frame.timestamp_ns)
        return _fix(frame.timestamp_ns, state, 12.0 if outcome == "poor" else 0.5)

    def _compare(self, frame: Frame, state: State) -> None:
        if frame.heading_deg is not None:
            off = abs(math.remainder(frame.heading_deg - state.heading_deg, 360.0))
            Scripted.heading_off_deg = max(Scripted.heading_off_deg, off)
        if frame.height_agl_m is not None:
            Scripted.height_off_m = max(Scripted.height_off_m, abs(frame.height_agl_m - state.height_m))


def _fix(stamp_ns: int, state: State, sigma_m: float) -> Fix:
    lat_deg, lon_deg = (float(v) for v in PLACE.geodetic_from_enu(state.east_m, state.north_m))
    return Fix(
        timestamp_ns=stamp_ns, lat_deg=lat_deg, lon_deg=lon_deg, east_m=state.east_m, north_m=state.north_m,
        up_m=None, covariance_m2=np.diag([sigma_m**2, sigma_m**2, 1e6]), attitude=None, score=0.9, method="ncc",
        window=Window(0, 0, 8, 8), timings=Timings(), map_xy_px=(0.0, 0.0),
    )  # fmt: skip


def hour(minutes: float, flood_pieces: int = 20_000) -> dict[str, Any]:
    """So many minutes of traffic on a clock that waits for the bridge; what came of them."""
    script = Script(round(minutes * 60))
    clock = VirtualClock(7_000 * S)
    agenda, growth, dice = Agenda(clock), Growth(SAMPLE), random.Random(2)
    received = Received.room(clock() + 137_000, script.seconds * 5)
    Scripted.heading_off_deg = Scripted.height_off_m = 0.0
    door = Door(Connection("udpin", "127.0.0.1", port := free_port()))
    back: dict[str, float] = {}
    begin, begin_ns, submitted = time.perf_counter(), clock(), 0
    with clock.reigns(), MavlinkBridge(
        door, lambda _: Scripted(script, received), MavlinkOptions(), origin=NedOrigin(33.643, 72.993, 500.0)
    ) as bridge:  # fmt: skip

        def on_fix(message: Any, arrived_ns: int) -> None:
            number = received.take(message, arrived_ns, pilot)
            if number is not None:
                received.unplaced += pilot.origin is None and not script.excused[number]
                state = circling(received.captured_ns(number) * 1e-9)
                received.place_off_m = max(received.place_off_m, place_off_m(message, state, pilot))
            for what, second in (("restart", script.restart), ("silence", sum(script.silence))):
                if pilot.origin is not None and arrived_ns > begin_ns + second * S:
                    back.setdefault(what, (arrived_ns - begin_ns) * 1e-9 - second)

        def submit(captured_ns: int) -> None:
            nonlocal submitted
            submitted += 1
            bridge.submit(IMAGE, captured_ns)
            end = time.perf_counter() + 2.0
            while bridge.status.answered < submitted and time.perf_counter() < end:
                time.sleep(0)
            pilot.poll()

        def expose(number: int = 0) -> None:
            captured_ns = received.captured_ns(number)
            agenda.at(captured_ns + round(dice.uniform(*CAMERA_MS) * MS), lambda: submit(captured_ns))
            if number + 1 < len(received.count):
                agenda.at(received.captured_ns(number + 1), lambda: expose(number + 1))

        def settle(sent: int) -> None:
            door.settle(sent)
            growth.look(pilot.messages)

        pilot = Standin(agenda, port, circling, PLACE, on_fix, settle, delay_ms=(4.0, 25.0))
        agenda.at(received.captured_ns(0), expose)
        at = lambda second, call: agenda.at(begin_ns + round(second * S), call)  # noqa: E731
        at(script.restart, pilot.restart)
        at(script.silence[0], lambda: pilot.fall_silent(script.silence[1]))
        at(script.move[0], lambda: pilot.fall_silent(script.move[1], move=True))
        flood: Counter[str] = Counter()
        at(script.flood, lambda: flood.update(pour(port, door, pilot, flood_pieces)))
        agenda.run(begin_ns + script.seconds * S)
        status = bridge.status
        pilot.close()
    due = np.array([script.outcome(n) == "fix" for n in range(len(received.count))])
    steps = received.counter[received.count > 0]
    jumps = np.diff(steps) % 256
    return {
        "seconds": script.seconds,
        "wall_s": time.perf_counter() - begin,
        "messages": pilot.messages,
        "frames": submitted,
        "due": int((due & ~script.excused).sum()),
        "missing": int((due & ~script.excused & (received.count == 0)).sum()),
        "sent": status.sent,
        "arrived": int(received.count.sum()),
        "twice": int((received.count > 1).sum()),
        "foreign": received.foreign,
        "unplaced": received.unplaced,
        "unwanted": int((~due & (received.count > 0)).sum()),
        "stamp_off_ms": received.stamp_off_ms,
        "heading_off_deg": Scripted.heading_off_deg,
        "height_off_m": Scripted.height_off_m,
        "place_off_m": received.place_off_m,
        "least_hz": received.least_hz(25, ~script.excused),
        "resets": len(script.relocated) + 1,
        "steps": int(jumps.sum()),
        "longest_step": int(jumps.max(initial=0)),
        "reconnections": status.reconnections,
        "back_s": back,
        "flood": dict(flood),
        "dropped": status.dropped,
        "withheld": status.withheld,
        "refused": status.refused,
        "growth": growth_rows(growth) if len(growth.seen) > 2 else [],
    }


def pour(port: int, door: Door, pilot: Standin, pieces: int) -> dict[str, int]:
    """A flood: noise, halves of packets and a stranger's lies, a tenth of it from the vehicle's own address."""
    dice, lie, before = random.Random(3), _lie(), door.handled
    makers = (lambda: dice.randbytes(300), lambda: lie[: dice.randrange(1, 18)], lambda: b"\xfd" * 900)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.connect(("127.0.0.1", port))
        for number in range(1, pieces + 1):
            source, piece = stranger, lie if dice.random() < 0.25 else dice.choice(makers)()
            if piece is not lie and dice.random() < 0.13:
                source = pilot.socket
            source.send(piece)
            if number % 50 == 0:  # no faster than the system keeps it for the bridge
                door.settle(before + number, patience_s=0.2)
    reached = door.handled - before
    pilot.datagrams += reached
    return {"sent": pieces, "reached the bridge": reached}


def _lie() -> bytes:
    liar = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    packets = (
        mavlink.MAVLink_gps_global_origin_message(1, 1, 1),
        mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3),
        mavlink.MAVLink_attitude_message(1, 1.0, 1.0, 1.0, 0, 0, 0),
    )
    return b"".join(message.pack(liar) for message in packets)


# ------------------------------------------------------------------------------------------------- the page


def hour_rows(r: dict[str, Any]) -> list[list[str]]:
    """What the hour showed."""
    flood = ", ".join(f"{n:,} {what}" for what, n in r["flood"].items())
    outages = ", ".join(f"{seconds:.1f} s after the {what}" for what, seconds in r["back_s"].items())
    return [
        ["time flown, time taken", f"{r['seconds'] / 60:.0f} min, {r['wall_s']:.0f} s"],
        ["messages of the vehicle; frames", f"{r['messages']:,}; {r['frames']:,}"],
        ["fixes due, of them missing", f"{r['due']:,}, {r['missing']}"],
        ["fixes sent, arrived, arrived twice", f"{r['sent']:,}, {r['arrived']:,}, {r['twice']}"],
        ["with a stamp that is of no capture", f"{r['foreign']}"],
        ["of frames that were refused or too uncertain", f"{r['unwanted']}"],
        ["sent to a vehicle that had started again and had no origin", f"{r['unplaced']}"],
        ["stamp on the vehicle's own clock, by TIMESYNC, off by at most", f"{r['stamp_off_ms']:.1f} ms"],
        ["position where ArduPilot puts it, off by at most", f"{r['place_off_m'] * 1000:.1f} mm"],
        ["heading of a frame, turning by 20 degrees/s; height: off by at most",
         f"{r['heading_off_deg']:.2f} degrees; {r['height_off_m']:.2f} m"],
        [f"fewest fixes a second over 5 s (ArduPilot needs {MIN_RATE_HZ:g})", f"{r['least_hz']:.1f}"],
        ["re-localisations; steps of the reset counter, largest",
         f"{r['resets']}; {r['steps']}, {r['longest_step']}"],
        ["reconnections after a silence, one of them to another port", f"{r['reconnections']}"],
        ["first fix", outages],
        ["flood", flood],
        *r["growth"],
    ]  # fmt: skip


def main() -> None:
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--write", action="store_true", help="into docs/results/mavlink.md")
    told = parser.parse_args()
    flown = hour(told.minutes)
    lines = table(["the hour, scripted matcher, 5 Hz", ""], hour_rows(flown))
    print("\n".join(lines), {k: flown[k] for k in ("withheld", "refused", "dropped")})
    if told.write:
        fill(PAGE, {"hour": lines})


if __name__ == "__main__":
    main()
