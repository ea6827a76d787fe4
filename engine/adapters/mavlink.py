"""The MAVLink bridge: images and the autopilot's telemetry go into the engine, its fixes to the autopilot.

One thread reads the link and keeps it alive; images arrive in the caller's thread, answers in the engine's.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.adapters.links import Connection, Link, PeerAddress, parse_connection
from engine.adapters.mavlink_in import HANDLED_MESSAGES, MAV_AUTOPILOTS, REQUESTED_RATES_HZ, MavlinkTelemetry
from engine.adapters.mavlink_out import (
    FixReport,
    MavlinkOptions,
    VelocityFromFixes,
    command_message,
    fix_message,
    heartbeat_message,
    set_origin_message,
    timesync_message,
    withhold_reason,
)
from engine.adapters.packets import PacketDecoder, PacketEncoder
from engine.adapters.vehicle import NedOrigin
from engine.live import Answer, Live, LiveOptions
from engine.navigator import Navigator
from engine.values import Fix, NoFix, Prior

__all__ = [
    "Connection",
    "MavlinkBridge",
    "MavlinkOptions",
    "MavlinkStatus",
    "NedOrigin",
    "parse_connection",
]

_log = logging.getLogger("scenematch")

MIN_RATE_HZ = 4.0
"""Minimum rate of fixes at which ArduPilot's estimator keeps using external navigation."""

_POLL_S = 0.02
_SILENCE_NS = 5_000_000_000  # without a heartbeat, after which the vehicle counts as disconnected
_REOPEN_S = 1.0
_ORIGIN_TIMEOUT_NS = 3_000_000_000  # after which an origin is set on an autopilot that reports none
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


