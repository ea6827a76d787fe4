"""The attitude's lag: how far roll, pitch and heading may have changed since they were measured.

A braking vehicle turns by tens of degrees a second, and one degree of tilt is 2.6 m on the ground at 150 m. The
lag is estimated from attitudes measured by matching; its uncertainty widens the attitude's errors.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engine.geo import wrap_heading_deg
from engine.navigation.attitude_bias import Bias
from engine.values import Fix, Frame

Array = NDArray[np.float64]

_MAX_INTERVAL_S = 0.5  # between frames; over longer ones the rates are unknown
_MIN_RATE_DPS = 2.0  # of roll and pitch; slower turns tell nothing about the lag
_DIFFERENCE_DEG = 0.6  # standard deviation between telemetry and image without any lag
_WALK_S = 0.01  # change of the lag in one second
_MAX_LAG_DEG = 180.0  # timestamps in a wrong unit make rates of any size
_MAX_SIGMAS = 3.0  # of the lag before it was measured: more is not a lag


class AttitudeLag:
    """Estimates how late the telemetry's attitude is.

    Args:
        sigma_s: standard deviation of the lag before images have measured it.
        jitter_s: standard deviation of one frame's lag about its mean.
    """

    def __init__(self, sigma_s: float, jitter_s: float) -> None:
        self._first_s2, self._jitter_s2 = sigma_s**2, jitter_s**2
        self._mean_s, self._variance_s2 = 0.0, sigma_s**2
        self._time_s: float | None = None
        self._angles_deg: Array | None = None  # of the newest frame
        self._rates_dps = np.zeros(3)

    @property
    def mean_s(self) -> float:
        """How late the attitude is on average."""
        return self._mean_s

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the lag of one frame."""
        return math.sqrt(self._variance_s2 + self._jitter_s2)

    def corrected(self, frame: Frame) -> Frame:
        """The next frame with its attitude corrected to the time of capture, as far as the lag is known."""
        self._follow(frame)
        if self._angles_deg is None or not self._rates_dps.any():
            return frame
        roll, pitch, heading = (float(v) for v in self._angles_deg + self._rates_dps * self._mean_s)
        return replace(
            frame,
            roll_deg=roll,
            pitch_deg=max(-90.0, min(pitch, 90.0)),
            heading_deg=wrap_heading_deg(heading),
            tilt_lag_deg=min(float(np.abs(self._rates_dps[:2]).max()) * self.sigma_s, _MAX_LAG_DEG),
            heading_lag_deg=min(float(abs(self._rates_dps[2])) * self.sigma_s, _MAX_LAG_DEG),
        )

    def note(self, fix: Fix, bias: Bias | None = None) -> None:
        """Learn from a fix of the newest frame; a fix without a height did not measure its attitude.

        Args:
            fix: of the newest frame.
            bias: the attitude's other error.
        """
        rates = self._rates_dps[:2]
        square = float(rates @ rates)
        if fix.attitude is None or fix.up_m is None or self._angles_deg is None or square < _MIN_RATE_DPS**2:
            return
        measured = np.array([fix.attitude.roll_deg, fix.attitude.pitch_deg])
        if bias is not None:
            measured = measured - (bias.roll_deg, bias.pitch_deg)
        noise_s2 = _DIFFERENCE_DEG**2 / square + self._jitter_s2
        gain = self._variance_s2 / (self._variance_s2 + noise_s2)
        lag_s = float(rates @ (measured - self._angles_deg[:2])) / square
        max_s = _MAX_SIGMAS * math.sqrt(self._first_s2)
        self._mean_s += gain * (min(max(lag_s, -max_s), max_s) - self._mean_s)
        self._variance_s2 *= 1.0 - gain

    def _follow(self, frame: Frame) -> None:
        """Take the next frame's attitude and compute its rates since the last frame."""
        known = (frame.roll_deg, frame.pitch_deg, frame.heading_deg)
        time_s = None if frame.timestamp_ns is None else frame.timestamp_ns * 1e-9
        last, last_s = self._angles_deg, self._time_s
        self._rates_dps = np.zeros(3)
        self._angles_deg = None if None in known else np.array(known, np.float64)
        self._time_s = time_s
        if time_s is None or last_s is None or last is None or self._angles_deg is None:
            return
        interval_s = time_s - last_s
        if 0.0 < interval_s <= _MAX_INTERVAL_S:
            self._variance_s2 = min(self._variance_s2 + _WALK_S**2 * interval_s, self._first_s2)
            steps = [math.remainder(float(step), 360.0) for step in self._angles_deg - last]
            self._rates_dps = np.array(steps) / interval_s
