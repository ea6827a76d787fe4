"""The faults of a flight, their times, and the file that tells a camera of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: what, when after the first picture, for how long, in which wind if another one begins with it."""

    kind: str
    begin_s: float
    seconds: float = 0.0
    wind_mps: float | None = None

    @property
    def end_s(self) -> float:
        """When the fault is over, as far as an outside process can end it."""
        return self.begin_s + self.seconds

    @property
    def name(self) -> str:
        """For a table."""
        name = f"{self.kind} {self.seconds:g} s" if self.seconds else self.kind
        return name if self.wind_mps is None else f"{name}, wind {self.wind_mps:g} m/s"


def reigning(fault_file: Path) -> str:
    """The fault that a camera has now, or nothing."""
    return fault_file.read_text(encoding="ascii") if fault_file.exists() else ""


def events(faults: Sequence[Fault]) -> list[tuple[float, bool, Fault]]:
    """Beginnings and ends in their order: when, whether it is an end, and of what."""
    both = [(fault.begin_s, False, fault) for fault in faults] + [(fault.end_s, True, fault) for fault in faults]
    return sorted(both, key=lambda event: event[0])
