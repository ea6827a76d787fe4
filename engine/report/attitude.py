"""The telemetry's attitude against that in the pictures: how late it is stamped, and how far it is off."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.values import Fix, Frame, NoFix

Array = NDArray[np.float64]
AttitudeRow = tuple[float, float, float, float, float]
"""Seconds; roll and pitch as told; roll and pitch as measured, NaN where they were not. All in degrees."""

_REACH_S = 0.5  # lags up to this are looked for
_STEP_S = 0.01
_MIN_FRAMES = 20
_MIN_MOTION_DEG = 0.7  # deviation of roll or pitch below which a flight says nothing of a lag
_MAX_INTERVAL_S = 0.25  # between frames; with longer ones the attitude in between is not known


@dataclass(frozen=True, slots=True)
class AttitudeCheck:
    """What the fixes of a flight say of its telemetry's roll and pitch.

    Attributes:
        frames: that were compared.
        lag_ms: by how much the telemetry's attitude is older than the frame that it came with; None where the
            flight is too calm or its frames too far apart to say.
        roll_offset_deg: telemetry less pictures, the median, at that lag.
        pitch_offset_deg: the same of pitch.
    """

    frames: int
    lag_ms: float | None
    roll_offset_deg: float
    pitch_offset_deg: float


def attitude_row(frame: Frame, result: Fix | NoFix) -> AttitudeRow | None:
    """What one frame contributes; None where its telemetry says nothing of its time, roll or pitch."""
    if frame.timestamp_ns is None or frame.roll_deg is None or frame.pitch_deg is None:
        return None
    attitude = result.attitude if isinstance(result, Fix) else None
    measured = (math.nan, math.nan) if attitude is None else (attitude.roll_deg, attitude.pitch_deg)
    return (frame.timestamp_ns * 1e-9, frame.roll_deg, frame.pitch_deg, *measured)


def check_attitude(rows: Sequence[AttitudeRow]) -> AttitudeCheck | None:
    """Compare roll and pitch of a flight's telemetry with those of its fixes; None where too few were measured.

    Args:
        rows: of its frames, in the order of time.
    """
    series = np.array(rows, dtype=np.float64).reshape(-1, 5)
    time_s, told, measured_deg = series[:, 0] - series[:1, 0], series[:, 1:3], series[:, 3:]
    known = np.isfinite(measured_deg[:, 0])
    if np.count_nonzero(known) < _MIN_FRAMES:
        return None
    lag_s = _lag_s(time_s, told, measured_deg, known)
    at_lag = _shifted(time_s, told, time_s[known], lag_s or 0.0)
    roll, pitch = np.median(at_lag - measured_deg[known], axis=0)
    lag_ms = None if lag_s is None else lag_s * 1e3
    return AttitudeCheck(int(np.count_nonzero(known)), lag_ms, float(roll), float(pitch))


def _shifted(time_s: Array, told_deg: Array, at_s: Array, lag_s: float) -> Array:
    """The told angles (N, 2) as they would have been, had they come so much earlier."""
    return np.stack([np.interp(at_s + lag_s, time_s, angle) for angle in told_deg.T], axis=-1)


def _lag_s(time_s: Array, told_deg: Array, measured_deg: Array, known: NDArray[np.bool_]) -> float | None:
    """The lag at which told and measured angles differ least, but for an offset; None where none is found."""
    known = known & (time_s > time_s[0] + _REACH_S) & (time_s < time_s[-1] - _REACH_S)
    if np.count_nonzero(known) < _MIN_FRAMES or np.median(np.diff(time_s)) > _MAX_INTERVAL_S:
        return None
    measured_deg = measured_deg[known]
    if measured_deg.std(axis=0).max() < _MIN_MOTION_DEG:
        return None
    lags_s = np.arange(-_REACH_S, _REACH_S + _STEP_S / 2.0, _STEP_S)
    spread = [
        np.var(_shifted(time_s, told_deg, time_s[known], lag) - measured_deg, axis=0).sum() for lag in lags_s
    ]
    best = int(np.argmin(spread))
    if best in (0, len(lags_s) - 1):
        return None
    before, here, after = spread[best - 1 : best + 2]
    bend = before - 2.0 * here + after
    return float(lags_s[best] + (0.5 * _STEP_S * (before - after) / bend if bend > 0 else 0.0))
