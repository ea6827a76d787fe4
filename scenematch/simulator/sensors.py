"""The vehicle's sensors and their errors: IMU, compass and barometer, drawn from one seed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from engine.geo import Array, wrap_heading_deg
from scenematch.simulator.quadrotor import STEP_S, IdealImu, State


@dataclass(frozen=True, kw_only=True)
class Imu:
    """Accelerometer and gyroscope: white noise, and a bias (Gauss-Markov).

    The defaults are the ADIS16448's from RotorS and PX4's Gazebo (Furrer et al., 2016); the initial biases are
    what levelling and gyroscope calibration on the ground leave.

    Attributes:
        accel_noise: white noise of the specific force, in m/s^2 per root Hz.
        accel_walk: driving noise of its bias, in m/s^3 per root Hz.
        accel_time_s: correlation time of that bias.
        accel_start_mps2: standard deviation of the bias at the start.
        gyro_noise: white noise of the turn rates, in rad/s per root Hz.
        gyro_walk: driving noise of their bias, in rad/s^2 per root Hz.
        gyro_time_s: correlation time of that bias.
        gyro_start_rps: standard deviation of the bias at the start.
    """

    accel_noise: float = 0.004
    accel_walk: float = 0.006
    accel_time_s: float = 300.0
    accel_start_mps2: float = 0.05
    gyro_noise: float = 3.4e-4
    gyro_walk: float = 3.9e-5
    gyro_time_s: float = 1000.0
    gyro_start_rps: float = 1.0e-3


@dataclass(frozen=True, kw_only=True)
class Compass:
    """Heading from the magnetic field, after declination: the HMC5883L's data sheet gives 1 to 2 degrees.

    Attributes:
        rate_hz: samples per second.
        noise_deg: white noise.
        bias_deg: standard deviation of the constant error left by iron and calibration.
    """

    rate_hz: float = 10.0
    noise_deg: float = 0.7
    bias_deg: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Barometer:
    """Height by air pressure: noise of an MS5611 (0.1 m at best) in the rotors' wash, and a slow drift.

    Attributes:
        rate_hz: samples per second.
        noise_m: white noise.
        drift_m: standard deviation of the drift (Gauss-Markov), which is 0 at the start.
        drift_time_s: its correlation time.
    """

    rate_hz: float = 20.0
    noise_m: float = 0.3
    drift_m: float = 1.0
    drift_time_s: float = 200.0


def steps_between(rate_hz: float) -> int:
    """Number of simulation steps per sample, for at most one sample a step."""
    return round(1.0 / (rate_hz * STEP_S))


@dataclass(frozen=True, kw_only=True)
class SensorSuite:
    """The sensors on board."""

    imu: Imu = field(default_factory=Imu)
    compass: Compass = field(default_factory=Compass)
    barometer: Barometer = field(default_factory=Barometer)


class Instruments:
    """The sensors of one flight with their errors, each drawn from a random stream of its own.

    Attributes:
        accel_bias_mps2: (3,) current bias.
        gyro_bias_rps: (3,) current bias.
        compass_bias_deg: constant.
        baro_drift_m: current drift.
    """

    def __init__(self, suite: SensorSuite, rng: np.random.Generator) -> None:
        self.suite = suite
        self._imu, self._compass, self._baro = rng.spawn(3)
        self.accel_bias_mps2: Array = suite.imu.accel_start_mps2 * self._imu.standard_normal(3)
        self.gyro_bias_rps: Array = suite.imu.gyro_start_rps * self._imu.standard_normal(3)
        self.compass_bias_deg = suite.compass.bias_deg * float(self._compass.standard_normal())
        self.baro_drift_m = 0.0

    def imu(self, felt: IdealImu) -> IdealImu:
        """One step's specific force and turn rates as measured; advances the biases."""
        imu, rng = self.suite.imu, self._imu
        white = rng.standard_normal(12)
        per_step, drive = 1.0 / math.sqrt(STEP_S), math.sqrt(STEP_S)
        force = felt.force_mps2 + self.accel_bias_mps2 + imu.accel_noise * per_step * white[:3]
        rates = felt.rates_rps + self.gyro_bias_rps + imu.gyro_noise * per_step * white[3:6]
        self.accel_bias_mps2 = (
            math.exp(-STEP_S / imu.accel_time_s) * self.accel_bias_mps2 + imu.accel_walk * drive * white[6:9]
        )
        self.gyro_bias_rps = (
            math.exp(-STEP_S / imu.gyro_time_s) * self.gyro_bias_rps + imu.gyro_walk * drive * white[9:]
        )
        return IdealImu(force, rates)

    def heading_deg(self, state: State) -> float:
        """Heading by the compass in degrees, in [0, 360)."""
        error = self.compass_bias_deg + self.suite.compass.noise_deg * float(self._compass.standard_normal())
        return wrap_heading_deg(state.attitude.heading_deg + error)

    def height_m(self, state: State) -> float:
        """Height by the barometer, above the ground where it was zeroed; advances its drift."""
        baro = self.suite.barometer
        white, walk = self._baro.standard_normal(2).tolist()
        measured = float(state.position_m[2]) + self.baro_drift_m + baro.noise_m * white
        keep = math.exp(-steps_between(baro.rate_hz) * STEP_S / baro.drift_time_s)
        self.baro_drift_m = keep * self.baro_drift_m + baro.drift_m * math.sqrt(1.0 - keep**2) * walk
        return float(measured)
