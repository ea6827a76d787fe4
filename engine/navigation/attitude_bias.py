"""The attitude's bias: by how much roll, pitch and heading are off for seconds on end.

Without a receiver's velocity an estimator lets roll and pitch drift by a degree or two and the heading by five,
and a mount is never quite level. The bias is estimated by attitudes that pictures measured, and taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.geo import wrap_heading_deg
from engine.values import Fix, Frame

Array = NDArray[np.float64]

# Standard deviation of telemetry against picture without any bias: refined, and by features alone.
_REFINED_DEG, _FEATURES_DEG = 0.6, 2.0
_WALK_DEG = np.array([0.2, 0.2, 0.5])  # by which the bias changes in a second, one standard deviation
_SCATTER_SHARE = 0.2  # of each new difference in their mean square
_MAX_SIGMAS = 3.0  # of one difference: what is beyond counts as so much
# Of a tilt and of a heading whose error the frame does not state, one standard deviation.
_ASSUMED_TILT_DEG, _ASSUMED_HEADING_DEG = 0.4, 1.0
_LEAST_SIGMAS = 2.0  # less is what every frame's matching allows for
_LEAST_FIXES = 3  # before which nothing is taken off: one of them may be wrong
_MAX_PITCH_DEG = 85.0  # beyond, roll and heading are hardly separate


@dataclass(frozen=True, slots=True)
class Bias:
    """What is to be added to an attitude that is off, as far as it is known.

    Attributes:
        roll_deg, pitch_deg, heading_deg: to be added to the telemetry's.
        sigma_deg: standard deviations of the three.
    """

    roll_deg: float
    pitch_deg: float
    heading_deg: float
    sigma_deg: tuple[float, float, float]


class AttitudeBias:
    """How far off the attitude of a vehicle's telemetry is.

    Args:
        tilt_deg: standard deviation of the bias of roll and of pitch while no picture measured it.
        heading_deg: of the heading's.
    """

    def __init__(self, tilt_deg: float, heading_deg: float) -> None:
        self._first_deg2 = np.array([tilt_deg, tilt_deg, heading_deg]) ** 2
        self._mean_deg, self._variance_deg2 = np.zeros(3), self._first_deg2.copy()
        self._scatter_deg2 = np.zeros(3)  # mean square of the newest differences beyond what is expected of them
        self._time_s: float | None = None
        self._angles_deg: Array | None = None  # of the newest frame
        self._lag_deg = np.zeros(3)  # by how much they may have changed since they were measured
        self._fixes = 0  # that measured it

    @property
    def bias(self) -> Bias | None:
        """What is known of it; None before a picture measured it."""
        if not self._fixes:
            return None
        roll, pitch, heading = self._mean_deg.tolist()
        return Bias(roll, pitch, heading, tuple(np.sqrt(self._variance_deg2).tolist()))

    def follow(self, frame: Frame, time_s: float) -> None:
        """The newest frame, and its time on any one clock."""
        elapsed_s = 0.0 if self._time_s is None else max(time_s - self._time_s, 0.0)
        self._variance_deg2 = np.minimum(self._variance_deg2 + _WALK_DEG**2 * elapsed_s, self._first_deg2)
        self._time_s = time_s
        known = (frame.roll_deg, frame.pitch_deg, frame.heading_deg)
        self._angles_deg = None if None in known else np.array(known, np.float64)
        tilt_lag_deg = frame.tilt_lag_deg or 0.0
        self._lag_deg = np.array([tilt_lag_deg, tilt_lag_deg, frame.heading_lag_deg or 0.0])

    def corrected(self, frame: Frame) -> Frame:
        """The newest frame, or a late one, without the bias; how well that is known widens its errors."""
        if frame.roll_deg is None or frame.pitch_deg is None or frame.heading_deg is None:
            return frame
        if self._fixes < _LEAST_FIXES:
            return frame
        tilt_deg = frame.tilt_sigma_deg or _ASSUMED_TILT_DEG
        heading_deg = frame.heading_sigma_deg or _ASSUMED_HEADING_DEG
        off = np.abs(self._mean_deg) > _LEAST_SIGMAS * np.array([tilt_deg, tilt_deg, heading_deg])
        roll, pitch, heading = (self._mean_deg * off).tolist()
        wider = np.sqrt(self._variance_deg2 * off + self._scatter_deg2)
        return replace(
            frame,
            roll_deg=frame.roll_deg + roll,
            pitch_deg=max(-90.0, min(frame.pitch_deg + pitch, 90.0)),
            heading_deg=wrap_heading_deg(frame.heading_deg + heading) if heading else frame.heading_deg,
            tilt_lag_deg=math.hypot(frame.tilt_lag_deg or 0.0, float(wider[:2].max())),
            heading_lag_deg=math.hypot(frame.heading_lag_deg or 0.0, float(wider[2])),
        )

    def doubt(self, heading_deg: float) -> None:
        """What was known did not hold, and the heading may be this far off, one standard deviation."""
        self._mean_deg, self._scatter_deg2, self._fixes = np.zeros(3), np.zeros(3), 0
        self._variance_deg2 = np.maximum(self._first_deg2, [0.0, 0.0, heading_deg**2])

    def note(self, fix: Fix) -> None:
        """Learn from a fix of the newest frame; one without a height did not measure its attitude."""
        known_deg, seen = self._angles_deg, fix.attitude
        if seen is None or fix.up_m is None or known_deg is None or abs(seen.pitch_deg) > _MAX_PITCH_DEG:
            return
        apart = np.array([seen.roll_deg, seen.pitch_deg, seen.heading_deg]) - known_deg
        off = np.array([math.remainder(angle, 360.0) for angle in apart.tolist()])
        difference_deg = _REFINED_DEG if fix.stage in ("refined", "verified") else _FEATURES_DEG
        noise_deg2 = difference_deg**2 + self._lag_deg**2
        total_deg2 = self._variance_deg2 + noise_deg2
        most = _MAX_SIGMAS * np.sqrt(total_deg2)
        gain = self._variance_deg2 / total_deg2
        off = np.clip(off - self._mean_deg, -most, most)
        self._mean_deg = self._mean_deg + gain * off
        self._variance_deg2 = self._variance_deg2 * (1.0 - gain)
        if self._fixes:
            beyond_deg2 = np.clip(off**2 - total_deg2, 0.0, self._first_deg2)
            self._scatter_deg2 += _SCATTER_SHARE * (beyond_deg2 - self._scatter_deg2)
        self._fixes += 1
