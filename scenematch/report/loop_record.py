"""Read loop.csv: plan, truth and the filter's estimate of a closed loop, ten times a second."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.geo import Array
from scenematch.files.tables import read_table
from scenematch.simulator.vehicle import START_NS

_PLACES = tuple(f"{what}{axis}_m" for what in ("plan_", "true_", "") for axis in ("east", "north", "up"))
SETTLING_S = 5.0
"""Time after which the initial error has decayed."""
_SIGMAS = ("sigma_east_m", "sigma_north_m")


@dataclass(frozen=True, slots=True)
class LoopRecord:
    """Samples of a closed loop, in metres of the map's origin.

    Attributes:
        timestamp_ns: (N,) of each sample.
        plan_m: (N, 3) where the vehicle should be, east, north and up.
        true_m: (N, 3) where it is.
        estimate_m: (N, 3) where the filter estimates it to be.
        sigma_m: (N,) the larger sigma of the estimate, east or north.
        healthy: (N,) whether the engine's last fix was recent.
    """

    timestamp_ns: NDArray[np.int64]
    plan_m: Array
    true_m: Array
    estimate_m: Array
    sigma_m: Array
    healthy: NDArray[np.bool_]

    @property
    def settled(self) -> NDArray[np.bool_]:
        """(N,) whether the initial error has decayed; the last sample of a shorter flight."""
        settled = self.timestamp_ns >= START_NS + round(SETTLING_S * 1e9)
        if not settled.any():
            settled[-1:] = True
        return np.asarray(settled, np.bool_)

    @property
    def off_plan_m(self) -> Array:
        """(N,) horizontal distance of the vehicle from its plan."""
        return np.asarray(np.hypot(*(self.true_m - self.plan_m)[:, :2].T), np.float64)

    @property
    def estimate_error_m(self) -> Array:
        """(N,) horizontal error of the estimate."""
        return np.asarray(np.hypot(*(self.estimate_m - self.true_m)[:, :2].T), np.float64)


def read_loop_csv(path: Path) -> LoopRecord:
    """Read loop.csv.

    Raises:
        TelemetryError: the file cannot be read, or a cell is not what its column holds.
    """
    rows = list(read_table(path, ("timestamp_ns", "healthy", *_PLACES, *_SIGMAS)))
    places = np.array([[row.required(name) for name in _PLACES] for row in rows], np.float64).reshape(-1, 3, 3)
    sigmas = np.array([[row.required(name) for name in _SIGMAS] for row in rows], np.float64).reshape(-1, 2)
    return LoopRecord(
        np.array([row.stamp() for row in rows], np.int64),
        places[:, 0],
        places[:, 1],
        places[:, 2],
        sigmas.max(axis=1, initial=0.0),
        np.array([row.text("healthy") == "true" for row in rows], np.bool_),
    )