class MavlinkBridge:
    """Connects one autopilot to one navigator.

    Args:
        connection: endpoint of the autopilot.
        make_navigator: as in :class:`engine.live.Live`.
        options: which message is sent, and which fixes are withheld.
        start: prior position at the start of the flight.
        live: deadlines of the frames.
        origin: NED origin to set on an autopilot that reports none; None sets none, so that local positions stay
            unsent.
        use_velocity: whether the autopilot's velocity is used for dead reckoning between fixes.
        system_id: MAVLink system id of the vehicle; messages of other systems are ignored.
        key: 32-byte key of MAVLink signing; None sends and accepts unsigned packets.
        watch: called with every answer; must return quickly.

    Raises:
        OSError: the link cannot be opened. After that, a link that fails is reopened.
    """

    def __init__(
        self,
        connection: Connection,
        make_navigator: Callable[[Prior | None], Navigator],
        options: MavlinkOptions,
        start: Prior | None = None,
        live: LiveOptions | None = None,
        *,
        origin: NedOrigin | None = None,
        use_velocity: bool = True,
        system_id: int = 1,
        key: bytes | None = None,
        watch: Callable[[Answer], None] | None = None,
    ) -> None:
        self.telemetry = MavlinkTelemetry()
        self._watch = watch
        self._connection, self._options, self._origin = connection, options, origin
        self._make_navigator, self._use_velocity = make_navigator, use_velocity
        self._system_id, self._key = system_id, key
        self._encoder = PacketEncoder(system_id, key)
        self._sending = threading.Lock()
        self._navigator: Navigator | None = None
        self._resets_before = 0  # by navigators that have been replaced
        self._velocity = VelocityFromFixes()
        self._sent_ns: deque[int] = deque(maxlen=256)
        self._counts: Counter[str] = Counter()
        self._withheld: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._least_age_ms: float | None = None
        self._peer: PeerAddress = None
        self._connected_ns = 0  # when the vehicle was heard first, or again
        self._without_origin_ns = 0  # since when the autopilot has reported no origin
        self._last_done_ns = {"heartbeat": 0, "timesync": 0, "request": 0, "log": 0}
        self._closed = threading.Event()
        self._link: Link | None = connection.open()
        self._decoder = self._new_decoder(self._link)
        self._live = Live(self._new_navigator, self.deliver, start, live)
        self._reader = threading.Thread(target=self._read, name="scenematch-mavlink", daemon=True)
        self._reader.start()

    def __enter__(self) -> MavlinkBridge:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Answer the frame in progress and close the link."""
        self._live.close()
        self._closed.set()
        self._reader.join(timeout=2.0)
        self._drop_link()

    @property
    def connected(self) -> bool:
        """Whether a heartbeat of the autopilot arrived in the last 5 seconds."""
        heard_ns = self.telemetry.heard_ns
        return heard_ns is not None and time.monotonic_ns() - heard_ns < _SILENCE_NS

    @property
    def status(self) -> MavlinkStatus:
        """Counters since the bridge was opened."""
        return MavlinkStatus(
            self.connected,
            self._counts["answered"],
            self._counts["sent"],
            dict(self._withheld),
            dict(self._refused),
            self._rate_hz(),
            self._least_age_ms,
            self._counts["dropped"] + self._decoder.dropped,
            self._counts["reconnections"],
        )

    def submit(self, image: NDArray[np.uint8], captured_ns: int) -> None:
        """Submit the newest image; one that still waits is dropped.

        Args:
            image: (H, W, 3) RGB or (H, W) grey, uint8.
            captured_ns: time of exposure on ``time.monotonic_ns``.

        Raises:
            StateError: the bridge has been closed.
        """
        vehicle = self.telemetry.vehicle(captured_ns)
        if not self._use_velocity:
            vehicle = replace(vehicle, east_velocity_mps=None, north_velocity_mps=None)
        frame = vehicle.frame(image, captured_ns)
        self._live.submit(frame, captured_ns=captured_ns)

    def deliver(self, answer: Answer) -> None:
        """Send an answer's fix unless it must be withheld, and pass the answer on to ``watch``."""
        self._count_and_send(answer)
        if self._watch is not None:
            self._watch(answer)

    def _count_and_send(self, answer: Answer) -> None:
        self._counts["answered"] += 1
        if isinstance(answer.result, NoFix):
            self._refused[answer.result.reason.value] += 1
            return
        assert answer.frame.timestamp_ns is not None  # set by submit
        report = self._compose(answer.result, answer.frame.timestamp_ns)
        cause = withhold_reason(report, self._options) if self.connected else "no autopilot"
        if cause is None and self.telemetry.firmware != MAV_AUTOPILOTS[self._options.firmware]:
            cause = "other firmware"
        if cause is not None:
            self._withheld[cause] += 1
            return
        if not self._send(fix_message(report, self._options)):
            self._withheld["link down"] += 1
            return
        self._counts["sent"] += 1
        self._sent_ns.append(time.monotonic_ns())
        self._least_age_ms = min(report.age_ms, self._least_age_ms or report.age_ms)

    # ---------------------------------------------------------------------------------------------- fixes

    def _new_navigator(self, start: Prior | None) -> Navigator:
        """Create a navigator; replacing one counts as a reset, since the new one acquires the position afresh."""
        navigator = self._make_navigator(start)
        if self._navigator is not None:
            self._resets_before += _resets(self._navigator) + 1
        self._navigator = navigator
        return navigator

    def _compose(self, fix: Fix, captured_ns: int) -> FixReport:
        resets = self._resets_before + (0 if self._navigator is None else _resets(self._navigator))
        unix_offset_ns = self.telemetry.unix_offset_ns()
        if unix_offset_ns is None:
            unix_offset_ns = time.time_ns() - time.monotonic_ns()
        return FixReport(
            fix,
            captured_ns,
            (time.monotonic_ns() - captured_ns) * 1e-6,
            self.telemetry.vehicle(captured_ns),
            self.telemetry.origin,
            self._velocity.add(fix, captured_ns, resets),
            resets % 256,
            captured_ns + unix_offset_ns,
        )

    def _rate_hz(self) -> float:
        since_ns = time.monotonic_ns() - round(_RATE_SPAN_S * 1e9)
        return sum(sent >= since_ns for sent in list(self._sent_ns)) / _RATE_SPAN_S

    # ----------------------------------------------------------------------------------------------- link

    def _read(self) -> None:
        """Loop of the reader thread: handle received packets, answer requests, and reopen a failed link."""
        while not self._closed.is_set():
            try:
                if self._link is None:
                    self._link = self._connection.open()
                    self._decoder = self._new_decoder(self._link)
                for data, sender in self._link.receive(_POLL_S):
                    self._receive(data, sender)
                self._keep_alive()
            except OSError as error:
                _log.warning("MAVLink: %s; reopening the link in %g s", error, _REOPEN_S)
                self._drop_link()
                self._closed.wait(_REOPEN_S)
            except Exception:  # caused by one packet: the next may be valid, and the link needs its reader
                if self._is_due("log", time.monotonic_ns(), _REOPEN_S):
                    _log.exception("MAVLink: a packet could not be read or sent")
                self._closed.wait(_POLL_S)

    def _receive(self, data: bytes, sender: PeerAddress) -> None:
        """Handle bytes of one sender; while a vehicle is connected, only bytes from its address."""
        if self._peer is not None and sender != self._peer and self.connected:
            return
        now_ns = time.monotonic_ns()
        for message in self._decoder.feed(data):
            if message.get_type() == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                self._peer = sender
                if not self.connected:
                    self._on_connected(now_ns)
            if sender != self._peer:
                continue  # only a heartbeat identifies the vehicle
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self._send(timesync_message(time.monotonic_ns(), message.ts1))
            self.telemetry.update(message, now_ns)

    def _on_connected(self, now_ns: int) -> None:
        """Start over with a vehicle that is heard for the first time, or again."""
        self._counts["reconnections"] += self._connected_ns != 0
        self._connected_ns = self._without_origin_ns = now_ns
        self._last_done_ns["request"] = self._last_done_ns["timesync"] = 0
        self.telemetry.reset()

    def _keep_alive(self) -> None:
        """Send what is periodic: heartbeats always, requests while the vehicle is connected."""
        now_ns = time.monotonic_ns()
        if self._is_due("heartbeat", now_ns, 1.0):
            self._send(heartbeat_message())
        if not self.connected:
            return
        if self._is_due("timesync", now_ns, 0.5):
            self.telemetry.add_timesync_request(now_ns)
            self._send(timesync_message(now_ns))
        if self.telemetry.origin is not None:
            self._without_origin_ns = now_ns
        if self._is_due("request", now_ns, 10.0 if self.telemetry.origin else 1.0):
            self._request_streams(now_ns)

    def _request_streams(self, now_ns: int) -> None:
        """Request the telemetry messages and the origin; set an origin where the autopilot has none."""
        for number, rate_hz in REQUESTED_RATES_HZ.items():
            self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz)
        self._command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        if self._origin is not None and now_ns - self._without_origin_ns > _ORIGIN_TIMEOUT_NS:
            self._send(set_origin_message(self._system_id, self._origin, now_ns))

    def _command(self, command: int, *values: float) -> None:
        self._send(command_message(self._system_id, command, *values))

    def _is_due(self, task: str, now_ns: int, period_s: float) -> bool:
        due = now_ns - self._last_done_ns[task] >= round(period_s * 1e9)
        if due:
            self._last_done_ns[task] = now_ns
        return due

    def _send(self, message: Any) -> bool:
        """Send one message; returns whether the link took it."""
        with self._sending:
            link = self._link
            if link is None:
                return False
            try:
                link.send(self._encoder.encode(message), self._peer)
            except (OSError, ValueError):  # the reader reopens the link; a closed socket has no file number
                return False
            return True

    def _new_decoder(self, link: Link) -> PacketDecoder:
        return PacketDecoder(self._system_id, HANDLED_MESSAGES, is_stream=link.is_stream, key=self._key)

    def _drop_link(self) -> None:
        with self._sending:
            if self._link is not None:
                self._link.close()
                self._counts["dropped"] += self._decoder.dropped
                self._decoder.dropped = 0
            self._link, self._peer, self.telemetry.heard_ns = None, None, None


def _resets(navigator: Navigator) -> int:
    return int(getattr(navigator, "reset_count", 0))
