"""The attitude's bias: learnt from measured attitudes, corrected where it is more than is assumed of any."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.navigation.attitude_bias import AttitudeBias, Bias
from engine.navigation.attitude_lag import AttitudeLag
from engine.navigation.navigator import Navigator
from engine.options import ACCEPT_ALL
from engine.values import Attitude, Frame, NoFix, Prior, Reason
from tests.support.fields import fields_of
from tests.support.fixes import a_fix

IMAGE = np.zeros((8, 8), np.uint8)
_NUMBERS = itertools.count()


def new_image():
    """A picture like no other: one that repeats is refused."""
    return np.full((8, 8), next(_NUMBERS) % 256, np.uint8)


INTERVAL_S = 0.1


def angles(time_s):
    """Roll, pitch and heading of a vehicle, through north."""
    return 6.0 * math.sin(2.0 * time_s), 12.0 * math.sin(2.5 * time_s), (350.0 + 15.0 * time_s) % 360.0


def frame_at(time_s, off=(0.0, 0.0, 0.0)):
    roll, pitch, heading = np.add(angles(time_s), off)
    return Frame(IMAGE, round(time_s * 1e9), 100.0, float(heading % 360.0), float(roll), float(pitch))


def fix_of(attitude, up_m=100.0):
    return a_fix(up_m=up_m, attitude=Attitude(*attitude), stage="refined")


def flown(off, *, seconds=10.0, noise_deg=0.0, up_m=100.0):
    """The filter after a flight whose telemetry was off by that much, and the frames that it corrected."""
    bias, out, rng = AttitudeBias(1.0, 5.0), [], np.random.default_rng(1)
    for k in range(round(seconds / INTERVAL_S)):
        frame = frame_at(k * INTERVAL_S, off)
        bias.follow(frame, k * INTERVAL_S)
        out.append(bias.corrected(frame))
        roll, pitch, heading = np.add(angles(k * INTERVAL_S), rng.normal(0.0, noise_deg, 3))
        bias.note(fix_of((roll, pitch, heading % 360.0), up_m))
    return bias, out


@settings(max_examples=30)
@given(
    off=st.tuples(st.floats(0.9, 3.0), st.floats(-3.0, -0.9), st.floats(-8.0, -2.1)),
    noise_deg=st.floats(0.0, 0.5),
)
def test_a_bias_is_learnt_within_its_sigma_and_taken_off(off, noise_deg):
    bias, frames = flown(off, noise_deg=noise_deg)
    known = bias.bias
    left = np.add([known.roll_deg, known.pitch_deg, known.heading_deg], off)
    assert np.all(np.abs(left) <= 3.0 * np.array(known.sigma_deg) + 1e-6)
    last, truth = frames[-1], angles((len(frames) - 1) * INTERVAL_S)
    assert last.roll_deg == pytest.approx(truth[0], abs=0.8)
    assert last.pitch_deg == pytest.approx(truth[1], abs=0.8)
    assert abs(math.remainder(last.heading_deg - truth[2], 360.0)) < 1.5


def test_what_is_assumed_of_any_telemetry_is_not_corrected():
    bias, frames = flown((0.5, -0.5, 1.5))
    assert bias.bias.roll_deg == pytest.approx(-0.5, abs=0.1)
    for k, frame in enumerate(frames):
        stated = frame_at(k * INTERVAL_S, (0.5, -0.5, 1.5))
        assert fields_of(replace(frame, tilt_lag_deg=None, heading_lag_deg=None)) == fields_of(stated)


def test_a_bias_that_changes_is_followed():
    bias = AttitudeBias(1.0, 5.0)
    for k in range(300):
        heading_off = -4.0 if k < 150 else 4.0
        bias.follow(frame_at(k * INTERVAL_S, (0.0, 0.0, heading_off)), k * INTERVAL_S)
        bias.note(fix_of(angles(k * INTERVAL_S)))
    assert bias.bias.heading_deg == pytest.approx(-4.0, abs=0.5)


def test_one_wild_attitude_moves_it_by_little():
    bias, _ = flown((0.0, 0.0, 0.0))
    bias.follow(frame_at(10.0), 10.0)
    roll, pitch, heading = angles(10.0)
    bias.note(fix_of((roll + 20.0, pitch - 20.0, (heading + 90.0) % 360.0)))
    known = bias.bias
    assert max(abs(known.roll_deg), abs(known.pitch_deg)) < 0.5
    assert abs(known.heading_deg) < 1.0


def test_differences_that_scatter_widen_the_errors():
    rng = np.random.default_rng(2)
    widths = []
    for scatter_deg in (0.3, 3.0):
        bias = AttitudeBias(1.0, 5.0)
        for k in range(100):
            frame = frame_at(k * INTERVAL_S, rng.normal(0.0, scatter_deg, 3))
            bias.follow(frame, k * INTERVAL_S)
            frame = bias.corrected(frame)
            bias.note(fix_of(angles(k * INTERVAL_S)))
        widths.append((frame.tilt_lag_deg, frame.heading_lag_deg))
    assert max(widths[0]) < 0.6
    assert widths[1][0] > 0.8  # at most the bias's own, 1 degree
    assert widths[1][1] > 0.8


@pytest.mark.parametrize("missing", ["roll_deg", "pitch_deg", "heading_deg"])
def test_a_frame_without_attitude_is_left_alone_and_teaches_nothing(missing):
    bias = AttitudeBias(1.0, 5.0)
    frame = replace(frame_at(0.0), **{missing: None})
    bias.follow(frame, 0.0)
    assert bias.corrected(frame) is frame
    bias.note(fix_of((3.0, 3.0, 3.0)))
    assert bias.bias is None


def test_a_fix_that_did_not_measure_the_attitude_teaches_nothing():
    assert flown((2.0, 2.0, 5.0), up_m=None)[0].bias is None


def test_one_fix_alone_takes_nothing_off():
    bias = AttitudeBias(1.0, 5.0)
    bias.follow(frame_at(0.0), 0.0)
    bias.note(fix_of((6.0, -6.0, 20.0)))
    assert fields_of(bias.corrected(frame_at(0.1))) == fields_of(frame_at(0.1))


def test_a_bias_within_what_the_frame_states_of_itself_is_left():
    bias, _ = flown((0.0, 0.0, 4.0))
    frame = frame_at(10.0, (0.0, 0.0, 4.0))
    assert bias.corrected(frame).heading_deg != frame.heading_deg
    vague = replace(frame, heading_sigma_deg=3.0)
    assert bias.corrected(vague).heading_deg == vague.heading_deg


def test_an_unsure_attitude_counts_less():
    sure, unsure = AttitudeBias(1.0, 5.0), AttitudeBias(1.0, 5.0)
    for bias, stage in ((sure, "refined"), (unsure, "fine")):
        bias.follow(frame_at(0.0), 0.0)
        bias.note(replace(fix_of((2.0, 0.0, 350.0)), stage=stage))
    assert 0.0 < unsure.bias.roll_deg < 0.5 * sure.bias.roll_deg


class Measuring:
    """A matcher whose fixes measure another attitude than the frame's, or that refuses."""

    def __init__(self, off_deg, *, has_surface=True):
        self.site = SimpleNamespace(
            is_searchable=True,
            has_surface=has_surface,
            gsd_m_per_px=1.0,
            georeference_sigma_m=0.0,
            ground_at=lambda _: 0.0,
        )
        self.off_deg, self.frames, self.refuses = off_deg, [], False

    def locate(self, frame, prior=None, budget=None):
        self.frames.append(frame)
        if self.refuses:
            return NoFix(reason=Reason.LOW_SCORE, timestamp_ns=frame.timestamp_ns)
        return replace(fix_of((0.0, 0.0, self.off_deg % 360.0)), timestamp_ns=frame.timestamp_ns)


