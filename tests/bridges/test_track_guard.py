"""The guard before the autopilot: a shifted map is not followed, a covered camera is recovered from."""

from dataclasses import replace

import numpy as np
import pytest

from engine.navigation.motion import PositionEstimate
from engine.values import Frame, NoFix, Reason
from scenematch.bridges.track_guard import TrackGuard
from tests.support.fixes import a_fix

SPEED_MPS = 7.0
STEP_S = 0.1


def fix(east_m, north_m=0.0, sigma_m=0.3):
    return a_fix(east_m, north_m, sigma_m)


def refused(result, reason=Reason.INCONSISTENT, **stated):
    return lambda east_m: NoFix(reason=reason, match=replace(result(east_m), **stated))


class Flight:
    """A flight to the east at 7 m/s; answers whether the guard trusts each result."""

    def __init__(self, guard=None):
        self.guard, self.time_s, self.east_m = guard or TrackGuard(), 0.0, 0.0

    def step(self, result, *, velocity=True, off_mps=0.0, sigma_mps=None):
        """The next frame; its velocity is off to the west."""
        self.time_s += STEP_S
        self.east_m += SPEED_MPS * STEP_S
        east_mps, north_mps = (SPEED_MPS - off_mps, 0.0) if velocity else (None, None)
        told = {"east_velocity_mps": east_mps, "north_velocity_mps": north_mps, "velocity_sigma_mps": sigma_mps}
        self.guard.advance(Frame(np.zeros((2, 2), np.uint8), None, 50.0, 0.0, **told), round(self.time_s * 1e9))
        trusted = self.guard.trusts(result(self.east_m))
        self.guard.has_fix |= trusted
        return trusted

    def fly(self, seconds, result, **told):
        return [self.step(result, **told) for _ in range(round(seconds / STEP_S))]


def true(east_m):
    return fix(east_m)


@pytest.fixture
def flight():
    """A flight of five seconds with true fixes."""
    begun = Flight()
    begun.fly(5.0, true)
    return begun


def shifted(east_m):
    return fix(east_m, 40.0)


def noisy(sigma_m, north_m=0.0):
    rng = np.random.default_rng(1)
    return lambda east_m: fix(*rng.normal((east_m, north_m), sigma_m), sigma_m)


def covered(_):
    return NoFix(reason=Reason.NO_TEXTURE)


@pytest.mark.parametrize("cover_s", [5.0, 10.0, 20.0])
def test_the_first_fix_after_a_covered_camera_is_trusted(flight, cover_s):
    flight.fly(min(cover_s, 7.0), covered)
    flight.fly(cover_s - min(cover_s, 7.0), covered, velocity=False)
    assert flight.step(true, velocity=cover_s <= 7.0)


@pytest.mark.parametrize(
    ("seconds", "wrong"),
    [(2.0, refused(shifted)), (0.3, lambda east_m: fix(east_m + 30.0))],
    ids=["refused for long", "three fixes"],
)
def test_matches_that_return_to_the_track_end_the_dispute(flight, seconds, wrong):
    assert not any(flight.fly(seconds, wrong))
    answers = flight.fly(1.0, true)
    assert not any(answers[:2])
    assert all(answers[3:])


@pytest.mark.parametrize(("confidence", "is_heard"), [(0.99995, True), (0.999, False)])
def test_a_match_that_suffices_by_itself_counts_though_the_navigator_doubts_it(flight, confidence, is_heard):
    """It followed the shifted map, and may take ten seconds to leave it."""
    assert not any(flight.fly(20.0, shifted))
    flight.fly(10.0, refused(true, Reason.UNCONFIRMED, confidence=confidence), velocity=False)
    assert all(flight.fly(5.0, true)) == is_heard


def test_a_refused_match_is_never_sent_however_well_it_agrees(flight):
    assert not any(flight.fly(2.0, refused(true)))
    assert flight.step(true)


def test_an_operators_word_ends_the_dispute(flight):
    assert not any(flight.fly(20.0, shifted))
    flight.guard.confirm()
    assert all(flight.fly(5.0, shifted))


def test_a_contradiction_below_the_tolerance_is_left_to_the_estimator(flight):
    assert all(flight.fly(1.0, lambda east_m: fix(east_m, 4.0)))


def test_the_first_fix_must_agree_with_the_start_or_the_receiver():
    assert not Flight(TrackGuard(PositionEstimate(np.array([0.0, 0.0]), 3.0))).step(shifted)
    flight = Flight()
    for _ in range(100):
        flight.guard.anchor(PositionEstimate(np.array([flight.east_m, 0.0]), 1.5))
        assert not flight.step(shifted)
    assert flight.guard.is_disputed
    for _ in range(3):
        flight.guard.anchor(PositionEstimate(np.array([flight.east_m, 0.0]), 1.5))
        flight.step(true)
    assert flight.step(true)
    flight.guard.anchor(PositionEstimate(np.array([1000.0, 0.0]), 1.5))  # a receiver that is led astray later
    assert flight.step(true)


