"""Fixes for tests that need one, whatever it says."""

from __future__ import annotations

from typing import Any

import numpy as np

from engine import Fix, Timings, Window


def a_fix(east_m: float = 0.0, north_m: float = 0.0, sigma_m: float = 1.0, **stated: Any) -> Fix:
    """A fix by correlation, by default at the origin and good to a metre, but for what is stated."""
    usual = {
        "timestamp_ns": None, "lat_deg": 48.0, "lon_deg": 15.0, "east_m": east_m, "north_m": north_m, "up_m": None,
        "covariance_m2": sigma_m**2 * np.eye(3), "attitude": None, "score": 0.9, "method": "ncc",
        "window": Window(0, 0, 1, 1), "timings": Timings(), "map_xy_px": (0.0, 0.0),
    }  # fmt: skip
    return Fix(**(usual | stated))