def level_at(time_s):
    return Frame(
        new_image(), round(time_s * 1e9), 100.0, 0.0, 0.0, 0.0, east_velocity_mps=0.0, north_velocity_mps=0.0
    )


def flown_by_navigator(matcher, options=None):
    navigator = Navigator(matcher, Prior(east_m=0.0, north_m=0.0, sigma_m=5.0), options=options)
    for k in range(30):
        navigator.update(level_at(0.1 * k))
    return navigator


def test_the_navigator_takes_it_off_new_and_late_frames_and_forgets_it_when_it_leads_nowhere():
    matcher = Measuring(-6.0)
    navigator = flown_by_navigator(matcher)
    assert navigator.calibration.attitude.heading_deg == pytest.approx(-6.0, abs=0.3)
    assert matcher.frames[-1].heading_deg == pytest.approx(354.0, abs=0.3)
    navigator.update(level_at(2.55))  # a late one
    assert matcher.frames[-1].heading_deg == pytest.approx(354.0, abs=0.3)
    matcher.refuses = True
    for k in range(15):
        navigator.update(level_at(3.0 + 0.1 * k))
    assert navigator.calibration.attitude is None
    assert matcher.frames[-1].heading_deg == 0.0


def test_without_a_surface_model_nothing_is_learnt():
    navigator = flown_by_navigator(Measuring(-6.0, has_surface=False))
    assert navigator.calibration.attitude is None


def test_where_every_match_is_accepted_the_attitude_stays_as_it_came():
    matcher = Measuring(-6.0)
    flown_by_navigator(matcher, ACCEPT_ALL)
    assert all(frame.heading_deg == 0.0 for frame in matcher.frames)
    assert max(frame.heading_lag_deg or 0.0 for frame in matcher.frames) < 1e-6


def test_the_lag_is_learnt_besides_a_bias():
    lag, known = AttitudeLag(0.1, 0.03), Bias(-2.0, 3.0, 0.0, (0.1, 0.1, 0.1))
    for k in range(100):
        lag.corrected(replace(frame_at(k * INTERVAL_S - 0.1, (2.0, -3.0, 0.0)), timestamp_ns=round(k * 1e8)))
        lag.note(fix_of(angles(k * INTERVAL_S)), known)
    assert lag.mean_s == pytest.approx(0.1, abs=0.02)
