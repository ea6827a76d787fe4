"""The quadrotor: physics against closed forms, the pilot along a route, and the statistics of the sensors."""

import math

import numpy as np
import pytest

from engine.geo import attitude_from_rotation, enu_from_body
from scenematch.simulator import quadrotor
from scenematch.simulator.pilot import Pilot, plan_rounds, plan_route
from scenematch.simulator.quadrotor import SHAKE_DEG, STEP_S, WindField, advance, aim, hovering, rotation, shaken
from scenematch.simulator.sensors import Barometer, Compass, Imu, Instruments, SensorSuite
from scenematch.simulator.vehicle import GRAVITY_MPS2, FlightStyle

CALM = np.zeros(3)
SQUARE = np.array([[-60.0, -40.0], [-60.0, 40.0], [60.0, 40.0]])


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.3, 1.5, 3.1])
def test_rotation_vectors_go_there_and_back(angle):
    axis = np.array([0.48, -0.6, 0.64])
    turned = rotation(angle * axis)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(quadrotor.rotation_vector(turned), angle * axis, atol=1e-9)
    np.testing.assert_allclose(turned @ axis, axis, atol=1e-12)


def test_rotation_is_the_one_of_the_attitude():
    # Heading is a turn clockwise, seen from above: about down.
    for heading in (20.0, 160.0):
        turned = enu_from_body(0.0, 0.0, 0.0) @ rotation(np.array([0.0, 0.0, math.radians(heading)]))
        np.testing.assert_allclose(turned, enu_from_body(0.0, 0.0, heading), atol=1e-12)


def test_what_hovers_stays_and_feels_its_weight():
    state = hovering(np.array([3.0, -4.0, 150.0]), 77.0)
    for _ in range(300):
        state, felt = advance(state, CALM, 77.0, CALM)
    np.testing.assert_allclose(state.position_m, [3.0, -4.0, 150.0], atol=1e-9)
    np.testing.assert_allclose(felt.force_mps2, [0.0, 0.0, -GRAVITY_MPS2], atol=1e-9)
    assert state.time_s == pytest.approx(3.0)


@pytest.mark.parametrize("heading", [0.0, 135.0, 300.0])
def test_the_attitude_gives_the_acceleration_that_is_asked_for(heading):
    wanted = np.array([1.2, -0.7, 0.4])
    attitude, force = aim(wanted, heading)
    np.testing.assert_allclose(attitude.T @ attitude, np.eye(3), atol=1e-12)
    assert np.linalg.det(attitude) == pytest.approx(1.0)
    np.testing.assert_allclose(-attitude[:, 2] * np.linalg.norm(force) - (0, 0, GRAVITY_MPS2), wanted, atol=1e-12)
    # The body's right stays level across the heading.
    sine, cosine = math.sin(math.radians(heading)), math.cos(math.radians(heading))
    assert attitude[:, 1] @ (sine, cosine, 0.0) == pytest.approx(0.0, abs=1e-12)


def test_tilt_is_limited_and_thrust_never_pushes_down():
    for wanted in ([40.0, 0.0, 0.0], [3.0, 3.0, -30.0]):
        attitude, force = aim(np.array(wanted), 10.0)
        assert math.degrees(math.acos(-attitude[2, 2])) <= quadrotor.MAX_TILT_DEG + 1e-9
        assert force[2] > 0.0


@pytest.mark.slow
def test_drag_ends_where_the_air_and_the_push_balance():
    air = np.array([4.0, -2.0, 0.0])
    state = hovering(np.zeros(3), 0.0)
    for _ in range(round(100.0 / STEP_S)):
        state, _ = advance(state, np.array([0.5, 0.0, 0.0]), 0.0, air)
    np.testing.assert_allclose(state.velocity_mps, air + np.array([0.5, 0.0, 0.0]) / 0.1, atol=0.01)


def test_a_shake_swings_to_its_size_and_dies_away():
    for seed in range(5):
        state = shaken(hovering(np.zeros(3), 0.0), np.random.default_rng(seed))
        tilts = []
        for _ in range(300):
            state, _ = advance(state, CALM, 0.0, CALM)
            tilts.append(math.degrees(math.acos(min(1.0, -state.enu_from_body[2, 2]))))
        assert 0.55 * SHAKE_DEG < max(tilts) < 1.05 * SHAKE_DEG
        assert max(tilts[-50:]) < 0.05 * max(tilts)


