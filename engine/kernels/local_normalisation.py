"""Local normalisation of a grey picture in one pass over its rows, compiled by numba.

Sums of whole grey levels, counted from middle grey, are exact in int32.
"""

from __future__ import annotations

import math

import numpy as np

from engine.kernels.sums import MIDDLE_GREY
from engine.runtime.jit import compiled, inlined

MAX_RADIUS_PX = (math.isqrt(np.iinfo(np.int32).max // MIDDLE_GREY**2) - 1) // 2
"""Radius of the largest neighbourhood whose sum of squares fits into int32."""


@compiled("(u1[:, ::1], i8, f8)")
def normalised(picture, radius_px, noise_variance):
    """Each pixel less the mean of its neighbourhood, over its standard deviation.

    Args:
        picture: (H, W) uint8; beyond its edges it is mirrored about its outermost pixels, as often as necessary.
        radius_px: neighbourhoods are boxes of 2 radius_px + 1 pixels, at most :data:`MAX_RADIUS_PX`.
        noise_variance: added to the variance.

    Returns:
        (H, W) float32.
    """
    height, width = picture.shape
    out = np.empty((height, width), np.float32)
    left = np.empty(radius_px, np.int64)  # columns that replace those beyond the edges
    right = np.empty(radius_px, np.int64)
    for n in range(radius_px):
        left[n], right[n] = _mirrored(n - radius_px, width), _mirrored(width + n, width)
    down, squares = np.zeros(width, np.int32), np.zeros(width, np.int32)  # sums over the rows of the box
    for y in range(-radius_px, radius_px + 1):
        _add(down, squares, picture[_mirrored(y, height)])
    side = 2 * radius_px + 1
    along, along_squares = np.zeros(width + side, np.int32), np.zeros(width + side, np.int32)
    area, share, noise = side * side, np.float32(1.0 / (side * side)), np.float32(noise_variance)
    for y in range(height):
        _accumulate(along, down, left, right)
        _accumulate(along_squares, squares, left, right)
        row, target = picture[y], out[y]
        for x in range(width):
            # Running sums of a long row wrap round, and their differences back.
            total = np.int32(along[x + side] - along[x])
            mean = np.float32(total) * share
            square = np.float32(np.int32(along_squares[x + side] - along_squares[x])) * share
            variance = max(square - mean * mean, np.float32(0.0)) + noise
            above_mean = np.float32(np.int32((np.int32(row[x]) - MIDDLE_GREY) * area - total)) * share
            target[x] = above_mean / np.sqrt(variance)
        if y + 1 < height:
            below, above = _mirrored(y + 1 + radius_px, height), _mirrored(y - radius_px, height)
            _replace(down, squares, picture[below], picture[above])
    return out


@inlined
def _mirrored(index, size):
    """The index inside of one that is beyond an edge; the outermost pixel is not repeated."""
    if size == 1:
        return 0
    while not 0 <= index < size:
        index = -index if index < 0 else 2 * (size - 1) - index
    return index


@inlined
def _add(down, squares, row):
    """Add a row to the sums over rows."""
    for x in range(row.size):
        value = np.int32(row[x]) - np.int32(MIDDLE_GREY)
        down[x] += value
        squares[x] += value * value


@inlined
def _replace(down, squares, new, old):
    """Move the sums over rows down by one row."""
    for x in range(new.size):
        value, gone = np.int32(new[x]) - np.int32(MIDDLE_GREY), np.int32(old[x]) - np.int32(MIDDLE_GREY)
        down[x] += value - gone
        squares[x] += value * value - gone * gone


@inlined
def _accumulate(along, values, left, right):
    """Write running sums along a row extended beyond its edges; the first is 0."""
    total, at = np.int32(0), 1
    for n in range(left.size):
        total += values[left[n]]
        along[at] = total
        at += 1
    for x in range(values.size):
        total += values[x]
        along[at] = total
        at += 1
    for n in range(right.size):
        total += values[right[n]]
        along[at] = total
        at += 1
