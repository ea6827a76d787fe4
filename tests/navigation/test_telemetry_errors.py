"""The calibration that a flight gives: attitude, its lag and the height, each within its own sigma."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from engine import Navigator, Prior, SceneMatcher
from engine.navigation.telemetry_errors import TelemetryErrors
from engine.options import NavigatorOptions
from engine.values import Attitude, Fix, Frame
from scenematch.simulator import plan_flight
from tests.support.fixes import a_fix
from tests.support.towns import drawn_town

IMAGE = np.zeros((4, 4), np.uint8)
GROUND_M, HEIGHT_M = 30.0, 150.0


def fix_of(attitude, up_m=GROUND_M + HEIGHT_M):
    return a_fix(up_m=up_m, attitude=attitude, stage="refined")


def flown(off_deg=(0.0, 0.0, 0.0), off_m=0.0, frames=40, seed=1, ground_m=GROUND_M):
    """What is learnt of a telemetry that reads too much by this."""
    errors, rng = TelemetryErrors(NavigatorOptions()), np.random.default_rng(seed)
    shown = None
    for k in range(frames):
        true = np.array([3.0 * math.sin(0.3 * k), 2.0 * math.cos(0.2 * k), (40.0 + k) % 360.0])
        stated = true + off_deg
        roll, pitch, heading = stated.tolist()
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


def test_attitude_and_height_are_corrected_and_the_height_says_by_how_much():
    """A height that contradicts the pictures stays a contradiction: the focal length may be what is wrong."""
    _, shown = flown((0.0, 0.0, 8.0), 20.0)
    assert math.remainder(shown.heading_deg - 79.0, 360.0) == pytest.approx(0.0, abs=0.6)
    assert shown.height_agl_m == pytest.approx(HEIGHT_M, abs=1.0)
    assert shown.height_agl_m - shown.height_correction_m == pytest.approx(HEIGHT_M + 20.0)


def test_an_error_of_the_height_that_a_match_bears_is_left():
    _, shown = flown(off_m=3.0)
    assert (shown.height_agl_m, shown.height_correction_m) == (HEIGHT_M + 3.0, None)


def refused(frames, frame=None):
    """In which of so many frames that are all refused heading and height are doubted."""
    errors = TelemetryErrors(NavigatorOptions())
    frame = frame or Frame(IMAGE, None, HEIGHT_M, 40.0, 0.0, 0.0)
    shown = [errors.corrected(frame, 0.2 * k, late=False, refusals=k) for k in range(frames)]
    return errors, [k for k, one in enumerate(shown) if one.is_doubted]


def test_refused_frames_are_doubted_ever_more_rarely():
    assert refused(100)[1] == [3, 5, 8, 12, 18, 27, 41, 62, 93]


def test_a_frame_without_heading_or_height_has_nothing_to_doubt():
    assert refused(20, Frame(IMAGE, None, HEIGHT_M))[1] == []
    assert refused(20, Frame(IMAGE, None, None, 40.0))[1] == []


def test_after_a_fix_frames_are_doubted_until_three_fixes_settled_what_is_off():
    errors, _ = refused(4)
    doubted = []
    for k in range(6):
        errors.note(fix_of(Attitude(0.0, 0.0, 30.0)), GROUND_M)
        shown = errors.corrected(Frame(IMAGE, None, HEIGHT_M, 40.0, 0.0, 0.0), 1.0 + 0.2 * k, late=False)
        doubted.append(shown.is_doubted)
    assert doubted == [True, True, False, False, False, False]
    assert math.remainder(shown.heading_deg - 30.0, 360.0) == pytest.approx(0.0, abs=0.6)


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


@pytest.mark.slow
def test_ncc_finds_a_heading_and_a_height_that_are_far_off():
    """Three refused frames, then the place, the heading and the height, which later frames are matched by."""
    plan = plan_flight(1, frames=10, town=drawn_town(1))
    site, first = plan.town.site(), plan.truth_rows()[0]
    navigator = Navigator(
        SceneMatcher(site, plan.camera, "ncc", "cpu"),
        Prior(lat_deg=first.lat_deg, lon_deg=first.lon_deg, sigma_m=10.0),
    )
    results = [
        navigator.update(replace(f, heading_deg=(f.heading_deg + 9.0) % 360.0, height_agl_m=1.12 * f.height_agl_m))
        for f in plan.iter_frames()
    ]
    fixes = [one for one in results if isinstance(one, Fix)]
    assert fixes == results[3:]
    for fix, there in zip(fixes, plan.truth.position_m[3:], strict=True):
        assert math.hypot(fix.east_m - there[0], fix.north_m - there[1]) < min(1.0, 3.0 * fix.sigma_m)
    found = navigator.calibration
    assert abs(found.attitude.heading_deg + 9.0) < 3.0 * found.attitude.sigma_deg[2]
    assert found.height_factor == pytest.approx(1.0 / 1.12, abs=0.02)
