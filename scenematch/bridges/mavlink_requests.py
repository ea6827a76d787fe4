"""Requests to an autopilot: for its telemetry and its origin, and to accept an origin if it has none."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from scenematch.bridges.mavlink_in import GIMBAL_RATES_HZ, REQUESTED_RATES_HZ, MavlinkTelemetry
from scenematch.bridges.mavlink_out import command_message, set_origin_message
from scenematch.bridges.parameters import MavlinkOptions
from scenematch.bridges.vehicle import NedOrigin

_ORIGIN_TIMEOUT_NS = 3_000_000_000  # after which an origin is set on an autopilot that reports none
_ORIGIN_TIMEOUT_GNSS_NS = 60_000_000_000  # the same while its GNSS receiver may still get a first fix
_RECEIVER_FOUND_MS = 20_000  # after boot, by when an autopilot has found its receiver: ArduPilot takes 9 s
_PERIOD_NS, _PERIOD_WITH_ORIGIN_NS = 1_000_000_000, 10_000_000_000


class AutopilotRequests:
    """Schedules the requests to one autopilot.

    Args:
        options: which message to send to which autopilot.
        origin: NED origin to set on an autopilot that reports none; None sets none.
        with_gimbal: whether to request its gimbal's attitude too.
    """

    def __init__(self, options: MavlinkOptions, origin: NedOrigin | None, *, with_gimbal: bool) -> None:
        self._system_id, self._options, self._origin = options.system_id, options, origin
        self._rates_hz = REQUESTED_RATES_HZ[options.firmware]
        if with_gimbal:
            self._rates_hz = self._rates_hz | GIMBAL_RATES_HZ[options.firmware]
        self._without_origin_ns = 0  # since when the autopilot has reported no origin
        self._last_ns: int | None = None

    def restart(self, now_ns: int) -> None:
        """Ask at once: the vehicle is heard for the first time or again."""
        self._without_origin_ns, self._last_ns = now_ns, None

    def due(self, telemetry: MavlinkTelemetry, now_ns: int) -> list[Any]:
        """The messages to send now; call it often while the vehicle is connected."""
        if telemetry.origin is not None:
            self._without_origin_ns = now_ns
        period_ns = _PERIOD_WITH_ORIGIN_NS if telemetry.origin else _PERIOD_NS
        if self._last_ns is not None and now_ns - self._last_ns < period_ns:
            return []
        self._last_ns = now_ns
        intervals = [
            command_message(self._system_id, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz)
            for number, rate_hz in self._rates_hz.items()
        ]
        asked = mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
        return [*intervals, command_message(self._system_id, *asked), *self._origin_to_set(telemetry, now_ns)]

    def _origin_to_set(self, telemetry: MavlinkTelemetry, now_ns: int) -> list[Any]:
        """An autopilot with a receiver sets a better origin itself once the receiver has a fix."""
        if self._origin is None or self._options.kind == "gps_input":
            return []
        receiver, uptime_ms = telemetry.has_receiver, telemetry.uptime_ms
        seeks = uptime_ms is not None and uptime_ms < _RECEIVER_FOUND_MS and not (receiver or telemetry.armed)
        waited_ns = _ORIGIN_TIMEOUT_GNSS_NS if receiver or seeks else _ORIGIN_TIMEOUT_NS
        if now_ns - self._without_origin_ns <= waited_ns:
            return []
        return [set_origin_message(self._system_id, self._origin, now_ns)]
