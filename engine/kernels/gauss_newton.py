"""Gauss-Newton over the pose of dense refinement in one compiled loop, and the sums that its covariance needs.

Arrays of samples are (3, N), (2, N) or (N,) float64, and the order of the eight parameters is that of
:mod:`engine.kernels.dense`.
"""

import numpy as np

from engine.kernels.dense_loops import CELLS, MIN_SAMPLES, compare_levels, project
from engine.kernels.small_matrices import MAX_STEPS, add_equation, mirror, solve, turn, turn_between
from engine.runtime.jit import compiled

_PARAMETERS = 8  # place, rotation, slope
_LAST_STEP = 0.5  # in standard deviations of the pose; the next one would be a tenth of it
EXCESS = 1.6
"""Variance factor at which the errors over six simulated towns at noon match the covariance."""


@compiled(
    "(f4[:, ::1], f8[:, ::1], Tuple((f8[:, ::1], f8[::1], f8[::1])), Tuple((f8[:, ::1], f8[::1], f8[::1])), "
    "f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])"
)
def gauss_newton(picture, matrix, start, prior, precision, offset_m, values, gradients, known):
    """Steps until the last one is small.

    Args:
        picture: (H, W) float32 levels.
        matrix: (3, 3) pinhole.
        start: rotation (3, 3) of cam_from_map, centre (3,) of the camera and slope (2,) of the ground.
        prior: the mean of the prior likewise; the slope pivots below its centre.
        precision: (8, 8) of the prior.
        offset_m: (3, N) of the samples from the slope's pivot.
        values: (N,) of the map.
        gradients: (N, 2) of the map, per metre to the east and to the north.
        known: (N,) weights.

    Returns:
        Whether a pose was found, and whether the last step was small; the correlation to begin with, and before
        the last step; rotation, center and slope; and what :func:`information` takes, of the projection before the
        last step.
    """
    rotation, center_m, slope = start[0].copy(), start[1].copy(), start[2].copy()
    step, converged, at_first = np.zeros(_PARAMETERS), False, np.nan
    for _ in range(MAX_STEPS):
        seen = rotation.copy()
        levels, points, shown, expected, weights, cell, count = project(
            picture, matrix, seen, center_m, slope, offset_m, prior[1], gradients, known
        )
        found = count >= MIN_SAMPLES
        differences, weights, correlation, gain = compare_levels(levels, values, weights)
        for k in range(3):
            for n in range(known.size):
                expected[k, n] *= gain
        if np.isnan(at_first):
            at_first = correlation
        if found:
            normal, score = normal_equations(shown, expected, points, offset_m, seen, weights, differences)
            _add_prior(normal, score, (rotation, center_m, slope), prior, precision)
            found = solve(normal, score, step)
        if found:
            turn(seen, step[3:6], rotation)
            size = 0.0
            for i in range(_PARAMETERS):
                size += step[i] * score[i]
            for i in range(3):
                center_m[i] += step[i]
            for i in range(2):
                slope[i] += step[6 + i]
            converged = size < _LAST_STEP**2
        if not found or converged:
            break
    projected = (shown, expected, points, offset_m, seen, weights, differences, cell)
    return found, converged, at_first, correlation, rotation, center_m, slope, projected


@compiled()
def _add_prior(normal, score, pose, prior, precision):
    """Add what the prior says of the parameters to their normal matrix (8, 8) and right side (8,)."""
    off = np.zeros(_PARAMETERS)
    turn_between(pose[0], prior[0], off[3:6])
    for i in range(3):
        off[i] = pose[1][i] - prior[1][i]
    for i in range(2):
        off[6 + i] = pose[2][i] - prior[2][i]
    for i in range(_PARAMETERS):
        for j in range(_PARAMETERS):
            normal[i, j] += precision[i, j]
            score[i] -= precision[i, j] * off[j]


@compiled()
def normal_equations(shown, expected, points, offset_m, rotation, weights, differences):
    """Normal matrix (8, 8) and right side (8,); the mean of both gradients converges from farther than one."""
    total = square = 0.0
    for n in range(weights.size):
        total += weights[n]
        square += weights[n] * differences[n] * differences[n]
    scale = 1.0 / (EXCESS * max(square / max(total, 1e-12), 1e-12))
    normal, score, row = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros(_PARAMETERS), np.zeros(_PARAMETERS)
    for n in range(weights.size):
        weight = weights[n] * scale
        if weight <= 0.0:
            continue
        a, b, c = shown[0, n] + expected[0, n], shown[1, n] + expected[1, n], shown[2, n] + expected[2, n]
        by_parameters(row, 0.5 * a, 0.5 * b, 0.5 * c, points, offset_m, rotation, n)
        add_equation(normal, score, row, weight, -differences[n])
    mirror(normal)
    return normal, score


@compiled()
def by_parameters(row, a, b, c, points, offset_m, rotation, n):
    """Write the derivatives (8,) by the parameters of one difference, from those by its point in the camera."""
    x, y, z = points[0, n], points[1, n], points[2, n]
    for k in range(3):
        row[k] = -(rotation[0, k] * a + rotation[1, k] * b + rotation[2, k] * c)
    row[3], row[4], row[5] = y * c - z * b, z * a - x * c, x * b - y * a
    row[6], row[7] = -row[2] * offset_m[0, n], -row[2] * offset_m[1, n]


@compiled("(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], i8[::1])")
def information(shown, expected, points, offset_m, rotation, weights, differences, cell):
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

    Returns:
        (8, 8) information by the picture's gradients; (8, 8) by both, its symmetric part; (8, 8) by the map's;
        (8, C) score vectors by the mean of both, summed over the C cells.
    """
    own, common = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros((_PARAMETERS, _PARAMETERS))
    of_map, by_cell = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros((_PARAMETERS, CELLS**2))
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
    mirror(own)
    mirror(common)
    mirror(of_map)
    return own, common, of_map, by_cell
