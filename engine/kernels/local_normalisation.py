"""Local normalisation of a grey picture in one pass over its rows, compiled by numba.

Sums of whole grey levels, counted from middle grey, are exact in int32.
"""

import numpy as np

from engine.kernels.sums import MIDDLE_GREY
from engine.runtime.jit import compiled, inlined


@compiled("(u1[:, ::1], i8, f8)")
def normalised(padded, radius_px, noise_variance):
    """Each pixel less the mean of its neighbourhood, over its standard deviation.

    Args:
        padded: (H + 2 radius_px, W + 2 radius_px) uint8, the picture extended beyond its edges.
        radius_px: neighbourhoods are boxes of 2 radius_px + 1 pixels, at most
            :data:`engine.kernels.scores.MAX_RADIUS_PX`.
        noise_variance: added to the variance.

    Returns:
        (H, W) float32.
    """
    side = 2 * radius_px + 1
    height, width = padded.shape[0] - side + 1, padded.shape[1] - side + 1
    out = np.empty((height, width), np.float32)
    down, squares = np.zeros(padded.shape[1], np.int32), np.zeros(padded.shape[1], np.int32)  # over the box's rows
    along, along_squares = np.zeros(down.size + 1, np.int32), np.zeros(down.size + 1, np.int32)
    area, share, noise = side * side, np.float32(1.0 / (side * side)), np.float32(noise_variance)
    for y in range(side - 1):
        _add(down, squares, padded[y], 1)
    for y in range(height):
        _add(down, squares, padded[y + side - 1], 1)
        _accumulate(along, down)
        _accumulate(along_squares, squares)
        row, target = padded[y + radius_px, radius_px:], out[y]
        ahead, ahead_squares = along[side:], along_squares[side:]  # an index x + side would not be vectorised
        for x in range(width):
            # Running sums of a long row wrap round, and their differences back.
            total = np.int32(ahead[x] - along[x])
            mean = np.float32(total) * share
            square = np.float32(np.int32(ahead_squares[x] - along_squares[x])) * share
            variance = max(square - mean * mean, np.float32(0.0)) + noise
            above_mean = np.float32(np.int32((np.int32(row[x]) - MIDDLE_GREY) * area - total)) * share
            target[x] = above_mean / np.sqrt(variance)
        _add(down, squares, padded[y], -1)
    return out


@inlined
def _add(down, squares, row, sign):
    """Add a row to the sums over rows, or subtract it."""
    for x in range(row.size):
        value = np.int32(row[x]) - np.int32(MIDDLE_GREY)
        down[x] += np.int32(sign) * value
        squares[x] += np.int32(sign) * value * value


@inlined
def _accumulate(along, values):
    """Write running sums along a row; the first is 0."""
    total = np.int32(0)
    for x in range(values.size):
        total += values[x]
        along[x + 1] = total
