"""The MAVLink bridge: feed images and the autopilot's telemetry to the engine, and its fixes to the autopilot.

One thread reads the link and keeps it alive; images arrive in the caller's thread, answers in the engine's.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.navigation.live import Answer, Live, LiveOptions
from engine.navigation.motion import place_of, position_of
from engine.navigation.navigator import Navigator
from engine.orthomap import OrthoMap
from engine.runtime.realtime import start_thread
from engine.values import Fix, NoFix, Prior
from scenematch.bridges import mavlink_out
from scenematch.bridges.fix_velocity import VelocityFromFixes
from scenematch.bridges.links import Connection, Link, PeerAddress, parse_connection
from scenematch.bridges.mavlink_in import HANDLED_MESSAGES, MAV_AUTOPILOTS, MavlinkTelemetry
from scenematch.bridges.mavlink_requests import AutopilotRequests
from scenematch.bridges.mavlink_status import MavlinkCounters, MavlinkStatus
from scenematch.bridges.notices import INFO, Notice, PilotNotices
from scenematch.bridges.packets import AUTOPILOT_COMPONENT, PacketDecoder, PacketEncoder
from scenematch.bridges.parameters import MavlinkOptions
from scenematch.bridges.track_guard import TrackGuard
from scenematch.bridges.vehicle import NedOrigin

__all__ = ["Connection", "MavlinkBridge", "MavlinkOptions", "MavlinkStatus", "NedOrigin", "parse_connection"]

_log = logging.getLogger("scenematch")

CONFIRM_COMMAND = mavlink.MAV_CMD_USER_1
"""COMMAND_LONG to the bridge's component by which an operator confirms fixes that contradict the track."""

_POLL_S = 0.02
_SILENCE_NS = 5_000_000_000  # without a heartbeat, after which the vehicle counts as disconnected
_REOPEN_S = 1.0
_GNSS_STALE_NS = 2_000_000_000


