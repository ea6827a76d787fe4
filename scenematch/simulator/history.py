"""Delayed measurements: keep the filter's last seconds to fuse each measurement at the time it was taken."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from engine.errors import StateError
from scenematch.simulator.ekf import FilterState, predict
from scenematch.simulator.quadrotor import STEP_S, IdealImu
from scenematch.simulator.sensors import SensorSuite

Correction = Callable[[FilterState], FilterState]
"""Fuses one measurement: takes the state before it, returns the state after it."""


@dataclass(slots=True)
class _Step:
    """An IMU sample, the state after it, and the measurements fused into that state."""

    sample: IdealImu
    state: FilterState
    corrections: list[Correction] = field(default_factory=list)


class History:
    """A filter that fuses late measurements: it goes back to their time and repeats the following steps in order.

    This is exact and costs one prediction per repeated step: 12 for a fix 120 ms old.

    Args:
        start: the first state.
        suite: the vehicle's sensors.
        keep_s: largest age of a measurement.
    """

    def __init__(self, start: FilterState, suite: SensorSuite, keep_s: float = 2.0) -> None:
        self._suite = suite
        self._before = start
        self._steps: deque[_Step] = deque()
        self._max_steps = round(keep_s / STEP_S)

    @property
    def now(self) -> FilterState:
        """The latest state."""
        return self._steps[-1].state if self._steps else self._before

    def advance(self, sample: IdealImu) -> None:
        """Predict one step from the IMU's measurements."""
        self._steps.append(_Step(sample, predict(self.now, sample, self._suite)))
        if len(self._steps) > self._max_steps:
            self._before = self._steps.popleft().state

    def at(self, time_s: float) -> FilterState:
        """The state at a time, using all measurements so far.

        Raises:
            StateError: the time is in the future, or older than ``keep_s``.
        """
        back = self._back(time_s)
        return self._before if back == len(self._steps) else self._steps[len(self._steps) - 1 - back].state

    def fuse(self, correction: Correction, time_s: float) -> None:
        """Fuse a measurement at the time it was taken.

        Raises:
            StateError: the time is in the future, or older than ``keep_s``.
        """
        back = self._back(time_s)
        if back == len(self._steps):
            self._before, last = correction(self._before), -1
        else:
            last = len(self._steps) - 1 - back
            step = self._steps[last]
            step.corrections.append(correction)
            step.state = correction(step.state)
        state = self._before if last < 0 else self._steps[last].state
        for k in range(last + 1, len(self._steps)):
            step = self._steps[k]
            state = predict(state, step.sample, self._suite)
            for later in step.corrections:
                state = later(state)
            step.state = state

    def _back(self, time_s: float) -> int:
        """How many steps ago a time is."""
        back = round((self.now.time_s - time_s) / STEP_S)
        if not 0 <= back <= len(self._steps):
            oldest = self.now.time_s - STEP_S * len(self._steps)
            raise StateError(f"time_s: expected {oldest:.2f} to {self.now.time_s:.2f}, got {time_s:.2f}")
        return back
