"""The attitude's lag: learnt from measured attitudes, corrected, and what is left of it widens the errors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from engine.errors import OptionError, TelemetryError
from engine.matching.covariance import with_frame_accuracy
from engine.navigation.attitude_lag import AttitudeLag
from engine.options import ACCEPT_ALL, AssumedErrors, NavigatorOptions
from engine.values import Attitude, Frame
from tests.support.fields import fields_of
from tests.support.fixes import a_fix

IMAGE = np.zeros((8, 8), np.uint8)
INTERVAL_S = 0.1


def angles(time_s):
    """Roll, pitch and heading of a vehicle that brakes and turns, up to 30 degrees a second."""
    return 6.0 * math.sin(2.0 * time_s), 12.0 * math.sin(2.5 * time_s), 350.0 + 20.0 * math.sin(1.5 * time_s)


def frame_at(time_s, lag_s=0.0, **changes):
    roll, pitch, heading = angles(time_s - lag_s)
    return replace(Frame(IMAGE, round(time_s * 1e9), 100.0, heading % 360.0, roll, pitch), **changes)


def fix_at(time_s, up_m=100.0):
    roll, pitch, heading = angles(time_s)
    return a_fix(up_m=up_m, attitude=Attitude(roll, pitch, heading % 360.0))


def flown(lag_s, *, frames=100, up_m=100.0, **changes):
    """The filter after a flight, and the frames that it corrected."""
    lag, out = AttitudeLag(0.1, 0.03), []
    for k in range(frames):
        out.append(lag.corrected(frame_at(k * INTERVAL_S, lag_s, **changes)))
        lag.note(fix_at(k * INTERVAL_S, up_m))
    return lag, out


@pytest.mark.parametrize("lag_s", [0.0, 0.05, 0.15])
def test_a_lag_is_learnt_and_corrected(lag_s):
    lag, frames = flown(lag_s)
    assert lag.mean_s == pytest.approx(lag_s, abs=0.02)
    assert lag.sigma_s < 0.05
    raw, errors = [], []
    for k, frame in list(enumerate(frames))[50:]:
        truth = angles(k * INTERVAL_S)
        errors.append([frame.roll_deg - truth[0], frame.pitch_deg - truth[1],
                       math.remainder(frame.heading_deg - truth[2], 360.0)])  # fmt: skip
        raw.append(np.subtract(angles(k * INTERVAL_S - lag_s), truth))
    assert np.sqrt(np.mean(np.square(errors))) <= max(0.4 * np.sqrt(np.mean(np.square(raw))), 0.3)


def test_an_unknown_lag_widens_the_attitude_of_a_vehicle_that_turns():
    _, frames = flown(0.1, up_m=None)  # pictures that measured no attitude
    last = frames[-1]
    before, here = np.array(angles(99 * INTERVAL_S - 0.2)), np.array(angles(99 * INTERVAL_S - 0.1))
    rates = np.abs(here - before) / INTERVAL_S
    assert last.tilt_lag_deg == pytest.approx(rates[:2].max() * math.hypot(0.1, 0.03), rel=1e-6)
    assert last.heading_lag_deg == pytest.approx(rates[2] * math.hypot(0.1, 0.03), rel=1e-6)
    assert (last.roll_deg, last.pitch_deg) == pytest.approx(tuple(here[:2]))  # nothing is corrected on suspicion


def test_a_calm_flight_is_as_it_was():
    lag = AttitudeLag(0.1, 0.03)
    for k in range(5):
        frame = Frame(IMAGE, k * 100_000_000, 100.0, 10.0, 1.0, -2.0)
        assert lag.corrected(frame) == frame
        lag.note(fix_at(0.0))
    assert lag.mean_s == 0.0


@pytest.mark.parametrize("changes", [{"timestamp_ns": None}, {"roll_deg": None}, {"heading_deg": None}])
def test_without_stamp_or_attitude_there_is_no_rate(changes):
    _, frames = flown(0.1, frames=4, **changes)
    given = [frame_at(k * INTERVAL_S, 0.1, **changes) for k in range(4)]
    assert list(map(fields_of, frames)) == list(map(fields_of, given))


def test_frames_far_apart_say_nothing():
    lag = AttitudeLag(0.1, 0.03)
    for k in range(4):
        frame = frame_at(2.0 * k, 0.1)
        assert lag.corrected(frame) == frame


def test_an_attitude_that_is_simply_wrong_is_no_lag_of_seconds():
    lag = AttitudeLag(0.1, 0.03)
    for k in range(100):
        frame = frame_at(k * INTERVAL_S)
        lag.corrected(replace(frame, roll_deg=-frame.roll_deg, pitch_deg=-frame.pitch_deg))
        lag.note(fix_at(k * INTERVAL_S))
    assert abs(lag.mean_s) <= 0.3


def test_the_lag_adds_to_what_is_stated_or_assumed():
    errors = AssumedErrors(tilt_deg=0.3, heading_deg=1.0)
    late = Frame(IMAGE, tilt_lag_deg=0.4, heading_lag_deg=2.0)
    assert with_frame_accuracy(late, errors).tilt_deg == pytest.approx(0.5)
    assert with_frame_accuracy(late, errors).heading_deg == pytest.approx(math.sqrt(5.0))
    stated = replace(late, tilt_sigma_deg=3.0)
    assert with_frame_accuracy(stated, errors).tilt_deg == pytest.approx(math.hypot(3.0, 0.4))
    assert with_frame_accuracy(Frame(IMAGE), errors) is errors


def test_the_baseline_takes_attitudes_as_they_are():
    lag = AttitudeLag(ACCEPT_ALL.attitude_lag_s, ACCEPT_ALL.attitude_jitter_s)
    for k in range(5):
        frame = frame_at(k * INTERVAL_S, 0.1)
        shown = lag.corrected(frame)
        assert max(shown.tilt_lag_deg or 0.0, shown.heading_lag_deg or 0.0) < 1e-6
        assert (shown.roll_deg, shown.pitch_deg) == pytest.approx((frame.roll_deg, frame.pitch_deg))
        lag.note(fix_at(k * INTERVAL_S))


def test_bad_lags_are_named():
    with pytest.raises(OptionError, match="attitude_lag_s: expected a number above 0, got -1"):
        NavigatorOptions(attitude_lag_s=-1.0)
    with pytest.raises(TelemetryError, match="tilt_lag_deg: expected 0 degrees or more, got nan"):
        Frame(IMAGE, tilt_lag_deg=math.nan)


def test_stamps_of_another_unit_leave_a_lag_that_a_frame_can_state():
    lag = AttitudeLag(0.1, 0.03)
    lag.corrected(frame_at(0.0))
    turned = lag.corrected(frame_at(0.2, timestamp_ns=200))  # milliseconds that pass for nanoseconds
    assert turned.tilt_lag_deg <= 180.0
    assert turned.heading_lag_deg <= 180.0
    with_frame_accuracy(turned, AssumedErrors())  # was refused: more than a million degrees