@pytest.mark.parametrize("velocity", [True, False])
def test_single_wrong_matches_are_held_back_and_no_dispute(velocity):
    flight = Flight()
    flight.fly(5.0, true, velocity=velocity)
    for _ in range(10):
        assert not flight.step(shifted, velocity=velocity)
        assert flight.step(true, velocity=velocity)


@pytest.mark.parametrize("cover_s", [0.0, 10.0])
def test_one_wrong_fix_is_no_track(cover_s):
    """It agrees with a track that is vague or none, and what contradicts it afterwards is the truth."""
    flight = Flight()
    if cover_s:
        flight.fly(5.0, true)
        flight.fly(cover_s, covered, velocity=False)
    assert flight.step(shifted)
    answers = flight.fly(5.0, true)
    assert answers[:2] == [False, False]
    assert all(answers[2:])


@pytest.mark.parametrize("good_s", [0.0, 3.0])
@pytest.mark.parametrize("off_mps", [2.0, 3.0, 4.3, 8.0])
def test_right_fixes_outweigh_a_stated_velocity_that_is_wrong(good_s, off_mps):
    flight = Flight()
    flight.fly(good_s, true)
    assert sum(flight.fly(6.0, true, off_mps=off_mps)) >= 55


@pytest.mark.parametrize(("off_mps", "sigma_m"), [(2.5, 0.05), (2.5, 1.0), (4.3, 0.3), (8.0, 0.05), (8.0, 1.0)])
def test_an_outage_with_a_wrong_velocity_is_recovered_from(off_mps, sigma_m):
    """By the fixes' own way it is wrong, and that explains how far off they are: 43 m by 4.3 m/s in 10 s."""
    flight, seen = Flight(), noisy(sigma_m)
    flight.fly(3.0, true)
    flight.fly(10.0, covered, off_mps=off_mps)
    assert all(flight.fly(10.0, seen, off_mps=off_mps)[30:])
    assert all(flight.fly(5.0, seen))  # it is right again


@pytest.mark.parametrize("drift_mps2", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("shifted_s", [1.0, 20.0, 60.0])
def test_a_map_that_shifts_back_is_trusted_at_once_whatever_the_estimator_states(flight, shifted_s, drift_mps2):
    """The vehicle moved as the matches did, however far the estimator drifted without a fix."""
    for second in range(round(shifted_s)):
        assert not any(flight.fly(1.0, noisy(0.3, 40.0), off_mps=drift_mps2 * second))
    assert sum(flight.fly(5.0, noisy(0.3), off_mps=drift_mps2 * shifted_s)) >= 48


@pytest.mark.parametrize(("cover_s", "drift_mps2"), [(10.0, 0.2), (20.0, 0.1), (60.0, 0.1)])
def test_an_estimator_without_fixes_drifts_and_is_right_before_it_is_proven_wrong(flight, cover_s, drift_mps2):
    for second in range(round(cover_s)):
        flight.fly(1.0, covered, off_mps=drift_mps2 * second)
    assert all(flight.fly(5.0, noisy(0.3)))


@pytest.mark.parametrize("off_mps", [0.5, 2.0])
def test_a_map_that_shifts_in_an_outage_is_not_explained_by_a_velocity_that_becomes_wrong_later(flight, off_mps):
    flight.fly(10.0, covered, off_mps=0.5)
    assert not any(flight.fly(30.0, noisy(0.3, 40.0), off_mps=0.5))
    assert not any(flight.fly(60.0, noisy(0.3, 40.0), off_mps=off_mps))


def test_a_vehicle_without_a_velocity_goes_on_by_inertia(flight):
    """40 m aside in two seconds would be an acceleration of 20 m/s2."""
    flight.fly(2.0, covered, velocity=False)
    assert not any(flight.fly(30.0, noisy(0.3, 40.0), velocity=False))


@pytest.mark.parametrize(("cover_s", "sigma_m"), [(0.0, 1.0), (5.0, 0.05), (10.0, 0.05), (10.0, 1.0)])
def test_a_map_that_shifts_is_not_explained_by_a_velocity_that_is_right(flight, cover_s, sigma_m):
    flight.fly(cover_s, covered, off_mps=0.5)
    assert not any(flight.fly(20.0, noisy(sigma_m, 40.0), off_mps=0.5))


def test_a_map_that_shifts_is_not_explained_by_a_velocity_that_is_known_to_be_wrong():
    flight = Flight()
    assert all(flight.fly(5.0, true, off_mps=4.3))
    assert not any(flight.fly(20.0, shifted, off_mps=4.3))
    assert not any(flight.fly(20.0, shifted, off_mps=8.0))


@pytest.mark.parametrize(("sigma_mps", "contradicts"), [(None, True), (0.1, True), (5.0, False)])
def test_a_velocity_counts_with_the_accuracy_that_it_states(sigma_mps, contradicts):
    """10 s without a fix, then matches 40 m aside: too far for 0.5 m/s, not for 5."""
    flight = Flight(TrackGuard(PositionEstimate(np.zeros(2), 1.0)))
    flight.fly(10.0, covered, sigma_mps=sigma_mps)
    assert flight.step(shifted, sigma_mps=sigma_mps) != contradicts
