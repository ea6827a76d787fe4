"""Wait for what other threads and processes do."""

import time
from collections.abc import Callable
from pathlib import Path


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
