"""The reference filter: derivatives against differences, consistency over seeds, and delayed measurements."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from engine import Attitude, StateError
from engine.geo import enu_from_body
from scenematch.simulator import ekf, quadrotor
from scenematch.simulator.ekf import STATES, FilterState, History, fuse_fix, fuse_heading, fuse_height
from scenematch.simulator.quadrotor import STEP_S, IdealImu, WindField, advance, hovering, rotation_vector, shaken
from scenematch.simulator.sensors import Instruments, SensorSuite
from tests.support.fixes import a_fix

SUITE = SensorSuite()
ADDITIVE = {
    "position_m": ekf.POSITION, "velocity_mps": ekf.VELOCITY, "accel_bias_mps2": ekf.ACCEL,
    "gyro_bias_rps": ekf.GYRO, "baro_drift_m": 15, "compass_bias_rad": ekf.COMPASS,
}  # fmt: skip
"""Where each part of the state but the attitude lies in an error."""
FIX_SIGMA_M, FIX_LATENCY_S = 1.5, 0.11
SAMPLE = IdealImu(np.array([0.4, -0.3, -9.6]), np.array([0.2, -0.1, 0.3]))


def some_belief() -> FilterState:
    spread = np.random.default_rng(2).normal(0.0, 0.3, (STATES, STATES))
    place_m, velocity_mps = np.array([10.0, -5.0, 120.0]), np.array([6.0, 2.0, -0.5])
    biases = np.array([0.05, -0.02, 0.03]), np.array([0.001, 0.002, -0.001]), 0.4, 0.02
    covariance = spread @ spread.T + 0.01 * np.eye(STATES)
    return FilterState(4.0, place_m, velocity_mps, enu_from_body(4.0, -9.0, 130.0), *biases, covariance)


def moved(estimate: FilterState, error: np.ndarray) -> FilterState:
    """The truth where the estimate is off by an error."""
    sums = {name: getattr(estimate, name) + error[part] for name, part in ADDITIVE.items()}
    return replace(estimate, enu_from_body=quadrotor.rotation(error[ekf.TURN]) @ estimate.enu_from_body, **sums)


def apart(truth: FilterState, estimate: FilterState) -> np.ndarray:
    """The error (17,) of an estimate."""
    error = np.empty(STATES)
    for name, part in ADDITIVE.items():
        error[part] = getattr(truth, name) - getattr(estimate, name)
    error[ekf.TURN] = rotation_vector(truth.enu_from_body @ estimate.enu_from_body.T)
    return error


def derivatives(function, estimate: FilterState, step: float) -> np.ndarray:
    """Columns of differences by each of the 17 errors."""
    errors = step * np.eye(STATES)
    return np.stack([(function(moved(estimate, e)) - function(estimate)) / step for e in errors], axis=-1)


# ------------------------------------------------------------------------------------- derivatives and algebra


def test_prediction_carries_errors_as_differences_say():
    estimate = some_belief()
    expected = ekf.predict(estimate, SAMPLE, SUITE)
    F = derivatives(lambda belief: apart(ekf.predict(belief, SAMPLE, SUITE), expected), estimate, 1e-5)
    added = expected.covariance - F @ estimate.covariance @ F.T
    np.testing.assert_allclose(added - np.diag(np.diag(added)), 0.0, atol=2e-5)
    assert np.diag(added).min() > -2e-5  # noise is white: on the diagonal
    baro = SUITE.barometer
    assert added[15, 15] == pytest.approx(2.0 * STEP_S * baro.drift_m**2 / baro.drift_time_s, rel=0.01)


@pytest.mark.parametrize(
    ("fuse", "measured", "variance"),
    [
        (partial(fuse_height, suite=SUITE), lambda b: b.position_m[2] + b.baro_drift_m,
         SUITE.barometer.noise_m**2),
        (partial(fuse_heading, suite=SUITE),
         lambda b: math.degrees(math.atan2(*b.enu_from_body[:2, 0]) + b.compass_bias_rad),
         SUITE.compass.noise_deg**2),
    ],
    ids=["barometer", "compass"],
)  # fmt: skip
def test_a_measurement_moves_the_belief_as_its_differences_say(fuse, measured, variance):
    estimate = some_belief()
    H = derivatives(measured, estimate, 1e-6)
    gain = estimate.covariance @ H / (H @ estimate.covariance @ H + variance)
    np.testing.assert_allclose(apart(fuse(estimate, measured(estimate) + 0.01), estimate), 0.01 * gain, atol=2e-6)


def test_a_heading_is_compared_the_short_way_round():
    estimate = replace(some_belief(), enu_from_body=enu_from_body(0.0, 0.0, 359.8), compass_bias_rad=0.0)
    turned = rotation_vector(fuse_heading(estimate, 0.2, SUITE).enu_from_body @ estimate.enu_from_body.T)
    assert np.linalg.norm(turned) < math.radians(0.6)


def test_joseph_is_the_textbook_where_that_is_exact():
    estimate = some_belief()
    H = np.random.default_rng(1).normal(size=(2, STATES))
    R = np.diag([0.3, 0.7])
    after = ekf.correct(estimate, np.zeros(2), H, R)
    expected = np.linalg.inv(np.linalg.inv(estimate.covariance) + H.T @ np.linalg.inv(R) @ H)
    np.testing.assert_allclose(after.covariance, expected, atol=1e-9)
    np.testing.assert_allclose(after.position_m, estimate.position_m)


def test_a_fix_pulls_by_its_covariance_and_without_height_leaves_the_height():
    estimate = replace(some_belief(), covariance=np.eye(STATES))
    assert fuse_fix(estimate, a_fix(12.0, -5.0)).position_m == pytest.approx([11.0, -5.0, 120.0])
    assert fuse_fix(estimate, a_fix(10.0, -5.0, up_m=122.0)).position_m == pytest.approx([10.0, -5.0, 121.0])
    assert ekf.fix_chi_square(estimate, a_fix(14.0, -2.0)) == pytest.approx(25.0 / 2.0)


def test_a_perfect_imu_carries_a_perfect_belief_along_the_truth():
    state, rng = hovering(np.array([0.0, 0.0, 100.0]), 200.0), np.random.default_rng(9)
    estimate = ekf.initial_state(state.position_m, 1.0, Attitude(0.0, 0.0, 200.0), SUITE)
    air = WindField(rng)
    for k in range(500):
        if k % 250 == 0:
            state = shaken(state, rng)
        state, felt = advance(state, np.array([1.0, math.cos(k / 60), 0.1]), 200.0 + 0.1 * k, air.next())
        estimate = ekf.predict(estimate, felt, SUITE)
    np.testing.assert_allclose(estimate.position_m, state.position_m, atol=1e-6)
    np.testing.assert_allclose(estimate.enu_from_body, state.enu_from_body, atol=1e-9)


# -------------------------------------------------------------------------------------------------- consistency


def fly(seed, seconds, fixes_until_s=math.inf):
    """A flight of turns: every second the filter's error (17,), covariance, and the sigma of the position."""
    winds, sensors, start, shakes = np.random.default_rng(seed).spawn(4)
    air, carried = WindField(winds), Instruments(SUITE, sensors)
    state, off = hovering(np.array([0.0, 0.0, 150.0]), 0.0), start.standard_normal(8)
    state = replace(state, velocity_mps=0.1 * off[:3])
    believed = Attitude(0.5 * off[3], 0.5 * off[4], carried.heading_deg(state))
    history = History(ekf.initial_state(state.position_m + 2.0 * off[5:], 2.0, believed, SUITE), SUITE)
    pending, rows = [], []
    for k in range(1, round(seconds / STEP_S) + 1):
        if k % 300 == 0:
            state = shaken(state, shakes)
        wanted = np.array([math.cos(0.01 * k), math.sin(0.007 * k), 0.0])
        state, felt = advance(state, wanted, 0.2 * k, air.next())
        history.advance(carried.imu(felt))
        if k % 5 == 0:
            history.fuse(partial(fuse_height, height_m=carried.height_m(state), suite=SUITE), state.time_s)
        if k % 10 == 0:
            heading_deg = carried.heading_deg(state)
            history.fuse(partial(fuse_heading, heading_deg=heading_deg, suite=SUITE), state.time_s)
        if k % 20 == 0 and state.time_s < fixes_until_s:
            east_m, north_m, up_m = state.position_m + FIX_SIGMA_M * start.standard_normal(3)
            pending.append((state.time_s, a_fix(east_m, north_m, FIX_SIGMA_M, up_m=up_m)))
        if pending and state.time_s >= pending[0][0] + FIX_LATENCY_S:
            time_s, fix = pending.pop(0)
            history.fuse(partial(fuse_fix, fix=fix), time_s)
        if k % 100 == 0:
            now = history.now
            truth = FilterState(
                state.time_s, state.position_m, state.velocity_mps, state.enu_from_body, carried.accel_bias_mps2,
                carried.gyro_bias_rps, carried.baro_drift_m, math.radians(carried.compass_bias_deg),
                np.eye(STATES),
            )  # fmt: skip
            rows.append((apart(truth, now), now.covariance, now.sigma_m))
    return rows


