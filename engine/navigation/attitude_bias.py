"""The attitude's bias: errors of roll, pitch and heading that last for seconds.

Without a receiver's velocity an estimator lets roll and pitch drift by a degree or two and the heading by five,
and a mount is never quite level. Attitudes measured by matching give the bias, which is then subtracted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.geo import wrap_heading_deg
from engine.values import Fix, Frame

Array = NDArray[np.float64]

# Standard deviation between telemetry and image without any bias: refined, and by features alone.
_REFINED_DEG, _FEATURES_DEG = 0.6, 2.0
_WALK_DEG = np.array([0.2, 0.2, 0.5])  # standard deviation of the bias's change in one second
_SCATTER_SHARE = 0.2  # weight of a new difference in the mean square
_MAX_SIGMAS = 3.0  # larger differences are clipped to this
# Standard deviations of a tilt and of a heading if the frame does not state them.
_ASSUMED_TILT_DEG, _ASSUMED_HEADING_DEG = 0.4, 1.0
_MIN_SIGMAS = 2.0  # every frame's matching allows for smaller ones
_MIN_FIXES = 3  # fewer are not used for correction: one of them may be wrong
_MAX_PITCH_DEG = 85.0  # beyond, roll and heading are hardly separate


@dataclass(frozen=True, slots=True)
class Bias:
    """The correction to add to a biased attitude, as far as it is known.

    Attributes:
        roll_deg, pitch_deg, heading_deg: to be added to the telemetry's.
        sigma_deg: standard deviations of the three.
    """

    roll_deg: float
    pitch_deg: float
    heading_deg: float
    sigma_deg: tuple[float, float, float]


class AttitudeBias:
    """Estimates the bias of the telemetry's attitude.

    Args:
        tilt_deg: standard deviation of the bias of roll and of pitch before images have measured it.
        heading_deg: the same for the heading.
    """

    def __init__(self, tilt_deg: float, heading_deg: float) -> None:
        self._first_deg2 = np.array([tilt_deg, tilt_deg, heading_deg]) ** 2
        self._mean_deg, self._variance_deg2 = np.zeros(3), self._first_deg2.copy()
        self._scatter_deg2 = np.zeros(3)  # mean square of recent differences in excess of the expected
        self._time_s: float | None = None
        self._angles_deg: Array | None = None  # of the newest frame
        self._lag_deg = np.zeros(3)  # possible change since they were measured
        self._fixes = 0  # fixes that measured it

    @property
    def bias(self) -> Bias | None:
        """The estimated correction; None before an image has measured it."""
        if not self._fixes:
            return None
        roll, pitch, heading = self._mean_deg.tolist()
        return Bias(roll, pitch, heading, tuple(np.sqrt(self._variance_deg2).tolist()))

    def follow(self, frame: Frame, time_s: float) -> None:
        """Take the newest frame, with its time on any one clock."""
        elapsed_s = 0.0 if self._time_s is None else max(time_s - self._time_s, 0.0)
        self._variance_deg2 = np.minimum(self._variance_deg2 + _WALK_DEG**2 * elapsed_s, self._first_deg2)
        self._time_s = time_s
        known = (frame.roll_deg, frame.pitch_deg, frame.heading_deg)
        self._angles_deg = None if None in known else np.array(known, np.float64)
        tilt_lag_deg = frame.tilt_lag_deg or 0.0
        self._lag_deg = np.array([tilt_lag_deg, tilt_lag_deg, frame.heading_lag_deg or 0.0])

    def corrected(self, frame: Frame) -> Frame:
        """The newest frame, or a late one, without the bias; the bias's uncertainty widens its errors."""
        if frame.roll_deg is None or frame.pitch_deg is None or frame.heading_deg is None:
            return frame
        if self._fixes < _MIN_FIXES:
            return frame
        tilt_deg = frame.tilt_sigma_deg or _ASSUMED_TILT_DEG
        heading_deg = frame.heading_sigma_deg or _ASSUMED_HEADING_DEG
        off = np.abs(self._mean_deg) > _MIN_SIGMAS * np.array([tilt_deg, tilt_deg, heading_deg])
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
        """Forget the estimate; the heading may be off by this standard deviation."""
        self._mean_deg, self._scatter_deg2, self._fixes = np.zeros(3), np.zeros(3), 0
        self._variance_deg2 = np.maximum(self._first_deg2, [0.0, 0.0, heading_deg**2])

    def note(self, fix: Fix) -> None:
        """Learn from a fix of the newest frame; a fix without a height did not measure its attitude."""
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
