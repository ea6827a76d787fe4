"""Read the velocity of another camera's odometry that a companion computer sends to the autopilot by MAVLink."""

from __future__ import annotations

from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.geo import Array, enu_from_body
from scenematch.bridges.packets import AUTOPILOT_COMPONENT
from scenematch.files.velocities import velocity_sigma_mps

_OF_BODY = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED)  # the latter is its former name
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_FAILED = -1  # quality


def vision_velocity(
    message: Any, attitude_deg: tuple[float, ...] | None
) -> tuple[float, float, float, float] | None:
    """East, north and up in m/s, and one standard deviation per axis, 0 if it is not stated.

    Args:
        message: VISION_SPEED_ESTIMATE or ODOMETRY of another camera.
        attitude_deg: roll, pitch and heading of the vehicle, used to rotate a velocity along its body.

    Returns:
        None if the message has no such velocity: it is in another frame, absurdly large, or of unbounded variance.
    """
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


def has_failed(message: Any) -> bool:
    """Whether an ODOMETRY reports failure, which invalidates the last message of its camera."""
    return bool(message.get_type() == "ODOMETRY" and message.quality == _FAILED)


def is_by_camera(message: Any, bridge_component: int) -> bool:
    """Whether it is another camera's odometry: neither the autopilot's nor the bridge's own.

    An autopilot also forwards what it receives, including the bridge's fixes, under its own component; a router
    may return them unchanged. The bridge's own ODOMETRY has type VISION.

    Args:
        message: VISION_SPEED_ESTIMATE or ODOMETRY.
        bridge_component: component id of the bridge itself.
    """
    if message.get_srcComponent() == AUTOPILOT_COMPONENT:
        return False
    if message.get_type() == "VISION_SPEED_ESTIMATE":
        return True
    if message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VISION:
        return bool(message.get_srcComponent() != bridge_component)
    return bool(message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VIO)


def _turn(frame: int, attitude_deg: tuple[float, ...] | None) -> Array | None:
    """Rotation from a velocity's frame to east, north, up; None if unknown."""
    if frame == mavlink.MAV_FRAME_LOCAL_NED:
        return _ENU_FROM_NED
    if frame not in _OF_BODY or attitude_deg is None:
        return None
    roll_deg, pitch_deg, heading_deg = attitude_deg
    return enu_from_body(roll_deg, pitch_deg, heading_deg)
