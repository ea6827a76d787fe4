"""Velocities that contradict successive matches lose their say, and right ones keep it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from engine.navigation.velocity_check import VelocityCheck
from engine.values import Frame
from tests.support.fixes import a_fix

IMAGE = np.zeros((4, 4), np.uint8)
FAULTS = {
    "swapped": lambda v: v[::-1],
    "reversed": lambda v: -v,
    "km/h": lambda v: 3.6 * v,
    "knots for metres": lambda v: v / 0.5144,
    "feet": lambda v: 3.28 * v,
}


def match_at(place_m, confidence=0.9999, sigma_m=0.3):
    return a_fix(*map(float, place_m), sigma_m, confidence=confidence)


def flown(stated=lambda v: v, *, seconds=60.0, rate_hz=5.0, speed_mps=7.0, seed=1, confidence=0.9999, check=None):
    """A vehicle that turns and brakes: the check, and the times of the frames that it does not believe."""
    check, rng = check or VelocityCheck(0.5, 3.0), np.random.default_rng(seed)
    place, doubted, phase = np.zeros(2), [], rng.uniform(0, 2 * math.pi)
    for k in range(int(seconds * rate_hz)):
        time_s = k / rate_hz
        course = phase + 0.8 * math.sin(0.2 * time_s + phase)
        speed = speed_mps * (0.6 + 0.4 * math.cos(0.3 * time_s))
        velocity = speed * np.array([math.sin(course), math.cos(course)])
        said = stated(velocity + rng.normal(0.0, 0.2, 2))
        frame = Frame(IMAGE, None, east_velocity_mps=float(said[0]), north_velocity_mps=float(said[1]))
        fix = match_at(place + rng.normal(0.0, 0.3, 2), confidence)
        if check.note(fix, frame, time_s):
            doubted.append(time_s)
        assert (check.shown(frame).east_velocity_mps is None) == (not check.is_believed)
        place = place + velocity / rate_hz
    return check, doubted


@pytest.mark.parametrize(
    ("rate_hz", "seeds"),
    [(1.0, 30), *(pytest.param(hz, 150 / hz, marks=pytest.mark.slow) for hz in (1.0, 5.0, 30.0))],
)
def test_a_right_velocity_is_believed(rate_hz, seeds):
    """Some 30,000 matches in all: the rate of false alarms that is stated is 1 in 10,000."""
    assert not any(flown(rate_hz=rate_hz, seed=seed)[1] for seed in range(round(seeds)))


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_velocity_is_not_believed_for_long(fault):
    for seed in range(3):
        _, doubted = flown(FAULTS[fault], seed=seed)
        assert doubted
        assert doubted[0] <= 15.0  # swapped axes fly to the north-east as if they were right


def test_a_velocity_that_is_right_again_is_believed_after_ten_seconds():
    check, _ = flown(FAULTS["reversed"], seconds=10.0)
    assert not check.is_believed
    flown(seconds=9.0, check=check)
    assert not check.is_believed
    check, _ = flown(seconds=20.0, check=check)
    assert check.is_believed


def test_a_vehicle_that_hovers_and_matches_that_are_doubtful_say_nothing():
    assert flown(FAULTS["reversed"], speed_mps=0.5)[1] == []
    assert flown(FAULTS["reversed"], confidence=0.9)[1] == []


def test_matches_that_jump_do_not_outweigh_a_velocity():
    """Wrong matches lie anywhere: their way is not smooth."""
    check, rng = VelocityCheck(0.5, 3.0), np.random.default_rng(5)
    frame = Frame(IMAGE, None, east_velocity_mps=7.0, north_velocity_mps=0.0)
    assert not any(check.note(match_at(rng.uniform(-50, 50, 2)), frame, 0.2 * k) for k in range(500))
    assert check.is_believed


def test_frames_without_a_velocity_and_pauses_say_nothing():
    check = VelocityCheck(0.5, 3.0)
    bare, stated = Frame(IMAGE, None), Frame(IMAGE, None, east_velocity_mps=7.0, north_velocity_mps=0.0)
    assert not any(check.note(match_at((0.0, 7.0 * k)), bare, float(k)) for k in range(20))
    assert not any(check.note(match_at((0.0, 42.0 * k)), stated, 6.0 * k) for k in range(20))
    assert check.shown(replace(bare, height_agl_m=3.0)).height_agl_m == 3.0
