"""Velocity over ground from the last fixes: sending the vehicle its own velocity back would be circular."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from engine.values import Fix
from scenematch.bridges.vehicle import VehicleState

_MIN_SPAN_S = 0.4  # between the first and the last fix
_MAX_SPAN_S, _MAX_SPAN_ALONE_S = 1.5, 0.8  # the latter without the vehicle's velocity
# 1 sigma of unmodelled change in that time: an estimator's velocity drifts, a vehicle turns and brakes.
_DRIFT_MPS2, _ACCELERATION_MPS2 = 0.3, 1.5


@dataclass(frozen=True, slots=True)
class GroundVelocity:
    """Velocity over ground at the last fix, and its standard deviation per axis."""

    east_mps: float
    north_mps: float
    sigma_mps: float


@dataclass(frozen=True, slots=True)
class _Sample:
    time_s: float
    fix: Fix
    velocity_mps: tuple[float, float] | None


class VelocityFromFixes:
    """A line fitted to the last fixes, corrected for changes in the vehicle's own velocity.

    The changes come from the vehicle's accelerometers. The fixes thus give only the mean velocity, and the result
    is valid at the last fix rather than in the middle of the interval.
    """

    def __init__(self) -> None:
        self._samples: deque[_Sample] = deque(maxlen=64)
        self._resets: int | None = None

    def add(self, fix: Fix, captured_ns: int, resets: int, vehicle: VehicleState) -> GroundVelocity | None:
        """Add a fix; returns the velocity at its time, or None after a reset or without earlier fixes."""
        east, north = vehicle.east_velocity_mps, vehicle.north_velocity_mps
        sample = _Sample(captured_ns * 1e-9, fix, None if east is None or north is None else (east, north))
        samples = self._samples
        if resets != self._resets or (samples and sample.time_s <= samples[-1].time_s):
            samples.clear()
        self._resets = resets
        samples.append(sample)
        measured = all(known.velocity_mps is not None for known in samples)
        while sample.time_s - samples[0].time_s > (_MAX_SPAN_S if measured else _MAX_SPAN_ALONE_S):
            samples.popleft()
        span_s = sample.time_s - samples[0].time_s
        if span_s < _MIN_SPAN_S:
            return None
        known_mps = [known.velocity_mps for known in samples]
        own_mps = None if None in known_mps else np.array(known_mps)  # (N, 2)
        changed_mps = 0.5 * span_s * (_ACCELERATION_MPS2 if own_mps is None else _DRIFT_MPS2)
        return _velocity(list(samples), own_mps, changed_mps)


def _velocity(samples: list[_Sample], own_mps: np.ndarray | None, changed_mps: float) -> GroundVelocity:
    """The slope of the fixes minus the vehicle's own movement, plus its own last velocity."""
    times_s = np.array([sample.time_s for sample in samples])
    times_s -= times_s.mean()
    positions_m = np.array([(sample.fix.east_m, sample.fix.north_m) for sample in samples])
    last_mps = np.zeros(2)
    if own_mps is not None:
        steps_m = 0.5 * (own_mps[1:] + own_mps[:-1]) * np.diff(times_s)[:, None]
        positions_m[1:] -= np.cumsum(steps_m, axis=0)
        last_mps = own_mps[-1]
    squares_s2 = float(times_s @ times_s)
    east_mps, north_mps = last_mps + times_s @ positions_m / squares_s2
    noise_mps = max(sample.fix.relative_sigma_m for sample in samples) / math.sqrt(squares_s2)
    return GroundVelocity(float(east_mps), float(north_mps), math.hypot(noise_mps, changed_mps))
