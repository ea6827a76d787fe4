"""Rotation vectors: convert an axis times an angle in radians to a matrix and back."""

from __future__ import annotations

import math

import cv2
import numpy as np

from engine.geo import Array


def cross_matrix(v: Array) -> Array:
    """The matrix of the cross product, [v]x.

    Args:
        v: (3,).

    Returns:
        (3, 3) with ``cross_matrix(v) @ w == np.cross(v, w)``.
    """
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


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
