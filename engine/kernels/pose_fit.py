"""Gauss-Newton over the six parameters of a pose by matched points, in one compiled loop.

Arrays of matches are (3, N), (2, N) or (N,) float64, and names are those of :mod:`engine.matching.pnp`.
"""

import math

import numpy as np

from engine.kernels.small_matrices import (
    MAX_STEPS,
    add_equation,
    mirror,
    pixel_of,
    rotated,
    solve,
    turn,
    turn_between,
)
from engine.runtime.jit import compiled, inlined

_FAR_PX = 1e9  # assigned coordinates of points behind the camera: they stay finite
_NOISE_FLOOR_PX = 0.05  # least standard deviation assumed for an image point's x and y
_REACH_SIGMAS = 4.0  # of a pixel, beyond which a match has no weight if its tolerance is less
_LAST_STEP = 2e-2  # in standard deviations of the pose


@compiled("(f8[::1, :], f8[::1, :], f8[:, ::1], f8[:, ::1], f8[::1])")
def reproject(points, pixels, matrix, rotation, center):
    """Reproject all matches.

    Args:
        points: (3, N) of the map.
        pixels: (2, N) of the picture.
        matrix: (3, 3) pinhole.
        rotation: (3, 3) of cam_from_map.
        center: (3,) of the camera.

    Returns:
        (3, N) x / z, y / z and 1 / z in the camera; (2, N) pixels, far off for points behind the camera; (N,)
        squared distances.
    """
    count = pixels.shape[1]
    tangents, projected, squared = np.empty((3, count)), np.empty((2, count)), np.empty(count)
    for n in range(count):
        x, y, z = points[0, n] - center[0], points[1, n] - center[1], points[2, n] - center[2]
        across, down, depth = rotated(rotation, x, y, z)
        is_behind = depth < 1e-9
        near = 1.0 if is_behind else 1.0 / depth
        u, v = across * near, down * near
        tangents[0, n], tangents[1, n], tangents[2, n] = u, v, near
        if is_behind:
            projected[0, n] = projected[1, n] = _FAR_PX
        else:
            projected[0, n], projected[1, n] = pixel_of(matrix, u, v)
        squared[n] = (projected[0, n] - pixels[0, n]) ** 2 + (projected[1, n] - pixels[1, n]) ** 2
    return tangents, projected, squared


@compiled("(f8[::1, :], f8[::1, :], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8, i8, f8[:, ::1], f8[::1], f8)")
def fit_pose(points, pixels, matrix, weights, attitude, precision, tolerance_px, least, rotation, center, slack):
    """Gauss-Newton with Tukey's biweight; each step updates the inliers and their variance.

    Args:
        points: (3, N) of the map.
        pixels: (2, N) of the picture.
        matrix: (3, 3) pinhole.
        weights: (N,) relative inverse variances.
        attitude: (3, 3) known rotation.
        precision: (3, 3) inverse covariance of its angles, 0 if unknown.
        tolerance_px: of an inlier.
        least: number of inliers with which to go on.
        rotation: (3, 3) to begin with.
        center: (3,) to begin with.
        slack: factor on the tolerance in the first step.

    Returns:
        Whether there is a pose; rotation, center; what :func:`reproject` returns; inliers (N,) bool; information
        (6, 6) by the matches alone; variance of a pixel's x and y.
    """
    square = tolerance_px * tolerance_px
    reach = slack * slack * square
    variance, student, found = reach / 9.0, 1.0, True
    rotation, center = rotation.copy(), center.copy()
    delta, angles, covariance = np.empty(6), np.empty(3), np.empty((6, 6))
    inliers, information = np.empty(weights.size, np.bool_), np.zeros((6, 6))
    tangents, projected, squared = reproject(points, pixels, matrix, rotation, center)
    count = _mark_within(squared, reach, inliers)
    for _ in range(MAX_STEPS):
        found = count >= least
        if not found:
            break
        gain, noise = biweight_factors(0.5 * reach / variance)
        scale = noise * student * variance
        normal, gradient = normal_equations(tangents, projected, squared, pixels, matrix, weights, reach, scale)
        found = _invert(normal, precision, covariance)
        if not found:
            break
        turn_between(rotation, attitude, angles)
        for i in range(3):
            for j in range(3):
                gradient[3 + i] -= precision[i, j] * angles[j]
        size = determined = 0.0
        for i in range(6):
            delta[i] = 0.0
            for j in range(6):
                delta[i] += covariance[i, j] * gradient[j]
                determined += covariance[i, j] * normal[i, j]
                information[i, j] = gain * normal[i, j]
            size += delta[i] * gradient[i]
        for i in range(3):
            for j in range(3):
                center[i] += rotation[j, i] * delta[j]
        turn(rotation.copy(), delta[3:], rotation)
        tangents, projected, squared = reproject(points, pixels, matrix, rotation, center)
        # The trace is the number of parameters that the matches determine; the prior determines the rest.
        freedom, mean = 2.0 * count - determined, 0.0
        student = freedom / max(freedom - 2.0, 1.0)  # of the t's variance over a normal's: it is itself estimated
        for n in range(weights.size):
            if inliers[n]:
                mean += weights[n] * squared[n]
        variance = variance_px2(mean / freedom, tolerance_px)
        count = _mark_within(squared, square, inliers)
        reach = max(square, _REACH_SIGMAS**2 * variance)
        if size < _LAST_STEP**2:
            break
    return found, rotation, center, tangents, projected, squared, inliers, information, variance


