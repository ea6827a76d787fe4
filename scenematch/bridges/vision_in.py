"""The velocity of another camera's odometry, as a companion computer sends it to the autopilot by MAVLink."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.geo import enu_from_body
from scenematch.bridges.packets import AUTOPILOT_COMPONENT
from scenematch.files.velocities import velocity_sigma_mps

Array = NDArray[np.float64]

_OVER_GROUND = (mavlink.MAV_FRAME_LOCAL_NED,)
_OF_BODY = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED)  # the latter was its name before
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_FAILED = -1  # quality


def vision_velocity(
    message: Any, attitude_deg: tuple[float, ...] | None, bridge_component: int
) -> tuple[float, float, float, float] | None:
    """East, north and up in m/s, and one standard deviation per axis, 0 if it is not stated.

    Args:
        message: VISION_SPEED_ESTIMATE or ODOMETRY.
        attitude_deg: roll, pitch and heading of the vehicle, by which a velocity along its body is turned.
        bridge_component: component of the vehicle that the bridge itself is.

    Returns:
        None if the message has no such velocity: of another estimator than a camera's, the autopilot's or the
        bridge's own, in another frame, failed, of an absurd size, or of an unbounded variance.
    """
    if not _is_by_camera(message, bridge_component) or has_failed(message, bridge_component):
        return None
    if message.get_type() == "VISION_SPEED_ESTIMATE":
        velocity, variances = np.array([message.x, message.y, message.z]), message.covariance[0::4]
        turn: Array | None = _ENU_FROM_NED
    else:
        velocity = np.array([message.vx, message.vy, message.vz])
        variances = [message.velocity_covariance[i] for i in (0, 6, 11)]  # of a 6 x 6 upper triangle
        turn = _turn(message.child_frame_id, attitude_deg)
    sigma_mps = velocity_sigma_mps(velocity, variances, turned=turn is not _ENU_FROM_NED)
    if turn is None or sigma_mps is None:
        return None
    east, north, up = (float(v) for v in turn @ velocity)
    return east, north, up, sigma_mps


def has_failed(message: Any, bridge_component: int) -> bool:
    """Whether another camera's ODOMETRY says that it has failed, so that what it said last holds no more."""
    if message.get_type() != "ODOMETRY" or message.quality != _FAILED:
        return False
    return _is_by_camera(message, bridge_component)


def _is_by_camera(message: Any, bridge_component: int) -> bool:
    """Whether it is of another camera's odometry: not the autopilot's, nor the bridge's own.

    An autopilot also passes on what it was sent, the bridge's fixes included, as a component of its own; a router
    may pass them back unchanged. The bridge's ODOMETRY is of type VISION: another type is not its own.
    """
    if message.get_srcComponent() == AUTOPILOT_COMPONENT:
        return False
    if message.get_type() == "VISION_SPEED_ESTIMATE":
        return True
    if message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VISION:
        return bool(message.get_srcComponent() != bridge_component)
    return bool(message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VIO)


def _turn(frame: int, attitude_deg: tuple[float, ...] | None) -> Array | None:
    """To east, north, up from the frame of a velocity; None if that is not known."""
    if frame in _OVER_GROUND:
        return _ENU_FROM_NED
    if frame not in _OF_BODY or attitude_deg is None:
        return None
    roll_deg, pitch_deg, heading_deg = attitude_deg
    return enu_from_body(roll_deg, pitch_deg, heading_deg)
