"""The most memory that a process had resident.

Not by ``getrusage``: what a program says of itself there begins with the peak of the process that started it.
"""

from __future__ import annotations

from pathlib import Path

_STATUS = Path("/proc/self/status")


def peak_mb() -> float:
    """Of this process so far, in megabytes (Linux)."""
    line = next(line for line in _STATUS.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1.024e-3
