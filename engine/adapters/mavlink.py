"""The MAVLink bridge: pictures and an autopilot's telemetry into the engine, its fixes to the autopilot.

One thread reads the link and keeps it alive; pictures come in the caller's, and answers from the engine's.
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

from engine.adapters.links import Connection, Link, Sender
from engine.adapters.mavlink_in import FIRMWARES, STREAMS_HZ, WANTED, Telemetry
from engine.adapters.mavlink_out import (
    FixVelocity,
    Outgoing,
    Sending,
    command_message,
    heartbeat_message,
    make_message,
    set_origin_message,
    timesync_message,
    why_withheld,
)
from engine.adapters.packets import Decoder, Encoder
from engine.adapters.vehicle import Origin
from engine.live import Answer, Live, LiveOptions
from engine.navigator import Navigator
from engine.values import Fix, NoFix, Prior

_log = logging.getLogger("scenematch")

MIN_RATE_HZ = 4.0
"""Slower than this ArduPilot's estimator does not hold on to external navigation."""

_POLL_S = 0.02
_SILENCE_NS = 5_000_000_000  # without a heartbeat, after which the vehicle counts as gone
_REOPEN_S = 1.0
_ORIGIN_PATIENCE_NS = 3_000_000_000  # before an origin is set where the autopilot states none
_RATE_SPAN_S = 2.0


