"""Status of a MAVLink bridge: its counters, and the line that reports them."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field

MIN_RATE_HZ = 4.0
"""Minimum rate of fixes at which ArduPilot's estimator keeps using external navigation."""

_RATE_SPAN_S = 2.0


@dataclass(frozen=True, slots=True)
class MavlinkStatus:
    """Counters of a bridge since it was opened.

    Attributes:
        connected: whether the autopilot is heard.
        answered: number of frames answered.
        sent: number of fixes sent to the autopilot.
        withheld: number of fixes not sent, by cause.
        refused: number of frames without a fix, by reason.
        rate_hz: rate of the fixes sent in the last 2 seconds.
        least_age_ms: shortest time from capture to sending; the value for VISO_DELAY_MS.
        dropped: number of packets that were malformed or wrongly signed.
        reconnections: number of times the vehicle was heard again after silence or a broken link.
    """

    connected: bool = False
    answered: int = 0
    sent: int = 0
    withheld: dict[str, int] = field(default_factory=dict)
    refused: dict[str, int] = field(default_factory=dict)
    rate_hz: float = 0.0
    least_age_ms: float | None = None
    dropped: int = 0
    reconnections: int = 0

    def line(self) -> str:
        """The same in one line."""
        reasons = ", ".join(f"{why} {n}" for why, n in {**self.withheld, **self.refused}.items()) or "nothing"
        heard = "autopilot heard" if self.connected else "no autopilot"
        warning = f" (below {MIN_RATE_HZ:g} Hz an estimator may stop using them)"
        slow = warning if self.rate_hz < MIN_RATE_HZ else ""
        age = "" if self.least_age_ms is None else f", least age {self.least_age_ms:.0f} ms"
        return f"{heard}; sent {self.sent}, {self.rate_hz:.1f} Hz{slow}{age}; not sent: {reasons}"


class MavlinkCounters:
    """The running counters; those that are not fixes are counted by their users.

    Attributes:
        withheld: fixes that were not sent, by cause.
        refused: frames that gave no fix, by reason.
        dropped: packets that earlier links dropped.
        reconnections: times that the vehicle was heard again.
    """

    def __init__(self) -> None:
        self._sent_ns: deque[int] = deque(maxlen=256)
        self.withheld: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self._least_age_ms: float | None = None
        self._sent = self.dropped = self.reconnections = 0

    def add_sent(self, age_ms: float) -> None:
        """A fix was sent."""
        self._sent += 1
        self._sent_ns.append(time.monotonic_ns())
        self._least_age_ms = min(age_ms, self._least_age_ms or age_ms)

    def status(self, *, connected: bool, dropped: int) -> MavlinkStatus:
        """The counters so far, including packets that the present link dropped."""
        since_ns = time.monotonic_ns() - round(_RATE_SPAN_S * 1e9)
        rate_hz = sum(sent >= since_ns for sent in list(self._sent_ns)) / _RATE_SPAN_S
        sent, withheld, refused = self._sent, dict(self.withheld), dict(self.refused)
        answered = sent + sum(withheld.values()) + sum(refused.values())
        return MavlinkStatus(
            connected, answered, sent, withheld, refused, rate_hz,
            self._least_age_ms, self.dropped + dropped, self.reconnections,
        )  # fmt: skip
