"""The drone's flight and telemetry: a path of straight legs with stops, and noisy measurements.

Convention:
    Positions are local east-north-up metres about the map's centre, up above the flat ground. The body is
    forward-right-down; a multirotor tilts its thrust into the acceleration, so it noses down to speed up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, fields

import numpy as np

from engine.errors import OptionError
from engine.geo import Array, wrap_difference_deg
from engine.values import check, check_positive

GRAVITY_MPS2 = 9.80665
COURSE_STEP_S = 0.01
"""Time step for integrating a flight along waypoints."""
START_NS = 1_000_000_000
"""Timestamp at which simulated flights begin."""


@dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """Errors of the telemetry; all zero is perfect telemetry.

    Attributes:
        height_sd_m: white noise of the height.
        height_drift_sd_m: standard deviation of the barometer's slow drift.
        height_drift_time_s: how long that drift stays correlated.
        heading_sd_deg: white noise of the heading.
        heading_bias_deg: constant error of the heading, to the right.
        tilt_sd_deg: white noise of roll and of pitch.
        velocity_sd_mps: white noise of each component of the velocity.

    Raises:
        OptionError: a value is negative or not finite.
    """

    height_sd_m: float = 0.7
    height_drift_sd_m: float = 0.5
    height_drift_time_s: float = 40.0
    heading_sd_deg: float = 0.7
    heading_bias_deg: float = 0.4
    tilt_sd_deg: float = 0.35
    velocity_sd_mps: float = 0.2

    def __post_init__(self) -> None:
        for item in fields(self):
            check(self, item.name, "0 or more", lambda value: 0.0 <= value < math.inf)


@dataclass(frozen=True, kw_only=True)
class FlightStyle:
    """The style of flying.

    Attributes:
        height_agl_m: above the flat ground.
        cruise_mps: speed in the middle of a leg; with the defaults legs are flown at 6.6 m/s on average.
        acceleration_mps2: on a leg; its tilt is atan(a / g).
        ramp_s: time for the acceleration to build up and fade, which limits the jerk.
        pause_s: hover at each waypoint, during which the vehicle yaws.
        peak_tilt_deg: largest tilt of the flight, from acceleration plus vibration.
        height_sd_m: slow variation about the set height.

    Raises:
        OptionError: a value is not positive, or acceleration alone tilts beyond the peak.
    """

    height_agl_m: float = 150.0
    cruise_mps: float = 8.5
    acceleration_mps2: float = 1.15
    ramp_s: float = 1.0
    pause_s: float = 2.5
    peak_tilt_deg: float = 7.2
    height_sd_m: float = 0.4

    def __post_init__(self) -> None:
        check_positive(self, *self.__dataclass_fields__)
        steady = math.degrees(math.atan(self.acceleration_mps2 / GRAVITY_MPS2))
        if steady >= self.peak_tilt_deg:
            raise OptionError(
                f"peak_tilt_deg: expected more than the {steady:.2f} of acceleration, got {self.peak_tilt_deg}"
            )


@dataclass(frozen=True)
class Motion:
    """The flight at times (N,): position and velocity (N, 3) east-north-up, attitude (N,) in degrees."""

    time_s: Array
    position_m: Array
    velocity_mps: Array
    roll_deg: Array
    pitch_deg: Array
    heading_deg: Array

    def at(self, time_s: Array) -> Motion:
        """The motion at other times, interpolated linearly between the steps of the integration.

        Args:
            time_s: (M,) seconds since take-off.

        Returns:
            The motion at these M times; headings in [0, 360) degrees.
        """

        def pick(values: Array) -> Array:
            return np.asarray(np.interp(time_s, self.time_s, values))

        position_m, velocity_mps = (
            np.column_stack([pick(v[:, k]) for k in range(3)]) for v in (self.position_m, self.velocity_mps)
        )
        heading = np.degrees(pick(np.unwrap(np.radians(self.heading_deg)))) % 360.0
        roll, pitch = pick(self.roll_deg), pick(self.pitch_deg)
        return Motion(np.asarray(time_s), position_m, velocity_mps, roll, pitch, heading)


def leg_accelerations(length_m: float, style: FlightStyle) -> Array:
    """Acceleration along a leg from stop to stop: speed up, cruise, slow down.

    Args:
        length_m: of the leg, above 0.
        style: cruise speed, acceleration and ramp.

    Returns:
        (N,) m/s^2 along the leg, every :data:`COURSE_STEP_S`.
    """
    # Speeding up to v takes v / a + ramp at a mean speed of v / 2, and slowing down mirrors it; short legs
    # have no cruise, and their top speed solves v (v / a + ramp) = length.
    a, ramp = style.acceleration_mps2, style.ramp_s
    top = min(style.cruise_mps, 0.5 * a * (math.sqrt(ramp**2 + 4.0 * length_m / a) - ramp))
    change = top / a + ramp
    total = change + length_m / top
    time = np.arange(0.0, total, COURSE_STEP_S)

    def pulse(since: Array) -> Array:
        return np.clip(np.minimum(since, change - since) / ramp, 0.0, 1.0)

    return np.asarray(a * (pulse(time) - pulse(time - (total - change))), dtype=np.float64)


def smooth_noise(rng: np.random.Generator, count: int, step_s: float, time_s: float) -> Array:
    """A first-order Gauss-Markov process of unit variance.

    Args:
        rng: of the process.
        count: number of samples N.
        step_s: time between two of them.
        time_s: correlation time; 0 is white noise.

    Returns:
        (N,) samples.
    """
    keep = math.exp(-step_s / time_s) if time_s > 0 else 0.0
    value, values = float(rng.standard_normal()), np.empty(count)
    for k, kick in enumerate(rng.standard_normal(count) * math.sqrt(1.0 - keep**2)):
        values[k] = value
        value = keep * value + kick
    return values


def _wander(rng: np.random.Generator, time_s: Array, period_s: float) -> Array:
    """A smooth curve (N,) of about unit variance with a knot every ``period_s``."""
    knots = np.arange(-period_s, time_s[-1] + 2 * period_s, period_s)
    values = rng.standard_normal(knots.size) * 1.25
    at = (time_s - knots[0]) / period_s
    left = at.astype(int)
    share = 0.5 - 0.5 * np.cos(math.pi * (at - left))
    return np.asarray(values[left] * (1 - share) + values[left + 1] * share)


def _vibration(rng: np.random.Generator, time_s: Array, kicks_s: list[float]) -> Array:
    """Damped swings (N, 2) in roll and pitch after every change of speed, of about unit size."""
    swing = np.zeros((time_s.size, 2))
    for kick in kicks_s:
        since = np.maximum(time_s - kick, 0.0)
        size, phase = rng.uniform(0.6, 1.0), rng.uniform(-0.9, 0.9)
        wave = np.sin(2 * math.pi * rng.uniform(1.2, 2.0) * since) * np.exp(-since / rng.uniform(0.5, 0.8))
        swing += size * np.outer(wave, [math.sin(phase), math.cos(phase)])
    return swing


def _scaled_to_peak(steady_deg: Array, swing: Array, peak_deg: float) -> Array:
    """Roll and pitch (N, 2) whose largest tilt is the peak: steady tilt plus as much vibration as it takes."""
    low, high = 0.0, peak_deg + float(np.hypot(*steady_deg.T).max())
    for _ in range(40):
        middle = 0.5 * (low + high)
        over = float(np.hypot(*(steady_deg + middle * swing).T).max()) > peak_deg
        low, high = (low, middle) if over else (middle, high)
    return steady_deg + low * swing


def course(waypoints_m: Array, style: FlightStyle) -> tuple[Array, Array, Array, Array, list[float]]:
    """Legs from stop to stop through waypoints, every :data:`COURSE_STEP_S`.

    Args:
        waypoints_m: (M, 2) east and north, neighbours apart.
        style: speed, acceleration and pauses.

    Returns:
        Position, velocity and acceleration (N, 2) to the east and north, heading (N,) unwrapped in degrees, and
        the times in seconds at which speeding up, braking and stopping shake the vehicle.
    """
    pause = round(style.pause_s / COURSE_STEP_S)
    turn = 0.5 - 0.5 * np.cos(math.pi * np.clip(np.linspace(-0.25, 1.25, pause), 0.0, 1.0))
    pushes, noses, kicks = [], [], []
    nose, count = None, 0
    for start, end in itertools.pairwise(waypoints_m):
        along = (end - start) / np.hypot(*(end - start))
        aim = math.degrees(math.atan2(along[0], along[1]))
        before = aim if nose is None else nose
        nose = before + wrap_difference_deg(aim - before)
        push = leg_accelerations(float(np.hypot(*(end - start))), style)
        pushes += [np.zeros((pause, 2)), np.outer(push, along)]
        noses += [before + turn * (nose - before), np.full(push.size, nose)]
        # Start of acceleration, start of braking, and stop: when the paper sees its large disturbances.
        braking = int(np.argmax(push < 0))
        kicks += [(count + pause + k) * COURSE_STEP_S for k in (0, braking, push.size)]
        count += pause + push.size
    pushes.append(np.zeros((pause, 2)))
    noses.append(np.full(pause, nose))
    push = np.concatenate(pushes)
    velocity = np.cumsum(push, axis=0) * COURSE_STEP_S
    position = waypoints_m[0] + np.cumsum(velocity, axis=0) * COURSE_STEP_S
    return position, velocity, push, np.concatenate(noses), kicks


def fly_waypoints(waypoints_m: Array, style: FlightStyle, rng: np.random.Generator) -> Motion:
    """Fly from waypoint to waypoint, with a stop at each in which the vehicle yaws to the next.

    Args:
        waypoints_m: (N, 2) east and north, neighbours apart.
        style: speed, tilt and height.
        rng: of vibration and wander.

    Returns:
        The motion every :data:`COURSE_STEP_S`, up above the flat ground.
    """
    position, _, push, nose, kicks = course(waypoints_m, style)
    time = np.arange(len(push), dtype=np.float64) * COURSE_STEP_S
    nose = nose + 0.4 * _wander(rng, time, 3.0)
    sin, cos = np.sin(np.radians(nose)), np.cos(np.radians(nose))
    forward, right = push[:, 0] * sin + push[:, 1] * cos, push[:, 0] * cos - push[:, 1] * sin
    steady = np.degrees(np.arctan(np.column_stack([right, -forward]) / GRAVITY_MPS2))
    breeze = 0.15 * np.column_stack([_wander(rng, time, 1.5), _wander(rng, time, 1.5)])
    tilt = _scaled_to_peak(steady + breeze, _vibration(rng, time, kicks), style.peak_tilt_deg)
    up = style.height_agl_m + style.height_sd_m * _wander(rng, time, 8.0)
    position_m = np.column_stack(
        [position + 0.3 * np.column_stack([_wander(rng, time, 6.0), _wander(rng, time, 6.0)]), up]
    )
    return Motion(
        time, position_m, np.gradient(position_m, COURSE_STEP_S, axis=0), tilt[:, 0], tilt[:, 1], nose % 360.0
    )


def simulate_telemetry(motion: Motion, noise: SensorNoise, rng: np.random.Generator) -> Motion:
    """The telemetry of a motion: attitude, velocity and height with noise; east and north stay exact.

    Args:
        motion: the truth at N times, one per frame.
        noise: standard deviations, bias and drift.
        rng: of the noise.

    Returns:
        The motion as measured, at the same times.
    """
    count = motion.time_s.size
    step = float(motion.time_s[1] - motion.time_s[0]) if count > 1 else 1.0
    # Two streams, drawn frame by frame: a shortened flight has the same telemetry as the start of the full one.
    slow, fast = rng.spawn(2)
    white = fast.standard_normal((count, 6)).T
    drift = noise.height_drift_sd_m * smooth_noise(slow, count, step, noise.height_drift_time_s)
    position_m, velocity = motion.position_m.copy(), motion.velocity_mps.copy()
    position_m[:, 2] += noise.height_sd_m * white[0] + drift
    velocity[:, :2] += noise.velocity_sd_mps * white[1:3].T
    return Motion(
        motion.time_s,
        position_m,
        velocity,
        motion.roll_deg + noise.tilt_sd_deg * white[3],
        motion.pitch_deg + noise.tilt_sd_deg * white[4],
        (motion.heading_deg + noise.heading_bias_deg + noise.heading_sd_deg * white[5]) % 360.0,
    )
