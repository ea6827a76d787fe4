"""Gauss-Newton over the pose of dense refinement in one compiled loop, and the sums that its covariance needs.

Arrays of samples are (3, N), (2, N) or (N,) float64, and the order of the eight parameters is that of
:mod:`engine.dense`.
"""

from __future__ import annotations

import numpy as np

from engine.kernels.dense_loops import compare_levels, project
from engine.kernels.jit import compiled

_PARAMETERS = 8


@compiled
def gauss_newton(
    picture, matrix, rotation, center_m, slope, prior_rotation, prior_center_m, prior_slope, precision,
    offset_m, values, gradients, known, edge_px, cells, least, steps, excess, last_step,
):  # fmt: skip
    """Steps until the last one is small.

    Args:
        picture: (H, W) float32 levels.
        matrix: (3, 3) pinhole.
        rotation: (3, 3) of cam_from_map, to begin with.
        center_m: (3,) of the camera, to begin with.
        slope: (2,) of the ground, to begin with.
        prior_rotation: (3, 3) mean of the prior.
        prior_center_m: (3,) likewise; the slope pivots below it.
        prior_slope: (2,) likewise.
        precision: (8, 8) of the prior.
        offset_m: (3, N) of the samples from the slope's pivot.
        values: (N,) of the map.
        gradients: (N, 2) of the map, per metre to the east and to the north.
        known: (N,) weights.
        edge_px: border of the picture that is not sampled, at least 2.
        cells: along each side of the picture.
        least: number of visible samples with which to go on.
        steps: at most.
        excess: factor on the variance of the differences.
        last_step: squared length in standard deviations of a step that is the last.

    Returns:
        Whether a pose was found, and whether the last step was small; the correlation to begin with; rotation,
        center and slope; of the projection before the last step: rotation, correlation, differences (N,), points
        (3, N), derivatives (3, N) by the picture and by the map, weights (N,) and cells (N,).
    """
    rotation, center_m, slope = rotation.copy(), center_m.copy(), slope.copy()
    step, found, converged, at_first = np.zeros(_PARAMETERS), True, False, np.nan
    while True:
        seen = rotation.copy()
        levels, points, shown, expected, weights, cell, count = project(
            picture, matrix, seen, center_m, slope, offset_m, prior_center_m, gradients, known, edge_px, cells
        )
        if count < least:
            found = False
        differences, weights, correlation, gain = compare_levels(levels, values, weights)
        expected *= gain
        if np.isnan(at_first):
            at_first = correlation
        if found:
            normal, score = normal_equations(shown, expected, points, offset_m, seen, weights, differences, excess)
            normal += precision
            off = parameters_between(rotation, center_m, slope, prior_rotation, prior_center_m, prior_slope)
            score -= small_product(precision, off.reshape(_PARAMETERS, 1))[:, 0]
            found = solve(normal, score, step)
        if found:
            rotation = small_product(rotation_of(step[3:6]), rotation)
            center_m += step[:3]
            slope += step[6:]
            converged = np.sum(step * score) < last_step
        steps -= 1
        if not found or converged or steps == 0:
            break
    return (
        found, converged, at_first, rotation, center_m, slope, seen, correlation, differences, points, shown,
        expected, weights, cell,
    )  # fmt: skip


@compiled
def normal_equations(shown, expected, points, offset_m, rotation, weights, differences, excess):
    """Normal matrix (8, 8) and right side (8,); the mean of both gradients converges from farther than one."""
    total = square = 0.0
    for n in range(weights.size):
        total += weights[n]
        square += weights[n] * differences[n] * differences[n]
    scale = 1.0 / (excess * max(square / max(total, 1e-12), 1e-12))
    normal, score, row = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros(_PARAMETERS), np.zeros(_PARAMETERS)
    for n in range(weights.size):
        weight = weights[n] * scale
        if weight <= 0.0:
            continue
        a, b, c = (
            0.5 * (shown[0, n] + expected[0, n]),
            0.5 * (shown[1, n] + expected[1, n]),
            0.5 * (shown[2, n] + expected[2, n]),
        )
        by_parameters(row, a, b, c, points, offset_m, rotation, n)
        for i in range(_PARAMETERS):
            weighted = weight * row[i]
            score[i] -= weighted * differences[n]
            for j in range(i + 1):
                normal[i, j] += weighted * row[j]
    mirror(normal)
    return normal, score


@compiled
def mirror(matrix):
    """Complete a symmetric matrix (N, N) of which the lower triangle is known, in place."""
    for i in range(matrix.shape[0]):
        for j in range(i):
            matrix[j, i] = matrix[i, j]


