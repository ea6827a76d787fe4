"""Delayed measurements: the filter's last seconds, so that each is taken in at the moment that it is of."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from engine.errors import StateError
from engine.sim.ekf import FilterState, predict
from engine.sim.quadrotor import STEP_S, IdealImu
from engine.sim.sensors import SensorSuite

Correction = Callable[[FilterState], FilterState]
"""A measurement: the belief before it in, the belief after it out."""


@dataclass(slots=True)
class _Step:
    """What led from one belief to the next, and that belief."""

    sample: IdealImu
    belief: FilterState
    corrections: list[Correction] = field(default_factory=list)


class History:
    """A filter that can be told of the past: what came since is then taken in again, in its order.

    That is exact, at the price of as many predictions as steps have gone by: 12 for a fix of 120 ms ago.

    Args:
        start: the first belief.
        suite: what the vehicle carries.
        keep_s: how far back a measurement may lie.
    """

    def __init__(self, start: FilterState, suite: SensorSuite, keep_s: float = 2.0) -> None:
        self._suite = suite
        self._before = start
        self._steps: deque[_Step] = deque()
        self._most = round(keep_s / STEP_S)

    @property
    def now(self) -> FilterState:
        """The newest belief."""
        return self._steps[-1].belief if self._steps else self._before

    def advance(self, sample: IdealImu) -> None:
        """One step on, by what the IMU measured."""
        self._steps.append(_Step(sample, predict(self.now, sample, self._suite)))
        if len(self._steps) > self._most:
            self._before = self._steps.popleft().belief

    def at(self, time_s: float) -> FilterState:
        """The belief of a moment as it stands by now.

        Raises:
            StateError: it lies in the future, or further back than is kept.
        """
        back = self._back(time_s)
        return self._before if back == len(self._steps) else self._steps[len(self._steps) - 1 - back].belief

    def fuse(self, correction: Correction, time_s: float) -> None:
        """Take in a measurement at the moment that it is of.

        Raises:
            StateError: that lies in the future, or further back than is kept.
        """
        back = self._back(time_s)
        if back == len(self._steps):
            self._before, last = correction(self._before), -1
        else:
            last = len(self._steps) - 1 - back
            step = self._steps[last]
            step.corrections.append(correction)
            step.belief = correction(step.belief)
        belief = self._before if last < 0 else self._steps[last].belief
        for k in range(last + 1, len(self._steps)):
            step = self._steps[k]
            belief = predict(belief, step.sample, self._suite)
            for known in step.corrections:
                belief = known(belief)
            step.belief = belief

    def _back(self, time_s: float) -> int:
        """How many steps ago a moment is."""
        back = round((self.now.time_s - time_s) / STEP_S)
        if not 0 <= back <= len(self._steps):
            oldest = self.now.time_s - STEP_S * len(self._steps)
            raise StateError(f"time_s: expected {oldest:.2f} to {self.now.time_s:.2f}, got {time_s:.2f}")
        return back
