"""Quaternions of attitudes, as MAVLink (w, x, y, z) and ROS (x, y, z, w) send them."""

from __future__ import annotations

import math

import numpy as np

from engine.geo import Array


def rotation_of(w: float, x: float, y: float, z: float) -> Array:
    """(3, 3) of a unit quaternion."""
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def quaternion_wxyz(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """The rotation about z by yaw, then about the new y by pitch, then about the new x by roll; in radians."""
    cr, cp, cy = (math.cos(0.5 * v) for v in (roll, pitch, yaw))
    sr, sp, sy = (math.sin(0.5 * v) for v in (roll, pitch, yaw))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def quaternion_xyzw(roll_deg: float, pitch_deg: float, heading_deg: float) -> tuple[float, float, float, float]:
    """Quaternion that rotates the body (forward-left-up) to east-north-up, w not negative."""
    w, x, y, z = quaternion_wxyz(*map(math.radians, (roll_deg, -pitch_deg, 90.0 - heading_deg)))
    return (x, y, z, w) if w >= 0.0 else (-x, -y, -z, -w)
