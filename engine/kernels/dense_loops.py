"""The loops of dense refinement, compiled by numba: a few thousand samples, each a few sums.

Arrays of samples are (3, N), (2, N) or (N,) float64 as in :mod:`engine.dense`.
"""

from __future__ import annotations

import numpy as np

from engine.kernels.jit import compiled

_BIWEIGHT = 4.685  # of the residuals' deviation: where Tukey's biweight gives a sample no weight
_MAD = 1.4826  # deviation of normal noise over its median absolute value
_THINNED = 3  # every so many differences tell their median


@compiled
def seen(picture, matrix, rotation, center_m, slope, offset_m, pivot_m, gradients, known, edge_px, cells):
    """What a pose sees of the samples.

    Args:
        picture: (H, W) float32 levels.
        matrix: (3, 3) pinhole.
        rotation: (3, 3) of cam_from_map.
        center_m: (3,) of the camera.
        slope: (2,) of the ground besides the samples' heights.
        offset_m: (3, N) of the samples from the slope's pivot.
        pivot_m: (3,) of the slope.
        gradients: (N, 2) of the map, per metre to the east and to the north.
        known: (N,) weights.
        edge_px: along the picture's edge, at least 2, nothing is seen.
        cells: that many cells along each side of the picture.

    Returns:
        levels (N,) that the picture shows; places (3, N) of the samples in the camera; shown (3, N) derivatives of
        the levels by the places, by the picture's central differences; expected (3, N) the same by the map's
        gradients, up to the gain; weights (N,), 0 where a sample is not seen; cell (N,) of the picture; how many
        were seen.
    """
    samples, (height, width) = known.size, picture.shape
    levels, weights, cell = np.zeros(samples), np.zeros(samples), np.zeros(samples, np.int64)
    places, shown, expected = np.zeros((3, samples)), np.zeros((3, samples)), np.zeros((3, samples))
    right, bottom, count = width - 1.0 - edge_px, height - 1.0 - edge_px, 0
    shift = pivot_m - center_m
    for n in range(samples):
        e, north = offset_m[0, n] + shift[0], offset_m[1, n] + shift[1]
        up = offset_m[2, n] + shift[2] + slope[0] * offset_m[0, n] + slope[1] * offset_m[1, n]
        x = rotation[0, 0] * e + rotation[0, 1] * north + rotation[0, 2] * up
        y = rotation[1, 0] * e + rotation[1, 1] * north + rotation[1, 2] * up
        z = rotation[2, 0] * e + rotation[2, 1] * north + rotation[2, 2] * up
        places[0, n], places[1, n], places[2, n] = x, y, z
        if known[n] <= 0.0 or z <= 1e-6:
            continue
        across, down = x / z, y / z
        u = matrix[0, 0] * across + matrix[0, 1] * down + matrix[0, 2]
        v = matrix[1, 0] * across + matrix[1, 1] * down + matrix[1, 2]
        if not (edge_px < u < right and edge_px < v < bottom):
            continue
        column, row = int(u), int(v)
        fu, fv = u - column, v - row
        one, two, three, four = (1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv
        nw, ne = picture[row, column], picture[row, column + 1]
        sw, se = picture[row + 1, column], picture[row + 1, column + 1]
        levels[n] = one * nw + two * ne + three * sw + four * se
        by_u = one * (ne - picture[row, column - 1]) + two * (picture[row, column + 2] - nw)
        by_u += three * (se - picture[row + 1, column - 1]) + four * (picture[row + 1, column + 2] - sw)
        by_v = one * (sw - picture[row - 1, column]) + two * (se - picture[row - 1, column + 1])
        by_v += three * (picture[row + 2, column] - nw) + four * (picture[row + 2, column + 1] - ne)
        by_u, by_v = 0.5 * by_u, 0.5 * by_v
        shown[0, n] = (matrix[0, 0] * by_u + matrix[1, 0] * by_v) / z
        shown[1, n] = (matrix[0, 1] * by_u + matrix[1, 1] * by_v) / z
        shown[2, n] = -(shown[0, n] * across + shown[1, n] * down)
        by_e, by_n = gradients[n, 0], gradients[n, 1]
        by_up = -(by_e * e + by_n * north) / min(up, -1e-6)  # along the ray nothing changes
        for k in range(3):
            expected[k, n] = rotation[k, 0] * by_e + rotation[k, 1] * by_n + rotation[k, 2] * by_up
        weights[n] = known[n]
        cell[n] = int(v / bottom * cells) * cells + int(u / right * cells)
        count += 1
    return levels, places, shown, expected, weights, cell, count


@compiled
def compare(levels, values, weights):
    """Differences of picture and map up to gain and bias, robust weights, the correlation and the gain.

    Args:
        levels: (N,) of the picture.
        values: (N,) of the map.
        weights: (N,) of the samples, some of them above 0.
    """
    differences, correlation, _ = _up_to_gain(levels, values, weights)
    agreement = _biweight(differences, weights)
    differences, _, gain = _up_to_gain(levels, values, agreement)  # what does not belong there sets no gain
    return differences, _biweight(differences, weights), correlation, gain


@compiled
def derivatives(by_places, places, offset_m, rotation):
    """(8, N) of the differences by the pose's parameters, from those by the places (3, N)."""
    out = np.empty((8, by_places.shape[1]))
    for n in range(by_places.shape[1]):
        a, b, c = by_places[0, n], by_places[1, n], by_places[2, n]
        x, y, z = places[0, n], places[1, n], places[2, n]
        for k in range(3):
            out[k, n] = -(rotation[0, k] * a + rotation[1, k] * b + rotation[2, k] * c)
        out[3, n], out[4, n], out[5, n] = y * c - z * b, z * a - x * c, x * b - y * a
        out[6, n], out[7, n] = -out[2, n] * offset_m[0, n], -out[2, n] * offset_m[1, n]
    return out


@compiled
def _up_to_gain(levels, values, weights):
    """Differences, correlation, gain."""
    total = level = value = 0.0
    for n in range(weights.size):
        total += weights[n]
        level += weights[n] * levels[n]
        value += weights[n] * values[n]
    level, value = level / total, value / total
    both = own = other = 0.0
    for n in range(weights.size):
        a, b = levels[n] - level, values[n] - value
        both += weights[n] * a * b
        own += weights[n] * a * a
        other += weights[n] * b * b
    gain = both / max(other, 1e-12)
    differences = np.empty(weights.size)
    for n in range(weights.size):
        differences[n] = levels[n] - level - gain * (values[n] - value)
    return differences, both / max(np.sqrt(own * other), 1e-12), gain


@compiled
def _biweight(differences, weights):
    sizes, index = np.empty(weights.size), 0
    for n in range(weights.size):
        if weights[n] > 0.0:
            if index % _THINNED == 0:
                sizes[index // _THINNED] = abs(differences[n])
            index += 1
    typical = np.median(sizes[: (index + _THINNED - 1) // _THINNED])
    far = _BIWEIGHT * _MAD * max(typical, 1e-6)
    out = np.empty(weights.size)
    for n in range(weights.size):
        agreement = max(1.0 - (differences[n] / far) ** 2, 0.0)
        out[n] = weights[n] * agreement * agreement
    return out