@compiled
def by_parameters(row, a, b, c, points, offset_m, rotation, n):
    """Write the derivatives (8,) by the parameters of one difference, from those by its point in the camera."""
    x, y, z = points[0, n], points[1, n], points[2, n]
    for k in range(3):
        row[k] = -(rotation[0, k] * a + rotation[1, k] * b + rotation[2, k] * c)
    row[3], row[4], row[5] = y * c - z * b, z * a - x * c, x * b - y * a
    row[6], row[7] = -row[2] * offset_m[0, n], -row[2] * offset_m[1, n]


@compiled
def information(shown, expected, points, offset_m, rotation, weights, differences, cell, cells):
    """Sums over the samples, for the covariance.

    Args:
        shown: (3, N) derivatives by the points, by the picture.
        expected: (3, N) the same by the map.
        points: (3, N) in the camera.
        offset_m: (2, N) or more of the samples from the slope's pivot.
        rotation: (3, 3) of cam_from_map.
        weights: (N,) of the samples.
        differences: (N,) of picture and map.
        cell: (N,) of the picture.
        cells: number of cells.

    Returns:
        (8, 8) information by the picture's gradients; (8, 8) by both, its symmetric part; (8, 8) by the map's;
        (8, cells) score vectors by the mean of both, summed over the cells.
    """
    own, common = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros((_PARAMETERS, _PARAMETERS))
    of_map, by_cell = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros((_PARAMETERS, cells))
    one, two = np.zeros(_PARAMETERS), np.zeros(_PARAMETERS)
    for n in range(weights.size):
        weight = weights[n]
        if weight <= 0.0:
            continue
        by_parameters(one, shown[0, n], shown[1, n], shown[2, n], points, offset_m, rotation, n)
        by_parameters(two, expected[0, n], expected[1, n], expected[2, n], points, offset_m, rotation, n)
        for i in range(_PARAMETERS):
            by_cell[i, cell[n]] += 0.5 * (one[i] + two[i]) * weight * differences[n]
            first, second = weight * one[i], weight * two[i]
            for j in range(i + 1):
                own[i, j] += first * one[j]
                common[i, j] += 0.5 * (first * two[j] + second * one[j])
                of_map[i, j] += second * two[j]
    for sums in (own, common, of_map):
        mirror(sums)
    return own, common, of_map, by_cell


@compiled
def solve(matrix, right, out):
    """Solve by Cholesky's decomposition, which overwrites the matrix; False where it is not positive definite."""
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


@compiled
def rotation_of(vector):
    """The rotation (3, 3) of a rotation vector (Rodrigues)."""
    angle = np.sqrt(np.sum(vector * vector))
    sine = 1.0 - angle * angle / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    cosine = 0.5 if angle < 1e-4 else (1.0 - np.cos(angle)) / (angle * angle)
    x, y, z = vector[0], vector[1], vector[2]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sine * cross + cosine * small_product(cross, cross)


@compiled
def parameters_between(rotation, center_m, slope, other_rotation, other_center_m, other_slope):
    """The parameters (8,) of the step from another pose to this one."""
    out = np.empty(_PARAMETERS)
    out[:3], out[6:] = center_m - other_center_m, slope - other_slope
    out[3:6] = rotation_vector(small_product(rotation, np.ascontiguousarray(other_rotation.T)))
    return out


@compiled
def rotation_vector(turn):
    """The rotation vector (3,) of a rotation (3, 3)."""
    sine = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    size, cosine = np.sqrt(np.sum(sine * sine)), 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)
    angle = np.arctan2(size, cosine)
    if cosine > -0.9:
        return sine * (1.0 if size < 1e-9 else angle / size)
    # Towards half a turn the sine vanishes: the axis is that of the symmetric part, 1 - cosine times a a^T.
    k = 0
    for i in range(1, 3):
        if turn[i, i] > turn[k, k]:
            k = i
    axis = np.empty(3)
    axis[k] = np.sqrt(max((turn[k, k] - cosine) / (1.0 - cosine), 0.0))
    for i in range(3):
        if i != k:
            axis[i] = (turn[k, i] + turn[i, k]) / (2.0 * (1.0 - cosine) * axis[k])
    return axis * (-angle if np.sum(axis * sine) < 0.0 else angle)


@compiled
def small_product(a, b):
    """Of two small matrices; numba's own needs SciPy."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            for k in range(a.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out
