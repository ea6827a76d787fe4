"""Store the delay measured by the last bridge with a camera, for the autopilot's parameter file."""

from __future__ import annotations

import contextlib
from pathlib import Path

from engine.runtime.cache_folder import cache_folder
from scenematch.bridges.parameters import MAX_DELAY_MS


def remember_delay(least_age_ms: float | None) -> None:
    """Store the least age of a fix; None, if the bridge sent none, keeps the stored one."""
    if least_age_ms is None:
        return
    with contextlib.suppress(OSError):  # a home that cannot be written must not end the run
        _file().parent.mkdir(parents=True, exist_ok=True)
        _file().write_text(f"{least_age_ms:.0f}\n", encoding="ascii")


def measured_delay_ms() -> int | None:
    """The stored delay, or None."""
    try:
        return min(int(_file().read_text(encoding="ascii")), round(MAX_DELAY_MS))
    except (OSError, ValueError):
        return None


def _file() -> Path:
    return cache_folder() / "mavlink-delay-ms"
