"""A camera on a gimbal: compute the attitude of a body to which the camera would be fixed by its mount.

The gimbal's rotation is thus expressed as a body attitude for each frame. If the camera looks straight down, where
the gimbal's own roll and yaw coincide, that body is level.
"""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.geo import Array, attitude_from_rotation, enu_from_body
from engine.values import Attitude
from scenematch.files.quaternions import rotation_of

_FORWARD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # mount of a camera that looks ahead
_EARTH_YAW = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
_VEHICLE_YAW = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
_LOCKED_YAW = mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK  # set by older devices instead of either


def body_behind(enu_from_gimbal: Array, mount: Array) -> Attitude:
    """The body whose mount holds the camera as the gimbal points it.

    Args:
        enu_from_gimbal: (3, 3) rotation from the gimbal's forward, right and down axes.
        mount: (3, 3) of the calibration, v_body = mount @ v_camera.
    """
    return Attitude(*attitude_from_rotation(enu_from_gimbal @ _FORWARD @ mount.T))


def from_device(q: list[float], flags: int, heading_deg: float) -> Array | None:
    """The rotation that GIMBAL_DEVICE_ATTITUDE_STATUS states; None if it states none.

    Args:
        q: w, x, y, z, relative to a level frame that faces north or, by the flags, the vehicle's heading.
        flags: flags of the device.
        heading_deg: heading of the vehicle.

    Returns:
        (3, 3) from the gimbal's axes to east, north and up.
    """
    norm = math.hypot(*q)
    if not 0.9 < norm < 1.1:  # NaN fails too
        return None
    is_of_earth = bool(flags & _EARTH_YAW) or (bool(flags & _LOCKED_YAW) and not flags & _VEHICLE_YAW)
    return enu_from_body(0.0, 0.0, 0.0 if is_of_earth else heading_deg) @ rotation_of(*(v / norm for v in q))


def from_mount(roll_deg: float, pitch_deg: float, yaw_deg: float, heading_deg: float) -> Array | None:
    """The rotation that MOUNT_ORIENTATION states, with yaw relative to the vehicle; None if it states none."""
    if not all(map(math.isfinite, (roll_deg, pitch_deg, yaw_deg))):
        return None
    return enu_from_body(roll_deg, pitch_deg, yaw_deg + heading_deg)
