"""Rotations and linear equations of a few unknowns for the compiled fits.

Scalars and loops only: an expression of whole arrays takes numba longer to compile than all of these together.
"""

import numpy as np

from engine.runtime.jit import compiled, inlined

MAX_STEPS = 12
"""Gauss-Newton steps of a pose fit at most; four or five are usual."""


@inlined
def rotated(rotation, a, b, c):
    """A vector by a rotation (3, 3)."""
    x = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
    y = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
    return x, y, rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c


@inlined
def pixel_of(matrix, across, down):
    """The pixel of the ray (across, down, 1) in a pinhole camera (3, 3)."""
    u = matrix[0, 0] * across + matrix[0, 1] * down + matrix[0, 2]
    return u, matrix[1, 0] * across + matrix[1, 1] * down + matrix[1, 2]


@inlined
def add_equation(normal, right, row, weight, off):
    """Add the weighted equation row x = off to normal equations, of the matrix (N, N) to the lower triangle."""
    for i in range(right.size):
        weighted = weight * row[i]
        right[i] += weighted * off
        for j in range(i + 1):
            normal[i, j] += weighted * row[j]


@compiled()
def mirror(matrix):
    """Complete a symmetric matrix (N, N) from its lower triangle, in place."""
    for i in range(matrix.shape[0]):
        for j in range(i):
            matrix[j, i] = matrix[i, j]


@compiled()
def solve(matrix, right, out):
    """Solve by Cholesky's decomposition, which overwrites the matrix; False if it is not positive definite."""
    size = right.size
    for i in range(size):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                matrix[i, i] = np.sqrt(value)
            else:
                matrix[i, j] = value / matrix[j, j]
    for i in range(size):
        value = right[i]
        for k in range(i):
            value -= matrix[i, k] * out[k]
        out[i] = value / matrix[i, i]
    for i in range(size - 1, -1, -1):
        value = out[i]
        for k in range(i + 1, size):
            value -= matrix[k, i] * out[k]
        out[i] = value / matrix[i, i]
    return True


@compiled()
def turn(rotation, vector, out):
    """Write exp([vector]) rotation to ``out``, all (3, 3), by Rodrigues' formula."""
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    sine = 1.0 - square / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    cosine = 0.5 if angle < 1e-4 else (1.0 - np.cos(angle)) / square
    rest = 1.0 - cosine * square
    for j in range(3):
        a, b, c = rotation[0, j], rotation[1, j], rotation[2, j]
        along = cosine * (x * a + y * b + z * c)
        out[0, j] = rest * a + x * along + sine * (y * c - z * b)
        out[1, j] = rest * b + y * along + sine * (z * a - x * c)
        out[2, j] = rest * c + z * along + sine * (x * b - y * a)


@compiled()
def turn_between(rotation, other, out):
    """Write the rotation vector (3,) of rotation other^T, which turns the other rotation into this one.

    Of exactly half a turn it is 0: the axis is that of the antisymmetric part, which vanishes.
    """
    trace = square = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        trace += _entry(rotation, other, i, i)
        out[i] = 0.5 * (_entry(rotation, other, k, j) - _entry(rotation, other, j, k))
        square += out[i] * out[i]
    size, cosine = np.sqrt(square), 0.5 * (trace - 1.0)
    angle = np.arctan2(size, cosine)
    for i in range(3):
        out[i] *= 1.0 if size < 1e-9 else angle / size


@inlined
def _entry(rotation, other, i, j):
    """An entry of rotation other^T."""
    return rotation[i, 0] * other[j, 0] + rotation[i, 1] * other[j, 1] + rotation[i, 2] * other[j, 2]
