"""loop.csv: plan, truth and the filter's estimate of a closed loop ten times a second, and its figures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.geo import Array, attitude_from_rotation
from engine.values import Fix
from scenematch.files.tables import cell_text, read_table, write_table
from scenematch.simulator.loop import LoopResult, LoopSample, Mode
from scenematch.simulator.vehicle import START_NS

_PLACES = tuple(f"{what}{axis}_m" for what in ("plan_", "true_", "") for axis in ("east", "north", "up"))
_SIGMAS = ("sigma_east_m", "sigma_north_m")
_ANGLES = tuple(f"{what}{name}_deg" for what in ("true_", "") for name in ("roll", "pitch", "heading"))
_COLUMNS = ("timestamp_ns", "mode", "healthy", *_PLACES, *_SIGMAS, "sigma_up_m", *_ANGLES)
SETTLING_S = 5.0
"""Time after which the initial error has decayed."""


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
    stamps_ns = np.array([row.integer("timestamp_ns") or 0 for row in rows], np.int64)
    places = np.array([[row.required(name) for name in _PLACES] for row in rows], np.float64).reshape(-1, 3, 3)
    sigma_m = np.array([max(map(row.required, _SIGMAS)) for row in rows], np.float64)
    healthy = np.array([row.text("healthy") == "true" for row in rows], np.bool_)
    return LoopRecord(stamps_ns, places[:, 0], places[:, 1], places[:, 2], sigma_m, healthy)


def write_loop_csv(path: Path, result: LoopResult) -> None:
    """Write loop.csv: plan, truth and estimate at 10 Hz, in metres of the map's origin.

    Raises:
        TelemetryError: the file cannot be written.
    """
    write_table(path, _COLUMNS, (_cells(row) for row in result.record))


def _cells(row: LoopSample) -> list[str]:
    sigmas = np.sqrt(np.diag(row.estimate.covariance)[:3])
    true = row.truth.attitude
    numbers = [*row.plan_m, *row.truth.position_m, *row.estimate.position_m, *sigmas]
    numbers += [true.roll_deg, true.pitch_deg, true.heading_deg]
    numbers += attitude_from_rotation(row.estimate.enu_from_body)
    stamp = str(START_NS + round(row.time_s * 1e9))
    return [stamp, row.mode.value, cell_text(row.healthy, 0), *(cell_text(float(v), 3) for v in numbers)]


def summarise_loop(result: LoopResult) -> dict[str, Any]:
    """Figures of merit of a closed loop as JSON values.

    Returns:
        ``seconds``; ``handed_over``, whether the flight ended in a handover; ``plan_rms_m`` and ``plan_max_m``,
        the true track's horizontal distance from the planned position at each time; ``height_rms_m``;
        ``estimate_rms_m`` and ``estimate_max_m``, the filter's horizontal error after its first 5 s;
        ``estimate_nees``, 2 if its covariance is consistent; ``frames``, ``fixes``, ``used`` and ``resets``;
        ``unhealthy_s`` and ``hold_s``.
    """
    plan, estimate = result.plan_error_m, result.estimate_error_m
    settled = [k for k, row in enumerate(result.record) if row.time_s >= SETTLING_S] or [len(result.record) - 1]
    covariance = np.array([result.record[k].estimate.covariance[:2, :2] for k in settled])
    flat = estimate[settled][:, :2]
    nees = np.einsum("ni,nij,nj->n", flat, np.linalg.inv(covariance), flat)
    off, wrong = np.hypot(*plan[:, :2].T), np.hypot(*flat.T)
    return {
        "seconds": round(result.record[-1].time_s, 2),
        "handed_over": result.record[-1].mode is Mode.HANDED_OVER,
        "plan_rms_m": rms(off),
        "plan_max_m": float(off.max()),
        "height_rms_m": rms(plan[:, 2]),
        "estimate_rms_m": rms(wrong),
        "estimate_max_m": float(wrong.max()),
        "estimate_nees": float(nees.mean()),
        "frames": len(result.answers),
        "fixes": sum(isinstance(answer.result, Fix) for answer in result.answers),
        "used": len(result.used),
        "resets": result.resets,
        "unhealthy_s": 0.1 * sum(not row.healthy for row in result.record),
        "hold_s": 0.1 * sum(row.mode is Mode.HOLD for row in result.record),
    }


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))
