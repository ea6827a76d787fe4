"""The autopilot: a timed route, and the cascade position, velocity, acceleration that follows it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.geo import Array
from scenematch.simulator.quadrotor import STEP_S
from scenematch.simulator.vehicle import COURSE_STEP_S, FlightStyle, course

__all__ = ["Pilot", "Route", "Setpoint", "plan_rounds", "plan_route"]

# Gains horizontally twice and vertically, those of PX4's multicopter position control (MPC_XY_P and its siblings).
_POSITION_PER_S = np.array([0.95, 0.95, 1.0])  # velocity per error of the position
_VELOCITY_PER_S = np.array([1.8, 1.8, 4.0])  # acceleration per error of the velocity
_INTEGRAL_PER_S2 = np.array([0.4, 0.4, 2.0])  # acceleration per second of that error, which compensates the wind
MAX_CORRECTION_MPS, MAX_ACCELERATION_MPS2 = 3.0, 2.0
"""Largest velocity commanded for an error of the position, and largest horizontal acceleration."""


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Where the vehicle should be at one time: (3,) position, velocity and acceleration, and its heading."""

    position_m: Array
    velocity_mps: Array
    acceleration_mps2: Array
    heading_deg: float


@dataclass(frozen=True)
class Route:
    """A planned flight, sampled every :data:`scenematch.simulator.vehicle.COURSE_STEP_S` of its own clock.

    Attributes:
        position_m: (N, 3) east, north, up.
        velocity_mps: (N, 3).
        acceleration_mps2: (N, 3).
        heading_deg: (N,), unwrapped.
        kicks_s: times when speeding up, braking and stopping shake the vehicle.
    """

    position_m: Array
    velocity_mps: Array
    acceleration_mps2: Array
    heading_deg: Array
    kicks_s: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        """From the first setpoint to the last."""
        return (len(self.heading_deg) - 1) * COURSE_STEP_S

    def at(self, clock_s: float, pace: float = 1.0, change_per_s: float = 0.0) -> Setpoint:
        """The setpoint at a time of the route's clock.

        Args:
            clock_s: on the route's clock; before and after the route the vehicle hovers at its ends.
            pace: speed of that clock relative to real time.
            change_per_s: how fast the pace changes.
        """
        k = min(max(round(clock_s / COURSE_STEP_S), 0), len(self.heading_deg) - 1)
        # x(s(t)): the chain rule with s' the pace and s'' its change.
        velocity = pace * self.velocity_mps[k]
        push = pace**2 * self.acceleration_mps2[k] + change_per_s * self.velocity_mps[k]
        return Setpoint(self.position_m[k], velocity, push, float(self.heading_deg[k]))


def plan_route(waypoints_m: Array, style: FlightStyle | None = None) -> Route:
    """Legs at constant height between waypoints with a stop at each, as in the built-in flight.

    Args:
        waypoints_m: (N, 2) east and north, two or more, neighbours apart.
        style: speed, acceleration, pauses and height.

    Returns:
        Route: from the first waypoint to the last.
    """
    style = style or FlightStyle()
    position, velocity, push, nose, kicks = course(waypoints_m, style)
    flat = np.zeros((len(push), 1))
    level = np.hstack([position, flat + style.height_agl_m])
    return Route(level, np.hstack([velocity, flat]), np.hstack([push, flat]), nose, tuple(kicks))


def plan_rounds(half_m: tuple[float, float], seconds: float, style: FlightStyle | None = None) -> Route:
    """Enough circuits of a rectangle around the origin to take at least the given time.

    Args:
        half_m: half its sides, to the east and to the north.
        seconds: least duration.
        style: speed and height.
    """
    corners = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) * half_m
    points = corners[:2]
    while (route := plan_route(points, style)).duration_s < seconds:
        points = np.vstack([points, corners[len(points) % 4]])
    return route


class Pilot:
    """Follows setpoints by the estimated position and velocity; its integral compensates the wind."""

    def __init__(self) -> None:
        self._wind = np.zeros(3)

    def steer(self, target: Setpoint, position_m: Array, velocity_mps: Array) -> Array:
        """The acceleration to command over the next :data:`scenematch.simulator.quadrotor.STEP_S`.

        Args:
            target: setpoint.
            position_m: (3,) estimated, east, north, up.
            velocity_mps: (3,) estimated.

        Returns:
            (3,) m/s^2.
        """
        towards = np.clip(
            _POSITION_PER_S * (target.position_m - position_m), -MAX_CORRECTION_MPS, MAX_CORRECTION_MPS
        )
        error = target.velocity_mps + towards - velocity_mps
        wanted = target.acceleration_mps2 + _VELOCITY_PER_S * error + self._wind
        flat = math.hypot(wanted[0], wanted[1])
        if flat > MAX_ACCELERATION_MPS2:
            wanted[:2] *= MAX_ACCELERATION_MPS2 / flat
            self._wind[2] += _INTEGRAL_PER_S2[2] * STEP_S * error[2]
        else:  # the integral would wind up at the limit
            self._wind += _INTEGRAL_PER_S2 * STEP_S * error
        self._wind = np.clip(self._wind, -2.0, 2.0)
        return np.asarray(wanted)
