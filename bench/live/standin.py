"""An autopilot that does not exist, over UDP on loopback, and the clock that it shares with the bridge."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import math
import random
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from unittest import mock

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.geo import LocalFrame
from scenematch.bridges.links import Connection, PeerAddress

S, MS = 1_000_000_000, 1_000_000
TICK_NS = 20 * MS
RATES_HZ = {
    "attitude": 50, "global_position_int": 10, "local_position_ned": 10, "distance_sensor": 10, "altitude": 10,
    "timesync": 10, "heartbeat": 1, "system_time": 1, "vfr_hud": 10, "raw_imu": 10, "sys_status": 2,
}  # fmt: skip
"""What the stand-in sends; the last three are not for the bridge. Each divides 50."""
_UNIX_NS = 1_790_000_000 * S
_ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED  # it flies
_DOWN = mavlink.MAV_SENSOR_ROTATION_PITCH_270


class VirtualClock:
    """A clock that stands still until somebody moves it, so that an hour takes as long as its work."""

    def __init__(self, now_ns: int) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns

    def wait_until(self, due_ns: int) -> None:
        """Move it."""
        self.now_ns = max(self.now_ns, due_ns)

    @contextlib.contextmanager
    def reigns(self) -> Iterator[None]:
        """While entered, everything that asks ``time`` for its monotonic clock or the date is told by this one."""
        dated = lambda: _UNIX_NS + self.now_ns  # noqa: E731
        with mock.patch.object(time, "monotonic_ns", self), mock.patch.object(time, "time_ns", dated):
            yield


class RealClock:
    """The machine's own."""

    def __call__(self) -> int:
        return time.monotonic_ns()

    def wait_until(self, due_ns: int) -> None:
        """Sleep."""
        time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)


class Agenda:
    """What happens when, on one clock."""

    def __init__(self, clock: VirtualClock | RealClock) -> None:
        self.clock = clock
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._number = itertools.count()

    def at(self, due_ns: int, call: Callable[[], None]) -> None:
        """Do it then."""
        heapq.heappush(self._events, (due_ns, next(self._number), call))

    def every(self, period_ns: int, call: Callable[[], None], due_ns: int) -> None:
        """Do it then, and again and again."""

        def again() -> None:
            call()
            self.every(period_ns, call, due_ns + period_ns)

        self.at(due_ns, again)

    def run(self, until_ns: int) -> None:
        """Let the time pass."""
        while self._events and self._events[0][0] <= until_ns:
            due_ns, _, call = heapq.heappop(self._events)
            self.clock.wait_until(due_ns)
            call()


