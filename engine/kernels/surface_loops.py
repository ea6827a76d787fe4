"""Loops around the transforms of a correlation on the CPU, compiled by numba: one pass, no temporaries.

Sums are in float64 and about the window's mean, or of a picture about 0: a large offset would cost digits.
"""

import math

import numpy as np

from engine.kernels.sums import FLAT_SHARE
from engine.runtime.jit import compiled, inlined


@compiled("(f4[:, ::1], b1)")
def moments(picture, zero_mean):
    """Mean and sum of squares.

    Args:
        picture: (H, W) float32.
        zero_mean: take the squares about the mean; else the mean is taken as 0.

    Returns:
        Both in float64; not finite if a pixel is not.
    """
    # Counted from the first pixel: a picture of one level has sums of exactly 0.
    start, total, square = np.float64(picture[0, 0]) if zero_mean else 0.0, 0.0, 0.0
    for y in range(picture.shape[0]):
        row = picture[y]
        for x in range(len(row)):
            value = np.float64(row[x]) - start
            total += value
            square += value * value
    if not zero_mean:
        return 0.0, square
    spread = square - total * total / picture.size
    return start + total / picture.size, 0.0 if spread < 0.0 else spread


@compiled("(f4[:, ::1], b1)")
def unit(template, zero_mean):
    """A template (h, w) float32 scaled to a norm of 1, zeros where flat, and its sum of squares."""
    mean, energy = moments(template, zero_mean)
    # As of a patch, but of the template's mean and not of the squares in which that is squared already.
    flat = energy <= FLAT_SHARE * FLAT_SHARE * template.size * mean * mean
    scale, model = 0.0 if flat else 1.0 / math.sqrt(energy), np.empty(template.shape, np.float32)
    for y in range(template.shape[0]):
        for x in range(template.shape[1]):
            model[y, x] = (np.float64(template[y, x]) - mean) * scale
    return model, energy


@compiled("(f4[:, ::1], f8, f8, i8, i8, b1)")
def inverse_norms(window, mean, energy, h, w, zero_mean):
    """Reciprocal norm of every patch.

    Args:
        window: (H, W) float32.
        mean: of the window, see :func:`moments`.
        energy: its sum of squares.
        h: rows of a patch.
        w: columns of a patch.
        zero_mean: norms about the patches' own means.

    Returns:
        (H-h+1, W-w+1) float32, 0 where a patch is flat.
    """
    columns, height, width = window.shape[1], window.shape[0] - h + 1, window.shape[1] - w + 1
    out = np.empty((height, width), np.float32)
    floor, share = FLAT_SHARE * energy, 1.0 / (1.0 * h * w) if zero_mean else 0.0
    down, down_squares = np.zeros(columns), np.zeros(columns)
    along, along_squares = np.zeros(columns + 1), np.zeros(columns + 1)
    spreads = np.empty(width, np.float32)
    # Patches are counted in the window's energy and norm, for float32 to hold them.
    unit_energy = 1.0 / energy if energy > 0.0 else 0.0
    unit_norm = np.float32(1.0 / math.sqrt(energy) if energy > 0.0 else 0.0)
    for y in range(height):
        _sum_rows(down, down_squares, window, y, h, mean)
        _sum_along(along, along_squares, down, down_squares)
        row, ahead, ahead_squares = out[y], along[w:], along_squares[w:]  # an index x + w would not be vectorised
        for x in range(width):
            total = ahead[x] - along[x]
            spread = ahead_squares[x] - along_squares[x] - total * total * share
            spreads[x] = spread * unit_energy if spread > floor else 0.0
        for x in range(width):
            row[x] = unit_norm / np.sqrt(spreads[x]) if spreads[x] > 0.0 else 0.0
    return out


@inlined
def _sum_rows(down, down_squares, picture, y, h, mean):
    """Sums over h rows of every column, the first of them y, from those of y - 1; both are 0 before y = 0."""
    if y == 0:
        for first in range(h):
            row = picture[first]
            for x in range(len(row)):
                value = row[x] - mean
                down[x] += value
                down_squares[x] += value * value
        return
    after, before = picture[y + h - 1], picture[y - 1]
    for x in range(len(after)):
        new, old = after[x] - mean, before[x] - mean
        down[x] += new - old
        down_squares[x] += (new - old) * (new + old)


@inlined
def _sum_along(along, along_squares, down, down_squares):
    """Running sums along a row, from 0."""
    total, square = 0.0, 0.0
    for x in range(len(down)):
        total += down[x]
        square += down_squares[x]
        along[x + 1], along_squares[x + 1] = total, square


@compiled("(f4[:, ::1], f4[:, ::1], f8)")
def centre(out, picture, mean):
    """Write a picture less a mean to the top left of ``out``, zeros elsewhere; returns its sum of squares."""
    (height, width), energy = picture.shape, 0.0
    for y in range(height):
        to, row = out[y], picture[y]
        for x in range(width):
            value = np.float32(row[x] - mean)
            energy += np.float64(value) * value
            to[x] = value
        to[width:] = 0.0
    out[height:] = 0.0
    return energy


@compiled("(f4[:, ::1], f4[:, ::1], f4[:, ::1], f4)")
def normalise(out, products, inverse, factor):
    """Write ``products * inverse * factor`` to ``out``, in [-1, 1]; all float32, products of at least its size."""
    for y in range(out.shape[0]):
        to, numerators, norms = out[y], products[y], inverse[y]
        for x in range(out.shape[1]):
            score = numerators[x] * (norms[x] * factor)
            to[x] = min(max(score, np.float32(-1.0)), np.float32(1.0))
