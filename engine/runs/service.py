"""Notifications to systemd of a bridge that it runs: ready, still running, its status, stopping.

Nothing is sent where systemd does not ask for it by $NOTIFY_SOCKET and $WATCHDOG_USEC (sd_notify(3)).
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_BEATS = 4  # within the time that the watchdog waits, so that one that is late or lost does not end the bridge


@contextmanager
def running_service() -> Iterator[Callable[[], None]]:
    """Tell that the service is ready, and when the context ends that it stops.

    Yields:
        A function for the loop to call each time around: it tells the watchdog that the loop goes on, as often as
        that waits for it. A loop that hangs does not call it, and systemd starts the service again.
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


def tell_status(line: str) -> None:
    """Let ``systemctl status`` show a line."""
    _tell(f"STATUS={line}")


def _tell(state: str) -> None:
    """Send a line; a manager that does not listen is no reason to stop a bridge."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.setblocking(False)  # a full queue must not stop it either
        try:
            line.sendto(state.encode(), "\0" + address[1:] if address[0] == "@" else address)
        except OSError:
            return
