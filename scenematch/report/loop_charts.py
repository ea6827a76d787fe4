"""Charts of a closed loop: the vehicle's distance from its plan, and the estimate it steered by."""

from __future__ import annotations

import numpy as np

from scenematch.report.charts import ChartArea, line
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.loop_record import LoopRecord, rms
from scenematch.report.page_charts import Chart
from scenematch.report.page_map import TrackMap, connected
from scenematch.report.verdict import metres

LOOP_LEGEND = [
    ("plan", '<path d="M0 7h22" class="line plan"/>'),
    ("estimate", '<path d="M0 7h22" class="line estimate"/>'),
]
"""Entries of the map's legend besides those of a track."""


def loop_sentence(loop: LoopRecord) -> str:
    """The verdict on the loop in one sentence."""
    off = loop.off_plan_m
    rms_m, estimate_m = rms(off), rms(loop.estimate_error_m[loop.settled])
    return (
        f"Closed loop: steered by the fixes, the vehicle was {metres(rms_m)} RMS and at most "
        f"{metres(float(off.max()))} from its plan, with an estimate that was {metres(estimate_m)} RMS off."
    )


def loop_marks(track_map: TrackMap, loop: LoopRecord) -> list[str]:
    """Plan and estimate as lines on the map."""
    plan, estimate = (connected(track_map, places[:, :2]) for places in (loop.plan_m, loop.estimate_m))
    return [line(estimate, "estimate"), line(plan, "plan")]


def draw_loop_charts(loop: LoopRecord, track: FinishedTrack) -> list[Chart]:
    """Distance from the plan, and the estimate's error with its sigma, on the time axis of the track's charts."""
    start_ns = track.rows[0].timestamp_ns
    if start_ns is None:
        return []
    time, limits = (loop.timestamp_ns - start_ns) / 1e9, track.time_limits
    settled = loop.settled  # the initial uncertainty would set the scale
    plan = ChartArea(limits, (0.0, 1.1 * max(0.1, float(loop.off_plan_m.max()))))
    top = 1.1 * max(0.1, float(loop.estimate_error_m[settled].max()), float(3.0 * loop.sigma_m[settled].max()))
    estimate = ChartArea(limits, (0.0, top))
    zero = np.zeros(len(time))
    inside = (time >= limits[0]) & (time <= limits[1])
    sick = np.where(loop.healthy, np.nan, top)
    estimate_marks = [
        estimate.band(time[inside], zero[inside], sick[inside], "unhealthy"),
        estimate.band(time[inside], zero[inside], 3.0 * loop.sigma_m[inside], "sigma-band"),
        estimate.line(time[inside], loop.estimate_error_m[inside], "estimate"),
    ]
    off = "Distance of the vehicle from its plan (m)"
    error = "Error of the estimate (m), on three of its sigmas; red: no recent fix"
    label = track.time_label
    return [
        (off, plan.svg(off, label, [plan.line(time[inside], loop.off_plan_m[inside], "plan")], timed=True)),
        (error, estimate.svg(error, label, estimate_marks, timed=True)),
    ]