def test_gusts_have_their_size_and_their_length():
    air = WindField(np.random.default_rng(1), mean_mps=(3.0, -1.0), gust_sd_mps=2.0, gust_time_s=0.5)
    blown = np.array([air.next() for _ in range(60000)])
    np.testing.assert_allclose(blown.mean(axis=0), [3.0, -1.0, 0.0], atol=0.3)
    np.testing.assert_allclose(blown.std(axis=0), [2.0, 2.0, 1.0], rtol=0.12)
    lag = round(0.5 / STEP_S)
    east = blown[:, 0] - blown[:, 0].mean()
    assert (east[lag:] * east[:-lag]).mean() / (east * east).mean() == pytest.approx(math.exp(-1.0), abs=0.12)


# --------------------------------------------------------------------------------------------------- the pilot


def test_a_route_stops_at_its_waypoints_and_its_velocity_is_its_derivative():
    route = plan_route(SQUARE, FlightStyle(height_agl_m=80.0))
    assert (route.position_m[:, 2] == 80.0).all()
    np.testing.assert_allclose(np.gradient(route.position_m, 0.01, axis=0), route.velocity_mps, atol=0.02)
    for corner in SQUARE:
        near = np.hypot(*(route.position_m[:, :2] - corner).T) < 0.2
        assert near.any()
        assert np.hypot(*route.velocity_mps[near, :2].T).min() < 0.1


def test_a_route_at_half_its_pace_is_flown_at_half_the_speed():
    route = plan_route(SQUARE)
    full, half = route.at(20.0), route.at(20.0, 0.5)
    np.testing.assert_allclose(half.velocity_mps, 0.5 * full.velocity_mps)
    np.testing.assert_allclose(half.acceleration_mps2, 0.25 * full.acceleration_mps2)
    # While the pace drops the speed does, by the chain rule; checked against differences of the velocity.
    paces = [0.6 - 0.2 * STEP_S, 0.6, 0.6 + 0.2 * STEP_S]
    clocks = [20.0 - 0.6 * STEP_S, 20.0, 20.0 + 0.6 * STEP_S]
    speeds = [p * np.array([np.interp(c, np.arange(len(v)) * 0.01, v) for v in route.velocity_mps.T])
              for p, c in zip(paces, clocks, strict=True)]  # fmt: skip
    slope = (speeds[2] - speeds[0]) / (2.0 * STEP_S)
    np.testing.assert_allclose(route.at(20.0, 0.6, 0.2).acceleration_mps2, slope, atol=0.02)


@pytest.mark.parametrize("clock_s", [-5.0, 1e6])
def test_beyond_its_ends_a_route_hovers(clock_s):
    point = plan_route(SQUARE).at(clock_s)
    assert np.abs(point.velocity_mps).max() < 0.05
    assert np.hypot(*(SQUARE - point.position_m[:2]).T).min() < 0.2


@pytest.mark.slow
def test_the_pilot_keeps_the_route_in_gusts_and_shakes():
    route, rng = plan_route(SQUARE), np.random.default_rng(5)
    state, air, pilot = hovering(route.position_m[0], float(route.heading_deg[0])), WindField(rng), Pilot()
    off, tilts, kicks = [], [], list(route.kicks_s)
    for k in range(round(route.duration_s / STEP_S)):
        target = route.at(k * STEP_S)
        if kicks and k * STEP_S >= kicks[0]:
            kicks.pop(0)
            state = shaken(state, rng)
        wanted = pilot.steer(target, state.position_m, state.velocity_mps)
        state, _ = advance(state, wanted, target.heading_deg, air.next())
        off.append(state.position_m - target.position_m)
        tilts.append(math.degrees(math.acos(min(1.0, -state.enu_from_body[2, 2]))))
    assert np.hypot(*np.array(off)[:, :2].T).max() < 0.6
    assert np.abs(np.array(off)[:, 2]).max() < 0.2
    assert 7.0 < max(tilts) < 16.0
    nose = attitude_from_rotation(state.enu_from_body)[2]
    assert abs((nose - route.heading_deg[-1] + 180.0) % 360.0 - 180.0) < 2.0