@pytest.mark.slow
def test_errors_are_as_large_as_the_covariance_says():
    """The NEES at the end of every flight lies in the 99.9 % interval of its chi-square, whole and by parts."""
    ends = [fly(seed, 12.0)[-1] for seed in range(200, 210)]
    for part in [ekf.POSITION, ekf.VELOCITY, ekf.TURN, ekf.ACCEL, ekf.GYRO, slice(0, STATES)]:
        squares = [e[part] @ np.linalg.solve(P[part, part], e[part]) for e, P, _ in ends]
        freedom = len(squares) * (part.stop - part.start)
        spread = 3.29 * math.sqrt(2.0 / freedom)  # the chi-square is near enough to a normal one
        assert 1.0 - spread < np.sum(squares) / freedom < 1.0 + spread, part


def test_the_covariance_stays_positive_definite_and_symmetric():
    for _, P, _ in fly(210, 12.0):
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P)[0] > 0.0


@pytest.mark.slow
def test_without_positions_the_sigma_grows_and_holds_the_error():
    squares, sigmas = [], []
    for seed in range(300, 304):
        rows = fly(seed, 12.0, fixes_until_s=6.0)
        sigma = [s for *_, s in rows]
        assert (np.diff(sigma[7:]) > 0.0).all()
        error, P, _ = rows[-1]
        squares.append(error[:2] @ np.linalg.solve(P[:2, :2], error[:2]))
        sigmas.append(sigma[-1] / sigma[5])
    assert np.mean(sigmas) > 2.0
    assert np.sum(squares) < 26.1  # chi-square of 8 degrees of freedom, 99.9 %


