"""What takes the processor from a process: others that burn it, and a throttle that stops and continues it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PERIOD_S = 0.02
_BURN = "import os\nparent = os.getppid()\nwhile os.getppid() == parent:\n    for _ in range(100_000): pass"


@contextmanager
def hogs(count: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """``count`` processes that burn a core each; they end with this block, or with this process."""
    burning = [subprocess.Popen([sys.executable, "-S", "-c", _BURN]) for _ in range(count)]
    try:
        time.sleep(0.2 if burning else 0.0)  # until they burn
        yield burning
    finally:
        for process in burning:
            process.kill()
            process.wait()


def throttle(pid: int, share: float, done: Callable[[float], bool], period_s: float = PERIOD_S) -> None:
    """Let another process run for a share of every period only, until ``done``.

    It is stopped by a signal for the rest of the period, as a quota of a control group would;
    that needs no rights.
    A shell that sees its own job stopped takes it for suspended, so the process must be somebody's child.

    Args:
        pid: of the process.
        share: of the time that it may run, above 0 and at most 1.
        done: waits at most so many seconds, and says whether to end.
        period_s: between two stops.
    """
    try:
        while not done(share * period_s):
            os.kill(pid, signal.SIGSTOP)
            time.sleep((1.0 - share) * period_s)
            os.kill(pid, signal.SIGCONT)
    finally:
        os.kill(pid, signal.SIGCONT)
