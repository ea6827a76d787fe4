"""Camera delay behind the attitude, from the turn of the optical axis between images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError
from engine.geo import enu_from_body
from engine.navigation.odometry import picture_shift

Array = NDArray[np.float64]

_STEP_S = 0.002
_MIN_PICTURES = 30
_MIN_CORRELATION = 0.8
_MIN_TURN_DEG = 0.2  # root mean square, between pictures


@dataclass(frozen=True, slots=True)
class Lag:
    """A delay, and how well the turns of pictures and attitude then agree, up to 1."""

    delay_s: float
    correlation: float


def turn_between(first: NDArray[np.uint8], second: NDArray[np.uint8], focal_px: float) -> float:
    """Angle by which the optical axis turned, measured by the shift between two pictures.

    Args:
        first: (H, W) grey.
        second: (H, W) grey.
        focal_px: of the camera at this size.

    Returns:
        Radians.
    """
    return math.atan2(math.hypot(*picture_shift(first, second)), focal_px)


def camera_lag(times_s: Array, turns_rad: Array, attitude: Array, mount: Array, max_lag_s: float = 0.6) -> Lag:
    """The delay at which the turns of pictures and vehicle agree best.

    Args:
        times_s: (N,) arrival times of the pictures.
        turns_rad: (N - 1,) from each to the next.
        attitude: (M, 4) time in seconds, roll, pitch and heading in degrees, on the same clock.
        mount: (3, 3) of the camera on the vehicle.
        max_lag_s: largest delay to try.

    Returns:
        Lag: the delay with the best agreement.

    Raises:
        TelemetryError: too few pictures, too little movement, or pictures and attitude do not agree.
    """
    if len(times_s) < _MIN_PICTURES or len(attitude) < _MIN_PICTURES:
        counts = f"{len(times_s)} and {len(attitude)}"
        raise TelemetryError(f"pictures: expected {_MIN_PICTURES} or more and as many attitudes, got {counts}")
    axes = np.array([enu_from_body(*row[1:]) @ mount[:, 2] for row in attitude])
    lags_s = np.arange(0.0, max_lag_s, _STEP_S)
    known = (times_s[:-1] - max_lag_s > attitude[0, 0]) & (times_s[1:] < attitude[-1, 0])
    if known.sum() < _MIN_PICTURES or np.sqrt(np.mean(turns_rad[known] ** 2)) < math.radians(_MIN_TURN_DEG):
        raise TelemetryError("pictures: expected the vehicle to be tilted to and fro, got too little movement")
    found = [_correlation(times_s - lag_s, turns_rad, attitude[:, 0], axes, known) for lag_s in lags_s]
    best = int(np.argmax(found))
    if found[best] < _MIN_CORRELATION:
        raise TelemetryError(
            f"pictures: expected turns as the attitude's by {_MIN_CORRELATION:g}, got {found[best]:.2f}"
        )
    return Lag(float(lags_s[best]), found[best])


def _correlation(times_s: Array, turns: Array, known_s: Array, axes: Array, known: NDArray[np.bool_]) -> float:
    """Correlation of the turns of the pictures with those of the axis between their times."""
    at = np.column_stack([np.interp(times_s, known_s, column) for column in axes.T])
    at /= np.linalg.norm(at, axis=1, keepdims=True)
    expected = np.arccos(np.clip(np.sum(at[1:] * at[:-1], axis=1), -1.0, 1.0))
    return float(np.nan_to_num(np.corrcoef(expected[known], turns[known])[0, 1]))
