"""The autopilot: a timed route, and the cascade position, velocity, acceleration that follows it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.errors import OptionError
from engine.geo import Array
from engine.values import check_positive
from scenematch.simulator.quadrotor import STEP_S
from scenematch.simulator.vehicle import COURSE_STEP_S, FlightStyle, course

__all__ = ["Gains", "Pilot", "Route", "Setpoint", "plan_rounds", "plan_route"]


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
        waypoints_m: (N, 2) east and north.
        style: speed, acceleration, pauses and height.

    Returns:
        Route: from the first waypoint to the last.

    Raises:
        OptionError: there are fewer than two waypoints, or two in a row are less than 1 m apart.
    """
    style = style or FlightStyle()
    points = np.asarray(waypoints_m, float)
    if points.ndim != 2 or points.shape[1:] != (2,) or len(points) < 2 or not np.isfinite(points).all():
        raise OptionError(f"waypoints_m: expected (N, 2) finite metres with 2 or more rows, got {points.shape}")
    if (np.hypot(*np.diff(points, axis=0).T) < 1.0).any():
        raise OptionError("waypoints_m: expected neighbours 1 m apart or more")
    push, nose, kicks = course(points, style)
    speed = np.cumsum(push, axis=0) * COURSE_STEP_S
    position = points[0] + np.cumsum(speed, axis=0) * COURSE_STEP_S
    flat = np.zeros((len(push), 1))
    return Route(
        np.hstack([position, flat + style.height_agl_m]),
        np.hstack([speed, flat]),
        np.hstack([push, flat]),
        nose,
        tuple(kicks),
    )


def plan_rounds(half_m: tuple[float, float], seconds: float, style: FlightStyle | None = None) -> Route:
    """Enough circuits of a rectangle around the origin to take at least the given time.

    Args:
        half_m: half its sides, to the east and to the north.
        seconds: least duration.
        style: speed and height.

    Raises:
        OptionError: a side is too short for a leg.
    """
    if min(half_m) < 5.0:
        raise OptionError(f"half_m: expected 5 m or more, got {half_m[0]:.1f} and {half_m[1]:.1f}")
    corners = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) * half_m
    points = corners[:2]
    while (route := plan_route(points, style)).duration_s < seconds:
        points = np.vstack([points, corners[len(points) % 4]])
    return route


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Gains of the cascade, by default those of PX4's multicopter position control (MPC_XY_P and its siblings).

    Attributes:
        position_per_s: velocity per error of the position, horizontally (MPC_XY_P).
        velocity_per_s: acceleration per error of the velocity (MPC_XY_VEL_P_ACC).
        integral_per_s2: acceleration per second of that error, which compensates the wind (MPC_XY_VEL_I_ACC).
        height_per_s: as ``position_per_s``, vertically (MPC_Z_P).
        climb_per_s: as ``velocity_per_s`` (MPC_Z_VEL_P_ACC).
        climb_integral_per_s2: as ``integral_per_s2`` (MPC_Z_VEL_I_ACC).
        max_correction_mps: largest velocity commanded for an error of the position.
        max_acceleration_mps2: largest horizontal acceleration; gentler than MPC_ACC_HOR.

    Raises:
        OptionError: a value is not above 0.
    """

    position_per_s: float = 0.95
    velocity_per_s: float = 1.8
    integral_per_s2: float = 0.4
    height_per_s: float = 1.0
    climb_per_s: float = 4.0
    climb_integral_per_s2: float = 2.0
    max_correction_mps: float = 3.0
    max_acceleration_mps2: float = 2.0

    def __post_init__(self) -> None:
        check_positive(self, *self.__dataclass_fields__)


class Pilot:
    """Follows setpoints by the estimated position and velocity; its integral compensates the wind."""

    def __init__(self, gains: Gains | None = None) -> None:
        self._gains = g = gains or Gains()
        self._position = np.array([g.position_per_s, g.position_per_s, g.height_per_s])
        self._velocity = np.array([g.velocity_per_s, g.velocity_per_s, g.climb_per_s])
        self._integral = np.array([g.integral_per_s2, g.integral_per_s2, g.climb_integral_per_s2])
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
        limit = self._gains.max_correction_mps
        towards = np.clip(self._position * (target.position_m - position_m), -limit, limit)
        error = target.velocity_mps + towards - velocity_mps
        wanted = target.acceleration_mps2 + self._velocity * error + self._wind
        flat = math.hypot(wanted[0], wanted[1])
        if flat > self._gains.max_acceleration_mps2:
            wanted[:2] *= self._gains.max_acceleration_mps2 / flat
            self._wind[2] += self._integral[2] * STEP_S * error[2]
        else:  # the integral would wind up at the limit
            self._wind += self._integral * STEP_S * error
        self._wind = np.clip(self._wind, -2.0, 2.0)
        return np.asarray(wanted)
