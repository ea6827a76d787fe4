"""The closed loop with a scripted matcher: the vehicle on its plan, and what each fault leads to."""

import math

import numpy as np
import pytest

from engine import Frame, NavigatorState, NoFix, OptionError, OrthoMap, Prior, Reason, Window
from scenematch.simulator.faults import Fault, ShiftedMap
from scenematch.simulator.loop import ClosedLoop, Mode
from scenematch.simulator.pilot import plan_rounds
from scenematch.simulator.vehicle import START_NS, FlightStyle
from tests.support.fixes import a_fix

SIGMA_M = 0.3


class Scripted:
    """Finds every picture where it was taken, with noise: the picture is its own place, written out in bytes."""

    def __init__(self, seed=0, blind=False):
        gray = np.zeros((64, 64), np.uint8)
        self.site = OrthoMap.from_arrays(gray, [[8.0, 0.0, 6e5], [0.0, -8.0, 5.34e6]], 32633)
        self.rng, self.blind = np.random.default_rng(seed), blind
        self.asked: list[tuple[Frame, Prior | None]] = []

    def locate(self, frame, prior=None, budget=None):
        self.asked.append((frame, prior))
        if self.blind:
            return NoFix(reason=Reason.NO_TEXTURE, timestamp_ns=frame.timestamp_ns)
        east, north, _ = np.frombuffer(frame.image.tobytes()) + SIGMA_M * self.rng.standard_normal(3)
        lat, lon = map(float, self.site.frame.geodetic_from_enu(east, north))
        place = {"lat_deg": lat, "lon_deg": lon, "window": Window(0, 0, 8, 8)}
        return a_fix(float(east), float(north), SIGMA_M, timestamp_ns=frame.timestamp_ns, **place)


def picture(state):
    """The place (3,) as 24 bytes: what the scripted matcher reads."""
    return np.frombuffer(state.position_m.tobytes(), np.uint8).reshape(1, 24)


ROUTE = plan_rounds((60.0, 50.0), 60.0, FlightStyle(height_agl_m=120.0))


def fly(seconds, fault=None, seed=3, matcher=None, **options):
    loop = ClosedLoop(ROUTE, picture, matcher or Scripted(seed), seed=seed, fault=fault, **options)
    assert all(isinstance(frame, Frame) for frame in loop.fly(seconds))
    return loop.flown


def distance(errors):
    return np.hypot(*errors[:, :2].T)


def rows_between(flown, start_s, end_s):
    return [row for row in flown.record if start_s <= row.time_s < end_s]


def is_within_its_sigmas(row):
    error = row.estimate.position_m - row.truth.position_m
    return math.hypot(error[0], error[1]) < 4.0 * row.estimate.sigma_m


def modes(flown, start_s=0.0, end_s=math.inf):
    return {row.mode for row in rows_between(flown, start_s, end_s)}


@pytest.fixture(scope="module")
def undisturbed():
    return fly(20.0)


def test_it_flies_its_plan_by_fixes_alone(undisturbed):
    assert math.sqrt(np.mean(distance(undisturbed.plan_error_m) ** 2)) < 0.8
    assert np.abs(undisturbed.plan_error_m[50:, 2]).max() < 2.0  # the barometer's drift
    counts = (len(undisturbed.record), len(undisturbed.answers), len(undisturbed.used))
    assert counts == (200, 100, 99)  # the last is on its way
    assert modes(undisturbed) == {Mode.FOLLOW}
    assert all(row.healthy for row in rows_between(undisturbed, 1.0, 99.0))
    assert undisturbed.resets == 0


def test_its_estimate_is_better_than_its_fixes_and_says_so(undisturbed):
    errors = undisturbed.estimate_error_m[50:]
    assert math.sqrt(np.mean(distance(errors) ** 2)) < SIGMA_M
    sigma = np.array([row.estimate.sigma_m for row in undisturbed.record[50:]])
    assert (distance(errors) < 4.0 * sigma).all()
    assert sigma.max() < 0.6


def test_one_seed_gives_one_flight_and_another_another(undisturbed):
    again, other = fly(3.0), fly(3.0, seed=4)
    for row, same, different in zip(undisturbed.record, again.record, other.record, strict=False):
        np.testing.assert_array_equal(row.truth.position_m, same.truth.position_m)
        assert not np.array_equal(row.truth.position_m, different.truth.position_m)


def test_the_engine_is_told_what_the_filter_believes():
    matcher = Scripted(1)
    flown = fly(6.0, matcher=matcher)
    for (frame, prior), answer in list(zip(matcher.asked, flown.answers, strict=True))[10:]:
        row = next(r for r in flown.record if START_NS + round(r.time_s * 1e9) == answer.timestamp_ns)
        assert frame.timestamp_ns == answer.timestamp_ns
        assert prior is not None
        assert frame.height_agl_m == pytest.approx(row.estimate.position_m[2], abs=0.5)
        true = answer.truth.attitude
        assert (frame.roll_deg, frame.pitch_deg) == pytest.approx((true.roll_deg, true.pitch_deg), abs=2.0)
        speed = np.array([frame.east_velocity_mps, frame.north_velocity_mps])
        np.testing.assert_allclose(speed, answer.truth.velocity_mps[:2], atol=1.0)