# ------------------------------------------------------------------------------------------------------ history


def test_a_measurement_that_comes_late_does_what_it_would_have_done_in_time():
    rng = np.random.default_rng(6)
    samples = [IdealImu(SAMPLE.force_mps2 + 0.1 * rng.normal(size=3), 0.1 * rng.normal(size=3)) for _ in range(60)]
    fix = partial(fuse_fix, fix=a_fix(11.0, -4.0, 0.5))
    prompt, late = (History(replace(some_belief(), time_s=0.0), SUITE) for _ in range(2))
    for k, sample in enumerate(samples):
        for history in (prompt, late):
            history.advance(sample)
            if k % 7 == 0:
                history.fuse(partial(fuse_height, height_m=120.0, suite=SUITE), history.now.time_s)
        if k == 29:
            prompt.fuse(fix, prompt.now.time_s)
            moment = prompt.now.time_s
    late.fuse(fix, moment)
    np.testing.assert_allclose(late.now.position_m, prompt.now.position_m, atol=1e-12)
    np.testing.assert_allclose(late.now.covariance, prompt.now.covariance, atol=1e-12)
    np.testing.assert_allclose(late.at(moment).position_m, prompt.at(moment).position_m, atol=1e-12)


def test_the_start_can_be_corrected_too_and_no_other_moment():
    history = History(replace(some_belief(), time_s=0.0), SUITE, keep_s=0.2)
    for _ in range(10):
        history.advance(SAMPLE)
    before = history.now.sigma_m
    history.fuse(partial(fuse_fix, fix=a_fix(10.0, -5.0, 0.5)), 0.0)
    assert history.now.sigma_m < before
    for _ in range(20):
        history.advance(SAMPLE)
    for moment in (0.0, 0.31):
        with pytest.raises(StateError, match="time_s"):
            history.fuse(partial(fuse_fix, fix=a_fix(10.0, -5.0, 0.5)), moment)
