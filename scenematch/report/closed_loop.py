"""Report on a closed loop: figures of merit and its samples as a table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from engine.geo import Array, attitude_from_rotation
from engine.values import Fix
from scenematch.files.tables import cell_text, write_table
from scenematch.report.loop_record import SETTLING_S
from scenematch.simulator.loop import LoopResult, LoopSample, Mode
from scenematch.simulator.vehicle import START_NS

_COLUMNS = (
    "timestamp_ns", "mode", "healthy",
    "plan_east_m", "plan_north_m", "plan_up_m",
    "true_east_m", "true_north_m", "true_up_m",
    "east_m", "north_m", "up_m",
    "sigma_east_m", "sigma_north_m", "sigma_up_m",
    "true_roll_deg", "true_pitch_deg", "true_heading_deg",
    "roll_deg", "pitch_deg", "heading_deg",
)  # fmt: skip


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
    numbers += [
        true.roll_deg,
        true.pitch_deg,
        true.heading_deg,
        *attitude_from_rotation(row.estimate.enu_from_body),
    ]
    stamp = str(START_NS + round(row.time_s * 1e9))
    return [stamp, row.mode.value, cell_text(row.healthy, 0), *(cell_text(float(v), 3) for v in numbers)]


def summarise_loop(result: LoopResult) -> dict[str, Any]:
    """Figures of merit of a closed loop as JSON values.

    Returns:
        ``seconds``; ``handed_over``, whether the flight ended in a handover; ``plan_rms_m`` and ``plan_max_m``,
        the true track's horizontal distance from the planned position at each time; ``path_rms_m``, that from the
        nearest point of the path; ``height_rms_m``; ``estimate_rms_m`` and ``estimate_max_m``, the filter's
        horizontal error after its first 5 s; ``estimate_nees``, 2 if its covariance is consistent; ``frames``,
        ``fixes``, ``used`` and ``resets``; ``unhealthy_s`` and ``hold_s``.
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
        "plan_rms_m": _rms(off),
        "plan_max_m": float(off.max()),
        "path_rms_m": _rms(_off_path(result)),
        "height_rms_m": _rms(plan[:, 2]),
        "estimate_rms_m": _rms(wrong),
        "estimate_max_m": float(wrong.max()),
        "estimate_nees": float(nees.mean()),
        "frames": len(result.answers),
        "fixes": sum(isinstance(answer.result, Fix) for answer in result.answers),
        "used": len(result.used),
        "resets": result.resets,
        "unhealthy_s": 0.1 * sum(not row.healthy for row in result.record),
        "hold_s": 0.1 * sum(row.mode is Mode.HOLD for row in result.record),
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _off_path(result: LoopResult) -> Array:
    """(N,) horizontal distance in metres of true positions from the nearest point of the path."""
    path = np.array([row.plan_m[:2] for row in result.record])
    true = np.array([row.truth.position_m[:2] for row in result.record])
    steps, start = np.diff(path, axis=0), path[:-1]
    length2 = np.maximum((steps**2).sum(axis=1), 1e-12)
    nearest = []
    for position in true:
        fraction = np.clip(((position - start) * steps).sum(axis=1) / length2, 0.0, 1.0)
        nearest.append(np.hypot(*(start + fraction[:, None] * steps - position).T).min() if len(start) else 0.0)
    return np.array(nearest)
