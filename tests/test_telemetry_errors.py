"""The calibration that a flight gives: attitude, its lag and the height, each within its own sigma."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from engine.navigator_options import NavigatorOptions
from engine.telemetry_errors import TelemetryErrors
from engine.values import Attitude, Fix, Frame, Timings, Window

IMAGE = np.zeros((4, 4), np.uint8)
GROUND_M, HEIGHT_M = 30.0, 150.0


def fix_of(attitude, up_m=GROUND_M + HEIGHT_M):
    return Fix(timestamp_ns=None, lat_deg=0.0, lon_deg=0.0, east_m=0.0, north_m=0.0, up_m=up_m,
               covariance_m2=np.eye(3), attitude=attitude, score=0.9, method="ncc", stage="refined",
               window=Window(0, 0, 1, 1), timings=Timings(), map_xy_px=(0.0, 0.0))  # fmt: skip


def flown(off_deg=(0.0, 0.0, 0.0), off_m=0.0, frames=40, seed=1, ground_m=GROUND_M):
    """What is learnt of a telemetry that reads too much by this."""
    errors, rng = TelemetryErrors(NavigatorOptions()), np.random.default_rng(seed)
    shown = None
    for k in range(frames):
        true = np.array([3.0 * math.sin(0.3 * k), 2.0 * math.cos(0.2 * k), (40.0 + k) % 360.0])
        told = true + off_deg
        roll, pitch, heading = told.tolist()
        frame = Frame(IMAGE, round(k * 2e8), HEIGHT_M + off_m, heading % 360.0, roll, pitch)
        shown = errors.corrected(frame, 0.2 * k, late=False)
        measured = true + rng.normal(0.0, 0.4, 3)
        errors.note(fix_of(Attitude(*measured), GROUND_M + HEIGHT_M + rng.normal(0.0, 0.5)), ground_m)
    return errors, shown


@pytest.mark.parametrize("seed", range(10))
def test_what_is_off_is_recovered_within_three_sigma(seed):
    errors, _ = flown((2.0, -1.5, 5.0), 10.0, seed=seed)
    found = errors.calibration
    for value, sigma, truth in zip(
        (found.attitude.roll_deg, found.attitude.pitch_deg, found.attitude.heading_deg),
        found.attitude.sigma_deg, (-2.0, 1.5, -5.0), strict=True,
    ):  # fmt: skip
        assert abs(value - truth) < 3.0 * sigma
    assert abs(found.height_m + 10.0) < 3.0 * found.height_sigma_m
    assert found.height_factor == pytest.approx(150.0 / 160.0, abs=0.01)


def test_the_attitude_is_corrected_and_the_height_is_not():
    """A height that contradicts the pictures stays a contradiction: the focal length may be what is wrong."""
    _, shown = flown((0.0, 0.0, 8.0), 20.0)
    assert math.remainder(shown.heading_deg - 79.0, 360.0) == pytest.approx(0.0, abs=0.6)
    assert shown.height_agl_m == HEIGHT_M + 20.0


def test_nothing_is_known_before_a_fix_nor_after_a_jump():
    errors = TelemetryErrors(NavigatorOptions())
    found = errors.calibration
    assert (found.attitude, found.height_m, found.height_factor, found.height_sigma_m) == (None, None, None, None)
    errors, _ = flown((0.0, 0.0, 8.0), 20.0)
    errors.forget()
    assert (errors.calibration.attitude, errors.calibration.height_m) == (None, None)


def test_over_ground_that_is_taken_for_flat_nothing_but_the_lag_is_learnt():
    errors, _ = flown((2.0, 2.0, 8.0), 20.0, ground_m=None)
    assert (errors.calibration.attitude, errors.calibration.height_m) == (None, None)


def test_a_late_frame_is_corrected_and_teaches_nothing():
    errors, _ = flown((0.0, 0.0, 8.0))
    before = errors.calibration
    late = replace(Frame(IMAGE, 0, HEIGHT_M, 48.0, 0.0, 0.0))
    shown = errors.corrected(late, 0.0, late=True)
    assert math.remainder(shown.heading_deg - 40.0, 360.0) == pytest.approx(0.0, abs=0.6)
    assert errors.calibration == before
