"""Fixes against the telemetry's velocity by a plain loop, and what that is blind to."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from engine.geo import LocalFrame
from scenematch.files.telemetry import TelemetryRow
from scenematch.files.track import TrackRow
from scenematch.report.segments import motion_consistency

FRAME = LocalFrame(48.2, 16.3)
STEP_S = 0.5


def flown(noise_m=0.4, count=60, seed=4, offset_m=(0.0, 0.0)):
    """A turn with velocities that a trapezoid integrates exactly, fixes with known errors, and some refusals."""
    rng = np.random.default_rng(seed)
    velocity = np.array([[8.0 - 0.1 * k, 0.2 * k] for k in range(count)])
    way = np.vstack([np.zeros(2), np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * STEP_S, axis=0)])
    error = rng.normal(0.0, noise_m, (count, 2))
    lat, lon = FRAME.geodetic_from_enu(*(way + error + offset_m).T)
    rows, telemetry = [], []
    for k in range(count):
        stamp_ns = 10**18 + round(k * STEP_S * 1e9)
        fixed = k % 7 != 3
        place = {"lat_deg": float(lat[k]), "lon_deg": float(lon[k])} if fixed else {}
        rows.append(TrackRow(timestamp_ns=stamp_ns, frame=str(k), status="fix" if fixed else "no_fix", **place))
        east, north = velocity[k]
        telemetry.append(
            TelemetryRow(timestamp_ns=stamp_ns, frame=str(k), east_velocity_mps=east, north_velocity_mps=north)
        )
    return rows, telemetry, error


def test_steps_are_off_by_what_the_errors_of_their_ends_differ():
    rows, telemetry, error = flown()
    found = motion_consistency(rows, telemetry, FRAME)
    fixed = [k for k, row in enumerate(rows) if row.fixed]
    off_m = [math.dist(error[a], error[b]) for a, b in pairwise(fixed)]
    assert (found["steps"], found["interval_s"]) == (len(off_m), STEP_S)
    assert found["median_m"] == pytest.approx(np.median(off_m), abs=1e-4)
    assert found["p95_m"] == pytest.approx(np.percentile(off_m, 95), abs=1e-4)
    assert found["max_m"] == pytest.approx(max(off_m), abs=1e-4)


def test_an_offset_that_stays_does_not_show():
    rows, telemetry, _ = flown(noise_m=0.0, offset_m=(30.0, -20.0))
    assert motion_consistency(rows, telemetry, FRAME)["max_m"] < 1e-3


def test_steps_without_a_velocity_or_too_long_do_not_count():
    rows, telemetry, _ = flown(count=20)
    before = motion_consistency(rows, telemetry, FRAME)["steps"]
    gap = [replace(row, east_velocity_mps=None) if row.frame == "3" else row for row in telemetry]
    assert motion_consistency(rows, gap, FRAME)["steps"] == before - 1  # frame 3 was refused: one step spans it
    refused = [TrackRow(timestamp_ns=row.timestamp_ns, frame=row.frame, status="no_fix") for row in rows[4:15]]
    assert motion_consistency([*rows[:4], *refused, *rows[15:]], telemetry, FRAME)["steps"] == 2 + 3
    bare = [TelemetryRow(timestamp_ns=row.timestamp_ns, frame=row.frame) for row in telemetry]
    for stated in (None, [], bare, telemetry[:-1]):
        assert motion_consistency(rows, stated, FRAME) is None
    assert motion_consistency([*refused, *refused][:1], telemetry[4:5], FRAME) is None
