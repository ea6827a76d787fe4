"""Checks whether the telemetry's velocity fits the distances between successive matches.

Swapped axes, a wrong sign or unit, or timestamps at a wrong rate make dead reckoning contradict every match. Wrong
matches do not follow a smooth path in another direction for long, so such a path supports the matches.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.navigation.motion import en_m
from engine.values import Fix, Frame

Array = NDArray[np.float64]

_MIN_CONFIDENCE = 0.99  # of a match to be compared
_WAY_S, _MAX_LEG_S = 2.0, 5.0  # time over which matches are compared; longest gap between two
_MIN_MATCHES = 3  # fewest matches of a smooth path
_MIN_WAY_M = 5.0  # by matches or by velocity: a hovering vehicle tells nothing
_GATE = 18.4  # chi-square of two degrees of freedom: chance exceeds it once in ten thousand
_CONTRADICTIONS = 3  # matches in a row
_AGREES_S = 10.0  # agreement for so long restores trust in the velocity


@dataclass(frozen=True, slots=True)
class _Seen:
    """A match and the velocity's integral up to it.

    Attributes:
        time_s: of the match.
        place_m: (2,) east and north.
        sigma_m: of the place.
        told_mps: (2,) velocity that came with the frame.
        told_m: (2,) its integral since the first match.
        coarse_m: error of that integral because matches are sparse or the velocity is stated to be inaccurate.
    """

    time_s: float
    place_m: Array
    sigma_m: float
    told_mps: Array
    told_m: Array
    coarse_m: float


class VelocityCheck:
    """Counts the matches whose motion contradicts the telemetry's velocity.

    Args:
        sigma_mps: standard deviation of a correct velocity.
        acceleration_mps2: acceleration of the vehicle.
    """

    def __init__(self, sigma_mps: float, acceleration_mps2: float) -> None:
        self._sigma_mps, self._acceleration_mps2 = sigma_mps, acceleration_mps2
        self._seen: deque[_Seen] = deque()  # of the last seconds
        self._contradictions = 0
        self._agrees_since_s: float | None = None
        self.is_believed = True

    def shown(self, frame: Frame) -> Frame:
        """The frame, without its velocity if that is not trusted."""
        if self.is_believed:
            return frame
        return replace(frame, east_velocity_mps=None, north_velocity_mps=None)

    def note(self, fix: Fix, frame: Frame, time_s: float) -> bool:
        """Compare the way to a match, accepted or not, with the way by the velocity.

        Args:
            fix: the match.
            frame: as received.
            time_s: on any one clock.

        Returns:
            bool: whether trust in the velocity ends at this match.
        """
        known = frame.east_velocity_mps is not None and frame.north_velocity_mps is not None
        if not known or (fix.confidence is not None and fix.confidence < _MIN_CONFIDENCE):
            return False
        told_mps = np.array([frame.east_velocity_mps, frame.north_velocity_mps], np.float64)
        leg_s = time_s - self._seen[-1].time_s if self._seen else math.inf
        if not 0.0 < leg_s <= _MAX_LEG_S:
            self._seen.clear()
            self._contradictions, self._agrees_since_s = 0, None
            self._seen.append(_Seen(time_s, en_m(fix), fix.relative_sigma_m, told_mps, np.zeros(2), 0.0))
            return False
        last = self._seen[-1]
        told_m = last.told_m + 0.5 * (last.told_mps + told_mps) * leg_s
        coarse_m = last.coarse_m + self._acceleration_mps2 * leg_s**2 / 12.0
        coarse_m += max((frame.velocity_sigma_mps or 0.0) - self._sigma_mps, 0.0) * leg_s
        self._seen.append(_Seen(time_s, en_m(fix), fix.relative_sigma_m, told_mps, told_m, coarse_m))
        while len(self._seen) > _MIN_MATCHES and self._seen[1].time_s <= time_s - _WAY_S:
            self._seen.popleft()
        return self._judge(self._seen[0], self._seen[-1])

    def _judge(self, first: _Seen, last: _Seen) -> bool:
        """Whether the newest way ends trust in the velocity."""
        elapsed_s = last.time_s - first.time_s
        moved_m, told_m = last.place_m - first.place_m, last.told_m - first.told_m
        if max(float(np.hypot(*moved_m)), float(np.hypot(*told_m))) < _MIN_WAY_M:
            return False
        noise_m = math.hypot(first.sigma_m, last.sigma_m)
        sigma_m = noise_m + self._sigma_mps * elapsed_s + last.coarse_m - first.coarse_m
        off_m = moved_m - told_m
        if float(off_m @ off_m) <= _GATE * sigma_m**2:
            self._contradictions = 0
            if float(told_m @ told_m) <= _GATE * sigma_m**2:
                return False  # matches as vague as these agree with anything
            since_s = self._agrees_since_s = last.time_s if self._agrees_since_s is None else self._agrees_since_s
            self.is_believed |= last.time_s - since_s >= _AGREES_S
            return False
        self._agrees_since_s = None
        self._contradictions = self._contradictions + 1 if self._is_smooth(noise_m) else 0
        if not self.is_believed or self._contradictions < _CONTRADICTIONS:
            return False
        self.is_believed = False
        return True

    def _is_smooth(self, noise_m: float) -> bool:
        """Whether the matches lie as near to a straight way as an accelerating vehicle would."""
        first, last = self._seen[0], self._seen[-1]
        elapsed_s = last.time_s - first.time_s
        share = np.array([(one.time_s - first.time_s) / elapsed_s for one in self._seen])
        straight_m = first.place_m + share[:, None] * (last.place_m - first.place_m)
        off_m = np.hypot(*(np.array([one.place_m for one in self._seen]) - straight_m).T)
        most_m = self._acceleration_mps2 * elapsed_s**2 / 8.0 + 3.0 * noise_m
        return len(self._seen) >= _MIN_MATCHES and bool(off_m.max() <= most_m)
