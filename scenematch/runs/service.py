"""Report what a bridge does: status lines to the terminal; readiness, heartbeats and stopping to systemd.

systemd receives reports only if it sets $NOTIFY_SOCKET and $WATCHDOG_USEC (sd_notify(3)).
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from scenematch.runs.output import Progress

_STATUS_PERIOD_S = 5.0
_BEATS = 4  # per watchdog interval, so that a late or lost one does not end the bridge


@contextmanager
def running_service() -> Iterator[Callable[[], None]]:
    """Report that the service is ready and, when the context ends, that it is stopping.

    Yields:
        A function to call in every iteration of the loop: it tells the watchdog in time that the loop still runs.
            If the loop hangs, systemd restarts the service.
    """
    period_s = int(os.environ.get("WATCHDOG_USEC") or 0) * 1e-6 / _BEATS
    due_s = time.monotonic()

    def beat() -> None:
        nonlocal due_s
        if period_s > 0.0 and (now := time.monotonic()) >= due_s:
            due_s = now + period_s
            _tell("WATCHDOG=1")

    _tell("READY=1")
    try:
        yield beat
    finally:
        _tell("STOPPING=1")


def status_reporter(line: Callable[[], str], progress: Progress) -> Callable[[], None]:
    """A function to call in every iteration of the loop: it reports the bridge's status now and then.

    Args:
        line: of the bridge's status.
        progress: receives the line, as does ``systemctl status``.
    """
    reported_s = time.monotonic()

    def report() -> None:
        nonlocal reported_s
        if (now := time.monotonic()) - reported_s >= _STATUS_PERIOD_S:
            reported_s = now
            text = line()
            progress.message(text)
            _tell(f"STATUS={text}")

    return report


def _tell(state: str) -> None:
    """Send a line; a manager that does not listen must not stop the bridge."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.setblocking(False)  # a full queue must not stop it either
        try:
            line.sendto(state.encode(), "\0" + address[1:] if address[0] == "@" else address)
        except OSError:
            return
