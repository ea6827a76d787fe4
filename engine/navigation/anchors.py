"""Anchors: where dead reckoning starts, and the velocity from the last seconds' anchors."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from engine.navigation.motion import DriftModel, OdometrySample, PositionEstimate, VelocityEstimate
from engine.values import Fix

_VELOCITY_S = 1.0  # the last fixes give a velocity over this time
_MEMORY_S = 5.0  # and must agree with measured velocities over this one


@dataclass(frozen=True, slots=True)
class Anchor:
    """Where dead reckoning starts: the last accepted fix, or the start of the flight.

    Attributes:
        position: the position there.
        sample: its odometry; None before the first frame.
        fix: None for a start.
        support: number of successive fixes up to this one that agreed.
        disputed: the other source contradicted it; its log-odds already count that.
    """

    position: PositionEstimate
    sample: OdometrySample | None
    fix: Fix | None = None
    support: int = 0
    disputed: bool = False

    @property
    def odometry(self) -> OdometrySample:
        """The odometry of an anchor that has one; every fix does."""
        assert self.sample is not None
        return self.sample


class RecentAnchors:
    """The fixes of the last seconds, and the velocity that follows from them.

    Args:
        drift: of dead reckoning.
    """

    def __init__(self, drift: DriftModel) -> None:
        self._drift = drift
        self._anchors: deque[Anchor] = deque()
        self.velocity: VelocityEstimate | None = None

    @property
    def oldest(self) -> Anchor | None:
        """The first fix of the last seconds."""
        return self._anchors[0] if self._anchors else None

    def append(self, anchor: Anchor, *, jump: bool) -> None:
        """Add the newest fix; after a jump, drop those before it."""
        if jump:
            self._anchors.clear()
        self._anchors.append(anchor)
        now_s = anchor.odometry.time_s
        while len(self._anchors) > 2 and self._anchors[1].odometry.time_s <= now_s - _MEMORY_S:
            self._anchors.popleft()
        long_ago = (a for a in reversed(self._anchors) if a.odometry.time_s <= now_s - _VELOCITY_S)
        first = next(long_ago, self._anchors[0])
        interval_s = now_s - first.odometry.time_s
        self.velocity = None
        if interval_s > 0.0:
            sigma_m = math.hypot(anchor.position.sigma_m, first.position.sigma_m)
            self.velocity = self._drift.velocity(anchor.position.en_m - first.position.en_m, sigma_m, interval_s)
