"""Velocities from another odometry: whether to use them, and their accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from engine.assumed_errors import AssumedErrors

# Odometry often states too small covariances; beyond the maximum it is lost.
_MIN_SIGMA_MPS, _MAX_SIGMA_MPS = 0.1, 5.0
_MAX_SPEED_MPS = 150.0


def velocity_sigma_mps(velocity_mps: ArrayLike, variances_m2ps2: Sequence[float], *, turned: bool) -> float | None:
    """One standard deviation per axis of a velocity, or 0 if it is not stated.

    Args:
        velocity_mps: (3,) along any axes.
        variances_m2ps2: (3,) along the same; not stated if one is not finite or none is above 0.
        turned: whether it was rotated to east and north by the vehicle's heading, which adds an error.

    Returns:
        None if the velocity is unusable: not finite, absurdly large, or of unbounded variance.
    """
    speed_mps = float(np.linalg.norm(np.asarray(velocity_mps, np.float64)))
    # Comparisons with NaN are false.
    if not speed_mps <= _MAX_SPEED_MPS or any(variance > _MAX_SIGMA_MPS**2 for variance in variances_m2ps2):
        return None
    if not all(math.isfinite(variance) for variance in variances_m2ps2) or max(variances_m2ps2) <= 0.0:
        return 0.0
    turned_mps = math.radians(AssumedErrors().heading_deg) * speed_mps if turned else 0.0
    return max(math.hypot(math.sqrt(max(variances_m2ps2)), turned_mps), _MIN_SIGMA_MPS)
