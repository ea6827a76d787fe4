"""The loops of dense refinement over a few thousand samples, compiled by numba.

Arrays of samples are (3, N), (2, N) or (N,) float64 as in :mod:`engine.kernels.dense`.
"""

import numpy as np

from engine.kernels.small_matrices import pixel_of, rotated
from engine.runtime.jit import compiled, inlined

MIN_SAMPLES = 60
"""Fewest visible samples of a pose: some seven per parameter."""
EDGE_PX = 2.0
"""Border of the picture that is not sampled: differences reach so far."""
CELLS = 8
"""Along each side of the picture. The score vector is summed over them: the scatter of the sums accounts for
errors that neighbouring samples have in common."""
# Median absolute differences at which the weight reaches 0: 4.685 standard deviations for Tukey's biweight, and
# normal noise has one of 1.4826 such medians.
_FAR = 4.685 * 1.4826
_MEDIAN_STEP = 3  # the median uses every third difference


@compiled("(f4[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])")
def project(picture, matrix, rotation, center_m, slope, offset_m, pivot_m, gradients, known):
    """Project samples into the picture by a pose, and read levels and gradients there.

    Args:
        picture: (H, W) float32 levels.
        matrix: (3, 3) pinhole.
        rotation: (3, 3) of cam_from_map.
        center_m: (3,) of the camera.
        slope: (2,) of the ground in addition to the samples' heights.
        offset_m: (3, N) of the samples from the slope's pivot.
        pivot_m: (3,) of the slope.
        gradients: (N, 2) of the map, per metre to the east and to the north.
        known: (N,) weights.

    Returns:
        levels (N,); points (3, N) in the camera; derivatives (3, N) of the levels by the points, from the
        picture's differences; the same from the map's gradients, up to the gain; weights (N,), 0 where not
        visible; cell (N,) of the picture; number of visible samples.
    """
    samples, (height, width), shift = known.size, picture.shape, pivot_m - center_m
    levels, weights, cell = np.zeros(samples), np.zeros(samples), np.zeros(samples, np.int64)
    points, shown, expected = np.zeros((3, samples)), np.zeros((3, samples)), np.zeros((3, samples))
    right, bottom, count = width - 1.0 - EDGE_PX, height - 1.0 - EDGE_PX, 0
    for n in range(samples):
        e, north = offset_m[0, n] + shift[0], offset_m[1, n] + shift[1]
        up = offset_m[2, n] + shift[2] + slope[0] * offset_m[0, n] + slope[1] * offset_m[1, n]
        points[0, n], points[1, n], points[2, n] = x, y, z = rotated(rotation, e, north, up)
        if known[n] <= 0.0 or z <= 1e-6:
            continue
        across, down = x / z, y / z
        u, v = pixel_of(matrix, across, down)
        if not (EDGE_PX < u < right and EDGE_PX < v < bottom):
            continue
        levels[n], by_u, by_v = _bilinear(picture, u, v)
        shown[0, n] = (matrix[0, 0] * by_u + matrix[1, 0] * by_v) / z
        shown[1, n] = (matrix[0, 1] * by_u + matrix[1, 1] * by_v) / z
        shown[2, n] = -(shown[0, n] * across + shown[1, n] * down)
        _from_map(expected, rotation, gradients, n, e, north, up)
        cell[n] = int(v / bottom * CELLS) * CELLS + int(u / right * CELLS)
        weights[n], count = known[n], count + 1
    return levels, points, shown, expected, weights, cell, count


@inlined
def _from_map(expected, rotation, gradients, n, e, north, up):
    """Write the derivatives by a point in the camera, from the map's gradient; they are 0 along the ray."""
    by_e, by_n = gradients[n, 0], gradients[n, 1]
    by_up = -(by_e * e + by_n * north) / min(up, -1e-6)
    for k in range(3):
        expected[k, n] = rotation[k, 0] * by_e + rotation[k, 1] * by_n + rotation[k, 2] * by_up


@inlined
def _bilinear(picture, u, v):
    """Level of the picture at (u, v), and its derivatives by central differences, all bilinear."""
    column, row = int(u), int(v)
    fu, fv = u - column, v - row
    one, two, three, four = (1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv
    nw, ne = picture[row, column], picture[row, column + 1]
    sw, se = picture[row + 1, column], picture[row + 1, column + 1]
    level = one * nw + two * ne + three * sw + four * se
    by_u = one * (ne - picture[row, column - 1]) + two * (picture[row, column + 2] - nw)
    by_u += three * (se - picture[row + 1, column - 1]) + four * (picture[row + 1, column + 2] - sw)
    by_v = one * (sw - picture[row - 1, column]) + two * (se - picture[row - 1, column + 1])
    by_v += three * (picture[row + 2, column] - nw) + four * (picture[row + 2, column + 1] - ne)
    return level, 0.5 * by_u, 0.5 * by_v


@compiled("(f8[::1], f8[::1], f8[::1])")
def compare_levels(levels, values, weights):
    """Differences of picture and map up to gain and bias, robust weights, the correlation and the gain.

    Args:
        levels: (N,) of the picture.
        values: (N,) of the map.
        weights: (N,) of the samples, some of them above 0.

    Returns:
        Differences (N,), weights (N,) times the biweight, correlation in [-1, 1], and gain.
    """
    differences, correlation, _ = _up_to_gain(levels, values, weights)
    agreement = _biweight(differences, weights)
    differences, _, gain = _up_to_gain(levels, values, agreement)  # outliers do not affect the gain
    return differences, _biweight(differences, weights), correlation, gain


@compiled()
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


@compiled()
def _biweight(differences, weights):
    sizes, index = np.empty(weights.size), 0
    for n in range(weights.size):
        if weights[n] > 0.0:
            if index % _MEDIAN_STEP == 0:
                sizes[index // _MEDIAN_STEP] = abs(differences[n])
            index += 1
    typical = median(sizes[: (index + _MEDIAN_STEP - 1) // _MEDIAN_STEP])
    far = _FAR * max(typical, 1e-6)
    out = np.empty(weights.size)
    for n in range(weights.size):
        agreement = max(1.0 - (differences[n] / far) ** 2, 0.0)
        out[n] = weights[n] * agreement * agreement
    return out


@compiled()
def median(values):
    """The median of values (N,), NaN of none, by Hoare's selection, which reorders them.

    NumPy's takes seconds to compile.
    """
    middle, low, high = values.size // 2, 0, values.size - 1
    if values.size == 0:
        return np.nan
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if middle > j and middle < i:
            break
        low, high = (low, j) if middle <= j else (i, high)
    if values.size % 2 == 1:
        return values[middle]
    below = values[0]
    for n in range(1, middle):
        below = max(below, values[n])
    return 0.5 * (below + values[middle])
