"""The delay that the last bridge with a camera measured, kept for the autopilot's parameter file."""

from __future__ import annotations

import contextlib
from pathlib import Path

from engine.runtime.cache_folder import cache_folder
from scenematch.bridges.parameters import MAX_DELAY_MS


def remember_delay(least_age_ms: float | None) -> None:
    """Keep the least age of a fix; None, of a bridge that sent none, leaves what was kept."""
    if least_age_ms is None:
        return
    with contextlib.suppress(OSError):  # a home that cannot be written must not end the run
        _file().parent.mkdir(parents=True, exist_ok=True)
        _file().write_text(f"{least_age_ms:.0f}\n", encoding="ascii")


def measured_delay_ms() -> int | None:
    """The delay that was kept, or None."""
    try:
        return min(int(_file().read_text(encoding="ascii")), round(MAX_DELAY_MS))
    except (OSError, ValueError):
        return None


def _file() -> Path:
    return cache_folder() / "mavlink-delay-ms"
