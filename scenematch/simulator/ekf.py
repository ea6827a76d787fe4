"""The reference filter: an error-state EKF over IMU, barometer, compass and the engine's delayed fixes.

Convention:
    Fifteen states of the vehicle: errors of position, velocity, attitude (a small rotation in east-north-up,
        applied from the left), accelerometer bias and gyroscope bias. Two more are the barometer's drift and the
        compass's error: they last so long that they would otherwise appear as height and heading. After Solà,
    "Quaternion kinematics for the error-state Kalman filter" (2017), section 7, with rotation matrices.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from engine.errors import StateError
from engine.geo import Array, chi_square, enu_from_body, larger_variance
from engine.values import Attitude, Fix
from scenematch.simulator.quadrotor import GRAVITY, STEP_S, IdealImu, next_time_s, rotation
from scenematch.simulator.sensors import SensorSuite

POSITION, VELOCITY, TURN, ACCEL, GYRO = (slice(k, k + 3) for k in range(0, 15, 3))
BARO, COMPASS = 15, 16
STATES = 17
START_TILT_DEG = 0.5
"""Standard deviation of roll and pitch of a levelled vehicle."""


@dataclass(frozen=True, slots=True)
class FilterState:
    """Estimate of the vehicle at one time, with its covariance.

    Attributes:
        time_s: since the start.
        position_m: (3,) east, north, up.
        velocity_mps: (3,) the same.
        enu_from_body: (3, 3) attitude.
        accel_bias_mps2: (3,) in the body.
        gyro_bias_rps: (3,) in the body.
        baro_drift_m: error of the barometer, positive if it reads too high.
        compass_bias_rad: error of the compass, positive if it reads too far clockwise.
        covariance: (17, 17) of the errors, in the order of the attributes.
    """

    time_s: float
    position_m: Array
    velocity_mps: Array
    enu_from_body: Array
    accel_bias_mps2: Array
    gyro_bias_rps: Array
    baro_drift_m: float
    compass_bias_rad: float
    covariance: Array

    @property
    def sigma_m(self) -> float:
        """Horizontal standard deviation, the larger axis of the ellipse."""
        return math.sqrt(larger_variance(self.covariance[:2, :2]))


def initial_state(position_m: Array, sigma_m: float, attitude: Attitude, suite: SensorSuite) -> FilterState:
    """The state of a levelled vehicle at rest; its heading is as uncertain as its compass.

    Args:
        position_m: (3,) east, north, up.
        sigma_m: of each of them.
        attitude: of the body.
        suite: its sensors.

    Returns:
        The state at time 0, biases and drifts 0.
    """
    imu = suite.imu
    tilt = math.radians(START_TILT_DEG)
    heading = math.radians(math.hypot(suite.compass.bias_deg, suite.compass.noise_deg))
    sigmas = np.array(
        [sigma_m] * 3 + [0.1] * 3 + [tilt, tilt, heading] + [imu.accel_start_mps2] * 3
        + [imu.gyro_start_rps] * 3 + [0.02, math.radians(suite.compass.bias_deg)]
    )  # fmt: skip
    covariance = np.diag(sigmas**2)
    # The heading is the compass's: if that reads too far clockwise, the true heading is anticlockwise of it.
    up = TURN.start + 2
    covariance[up, COMPASS] = covariance[COMPASS, up] = math.radians(suite.compass.bias_deg) ** 2
    return FilterState(
        0.0,
        np.asarray(position_m, float),
        np.zeros(3),
        enu_from_body(attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg),
        np.zeros(3),
        np.zeros(3),
        0.0,
        0.0,
        covariance,
    )


def predict(state: FilterState, sample: IdealImu, suite: SensorSuite) -> FilterState:
    """The state one step later, from the IMU's measurements."""
    rates, dt = sample.rates_rps - state.gyro_bias_rps, STEP_S
    half = state.enu_from_body @ rotation(0.5 * dt * rates)
    force = half @ (sample.force_mps2 - state.accel_bias_mps2)
    acceleration = force + GRAVITY
    keep_accel = math.exp(-dt / suite.imu.accel_time_s)
    keep_gyro = math.exp(-dt / suite.imu.gyro_time_s)
    keep_baro = math.exp(-dt / suite.barometer.drift_time_s)
    F = _transition(half, force, keep_accel, keep_gyro, keep_baro)
    covariance = F @ state.covariance @ F.T
    covariance[_DIAGONAL] += _process_noise(suite)
    return FilterState(
        next_time_s(state.time_s),
        state.position_m + dt * state.velocity_mps + 0.5 * dt**2 * acceleration,
        state.velocity_mps + dt * acceleration,
        state.enu_from_body @ rotation(dt * rates),
        keep_accel * state.accel_bias_mps2,
        keep_gyro * state.gyro_bias_rps,
        keep_baro * state.baro_drift_m,
        state.compass_bias_rad,
        covariance,
    )


