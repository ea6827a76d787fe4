"""The sensors: the statistics that their descriptions promise, over many samples or many flights."""

from __future__ import annotations

import math

import numpy as np
import pytest

from scenematch.simulator.quadrotor import STEP_S, IdealImu, hovering
from scenematch.simulator.sensors import Barometer, Compass, Imu, Instruments, SensorSuite, steps_between

STILL = hovering(np.array([10.0, -20.0, 120.0]), 359.5)
NOTHING = IdealImu(np.zeros(3), np.zeros(3))


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


def test_the_imu_adds_its_errors_to_what_is_felt():
    felt = IdealImu(np.array([1.0, 2.0, -9.0]), np.array([0.1, 0.2, 0.3]))
    with_motion, without = instruments(4).imu(felt), instruments(4).imu(NOTHING)
    np.testing.assert_allclose(with_motion.force_mps2 - without.force_mps2, felt.force_mps2, atol=1e-12)
    np.testing.assert_allclose(with_motion.rates_rps - without.rates_rps, felt.rates_rps, atol=1e-12)


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


def test_rates_are_those_of_the_steps():
    assert steps_between(5.0) == 20
    assert steps_between(100.0) == 1
