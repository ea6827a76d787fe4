"""The check of the telemetry's attitude: a late stamp and a mount that is off are found, or nothing is said."""

from __future__ import annotations

import numpy as np
import pytest

from engine import Frame, NoFix, Reason
from engine.values import Attitude, Window
from scenematch.report.attitude import attitude_row, check_attitude
from tests.support.fixes import a_fix

PICTURE = np.zeros((4, 4), np.uint8)


def swing(time_s):
    """Roll and pitch of a drone that never hangs still, in degrees."""
    roll = 4.0 * np.sin(1.1 * time_s) + 1.5 * np.sin(2.9 * time_s + 1.0)
    return roll, 3.0 * np.cos(0.8 * time_s) + np.sin(2.1 * time_s)


def flight(*, lag_s=0.0, offset_deg=(0.0, 0.0), interval_s=0.1, size=1.0, every=1, count=300):
    """Rows of frames whose attitude is as old as the lag."""
    rng = np.random.default_rng(3)
    rows = []
    for k in range(count):
        time_s = k * interval_s
        stamp = int(time_s * 1e9)
        roll, pitch = (size * angle for angle in swing(time_s))
        stated = [
            size * a + o + rng.normal(0, 0.1) for a, o in zip(swing(time_s - lag_s), offset_deg, strict=True)
        ]
        frame = Frame(PICTURE, stamp, 100.0, 0.0, *stated)
        if k % every:
            rows.append(attitude_row(frame, NoFix(reason=Reason.AMBIGUOUS)))
            continue
        attitude = Attitude(roll + rng.normal(0, 0.05), pitch + rng.normal(0, 0.05), 0.0)
        fix = a_fix(timestamp_ns=stamp, up_m=100.0, attitude=attitude, score=0.5, window=Window(0, 0, 4, 4))
        rows.append(attitude_row(frame, fix))
    return rows


@pytest.mark.parametrize("lag_s", [-0.2, 0.0, 0.13, 0.4])
@pytest.mark.parametrize("every", [1, 3])
def test_lag_and_offset_are_found_again(lag_s, every):
    check = check_attitude(flight(lag_s=lag_s, offset_deg=(0.8, -0.5), every=every))
    assert check.frames == 300 // every
    assert check.lag_ms == pytest.approx(1e3 * lag_s, abs=15.0)
    assert (check.roll_offset_deg, check.pitch_offset_deg) == pytest.approx((0.8, -0.5), abs=0.05)


@pytest.mark.parametrize("silent", [{"size": 0.05}, {"interval_s": 0.9}, {"lag_s": 0.7}])
def test_a_flight_that_cannot_tell_a_lag_says_none(silent):
    """Too calm, too few frames a second, or a lag beyond what is looked for."""
    assert check_attitude(flight(**silent)).lag_ms is None


def test_too_few_measured_attitudes_say_nothing():
    assert check_attitude(flight(every=30)) is None
    assert check_attitude([]) is None


def test_a_frame_without_stamp_or_tilt_contributes_nothing():
    refused = NoFix(reason=Reason.AMBIGUOUS)
    assert attitude_row(Frame(PICTURE, None, 100.0, 0.0, 1.0, 2.0), refused) is None
    assert attitude_row(Frame(PICTURE, 1, 100.0, 0.0, None, 2.0), refused) is None
