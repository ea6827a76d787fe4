"""A quadrotor in wind: thrust along its body, a second-order attitude response, drag, and its ideal IMU.

Convention:
    World axes are east-north-up, body axes forward-right-down; ``enu_from_body`` maps the second to the first. A
    step integrates the acceleration at its beginning over its length, so that integrating the IMU in the same way
    gives the same path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from engine.geo import Array, attitude_from_rotation, enu_from_body
from engine.values import Attitude
from scenematch.simulator.vehicle import GRAVITY_MPS2

__all__ = ["IdealImu", "State", "WindField", "advance", "hovering"]


STEP_S = 0.01
"""Time step of dynamics, control and IMU."""
GRAVITY = np.array([0.0, 0.0, -GRAVITY_MPS2])
_PEAK_OF_SWING = 0.71  # first peak after an impulse over impulse / frequency, at a damping of 0.25


# The vehicle: the size of a 3DR Iris, with the 1.5 kg of Gazebo's model.
_MAX_THRUST_MPS2 = 20.0  # of all four rotors, per mass
_THRUST_LAG_S = 0.05  # time constant of the rotors
_DRAG_PER_S = 0.1  # drag per mass and airspeed: flying 8.5 m/s takes 5 degrees of tilt
SWING_RPS, SWING_DAMPING = 10.0, 0.25
"""Natural frequency of roll and pitch under control, and its share of critical damping: rings half a second."""
_YAW_RPS = 3.0  # natural frequency of the heading, which is critically damped
MAX_TILT_DEG, SHAKE_DEG = 25.0, 7.0
"""Largest tilt that the controller commands, and largest swing excited by a start or a stop."""


class WindField:
    """Wind with gusts, one velocity per :data:`STEP_S`.

    Args:
        rng: of the gusts.
        mean_mps: the air's mean velocity to the east and to the north.
        gust_sd_mps: standard deviation of each horizontal component; the vertical one has half of it.
        gust_time_s: how long a gust lasts: each component is a Gauss-Markov process, which has the spectrum of
            Dryden's longitudinal gusts (MIL-F-8785C).
    """

    def __init__(
        self,
        rng: np.random.Generator,
        mean_mps: tuple[float, float] = (2.5, 1.5),
        gust_sd_mps: float = 0.8,
        gust_time_s: float = 3.0,
    ) -> None:
        self._rng, self._mean = rng, np.array([*mean_mps, 0.0])
        self._sd = gust_sd_mps * np.array([1.0, 1.0, 0.5])
        self._keep = math.exp(-STEP_S / gust_time_s)
        self._gust = self._sd * rng.standard_normal(3)

    def next(self) -> Array:
        """Velocity of the air in the next step.

        Returns:
            (3,) m/s to the east, north and up.
        """
        kick = math.sqrt(1.0 - self._keep**2) * self._rng.standard_normal(3)
        self._gust = self._keep * self._gust + self._sd * kick
        return np.asarray(self._mean + self._gust)


@dataclass(frozen=True, slots=True)
class State:
    """The vehicle at one time.

    Attributes:
        time_s: since the start.
        position_m: (3,) east, north, up.
        velocity_mps: (3,) east, north, up.
        enu_from_body: (3, 3) attitude.
        rates_rps: (3,) turn rates about forward, right and down.
        thrust_mps2: thrust per mass.
    """

    time_s: float
    position_m: Array
    velocity_mps: Array
    enu_from_body: Array
    rates_rps: Array
    thrust_mps2: float

    @property
    def attitude(self) -> Attitude:
        """Roll, pitch and heading."""
        return Attitude(*attitude_from_rotation(self.enu_from_body))


@dataclass(frozen=True, slots=True)
class IdealImu:
    """A perfect IMU's measurement over one step: (3,) specific force and (3,) turn rates, both in the body."""

    force_mps2: Array
    rates_rps: Array


def rotation(vector_rad: Array) -> Array:
    """Rotation matrix about a vector by its length (Rodrigues' formula).

    Args:
        vector_rad: (3,) axis times angle in radians.

    Returns:
        (3, 3) rotation matrix.
    """
    return np.asarray(cv2.Rodrigues(vector_rad)[0], dtype=np.float64)


def rotation_vector(matrix: Array) -> Array:
    """Axis times angle of a rotation, the inverse of :func:`rotation`.

    Args:
        matrix: (3, 3) rotation by less than half a turn.

    Returns:
        (3,) in radians; cv2.Rodrigues would return 0 below 1e-5.
    """
    twice_sine = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    sine = 0.5 * float(np.linalg.norm(twice_sine))
    angle = math.atan2(sine, 0.5 * (float(np.trace(matrix)) - 1.0))
    return np.asarray(twice_sine * (0.5 if sine < 1e-9 else 0.5 * angle / sine), dtype=np.float64)