def test_rounds_last_as_long_as_they_should():
    route = plan_rounds((50.0, 30.0), 100.0)
    assert 100.0 <= route.duration_s < 130.0
    assert (np.abs(route.position_m[:, :2]) < (50.5, 30.5)).all()


# ----------------------------------------------------------------------------------------------------- the sensors


STILL = hovering(np.array([10.0, -20.0, 120.0]), 359.5)
NOTHING = quadrotor.IdealImu(np.zeros(3), np.zeros(3))


def instruments(seed=0, **sensors):
    return Instruments(SensorSuite(**sensors), np.random.default_rng(seed))


def test_the_imus_noise_has_its_density():
    # A bias that neither starts nor walks leaves white noise, of density / sqrt(step).
    imu = Imu(accel_walk=1e-12, accel_start_mps2=1e-12, gyro_walk=1e-12, gyro_start_rps=1e-12)
    carried = instruments(imu=imu)
    samples = [carried.imu(NOTHING) for _ in range(5000)]
    force, rates = np.array([s.force_mps2 for s in samples]), np.array([s.rates_rps for s in samples])
    np.testing.assert_allclose(force.std(axis=0), imu.accel_noise / math.sqrt(STEP_S), rtol=0.05)
    np.testing.assert_allclose(rates.std(axis=0), imu.gyro_noise / math.sqrt(STEP_S), rtol=0.05)
    assert abs(np.corrcoef(force[1:, 0], force[:-1, 0])[0, 1]) < 0.05


def test_the_imus_biases_walk_as_far_as_they_should():
    imu, seconds, flights = Imu(), 5.0, 60
    moved, turned = [], []
    for seed in range(flights):
        carried = instruments(seed, imu=imu)
        before = carried.accel_bias_mps2.copy(), carried.gyro_bias_rps.copy()
        for _ in range(round(seconds / STEP_S)):
            carried.imu(NOTHING)
        moved.append(carried.accel_bias_mps2 - before[0])
        turned.append(carried.gyro_bias_rps - before[1])
    root = math.sqrt(seconds)
    assert np.std(moved) == pytest.approx(imu.accel_walk * root, rel=0.2)
    assert np.std(turned) == pytest.approx(imu.gyro_walk * root, rel=0.2)


def test_the_compass_is_off_by_one_angle_in_a_flight_and_by_others_in_others():
    compass = Compass(noise_deg=0.5, bias_deg=2.0)
    biases = []
    for seed in range(80):
        carried = instruments(seed, compass=compass)
        read = np.array([carried.heading_deg(STILL) for _ in range(40)])
        assert ((read >= 0.0) & (read < 360.0)).all()
        off = (read - 359.5 + 180.0) % 360.0 - 180.0
        assert off.mean() == pytest.approx(carried.compass_bias_deg, abs=0.4)
        biases.append(carried.compass_bias_deg)
    assert np.std(biases) == pytest.approx(2.0, rel=0.25)


def test_the_barometer_starts_at_zero_and_drifts_to_its_sigma():
    baro = Barometer(noise_m=0.2, drift_m=1.5, drift_time_s=2.0)
    drifts, reads = [], []
    for seed in range(80):
        carried = instruments(seed, barometer=baro)
        reads.append(carried.height_m(STILL))
        for _ in range(200):  # five correlation times
            carried.height_m(STILL)
        drifts.append(carried.baro_drift_m)
    assert np.std(reads) == pytest.approx(0.2, rel=0.25)
    assert np.mean(reads) == pytest.approx(120.0, abs=0.1)
    assert np.std(drifts) == pytest.approx(1.5, rel=0.25)


def test_one_seed_gives_one_flight_and_each_sensor_its_own_stream():
    first, second, other = instruments(7), instruments(7), instruments(8)
    second.height_m(STILL)  # another sensor's use changes nothing
    a, b, c = (s.imu(NOTHING).force_mps2 for s in (first, second, other))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