@pytest.mark.slow
def test_a_long_latency_costs_little_because_fixes_are_taken_in_where_they_belong():
    assert fly(5.0, latency_s=3.5).used  # longer than anybody's, and still kept for
    assert np.median(distance(fly(20.0, latency_s=0.6).estimate_error_m[50:])) < 0.5  # 5 m are flown in 0.6 s


# ------------------------------------------------------------------------------------------------------- faults


@pytest.mark.slow
def test_an_engine_that_is_killed_for_ten_seconds_is_coasted_over():
    flown = fly(28.0, Fault(kind="killed", start_s=12.0, duration_s=10.0))
    dead = [a for a in flown.answers if a.state is None]
    assert len(dead) == 50
    assert {a.result.reason for a in dead} == {Reason.FAILED}
    assert not any(row.healthy for row in rows_between(flown, 13.4, 21.9))
    assert all(row.healthy for row in rows_between(flown, 23.0, 99.0))
    assert modes(flown) == {Mode.FOLLOW}
    assert all(map(is_within_its_sigmas, rows_between(flown, 12.0, 22.0)))
    assert distance(flown.plan_error_m[-20:]).max() < 2.0


@pytest.mark.slow
def test_beyond_its_limit_it_holds_and_when_fixes_return_it_flies_on():
    flown = fly(50.0, Fault(kind="killed", start_s=12.0, duration_s=18.0))
    held = [row for row in flown.record if row.mode is Mode.HOLD]
    assert held[0].estimate.sigma_m > 5.0
    assert 20.0 < held[0].time_s < 30.0
    stopped = rows_between(flown, held[0].time_s + 4.1, 30.0)
    assert all(np.array_equal(row.plan_m, stopped[0].plan_m) for row in stopped)  # the route waits
    assert modes(flown, 45.0) == {Mode.FOLLOW}
    assert distance(flown.plan_error_m[-20:]).max() < 3.0


@pytest.mark.slow
def test_without_an_engine_the_flight_is_handed_over_before_nothing_is_known():
    flown = fly(58.0, Fault(kind="killed", start_s=8.0, duration_s=math.inf))
    last = flown.record[-1]
    assert last.mode is Mode.HANDED_OVER
    assert last.time_s < 57.0
    assert [a.timestamp_ns for a in flown.answers][-1] <= START_NS + round(last.time_s * 1e9)
    assert flown.record[-2].mode is Mode.HOLD
    assert flown.record[-2].estimate.sigma_m < 20.0


@pytest.mark.slow
def test_a_shifted_map_is_never_followed():
    flown = fly(58.0, Fault(kind="shifted", start_s=20.0, duration_s=math.inf))
    shift_ns = START_NS + 20_000_000_000
    assert not [stamp for stamp in flown.used if stamp >= shift_ns]
    assert not any(row.healthy for row in rows_between(flown, 21.3, 30.0))  # then the matches outweigh the flight
    last = flown.record[-1]
    assert last.time_s < 57.0
    assert last.mode is Mode.HANDED_OVER
    # It believes in no place that is 40 m to the east: its error is what its own sigma allows for.
    assert is_within_its_sigmas(last)
    assert last.estimate.sigma_m < 12.0


@pytest.mark.slow
def test_a_frozen_camera_is_refused_and_survived():
    flown = fly(28.0, Fault(kind="frozen", start_s=7.0, duration_s=10.0))
    frozen = [a for a in flown.answers if 8.5 < a.truth.time_s < 17.0]
    assert all(isinstance(a.result, NoFix) for a in frozen)
    assert {a.state for a in frozen} <= {NavigatorState.COASTING, NavigatorState.LOST}
    assert not any(row.healthy for row in rows_between(flown, 10.0, 17.0))
    assert not [s for s in flown.used if START_NS + 8_000_000_000 < s < START_NS + 17_000_000_000]
    # Nothing but coasting: the frozen place pulls at nothing.
    assert all(map(is_within_its_sigmas, rows_between(flown, 7.0, 17.0)))
    assert distance(flown.plan_error_m[-20:]).max() < 2.0
    assert modes(flown, 26.0) == {Mode.FOLLOW}


def test_a_shifted_map_looks_west_and_says_east():
    matcher = Scripted()
    shifted = ShiftedMap(matcher)
    frame = Frame(np.frombuffer(np.array([5.0, 6.0, 100.0]).tobytes(), np.uint8).reshape(1, 24), 0, 100.0)
    for shift_m in (0.0, 40.0):
        shifted.shift_m = shift_m
        fix = shifted.locate(frame, Prior(east_m=50.0, north_m=6.0, sigma_m=1.0))
        assert matcher.asked[-1][1].east_m == 50.0 - shift_m
        assert fix.east_m == pytest.approx(5.0 + shift_m, abs=1.5)
        there = matcher.site.frame.enu_from_geodetic(fix.lat_deg, fix.lon_deg)
        np.testing.assert_allclose(there, [fix.east_m, fix.north_m], atol=1e-6)
    with pytest.raises(OptionError, match="prior"):
        shifted.locate(frame, Prior(lat_deg=48.0, lon_deg=16.0, sigma_m=1.0))
