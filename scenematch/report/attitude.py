"""Check the telemetry's attitude against the fixes': time lag and offset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.geo import Array
from engine.values import Fix, Frame, NoFix

AttitudeRow = tuple[float, float, float, float, float]
"""Time in seconds; roll and pitch of the telemetry; roll and pitch of the fix, NaN where unknown; in degrees."""

_MAX_LAG_S = 0.5  # of the search
_LAG_STEP_S = 0.01
_MIN_FRAMES = 20
_MIN_MOTION_DEG = 0.7  # standard deviation of roll or pitch below which no lag can be estimated
_MAX_INTERVAL_S = 0.25  # between frames; over longer intervals the attitude is unknown


@dataclass(frozen=True, slots=True)
class AttitudeCheck:
    """Lag and offset of the telemetry's roll and pitch against those of the fixes.

    Attributes:
        frames: number of frames compared.
        lag_ms: age of the telemetry's attitude at the capture of its frame; None if the flight is too calm or its
            frames are too far apart.
        roll_offset_deg: median of telemetry minus fix at that lag.
        pitch_offset_deg: the same for pitch.
    """

    frames: int
    lag_ms: float | None
    roll_offset_deg: float
    pitch_offset_deg: float


def attitude_row(frame: Frame, result: Fix | NoFix) -> AttitudeRow | None:
    """The row of one frame; None if its telemetry lacks time, roll or pitch."""
    if frame.timestamp_ns is None or frame.roll_deg is None or frame.pitch_deg is None:
        return None
    attitude = result.attitude if isinstance(result, Fix) else None
    measured = (math.nan, math.nan) if attitude is None else (attitude.roll_deg, attitude.pitch_deg)
    return (frame.timestamp_ns * 1e-9, frame.roll_deg, frame.pitch_deg, *measured)


def check_attitude(rows: Sequence[AttitudeRow]) -> AttitudeCheck | None:
    """Compare roll and pitch of the telemetry with those of the fixes.

    Args:
        rows: of the frames, in the order of time.

    Returns:
        The result, or None if fewer than 20 frames have a measured attitude.
    """
    series = np.array(rows, dtype=np.float64).reshape(-1, 5)
    time_s, telemetry_deg, measured_deg = series[:, 0] - series[:1, 0], series[:, 1:3], series[:, 3:]
    known = np.isfinite(measured_deg[:, 0])
    if np.count_nonzero(known) < _MIN_FRAMES:
        return None
    lag_s = _lag_s(time_s, telemetry_deg, measured_deg, known)
    at_lag = _shifted(time_s, telemetry_deg, time_s[known], lag_s or 0.0)
    roll, pitch = np.median(at_lag - measured_deg[known], axis=0)
    lag_ms = None if lag_s is None else lag_s * 1e3
    return AttitudeCheck(int(np.count_nonzero(known)), lag_ms, float(roll), float(pitch))


def _shifted(time_s: Array, telemetry_deg: Array, at_s: Array, lag_s: float) -> Array:
    """(N, 2) telemetry angles in degrees, interpolated ``lag_s`` later than ``at_s``."""
    return np.stack([np.interp(at_s + lag_s, time_s, angle) for angle in telemetry_deg.T], axis=-1)


def _lag_s(time_s: Array, telemetry_deg: Array, measured_deg: Array, known: NDArray[np.bool_]) -> float | None:
    """The lag with the least variance of telemetry minus measured angles; None if there is none."""
    known = known & (time_s > time_s[0] + _MAX_LAG_S) & (time_s < time_s[-1] - _MAX_LAG_S)
    if np.count_nonzero(known) < _MIN_FRAMES or np.median(np.diff(time_s)) > _MAX_INTERVAL_S:
        return None
    measured_deg = measured_deg[known]
    if measured_deg.std(axis=0).max() < _MIN_MOTION_DEG:
        return None
    lags_s = np.arange(-_MAX_LAG_S, _MAX_LAG_S + _LAG_STEP_S / 2.0, _LAG_STEP_S)
    variance_deg2 = [
        np.var(_shifted(time_s, telemetry_deg, time_s[known], lag) - measured_deg, axis=0).sum() for lag in lags_s
    ]
    best = int(np.argmin(variance_deg2))
    if best in (0, len(lags_s) - 1):
        return None
    before, here, after = variance_deg2[best - 1 : best + 2]
    curvature = before - 2.0 * here + after
    return float(lags_s[best] + (0.5 * _LAG_STEP_S * (before - after) / curvature if curvature > 0 else 0.0))