_DIAGONAL = np.diag_indices(STATES)


def _transition(half: Array, force: Array, keep_accel: float, keep_gyro: float, keep_baro: float) -> Array:
    """Transition matrix (17, 17) of the errors over one step."""
    dt, F = STEP_S, np.eye(STATES)
    F[POSITION, VELOCITY] = dt * np.eye(3)
    F[VELOCITY, TURN] = -dt * _cross_matrix(force)
    F[VELOCITY, ACCEL] = -dt * half
    F[POSITION, TURN], F[POSITION, ACCEL] = 0.5 * dt * F[VELOCITY, TURN], 0.5 * dt * F[VELOCITY, ACCEL]
    F[TURN, GYRO] = -dt * half
    F[VELOCITY, GYRO] = 0.5 * F[VELOCITY, TURN] @ F[TURN, GYRO]
    F[ACCEL, ACCEL], F[GYRO, GYRO], F[BARO, BARO] = keep_accel * np.eye(3), keep_gyro * np.eye(3), keep_baro
    return F


def _cross_matrix(v: Array) -> Array:
    """The matrix of the cross product, [v]x.

    Args:
        v: (3,).

    Returns:
        (3, 3) with ``_cross_matrix(v) @ w == np.cross(v, w)``.
    """
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _process_noise(suite: SensorSuite) -> Array:
    """(17,) variances that one step adds; the same in every direction, so attitude does not matter."""
    imu, baro = suite.imu, suite.barometer
    drive = [0.0, imu.accel_noise, imu.gyro_noise, imu.accel_walk, imu.gyro_walk]
    drift = baro.drift_m * math.sqrt(2.0 / baro.drift_time_s)
    return STEP_S * np.concatenate([np.repeat(drive, 3), [drift, 0.0]]) ** 2


def correct(state: FilterState, residual: Array, H: Array, R: Array) -> FilterState:
    """The state after a measurement, in Joseph form, which keeps the covariance positive definite.

    Args:
        state: before.
        residual: (M,) measured less expected.
        H: (M, 17) Jacobian of the measurement by the errors.
        R: (M, M) covariance of its noise.

    Returns:
        The corrected state, with the errors taken into its position, velocity, attitude, biases and drifts.
    """
    P = state.covariance
    gain = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    update = np.eye(STATES) - gain @ H
    covariance = update @ P @ update.T + gain @ R @ gain.T
    error = gain @ residual
    # Applying the rotation to the attitude rotates the error frame by half of it (Solà, eq. 287): negligible.
    return FilterState(
        state.time_s,
        state.position_m + error[POSITION],
        state.velocity_mps + error[VELOCITY],
        rotation(error[TURN]) @ state.enu_from_body,
        state.accel_bias_mps2 + error[ACCEL],
        state.gyro_bias_rps + error[GYRO],
        state.baro_drift_m + float(error[BARO]),
        state.compass_bias_rad + float(error[COMPASS]),
        0.5 * (covariance + covariance.T),
    )


def fuse_height(state: FilterState, height_m: float, suite: SensorSuite) -> FilterState:
    """Fuse a height of the barometer, in metres in the datum of the position."""
    H = np.zeros((1, STATES))
    H[0, 2] = H[0, BARO] = 1.0
    residual = np.array([height_m - state.position_m[2] - state.baro_drift_m])
    return correct(state, residual, H, np.array([[suite.barometer.noise_m**2]]))