@compiled()
def normal_equations(tangents, projected, squared, pixels, matrix, weights, reach, variance):
    """J^T W J (6, 6) and -J^T W r (6,), W over the variance, for a step of the centre and of the rotation.

    In the camera's axes, with x = R (X - C), R <- exp([w]) R and C <- C + R^T c:  dx = -c + w x x,  and the pixel
    is K x / z.
    """
    normal, gradient, row = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    for n in range(weights.size):
        agreement = max(1.0 - squared[n] / reach, 0.0)
        weight = weights[n] * agreement * agreement / variance
        if weight <= 0.0:
            continue
        u, v, near = tangents[0, n], tangents[1, n], tangents[2, n]
        by_u = (-near, 0.0, u * near, -u * v, 1.0 + u * u, -v)
        by_v = (0.0, -near, v * near, -1.0 - v * v, u * v, u)
        for axis in range(2):
            for i in range(6):
                row[i] = matrix[axis, 0] * by_u[i] + matrix[axis, 1] * by_v[i]
            add_equation(normal, gradient, row, weight, pixels[axis, n] - projected[axis, n])
    mirror(normal)
    return normal, gradient


@inlined
def _mark_within(squared, reach, inliers):
    """Mark the matches with a squared distance within a reach; return their number."""
    count = 0
    for n in range(squared.size):
        inliers[n] = squared[n] <= reach
        count += inliers[n]
    return count


@inlined
def _invert(information, precision, out):
    """Write the inverse information of matches and known attitude; False if it is not definite."""
    total, right = np.empty((6, 6)), np.empty(6)
    for column in range(6):
        for i in range(6):
            right[i] = 1.0 if i == column else 0.0
            for j in range(6):
                total[i, j] = information[i, j]
                if i >= 3 and j >= 3:
                    total[i, j] += precision[i - 3, j - 3]
        if not solve(total, right, out[column]):
            return False
    return True


@compiled()
def biweight_factors(u):
    """The efficiency factors of the biweight w = (1 - r^2 / T^2)^2 for normal noise s, u = T^2 / (2 s^2).

    The first factor turns the sum of w J^T J into the derivative that the sum of w J^T r is expected to have, the
    second s^2 into the variance that makes it the inverse covariance (Huber's sandwich): with q = r^2 / (2 s^2),
    which is exponential, they are  E[w q] / E[w]  and  E[w^2 q] / E[w q].
    """
    u = min(u, 500.0)
    g, tail, moment, power = np.empty(6), math.exp(-u), 1.0 - math.exp(-u), 1.0
    g[0] = moment
    for n in range(1, 6):  # moments of q up to u: g_n = n g_(n-1) - u^n e^-u
        tail *= u
        power *= u
        moment = n * moment - tail
        g[n] = moment / power
    weight = g[0] - 2.0 * g[1] + g[2]
    sensitivity = u * (g[1] - 2.0 * g[2] + g[3])
    noise = u * (g[1] - 4.0 * g[2] + 6.0 * g[3] - 4.0 * g[4] + g[5])
    return sensitivity / weight, noise / sensitivity


@compiled("(f8, f8)")
def variance_px2(mean, tolerance_px):
    """The variance s^2 at which distances r, truncated at T, have this mean square per axis.

    E[r^2 | r < T] = 2 s^2 (1 - u / (e^u - 1)),  u = T^2 / (2 s^2).
    """
    mean = max(mean, _NOISE_FLOOR_PX * _NOISE_FLOOR_PX)
    half = 0.5 * tolerance_px * tolerance_px
    variance = min(mean, half)
    for _ in range(5):
        u = min(half / variance, 50.0)
        variance = min(mean / (1.0 - u / math.expm1(u)), half)
    return variance
