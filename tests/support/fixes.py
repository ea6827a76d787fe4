"""Fixes for tests that need one, whatever it says, and what is asked of one."""

from typing import Any

import numpy as np

from engine import Fix, NoFix, Timings, Window


def a_fix(east_m: float = 0.0, north_m: float = 0.0, sigma_m: float = 1.0, **stated: Any) -> Fix:
    """A fix by correlation, by default at the origin and good to a metre, but for what is stated."""
    usual = {
        "timestamp_ns": None, "lat_deg": 48.0, "lon_deg": 15.0, "east_m": east_m, "north_m": north_m, "up_m": None,
        "covariance_m2": sigma_m**2 * np.eye(3), "attitude": None, "score": 0.9, "method": "ncc",
        "window": Window(0, 0, 1, 1), "timings": Timings(), "map_xy_px": (0.0, 0.0),
    }  # fmt: skip
    return Fix(**(usual | stated))


def px_off(fix: Fix | NoFix, nadir_px: Any) -> float:
    """How many map pixels a fix lies off the place that its frame was taken above."""
    assert isinstance(fix, Fix), fix
    return float(np.hypot(*(np.array(fix.map_xy_px) - nadir_px)))


def values_of(result: Fix | NoFix) -> tuple[Any, ...]:
    """Everything in an answer that does not tell the time."""
    if isinstance(result, NoFix):
        return result.timestamp_ns, result.reason, result.detail, result.score, result.window, result.method
    place = (result.lat_deg, result.lon_deg, result.up_m, result.map_xy_px, result.covariance_m2.tolist())
    return result.timestamp_ns, *place, result.score, result.window, result.stage, result.confidence