class MavlinkBridge:
    """Connects one autopilot to one navigator.

    Args:
        connection: endpoint of the autopilot.
        make_navigator: see :class:`engine.navigation.live.Live`.
        options: which message to send, and which fixes to withhold.
        start: prior position at the start of the flight.
        live: deadlines of the frames.
        origin: NED origin to set on an autopilot that reports none; None sets none, so local positions are not
            sent.
        site: the map; None checks the first fixes against neither the start nor a receiver.
        resumed: whether ``start`` is the last fix sent to this autopilot, by an earlier bridge: the next one must
            agree with it, waits neither for a heartbeat nor for the autopilot's report on its receiver.
        gimbal_mount: (3, 3) mount of a camera on a gimbal that the autopilot reports; None for a fixed camera.
        key: 32-byte key of MAVLink signing; None sends and accepts unsigned packets.
        watch: called with every answer, and whether its fix was sent; must return quickly.

    Raises:
        OSError: the link cannot be opened. Later, a link that fails is reopened.
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
        site: OrthoMap | None = None,
        resumed: bool = False,
        gimbal_mount: NDArray[np.float64] | None = None,
        key: bytes | None = None,
        watch: Callable[[Answer, bool], None] | None = None,
    ) -> None:
        self.telemetry = MavlinkTelemetry(gimbal_mount, options.component_id)
        self._requests = AutopilotRequests(options, origin, with_gimbal=gimbal_mount is not None)
        self._watch, self._connection, self._options, self._origin = watch, connection, options, origin
        self._make_navigator, self._key = make_navigator, key
        self._checked_on, self._resumed = site if options.check_gnss else None, resumed
        self._begin = None if start is None or site is None else position_of(start, site)
        self._notices = PilotNotices()
        self._encoder = PacketEncoder(options.system_id, key, options.component_id)
        self._sending = threading.Lock()
        self._navigator: Navigator | None = None
        self._resets_before = 0  # of navigators that have been replaced
        self._velocity = VelocityFromFixes()
        self._counters = MavlinkCounters()
        self._confirmed = False  # by an operator, for the next fix
        self._peer: PeerAddress = None
        self._connected_ns = 0  # when the vehicle was first heard, or heard again
        self._last_done_ns: dict[str, int] = {}
        self._closed = threading.Event()
        self._link: Link | None = connection.open()
        self._decoder = self._new_decoder(self._link)
        self._live = Live(self._new_navigator, self.deliver, start, live)
        # If the reader held Python's lock while waiting for a core, the worker would have to wait too.
        self._reader = start_thread(self._read, "scenematch-mavlink", None if live is None else live.realtime)

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
        return self._counters.status(connected=self.connected, dropped=self._decoder.dropped)

    def submit(self, image: NDArray[np.uint8], captured_ns: int) -> None:
        """Submit the newest image; an image still waiting is dropped.

        Args:
            image: (H, W, 3) RGB or (H, W) grey, uint8.
            captured_ns: time of exposure on ``time.monotonic_ns``.

        Raises:
            StateError: the bridge has been closed.
        """
        vehicle = self.telemetry.vehicle(captured_ns, own_velocity=self._options.use_velocity)
        frame = vehicle.frame(image, captured_ns)
        self._live.submit(frame, captured_ns=captured_ns)

    def deliver(self, answer: Answer) -> None:
        """Send an answer's fix unless it must be withheld, and pass the answer on to ``watch``."""
        now_s = time.monotonic()
        trusted = self._is_trusted(answer, now_s)
        if isinstance(answer.result, Fix):
            cause = self._send_fix(answer.result, answer.frame.timestamp_ns or 0, trusted=trusted)
        else:
            cause = answer.result.reason.value
            self._counters.refused[cause] += 1
        if cause is None:
            self._tell(self._notices.sent(now_s))
        else:
            self._notices.not_sent(cause)
            if self._options.firmware == "ardupilot" and not self.telemetry.armed:
                self._keep_ready_to_arm()
        if self._watch is not None:
            self._watch(answer, cause is None)

    def _keep_ready_to_arm(self) -> None:
        """Send what ArduPilot requires before arming: a live camera, or a fix from every receiver."""
        now_ns, gnss, gps_id = time.monotonic_ns(), self.telemetry.gnss, self._options.gps_id
        if self._options.needs_origin:
            self._send(mavlink_out.no_position_message(now_ns))
        elif gps_id and gnss is not None and now_ns - gnss.time_ns < _GNSS_STALE_NS:
            stamp_ns = mavlink_out.stamp_on_ground_ns(now_ns)
            times_ns = stamp_ns, self.telemetry.unix_ns(stamp_ns)
            self._send(mavlink_out.receiver_message(gnss, self.telemetry.vehicle(now_ns), gps_id, times_ns))

    def _is_trusted(self, answer: Answer, now_s: float) -> bool:
        """Whether a fix continues the track sent to the autopilot or, before the first fix, its GNSS."""
        stamp_ns, gnss = answer.frame.timestamp_ns or 0, self.telemetry.gnss
        if self._confirmed:
            self._guard.confirm()
            self._confirmed = False
        self._guard.advance(answer.frame, stamp_ns)
        site = self._checked_on
        if site is not None and gnss is not None and abs(stamp_ns - gnss.time_ns) < _GNSS_STALE_NS:
            prior = Prior(lat_deg=gnss.lat_deg, lon_deg=gnss.lon_deg, sigma_m=gnss.sigma_m)
            self._guard.anchor(position_of(prior, site))
        was_disputed, trusted = self._guard.is_disputed, self._guard.trusts(answer.result)
        if self._guard.is_disputed:
            self._tell(self._notices.doubted(self._guard.distance_m, now_s))
        elif was_disputed and isinstance(answer.result, NoFix) and answer.result.match is not None:
            # The navigator refused what confirms the fixes that were sent: it follows a shifted map.
            self._live.restart(place_of(answer.result.match).prior())
        return trusted

    def _send_fix(self, fix: Fix, captured_ns: int, *, trusted: bool) -> str | None:
        """Send a fix; returns the cause if it is withheld."""
        report = self._compose(fix, captured_ns)
        cause = mavlink_out.withhold_reason(report, self._options) if self.connected else "no autopilot"
        if cause is None and self.telemetry.firmware != MAV_AUTOPILOTS[self._options.firmware]:
            cause = "other firmware"
        if cause is None and not trusted:
            cause = "contradicts the track"
        if cause is None and self._awaits_receiver():
            cause = "receiver not heard yet"
        if cause is None and not self._send(mavlink_out.fix_message(report, self._options)):
            cause = "link down"
        if cause is not None:
            self._counters.withheld[cause] += 1
            return cause
        self._guard.has_fix = True
        self.telemetry.add_sent(captured_ns)
        self._counters.add_sent(report.age_ms)
        return None

    def _awaits_receiver(self) -> bool:
        """Whether the first fix must wait for the autopilot's report on its receiver, which is requested."""
        is_first = not (self._guard.has_fix or self._resumed)
        recent = time.monotonic_ns() - self._connected_ns < _GNSS_STALE_NS
        return self._checked_on is not None and is_first and recent and self.telemetry.has_receiver is None

    def _tell(self, notices: list[Notice]) -> None:
        for severity, text in notices:
            self._send(mavlink_out.notice_message(severity, text))

    def _new_navigator(self, start: Prior | None) -> Navigator:
        """Create a navigator, and with the first its guard.

        Replacing one counts as a reset because the new one acquires the position again.
        """
        navigator = self._make_navigator(start)
        if self._navigator is None:
            self._guard = TrackGuard(self._begin, navigator.options)
        else:
            self._resets_before += self._navigator.reset_count + 1
        self._navigator = navigator
        return navigator

    def _compose(self, fix: Fix, captured_ns: int) -> mavlink_out.FixReport:
        resets = self._resets_before + (0 if self._navigator is None else self._navigator.reset_count)
        origin, vehicle = self.telemetry.origin, self.telemetry.vehicle(captured_ns)
        if origin is None and self._origin is not None and vehicle.down_m is not None:
            # An autopilot without a position reports a height above sea level of 0.
            vehicle = replace(vehicle, alt_amsl_m=self._origin.alt_amsl_m - vehicle.down_m)
        return mavlink_out.FixReport(
            fix,
            captured_ns,
            (time.monotonic_ns() - captured_ns) * 1e-6,
            vehicle,
            origin,
            self._velocity.add(fix, captured_ns, resets, vehicle),
            resets % 256,
            self.telemetry.unix_ns(captured_ns),
        )

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
            except Exception:  # one packet caused it: the next may be valid, and the link needs its reader
                if self._is_due("log", time.monotonic_ns(), _REOPEN_S):
                    _log.exception("MAVLink: a packet could not be read or sent")
                self._closed.wait(_POLL_S)

    def _receive(self, data: bytes, sender: PeerAddress) -> None:
        """Handle bytes from one sender; while a vehicle is connected, only from its address."""
        if self._peer is not None and sender != self._peer and self.connected:
            return
        now_ns = time.monotonic_ns()
        for message in self._decoder.feed(data):
            if message.get_type() == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                self._peer = sender
                if not self.connected:
                    self._on_connected(now_ns)
            elif self._resumed and self.telemetry.heard_ns is None and self._is_of_autopilot(message):
                # The autopilot of the last fix, heard before its heartbeat, which comes once a second. It flies.
                self._peer = sender
                self._on_connected(now_ns)
                self.telemetry.firmware, self.telemetry.heard_ns = MAV_AUTOPILOTS[self._options.firmware], now_ns
                self.telemetry.armed = True
            if sender != self._peer:
                continue  # not the vehicle
            if message.get_type() == "COMMAND_LONG":
                self._obey(message)
                continue
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self._send(mavlink_out.timesync_message(time.monotonic_ns(), message.ts1))
            self.telemetry.update(message, now_ns)

    def _is_of_autopilot(self, message: Any) -> bool:
        source = message.get_srcSystem(), message.get_srcComponent()
        return source == (self._options.system_id, AUTOPILOT_COMPONENT)

    def _obey(self, message: Any) -> None:
        """Handle an operator's command to trust the fixes that contradict the track."""
        own = self._options
        if (message.target_system, message.target_component) != (own.system_id, own.component_id):
            return
        accepted = message.command == CONFIRM_COMMAND
        if accepted:
            self._confirmed = True
            self._tell([(INFO, "Scenematch: position confirmed")])
        self._send(mavlink_out.acknowledgement_message(message.command, accepted=accepted))

    def _on_connected(self, now_ns: int) -> None:
        """Start over with a vehicle that is heard for the first time or again."""
        self._counters.reconnections += self._connected_ns != 0
        self._connected_ns = now_ns
        self._last_done_ns.pop("timesync", None)
        self._requests.restart(now_ns)
        self.telemetry.reset()

    def _keep_alive(self) -> None:
        """Send periodic messages: heartbeats always, requests while the vehicle is connected."""
        now_ns = time.monotonic_ns()
        if self._is_due("heartbeat", now_ns, 1.0):
            self._send(mavlink_out.heartbeat_message())
        if not self.connected:
            return
        self._tell(self._notices.due(now_ns * 1e-9))
        if self._is_due("timesync", now_ns, 0.5):
            self.telemetry.add_timesync_request(now_ns)
            self._send(mavlink_out.timesync_message(now_ns))
        for request in self._requests.due(self.telemetry, now_ns):
            self._send(request)

    def _is_due(self, task: str, now_ns: int, period_s: float) -> bool:
        last_ns = self._last_done_ns.get(task)
        due = last_ns is None or now_ns - last_ns >= round(period_s * 1e9)
        if due:
            self._last_done_ns[task] = now_ns
        return due

    def _send(self, message: Any) -> bool:
        """Send one message; returns whether the link accepted it."""
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
        numbers = HANDLED_MESSAGES | {mavlink.MAVLINK_MSG_ID_COMMAND_LONG}
        return PacketDecoder(self._options.system_id, numbers, is_stream=link.is_stream, key=self._key)

    def _drop_link(self) -> None:
        with self._sending:
            if self._link is not None:
                self._link.close()
                self._counters.dropped += self._decoder.dropped
                self._decoder.dropped = 0
            self._link, self._peer, self.telemetry.heard_ns = None, None, None