def fuse_heading(state: FilterState, heading_deg: float, suite: SensorSuite) -> FilterState:
    """Fuse a compass heading, clockwise from north; a body that points straight up or down has none."""
    east, north, up = state.enu_from_body[:, 0].tolist()
    flat2 = east**2 + north**2
    if flat2 < 1e-3:
        return state
    H = np.zeros((1, STATES))
    # d atan2(east, north) under a turn from the left, which moves the nose by turn x nose.
    H[0, TURN] = (up * east / flat2, up * north / flat2, -1.0)
    H[0, COMPASS] = 1.0
    off = math.radians(heading_deg) - math.atan2(east, north) - state.compass_bias_rad
    residual = np.array([(off + math.pi) % (2.0 * math.pi) - math.pi])
    return correct(state, residual, H, np.array([[math.radians(suite.compass.noise_deg) ** 2]]))


def fuse_fix(state: FilterState, fix: Fix) -> FilterState:
    """Fuse a fix of the engine with its covariance, and its height if it has one.

    Args:
        state: at the capture of the frame, about the same origin and in the same datum of heights.
        fix: of that frame.
    """
    position_m = [fix.east_m, fix.north_m] + ([] if fix.up_m is None else [fix.up_m])
    count = len(position_m)
    covariance_m2 = fix.covariance_m2[:count, :count]
    return correct(state, np.array(position_m) - state.position_m[:count], np.eye(count, STATES), covariance_m2)


def fix_chi_square(state: FilterState, fix: Fix) -> float:
    """Chi-square of a fix against the state, horizontally, with both covariances: 2 degrees of freedom."""
    offset_m = np.array([fix.east_m, fix.north_m]) - state.position_m[:2]
    return chi_square(offset_m, state.covariance[:2, :2] + fix.covariance_m2[:2, :2])


Correction = Callable[[FilterState], FilterState]
"""Fuses one measurement: takes the state before it, returns the state after it."""


@dataclass(slots=True)
class _Step:
    """A state, the IMU sample that led to it, and the measurements fused into it."""

    state: FilterState
    sample: IdealImu
    corrections: list[Correction] = field(default_factory=list)


class History:
    """A filter that fuses late measurements: it goes back to their time and repeats the following steps in order.

    This is exact and costs one prediction per repeated step: 12 for a fix 120 ms old.

    Args:
        start: the first state.
        suite: the vehicle's sensors.
        keep_s: largest age of a measurement.
    """

    def __init__(self, start: FilterState, suite: SensorSuite, keep_s: float = 2.0) -> None:
        self._suite = suite
        at_rest = IdealImu(np.zeros(3), np.zeros(3))  # a placeholder: the oldest step is never repeated
        self._steps = deque([_Step(start, at_rest)], maxlen=1 + round(keep_s / STEP_S))

    @property
    def now(self) -> FilterState:
        """The latest state."""
        return self._steps[-1].state

    def advance(self, sample: IdealImu) -> None:
        """Predict one step from the IMU's measurements."""
        self._steps.append(_Step(predict(self.now, sample, self._suite), sample))

    def at(self, time_s: float) -> FilterState:
        """The state at a time, using all measurements so far.

        Raises:
            StateError: the time is in the future, or older than ``keep_s``.
        """
        return self._steps[self._index(time_s)].state

    def fuse(self, correction: Correction, time_s: float) -> None:
        """Fuse a measurement at the time it was taken.

        Raises:
            StateError: the time is in the future, or older than ``keep_s``.
        """
        index = self._index(time_s)
        step = self._steps[index]
        step.corrections.append(correction)
        step.state = correction(step.state)
        for before, step in itertools.pairwise(itertools.islice(self._steps, index, None)):
            step.state = predict(before.state, step.sample, self._suite)
            for later in step.corrections:
                step.state = later(step.state)

    def _index(self, time_s: float) -> int:
        """The step that ended at a time."""
        index = len(self._steps) - 1 - round((self.now.time_s - time_s) / STEP_S)
        if not 0 <= index < len(self._steps):
            oldest_s, newest_s = self._steps[0].state.time_s, self.now.time_s
            raise StateError(f"time_s: expected {oldest_s:.2f} to {newest_s:.2f}, got {time_s:.2f}")
        return index