class Door:
    """A connection whose link counts the datagrams that the bridge is done with."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._link = connection, None
        self.taken = self.handled = 0

    def open(self) -> Door:
        """Open the link, which is this object too."""
        self._link = self._connection.open()
        self.is_stream, self.send, self.close = self._link.is_stream, self._link.send, self._link.close
        return self

    def receive(self, timeout_s: float) -> list[tuple[bytes, PeerAddress]]:
        """Whoever asks for more is done with what came before."""
        self.handled = self.taken
        got = self._link.receive(timeout_s)
        self.taken += len(got)
        return got

    def settle(self, sent: int, patience_s: float = 1.0) -> None:
        """Wait until the bridge is done with so many datagrams."""
        end = time.perf_counter() + patience_s
        while self.handled < sent and time.perf_counter() < end:
            time.sleep(0)


@dataclass(frozen=True, slots=True)
class State:
    """Where the vehicle is and how it lies: metres east and north of a place, degrees, metres a second."""

    east_m: float
    north_m: float
    height_m: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float
    east_mps: float
    north_mps: float


def circling(time_s: float) -> State:
    """A circle of 60 m at 8 m/s, turning by 20 degrees a second, rolling, climbing and sinking."""
    turn = time_s * 8.0 / 60.0
    return State(
        60.0 * math.sin(turn), 60.0 * math.cos(turn), 100.0 + 10.0 * math.sin(0.1 * time_s),
        5.0 * math.sin(time_s), 4.0 * math.cos(0.7 * time_s), (20.0 * time_s) % 360.0,
        8.0 * math.cos(turn), -8.0 * math.sin(turn),
    )  # fmt: skip


class Standin:
    """An ArduPilot that streams its telemetry and listens, as far as the bridge can tell.

    Args:
        agenda: its time.
        port: of the bridge, on loopback.
        motion: where it is, by seconds on the agenda's clock.
        place: about which ``motion`` is.
        on_fix: takes each position that it is sent, and when it came.
        settle: called with the count of datagrams sent, after each burst.
        delay_ms: of the link, least and most, either way.
        firmware: of its heartbeats.
    """

    def __init__(
        self,
        agenda: Agenda,
        port: int,
        motion: Callable[[float], State],
        place: LocalFrame,
        on_fix: Callable[[Any, int], None],
        settle: Callable[[int], object] = lambda _: None,
        delay_ms: tuple[float, float] = (0.0, 0.0),
        *,
        firmware: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    ) -> None:
        self.agenda, self.motion, self.place, self._firmware = agenda, motion, place, firmware
        self.messages = self.datagrams = 0
        self._port, self._on_fix, self._settle, self._delay_ms = port, on_fix, settle, delay_ms
        self._random, self._silent_until_ns = random.Random(1), 0
        self.socket = self._dial()
        lat_1e7, lon_1e7 = round(place.lat_deg * 1e7), round(place.lon_deg * 1e7)
        self.origin: tuple[int, int, int] | None = (lat_1e7, lon_1e7, 500_000)
        self._boot(agenda.clock() - 120 * S)
        agenda.every(TICK_NS, self._burst, agenda.clock())

    @property
    def now_ns(self) -> int:
        """The time on the agenda's clock."""
        return self.agenda.clock()

    @property
    def boot_ns(self) -> int:
        """The time since it began."""
        return self.now_ns - self.began_ns

    def own_ns(self, stamp_ns: int) -> int | None:
        """A stamp of the bridge on the own clock, by TIMESYNC; None before the first answer."""
        return stamp_ns - min(self._synced)[1] if self._synced else None

    def restart(self) -> None:
        """A reboot: the clock at nought, no origin."""
        self.origin = None
        self._boot(self.now_ns)

    def fall_silent(self, seconds: float, *, move: bool = False) -> None:
        """Neither send nor hear for so long; ``move`` goes on from another port then."""
        self._silent_until_ns = self.now_ns + round(seconds * S)
        if move:
            self.socket.close()
            self.socket = self._dial()

    def close(self) -> None:
        """Give the port back."""
        self.socket.close()

    def poll(self) -> None:
        """Take what has come; it counts when the link has let it through."""
        while True:
            try:
                data = self.socket.recv(4096)
            except OSError:
                return
            if self.now_ns >= self._silent_until_ns:
                self.agenda.at(self.now_ns + self._delay_ns(), lambda data=data: self._take(data))

    def _dial(self) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.connect(("127.0.0.1", self._port))
        made.setblocking(False)
        return made

    def _boot(self, began_ns: int) -> None:
        self.began_ns, self._tick = began_ns, 0
        self._mavlink: Any = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._parser: Any = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._synced: deque[tuple[int, int]] = deque(maxlen=50)  # round trip, the bridge's clock less the own

    def _delay_ns(self) -> int:
        return round(self._random.uniform(*self._delay_ms) * MS)

    def _burst(self) -> None:
        """Everything that is due at this tick, in one go."""
        if self.now_ns < self._silent_until_ns:
            self.poll()
            return
        state, ms = self.motion(self.now_ns * 1e-9), self.boot_ns // MS
        due = [name for name, rate_hz in RATES_HZ.items() if self._tick % (50 // rate_hz) == 0]
        self._tick += 1
        self._later(*(self._message(name, state, ms) for name in due))

    def _later(self, *messages: Any) -> None:
        packets = [message.pack(self._mavlink) for message in messages]
        self.agenda.at(self.now_ns + self._delay_ns(), lambda: self._put(packets))

    def _put(self, packets: list[bytes]) -> None:
        if self.now_ns < self._silent_until_ns:
            return
        for packet in packets:
            with contextlib.suppress(OSError):  # nobody listens
                self.socket.send(packet)
                self.datagrams += 1
        self.messages += len(packets)
        self._settle(self.datagrams)
        self.poll()

    def _message(self, name: str, state: State, ms: int) -> Any:
        north, east, height = state.north_mps, state.east_mps, state.height_m
        roll, pitch, yaw = (math.radians(v) for v in (state.roll_deg, state.pitch_deg, state.heading_deg))
        slant_m = height / math.cos(roll) / math.cos(pitch)
        fields: dict[str, Callable[[], tuple[Any, ...]]] = {
            "attitude": lambda: (ms, roll, pitch, math.remainder(yaw, math.tau), 0, 0, 0),
            "global_position_int": lambda: (
                ms, *self._degrees_1e7(state), 600_000, round(height * 1e3),
                round(north * 100), round(east * 100), 0, 0,
            ),
            "local_position_ned": lambda: (ms, state.north_m, state.east_m, -height, north, east, 0),
            "distance_sensor": lambda: (ms, 20, 30_000, round(slant_m * 100), 0, 0, _DOWN, 0),
            "altitude": lambda: (ms * 1000, 600, 600, height, height, -1001.0, height),
            "timesync": lambda: (0, self.boot_ns),
            "heartbeat": lambda: (mavlink.MAV_TYPE_QUADROTOR, self._firmware, _ARMED, 0, 4, 3),
            "system_time": lambda: ((_UNIX_NS + self.now_ns) // 1000, ms),
            "vfr_hud": lambda: (10.0, 10.0, 90, 50, 600.0, 0.0),
            "raw_imu": lambda: (ms * 1000, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
            "sys_status": lambda: (0, 0, 0, 500, 12_000, 100, 90, 0, 0, 0, 0, 0, 0),
        }  # fmt: skip
        return getattr(mavlink, f"MAVLink_{name}_message")(*fields[name]())

    def _degrees_1e7(self, state: State) -> tuple[int, int]:
        lat_deg, lon_deg = self.place.geodetic_from_enu(state.east_m, state.north_m)
        return round(float(lat_deg) * 1e7), round(float(lon_deg) * 1e7)

    def _take(self, data: bytes) -> None:
        if self.now_ns < self._silent_until_ns:
            return
        for message in self._parser.parse_buffer(data) or []:
            kind = message.get_type()
            if kind == "ODOMETRY" and message.quality < 0:
                continue  # the camera works, and there is no position
            if kind in ("VISION_POSITION_ESTIMATE", "ODOMETRY", "GPS_INPUT", "GLOBAL_POSITION_SENSOR"):
                self._on_fix(message, self.now_ns)
            elif kind == "TIMESYNC" and message.tc1 == 0:
                self._later(mavlink.MAVLink_timesync_message(self.boot_ns, message.ts1))
            elif kind == "TIMESYNC":
                self._sync(message)
            elif kind == "SET_GPS_GLOBAL_ORIGIN" and self.origin is None:
                self.origin = (message.latitude, message.longitude, message.altitude)
            asked = kind == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_REQUEST_MESSAGE
            if self.origin is not None and (asked or kind == "SET_GPS_GLOBAL_ORIGIN"):
                self._later(mavlink.MAVLink_gps_global_origin_message(*self.origin))

    def _sync(self, message: Any) -> None:
        """An answer to the own question; one to a question before the reboot is older than the clock."""
        if 0 <= message.ts1 <= self.boot_ns:
            self._synced.append((self.boot_ns - message.ts1, message.tc1 - (message.ts1 + self.boot_ns) // 2))
