"""Notices to the pilot's ground station: fixes begin, stop or are refused in a row, the map is in doubt."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

MAX_TEXT = 50
"""Characters of STATUSTEXT."""

_STOPPED_S = 2.0  # without a fix sent, after which the pilot is told
_REPEAT_S = 30.0  # between two notices of the same state
INFO, WARNING, CRITICAL = mavlink.MAV_SEVERITY_INFO, mavlink.MAV_SEVERITY_WARNING, mavlink.MAV_SEVERITY_CRITICAL
Notice = tuple[int, str]
"""Severity and text of a STATUSTEXT."""


class PilotNotices:
    """Turns the outcomes of frames into notices, a new one for each change."""

    def __init__(self) -> None:
        self._sending = False
        self._last_sent_s: float | None = None
        self._cause = "no pictures"
        self._refused_in_a_row = 0
        self._told_s: dict[str, float] = {}

    def sent(self, now_s: float) -> list[Notice]:
        """A fix was sent."""
        began = not self._sending
        self._sending, self._last_sent_s, self._refused_in_a_row = True, now_s, 0
        self._told_s.clear()
        return [_notice(INFO, "fixes begin")] if began else []

    def not_sent(self, cause: str) -> None:
        """A frame gave no fix, or its fix was withheld."""
        self._cause = cause.replace("_", " ")
        self._refused_in_a_row += 1

    def doubted(self, distance_m: float, now_s: float) -> list[Notice]:
        """Matches contradict the track."""
        return self._repeated("doubted", CRITICAL, f"map doubted, {distance_m:.0f} m off; confirm or land", now_s)

    def due(self, now_s: float) -> list[Notice]:
        """Notices about a time without a fix; call it often."""
        last_s = self._last_sent_s
        if last_s is None or now_s - last_s < _STOPPED_S:
            return []
        cause = f"{self._refused_in_a_row} refused: {self._cause}" if self._refused_in_a_row else "no pictures"
        if self._sending:
            self._sending = False
            self._told_s["stopped"] = now_s
            return [_notice(WARNING, f"fixes stopped, {cause}")]
        return self._repeated("stopped", WARNING, f"no fix for {now_s - last_s:.0f} s, {cause}", now_s)

    def _repeated(self, name: str, severity: int, text: str, now_s: float) -> list[Notice]:
        if now_s - self._told_s.get(name, -_REPEAT_S) < _REPEAT_S:
            return []
        self._told_s[name] = now_s
        return [_notice(severity, text)]


def _notice(severity: int, text: str) -> Notice:
    return severity, f"Scenematch: {text}"[:MAX_TEXT]
