"""Report on a closed loop: figures of merit, its samples as a table, and plots of plan, truth and estimate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.geo import attitude_from_rotation
from engine.values import Fix
from scenematch.files.tables import cell_text, write_table
from scenematch.report.figures import DPI, FIX, GRID, REFUSED, TRUTH
from scenematch.report.loop_record import SETTLING_S
from scenematch.simulator.faults import Fault
from scenematch.simulator.loop import LoopResult, LoopSample, Mode
from scenematch.simulator.vehicle import START_NS

Array = NDArray[np.float64]

PLAN = "#009E73"
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
        ``seconds``; ``handed_over``, whether the flight ended that way; ``plan_rms_m`` and ``plan_max_m``, the
        true track's horizontal distance from the planned position at each time; ``path_rms_m``, that from the
        nearest point of the path; ``height_rms_m``; ``estimate_rms_m`` and ``estimate_max_m``, the filter's
        horizontal error after its first 5 s; ``estimate_nees``, 2 where its covariance is consistent; ``frames``,
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


def draw_loop(directory: Path, result: LoopResult, title: str, fault: Fault | None = None) -> list[Path]:
    """Draw loop-path.png (plan, truth and estimate from above) and loop.png (errors and health over time).

    Args:
        directory: folder of the files.
        result: the flight.
        title: heading of both.
        fault: shaded while it acts.

    Returns:
        Paths of the written files.
    """
    figures = {"loop-path.png": _path(result, title), "loop.png": _in_time(result, title, fault or Fault())}
    for name, figure in figures.items():
        figure.savefig(directory / name, dpi=DPI, facecolor="white")
    return [directory / name for name in figures]


def _axes(figure: Any, *shape: int, **options: Any) -> list[Any]:
    axes = list(np.atleast_1d(figure.subplots(*shape, **options)))
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(True, color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
        ax.tick_params(labelsize=9)
    return axes


def _path(result: LoopResult, title: str) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 7.0), layout="constrained")
    (ax,) = _axes(figure)
    plan = np.array([row.plan_m for row in result.record])
    true = np.array([row.truth.position_m for row in result.record])
    estimate = np.array([row.estimate.position_m for row in result.record])
    ax.plot(plan[:, 0], plan[:, 1], color=PLAN, linewidth=5.0, alpha=0.35, label="plan")
    ax.plot(true[:, 0], true[:, 1], color=TRUTH, linewidth=1.3, label="truth")
    ax.plot(estimate[:, 0], estimate[:, 1], color=FIX, linewidth=1.0, linestyle=(0, (4, 2)), label="estimate")
    holding = np.array([row.mode is not Mode.FOLLOW for row in result.record])
    ax.plot(true[holding, 0], true[holding, 1], ".", color=REFUSED, markersize=3, label="truth while it holds")
    ax.set(aspect="equal", xlabel="east (m)", ylabel="north (m)")
    ax.set_title(title, fontsize=10.5, loc="left")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _in_time(result: LoopResult, title: str, fault: Fault) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    plan, estimate, health = _axes(figure, 3, 1, sharex=True, height_ratios=[3, 3, 1.1])
    time = np.array([row.time_s for row in result.record])
    sigma = np.array([row.estimate.sigma_m for row in result.record])
    plan.plot(time, np.hypot(*result.plan_error_m[:, :2].T), color=TRUTH, linewidth=1.1)
    plan.set_ylabel("truth from plan (m)")
    estimate.fill_between(time, 0.0, 3.0 * sigma, color=FIX, alpha=0.18, linewidth=0, label="3 σ of the estimate")
    estimate.plot(time, np.hypot(*result.estimate_error_m[:, :2].T), color=FIX, linewidth=1.1, label="error")
    estimate.set_ylabel("estimate's error (m)")
    estimate.legend(frameon=False, fontsize=9, loc="upper right")
    late = time > SETTLING_S
    if late.any():  # the initial uncertainty would dominate the scale
        errors = np.hypot(*result.estimate_error_m[:, :2].T)
        estimate.set_ylim(0.0, max(1.5, 1.1 * float(max((3.0 * sigma)[late].max(), errors[late].max()))))
    _draw_health(health, result, time)
    if fault.kind != "none":
        end_s = min(fault.start_s + fault.duration_s, float(time[-1]))
        for ax in (plan, estimate, health):
            ax.axvspan(fault.start_s, end_s, color=REFUSED, alpha=0.1, linewidth=0)
    plan.set_ylim(bottom=0.0)
    plan.set_title(title, fontsize=10.5, loc="left")
    return figure


def _draw_health(ax: Any, result: LoopResult, time: Array) -> None:
    """Draw used fixes, refusals, unhealthy times and holding, one row each."""
    used = set(result.used)
    used_s = [answer.truth.time_s for answer in result.answers if answer.timestamp_ns in used]
    others_s = [answer.truth.time_s for answer in result.answers if answer.timestamp_ns not in used]
    lines = (
        (3, "fix used", used_s, FIX),
        (2, "refused or not used", others_s, REFUSED),
        (1, "unhealthy", [t for t, row in zip(time, result.record, strict=True) if not row.healthy], REFUSED),
        (0, "holds", [t for t, row in zip(time, result.record, strict=True) if row.mode is Mode.HOLD], TRUTH),
    )
    for level, _, times_s, colour in lines:
        ax.plot(times_s, np.full(len(times_s), level), "|", color=colour, markersize=7)
    ax.set_yticks([level for level, *_ in lines], [name for _, name, *_ in lines])
    ax.set(ylim=(-0.6, 3.6), xlabel="time (s)")
