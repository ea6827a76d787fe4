"""Calls from several threads at once, and waiting for what threads and processes do."""

import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any


def wait_until(holds: Callable[[], object], timeout_s: float = 60.0) -> None:
    """Wait until something holds, and fail if it does not."""
    end = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def is_running(pid: int) -> bool:
    """Whether a process is not gone, nor dead and not yet reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def called_at_once(call: Callable[[Any], Any], arguments: Iterable[Any]) -> list[Any]:
    """Answers by four threads that take turns as often as the interpreter lets them."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            return list(pool.map(call, arguments))
    finally:
        sys.setswitchinterval(before)