@dataclass(frozen=True, slots=True)
class Status:
    """What a bridge did so far.

    Attributes:
        connected: whether the autopilot is heard.
        answered: frames.
        sent: fixes to the autopilot.
        withheld: fixes that were not, by why.
        refused: frames without a fix, by reason.
        rate_hz: of the fixes sent in the last seconds.
        least_age_ms: from capture to sending, the quickest; what VISO_DELAY_MS is set to.
        dropped: packets that were malformed or not rightly signed.
        reconnections: how often the vehicle was heard again after silence or a broken link.
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


class Bridge:
    """Between one autopilot and one navigator.

    Args:
        connection: where the autopilot is.
        make_navigator: as of :class:`engine.live.Live`.
        options: what is sent.
        start: where the flight begins.
        live: deadlines of the frames.
        origin: given to an autopilot that has none; None leaves it without, and positions about it unsent.
        use_velocity: whether the autopilot's velocity carries the engine from fix to fix; without, its fixes do.
        system_id: of the vehicle; whoever has another is not heard.
        key: of MAVLink's signing; None sends and takes unsigned packets.
        watch: is told every answer, and must not take long; None tells nobody.

    Raises:
        OSError: the link cannot be opened. Later it is opened again whenever it fails.
    """

    def __init__(
        self,
        connection: Connection,
        make_navigator: Callable[[Prior | None], Navigator],
        options: Outgoing,
        start: Prior | None = None,
        live: LiveOptions | None = None,
        *,
        origin: Origin | None = None,
        use_velocity: bool = True,
        system_id: int = 1,
        key: bytes | None = None,
        watch: Callable[[Answer], None] | None = None,
    ) -> None:
        self.telemetry = Telemetry()
        self._watch = watch
        self._connection, self._options, self._origin = connection, options, origin
        self._make_navigator, self._use_velocity = make_navigator, use_velocity
        self._system_id, self._key = system_id, key
        self._encoder = Encoder(system_id, key)
        self._sending = threading.Lock()
        self._navigator: Navigator | None = None
        self._resets_before = 0  # of navigators that were replaced
        self._velocity = FixVelocity()
        self._sent_ns: deque[int] = deque(maxlen=256)
        self._counts: Counter[str] = Counter()
        self._withheld: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._least_age_ms: float | None = None
        self._peer: Sender = None
        self._met_ns = 0  # when the vehicle was heard first, or again
        self._originless_ns = 0  # since when the autopilot states no origin
        self._done_ns = {"beat": 0, "sync": 0, "ask": 0, "complaint": 0}
        self._closed = threading.Event()
        self._link: Link | None = connection.open()
        self._decoder = self._new_decoder(self._link)
        self._live = Live(self._new_navigator, self.deliver, start, live)
        self._reader = threading.Thread(target=self._read, name="scenematch-mavlink", daemon=True)
        self._reader.start()

    def __enter__(self) -> Bridge:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Answer the frame in work, and give the link back."""
        self._live.close()
        self._closed.set()
        self._reader.join(timeout=2.0)
        self._drop_link()

    @property
    def connected(self) -> bool:
        """Whether the autopilot, of the firmware that was told, was heard lately."""
        heard_ns = self.telemetry.heard_ns
        return heard_ns is not None and time.monotonic_ns() - heard_ns < _SILENCE_NS

    @property
    def status(self) -> Status:
        """What was done so far."""
        return Status(
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
        """Hand in the newest picture.

        Args:
            image: (H, W, 3) or (H, W), uint8.
            captured_ns: when it was exposed, on ``time.monotonic_ns``.
        """
        vehicle = self.telemetry.vehicle(captured_ns)
        if not self._use_velocity:
            vehicle = replace(vehicle, east_velocity_mps=None, north_velocity_mps=None)
        frame = vehicle.frame(image, captured_ns)
        self._live.submit(frame, captured_ns=captured_ns)

    def deliver(self, answer: Answer) -> None:
        """Send what became of a frame, where it is fit to be sent."""
        self._tell(answer)
        if self._watch is not None:
            self._watch(answer)

    def _tell(self, answer: Answer) -> None:
        """Count it, and send what is fit."""
        self._counts["answered"] += 1
        if isinstance(answer.result, NoFix):
            self._refused[answer.result.reason.value] += 1
            return
        assert answer.frame.timestamp_ns is not None  # submit has stamped it
        sending = self._compose(answer.result, answer.frame.timestamp_ns)
        why = why_withheld(sending, self._options) if self.connected else "no autopilot"
        if why is None and self.telemetry.firmware != FIRMWARES[self._options.firmware]:
            why = "other firmware"
        if why is not None:
            self._withheld[why] += 1
            return
        if not self._send(make_message(sending, self._options)):
            self._withheld["link down"] += 1
            return
        self._counts["sent"] += 1
        self._sent_ns.append(time.monotonic_ns())
        self._least_age_ms = min(sending.age_ms, self._least_age_ms or sending.age_ms)

    # ---------------------------------------------------------------------------------------------- fixes

    def _new_navigator(self, start: Prior | None) -> Navigator:
        """A navigator; one that replaces another takes the position up anew, which counts as a reset."""
        made = self._make_navigator(start)
        if self._navigator is not None:
            self._resets_before += _resets(self._navigator) + 1
        self._navigator = made
        return made

    def _compose(self, fix: Fix, captured_ns: int) -> Sending:
        resets = self._resets_before + (0 if self._navigator is None else _resets(self._navigator))
        unix_offset_ns = self.telemetry.unix_offset_ns()
        if unix_offset_ns is None:
            unix_offset_ns = time.time_ns() - time.monotonic_ns()
        return Sending(
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
        """The reader: takes what comes, answers what must be answered, and opens the link again."""
        while not self._closed.is_set():
            try:
                if self._link is None:
                    self._link = self._connection.open()
                    self._decoder = self._new_decoder(self._link)
                for data, sender in self._link.receive(_POLL_S):
                    self._take(data, sender)
                self._keep_alive()
            except OSError as error:
                _log.warning("MAVLink: %s; opened again after %g s", error, _REOPEN_S)
                self._drop_link()
                self._closed.wait(_REOPEN_S)
            except Exception:  # of one packet: the next may be sound, and without a reader nothing comes any more
                if self._is_due("complaint", time.monotonic_ns(), _REOPEN_S):
                    _log.exception("MAVLink: a packet could not be read or sent")
                self._closed.wait(_POLL_S)

    def _take(self, data: bytes, sender: Sender) -> None:
        """What one sender sent; while a vehicle is heard, only what comes from its address."""
        if self._peer is not None and sender != self._peer and self.connected:
            return
        now_ns = time.monotonic_ns()
        for message in self._decoder.feed(data):
            if message.get_type() == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                self._peer = sender
                if not self.connected:
                    self._meet(now_ns)
            if sender != self._peer:
                continue  # only a heartbeat makes somebody the vehicle
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self._send(timesync_message(time.monotonic_ns(), message.ts1))
            self.telemetry.update(message, now_ns)

    def _meet(self, now_ns: int) -> None:
        """The vehicle is heard for the first time, or again."""
        self._counts["reconnections"] += self._met_ns != 0
        self._met_ns = self._originless_ns = now_ns
        self._done_ns["ask"] = self._done_ns["sync"] = 0
        self.telemetry.forget()

    def _keep_alive(self) -> None:
        """What is sent by the clock: heartbeats always, questions while the vehicle is heard."""
        now_ns = time.monotonic_ns()
        if self._is_due("beat", now_ns, 1.0):
            self._send(heartbeat_message())
        if not self.connected:
            return
        if self._is_due("sync", now_ns, 0.5):
            self.telemetry.sync_asked(now_ns)
            self._send(timesync_message(now_ns))
        if self.telemetry.origin is not None:
            self._originless_ns = now_ns
        if self._is_due("ask", now_ns, 10.0 if self.telemetry.origin else 1.0):
            self._ask(now_ns)

    def _ask(self, now_ns: int) -> None:
        """Ask for the messages that are needed, and for the origin; set one where there is none."""
        for number, rate_hz in STREAMS_HZ.items():
            self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz)
        self._command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        if self._origin is not None and now_ns - self._originless_ns > _ORIGIN_PATIENCE_NS:
            self._send(set_origin_message(self._system_id, self._origin, now_ns))

    def _command(self, command: int, *values: float) -> None:
        self._send(command_message(self._system_id, command, *values))

    def _is_due(self, what: str, now_ns: int, every_s: float) -> bool:
        due = now_ns - self._done_ns[what] >= round(every_s * 1e9)
        if due:
            self._done_ns[what] = now_ns
        return due

    def _send(self, message: Any) -> bool:
        """Send one message; returns whether there was a link."""
        with self._sending:
            link = self._link
            if link is None:
                return False
            try:
                link.send(self._encoder.encode(message), self._peer)
            except (OSError, ValueError):  # the reader opens it again; a closed socket has no number
                return False
            return True

    def _new_decoder(self, link: Link) -> Decoder:
        return Decoder(self._system_id, WANTED, is_stream=link.is_stream, key=self._key)

    def _drop_link(self) -> None:
        with self._sending:
            if self._link is not None:
                self._link.close()
                self._counts["dropped"] += self._decoder.dropped
                self._decoder.dropped = 0
            self._link, self._peer, self.telemetry.heard_ns = None, None, None


def _resets(navigator: Navigator) -> int:
    return int(getattr(navigator, "reset_count", 0))
