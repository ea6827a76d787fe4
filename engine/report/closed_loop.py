"""What a closed loop was like: its figures, its record as a table, and plots of plan, truth and estimate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.formats.telemetry import cell_text, write_table
from engine.geo import attitude_from_rotation
from engine.report.figures import DPI, FIX, GRID, REFUSED, TRUTH
from engine.sim.faults import Fault
from engine.sim.loop import LoopResult, LoopSample, Mode
from engine.sim.vehicle import START_NS
from engine.values import Fix

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
_SETTLED_S = 5.0  # after which the start's error is gone


def write_record(path: Path, flown: LoopResult) -> None:
    """Write loop.csv: plan, truth and estimate ten times a second, metres about the map's origin.

    Raises:
        TelemetryError: the file cannot be written.
    """
    write_table(path, _COLUMNS, (_cells(row) for row in flown.record))


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


def summarise_loop(flown: LoopResult) -> dict[str, Any]:
    """Figures of merit of a closed loop, as JSON can hold them.

    Returns:
        ``seconds``; ``handed_over``, whether the flight ended that way; ``plan_rms_m`` and ``plan_max_m``, the
        true track's horizontal distance from where it should be at each moment; ``path_rms_m``, that from the
        nearest place of the path; ``height_rms_m``; ``estimate_rms_m`` and ``estimate_max_m``, the filter's
        horizontal error after its first 5 s; ``estimate_nees``, 2 where its covariance is honest; ``frames``,
        ``fixes``, ``used`` and ``resets``; ``unhealthy_s`` and ``hold_s``.
    """
    plan, estimate = flown.plan_error_m, flown.estimate_error_m
    settled = [k for k, row in enumerate(flown.record) if row.time_s >= _SETTLED_S] or [len(flown.record) - 1]
    covariance = np.array([flown.record[k].estimate.covariance[:2, :2] for k in settled])
    flat = estimate[settled][:, :2]
    nees = np.einsum("ni,nij,nj->n", flat, np.linalg.inv(covariance), flat)
    off, wrong = np.hypot(*plan[:, :2].T), np.hypot(*flat.T)
    return {
        "seconds": round(flown.record[-1].time_s, 2),
        "handed_over": flown.record[-1].mode is Mode.HANDED_OVER,
        "plan_rms_m": _rms(off),
        "plan_max_m": float(off.max()),
        "path_rms_m": _rms(_off_path(flown)),
        "height_rms_m": _rms(plan[:, 2]),
        "estimate_rms_m": _rms(wrong),
        "estimate_max_m": float(wrong.max()),
        "estimate_nees": float(nees.mean()),
        "frames": len(flown.answers),
        "fixes": sum(isinstance(answer.result, Fix) for answer in flown.answers),
        "used": len(flown.used),
        "resets": flown.resets,
        "unhealthy_s": 0.1 * sum(not row.healthy for row in flown.record),
        "hold_s": 0.1 * sum(row.mode is Mode.HOLD for row in flown.record),
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _off_path(flown: LoopResult) -> Array:
    """(N,) horizontal distance of the true places from the nearest place of the path."""
    path = np.array([row.plan_m[:2] for row in flown.record])
    true = np.array([row.truth.position_m[:2] for row in flown.record])
    ahead, start = np.diff(path, axis=0), path[:-1]
    length2 = np.maximum((ahead**2).sum(axis=1), 1e-12)
    nearest = []
    for place in true:
        share = np.clip(((place - start) * ahead).sum(axis=1) / length2, 0.0, 1.0)
        nearest.append(np.hypot(*(start + share[:, None] * ahead - place).T).min() if len(start) else 0.0)
    return np.array(nearest)


def draw_loop(directory: Path, flown: LoopResult, title: str, fault: Fault | None = None) -> list[Path]:
    """Draw loop-path.png (plan, truth and estimate from above) and loop.png (errors and health over time).

    Args:
        directory: where the files go.
        flown: the flight.
        title: heading of both.
        fault: is shaded where it acts.

    Returns:
        The files that were written.
    """
    figures = {"loop-path.png": _path(flown, title), "loop.png": _in_time(flown, title, fault or Fault())}
    for name, figure in figures.items():
        figure.savefig(directory / name, dpi=DPI, facecolor="white")
    return [directory / name for name in figures]


def _axes(figure: Any, *shape: int, **how: Any) -> list[Any]:
    axes = list(np.atleast_1d(figure.subplots(*shape, **how)))
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(True, color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
        ax.tick_params(labelsize=9)
    return axes


def _path(flown: LoopResult, title: str) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 7.0), layout="constrained")
    (ax,) = _axes(figure)
    plan = np.array([row.plan_m for row in flown.record])
    true = np.array([row.truth.position_m for row in flown.record])
    estimate = np.array([row.estimate.position_m for row in flown.record])
    ax.plot(plan[:, 0], plan[:, 1], color=PLAN, linewidth=5.0, alpha=0.35, label="plan")
    ax.plot(true[:, 0], true[:, 1], color=TRUTH, linewidth=1.3, label="truth")
    ax.plot(estimate[:, 0], estimate[:, 1], color=FIX, linewidth=1.0, linestyle=(0, (4, 2)), label="estimate")
    held = np.array([row.mode is not Mode.FOLLOW for row in flown.record])
    ax.plot(true[held, 0], true[held, 1], ".", color=REFUSED, markersize=3, label="truth while it holds")
    ax.set(aspect="equal", xlabel="east (m)", ylabel="north (m)")
    ax.set_title(title, fontsize=10.5, loc="left")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _in_time(flown: LoopResult, title: str, fault: Fault) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    plan, estimate, health = _axes(figure, 3, 1, sharex=True, height_ratios=[3, 3, 1.1])
    time = np.array([row.time_s for row in flown.record])
    sigma = np.array([row.estimate.sigma_m for row in flown.record])
    plan.plot(time, np.hypot(*flown.plan_error_m[:, :2].T), color=TRUTH, linewidth=1.1)
    plan.set_ylabel("truth from plan (m)")
    estimate.fill_between(time, 0.0, 3.0 * sigma, color=FIX, alpha=0.18, linewidth=0, label="3 σ as believed")
    estimate.plot(time, np.hypot(*flown.estimate_error_m[:, :2].T), color=FIX, linewidth=1.1, label="error")
    estimate.set_ylabel("estimate's error (m)")
    estimate.legend(frameon=False, fontsize=9, loc="upper right")
    late = time > _SETTLED_S
    if late.any():  # the start's uncertainty would dwarf the rest
        errors = np.hypot(*flown.estimate_error_m[:, :2].T)
        estimate.set_ylim(0.0, max(1.5, 1.1 * float(max((3.0 * sigma)[late].max(), errors[late].max()))))
    _draw_health(health, flown, time)
    if fault.kind != "none":
        end_s = min(fault.start_s + fault.duration_s, float(time[-1]))
        for ax in (plan, estimate, health):
            ax.axvspan(fault.start_s, end_s, color=REFUSED, alpha=0.1, linewidth=0)
    plan.set_ylim(bottom=0.0)
    plan.set_title(title, fontsize=10.5, loc="left")
    return figure


def _draw_health(ax: Any, flown: LoopResult, time: Array) -> None:
    """Fixes that were taken in, refusals, ill health and holding, one line each."""
    used = set(flown.used)
    taken = [answer.truth.time_s for answer in flown.answers if answer.timestamp_ns in used]
    others = [answer.truth.time_s for answer in flown.answers if answer.timestamp_ns not in used]
    lines = (
        (3, "fix used", taken, FIX),
        (2, "refused or not used", others, REFUSED),
        (1, "unhealthy", [t for t, row in zip(time, flown.record, strict=True) if not row.healthy], REFUSED),
        (0, "holds", [t for t, row in zip(time, flown.record, strict=True) if row.mode is Mode.HOLD], TRUTH),
    )
    for level, _, moments, colour in lines:
        ax.plot(moments, np.full(len(moments), level), "|", color=colour, markersize=7)
    ax.set_yticks([level for level, *_ in lines], [name for _, name, *_ in lines])
    ax.set(ylim=(-0.6, 3.6), xlabel="time (s)")
