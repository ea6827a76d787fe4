"""What is counted of a bridge beside a stand-in autopilot: the fixes that arrived, and how the process grew."""

from __future__ import annotations

import math
import socket
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.live.growth import Growth
from bench.live.standin import MS, Standin, State

RATE_NS = 200 * MS
"""Between two frames: 5 Hz."""


def free_port() -> int:
    """A UDP port of loopback that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def growth_rows(growth: Growth) -> list[list[str]]:
    """After the first tenth, in which tables and caches fill."""
    settled = growth.seen[len(growth.seen) // 10 :]
    (first, last), (files, threads) = settled[[0, -1], 1] / 1.048576, settled[:, 2:].T
    slope_kib = growth.slope_mb() * growth.every * 1e6 / 1024
    return [
        ["memory (RSS), after a tenth, and at the end", f"{first:.1f}, {last:.1f} MiB"],
        [f"its slope, KiB per {growth.every:,} messages", f"{slope_kib:+.2f}"],
        ["open files, threads: least to most", f"{_span(files)}, {_span(threads)}"],
    ]


def _span(values: np.ndarray) -> str:
    return f"{values.min():.0f} to {values.max():.0f}"


@dataclass
class Received:
    """The fixes that reached the stand-in, by the number of their frame."""

    begin_ns: int
    count: np.ndarray
    arrived_ns: np.ndarray
    counter: np.ndarray
    foreign: int = 0
    unplaced: int = 0
    stamp_off_ms: float = 0.0
    place_off_m: float = 0.0

    @classmethod
    def room(cls, begin_ns: int, frames: int) -> Received:
        # Written now, so that memory does not grow in flight.
        return cls(begin_ns, np.ones(frames, int) * 0, np.ones(frames, np.int64) * 0, np.ones(frames, int) * 0)

    def captured_ns(self, number: int) -> int:
        """Of a frame; not on a round microsecond."""
        return self.begin_ns + number * RATE_NS + number % 997 * 1001

    def take(self, message: Any, arrived_ns: int, pilot: Standin) -> int | None:
        """Note a position; its frame's number, or None where its stamp is of no capture."""
        number = round((message.usec * 1000 - self.begin_ns) / (RATE_NS + 0.0))
        if not 0 <= number < len(self.count) or self.captured_ns(number) // 1000 != message.usec:
            self.foreign += 1
            return None
        self.count[number] += 1
        self.arrived_ns[number], self.counter[number] = arrived_ns, message.reset_counter
        own_ns = pilot.own_ns(message.usec * 1000)
        if own_ns is not None:
            off_ns = own_ns - (self.captured_ns(number) - pilot.began_ns)
            self.stamp_off_ms = max(self.stamp_off_ms, abs(off_ns) * 1e-6)
        return number

    def least_hz(self, span: int, due: np.ndarray) -> float:
        """The fewest fixes over so many frames in a row of which none is excused."""
        kept = np.convolve(due, np.ones(span), "valid") == span
        rates = np.convolve(self.count > 0, np.ones(span), "valid") / (span * RATE_NS * 1e-9)
        return float(rates[kept].min()) if kept.any() else math.nan


def place_off_m(message: Any, state: State, pilot: Standin) -> float:
    """How far from the truth ArduPilot would put a position, by its own scale of degrees."""
    if pilot.origin is None:
        return 0.0  # an estimator without an origin puts it nowhere
    scale, (lat0, lon0, _) = 0.011131884502145034, pilot.origin
    lat, lon = (float(v) * 1e7 for v in pilot.place.geodetic_from_enu(state.east_m, state.north_m))
    middle = math.radians((lat + lat0) / 2e7)
    return math.hypot(message.x - (lat - lat0) * scale, message.y - (lon - lon0) * scale * math.cos(middle))
