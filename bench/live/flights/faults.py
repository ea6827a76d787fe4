"""The faults of a flight, and their times."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: what, when after the first picture, for how long."""

    kind: str
    begin_s: float
    seconds: float = 0.0

    @property
    def end_s(self) -> float:
        """When the fault is over, as far as an outside process can end it."""
        return self.begin_s + self.seconds

    def reigns(self, time_s: float) -> bool:
        """Whether it is active then."""
        return self.begin_s <= time_s < self.end_s

    @property
    def name(self) -> str:
        """For a table."""
        return f"{self.kind} {self.seconds:g} s" if self.seconds else self.kind


FAULTS = (
    Fault("bridge killed", 15.0, 3.0),
    Fault("worker killed", 35.0),
    Fault("camera covered", 45.0, 10.0),
    Fault("picture frozen", 65.0, 6.0),
    Fault("autopilot silent", 80.0, 5.0),
    Fault("autopilot restarted", 95.0),
    Fault("bridge killed", 110.0, 15.0),
)
FLIGHT_S = 145.0