def hovering(position_m: Array, heading_deg: float) -> State:
    """The vehicle at rest in still air.

    Args:
        position_m: (3,) east, north, up.
        heading_deg: clockwise from north.

    Returns:
        State: level, at time 0.
    """
    attitude = enu_from_body(0.0, 0.0, heading_deg)
    return State(0.0, np.asarray(position_m, float), np.zeros(3), attitude, np.zeros(3), GRAVITY_MPS2)


def aim(acceleration_mps2: Array, heading_deg: float) -> tuple[Array, Array]:
    """The attitude that gives an acceleration in still air, and the force per mass it needs.

    If the force would tilt the vehicle beyond :data:`MAX_TILT_DEG`, only its horizontal component is reduced; the
    rotors never push down.

    Args:
        acceleration_mps2: (3,) east, north, up.
        heading_deg: clockwise from north.

    Returns:
        enu_from_body (3, 3), and the force per mass (3,) in m/s^2.
    """
    force = acceleration_mps2 - GRAVITY
    force[2] = max(force[2], 0.3 * GRAVITY_MPS2)
    flat, max_flat = math.hypot(force[0], force[1]), force[2] * math.tan(math.radians(MAX_TILT_DEG))
    if flat > max_flat:
        force[:2] *= max_flat / flat
    down = -force / np.linalg.norm(force)
    heading = math.radians(heading_deg)
    right = np.cross(down, (math.sin(heading), math.cos(heading), 0.0))
    right /= np.linalg.norm(right)
    return np.column_stack([np.cross(right, down), right, down]), force


def advance(state: State, acceleration_mps2: Array, heading_deg: float, air_mps: Array) -> tuple[State, IdealImu]:
    """One step of :data:`STEP_S`.

    Args:
        state: at its beginning.
        acceleration_mps2: (3,) that the controller commands.
        heading_deg: that the controller commands.
        air_mps: (3,) velocity of the air.

    Returns:
        State: at its end.
        IdealImu: the IMU's measurement during the step.
    """
    wanted, force = aim(acceleration_mps2, heading_deg)
    up = -state.enu_from_body[:, 2]
    thrust = state.thrust_mps2 + (min(float(force @ up), _MAX_THRUST_MPS2) - state.thrust_mps2) * (
        1.0 - math.exp(-STEP_S / _THRUST_LAG_S)
    )
    pushed = thrust * up - _DRAG_PER_S * (state.velocity_mps - air_mps)
    acceleration = pushed + GRAVITY
    half = state.enu_from_body @ rotation(0.5 * STEP_S * state.rates_rps)
    return State(
        next_time_s(state.time_s),
        state.position_m + STEP_S * state.velocity_mps + 0.5 * STEP_S**2 * acceleration,
        state.velocity_mps + STEP_S * acceleration,
        state.enu_from_body @ rotation(STEP_S * state.rates_rps),
        state.rates_rps + STEP_S * _swing(state, wanted),
        thrust,
    ), IdealImu(half.T @ pushed, state.rates_rps)


def next_time_s(time_s: float) -> float:
    """The time one step later, rounded to a multiple of the step so that errors do not accumulate."""
    return (round(time_s / STEP_S) + 1) * STEP_S


def _swing(state: State, wanted: Array) -> Array:
    """Angular acceleration (3,): the controlled attitude is a damped oscillator about the commanded one."""
    error = rotation_vector(state.enu_from_body.T @ wanted)
    error[2] = np.clip(error[2], -0.5, 0.5)  # the yaw rate is limited
    spring = np.array([SWING_RPS, SWING_RPS, _YAW_RPS])
    damping = np.array([SWING_DAMPING, SWING_DAMPING, 1.0])
    return np.asarray(spring**2 * error - 2.0 * damping * spring * state.rates_rps)


def shaken(state: State, rng: np.random.Generator) -> State:
    """The vehicle after the impulse of a start or a stop: a swing in roll and pitch, mostly in pitch.

    Its first peak is 0.6 to 1 of :data:`SHAKE_DEG`.
    """
    peak = math.radians(SHAKE_DEG) * rng.uniform(0.6, 1.0)
    direction = rng.uniform(-0.9, 0.9)
    kick = peak * SWING_RPS / _PEAK_OF_SWING * np.array([math.sin(direction), math.cos(direction), 0.0])
    return replace(state, rates_rps=state.rates_rps + kick)
