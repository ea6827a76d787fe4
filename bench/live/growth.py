"""What may not grow in a process that lasts: memory, open files and threads."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from engine.geo import Array


def resident_mb(process: int | str = "self", field: str = "VmRSS") -> float:
    """Resident memory of a process in megabytes (Linux); ``VmHWM`` is the most that it had so far.

    Not by ``getrusage``: what a program says of itself there begins with the peak of the process that started it.
    """
    status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    return int(status.split(f"{field}:")[1].split()[0]) * 1.024e-3


class Growth:
    """Looks at this process after every so many frames or messages.

    Args:
        every: so many.
        most: looks at most. Their room is written now, so that memory does not grow in flight.
    """

    def __init__(self, every: int, most: int = 1000) -> None:
        self.every, self._looks, self._room = every, 0, np.full((most, 4), np.nan)

    @property
    def seen(self) -> Array:
        """(N, 4) how many there had been, megabytes, open files and threads of every look."""
        return self._room[: self._looks]

    def look(self, count: int) -> None:
        """Look if there were so many more since the last time."""
        if count // self.every >= self._looks:
            files, threads = (len(os.listdir(f"/proc/self/{kind}")) for kind in ("fd", "task"))
            self._room[self._looks] = count, resident_mb(), files, threads
            self._looks += 1

    def slope_mb(self) -> float:
        """Growth of memory each time, by least squares after the first tenth, in which tables and caches fill."""
        return slope(self.seen[:, 0], self.seen[:, 1])


def slope(counts: Array, values: Array) -> float:
    """Growth of a value by least squares, after the first tenth."""
    kept = np.s_[len(values) // 10 :]
    return float(np.polyfit(counts[kept], values[kept], 1)[0]) if len(values[kept]) > 1 else 0.0
