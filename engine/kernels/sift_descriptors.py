"""SIFT's dominant angles and descriptors for the CPU, compiled by numba.

``buffer`` is the flat scale space of :mod:`engine.sift.scale_space`, ``table`` its layout: for every octave
height, width, offset, and the strides of level and row. ``keypoints`` are rows of x, y, growth of sigma, contrast,
level, octave, in pixels of the octave.
"""

import math

import numpy as np

from engine.runtime.jit import compiled, inlined

_BOUND = 0.2  # of an entry before the last normalisation
_TINY = np.finfo(np.float32).tiny  # keeps an empty descriptor zero


@inlined
def _sample(buffer, layout, x, y, cos, sin, patch):
    """Fill a square patch with bilinear samples on a grid rotated and scaled by (cos, sin), edges extended."""
    height, width, base, per_row = layout
    side = len(patch)
    half = np.float32(0.5 * (side - 1))
    max_x, max_y = np.float32(width - 1.001), np.float32(height - 1.001)
    zero = np.float32(0)
    for row in range(side):
        v = row - half
        for column in range(side):
            u = column - half
            px = min(max(np.float32(x + cos * u - sin * v), zero), max_x)
            py = min(max(np.float32(y + sin * u + cos * v), zero), max_y)
            left, top = int(px), int(py)
            fx, fy = px - np.float32(left), py - np.float32(top)
            at = base + top * per_row + left
            upper = buffer[at] + fx * (buffer[at + 1] - buffer[at])
            at += per_row
            lower = buffer[at] + fx * (buffer[at + 1] - buffer[at])
            patch[row, column] = upper + fy * (lower - upper)


@inlined
def _sample_upright(buffer, layout, x, y, spacing, line, patch):
    """The same on an unrotated grid: columns and rows are computed once each, in half the time."""
    height, width, base, per_row = layout
    left, share = line
    side = len(patch)
    half = np.float32(0.5 * (side - 1))
    max_x, max_y = np.float32(width - 1.001), np.float32(height - 1.001)
    zero = np.float32(0)
    for column in range(side):
        px = min(max(np.float32(x + spacing * (column - half)), zero), max_x)
        left[column] = np.int32(px)
        share[column] = px - np.float32(left[column])
    for row in range(side):
        py = min(max(np.float32(y + spacing * (row - half)), zero), max_y)
        top = int(py)
        fy, start = py - np.float32(top), base + top * per_row
        for column in range(side):
            at, fx = start + left[column], share[column]
            upper = buffer[at] + fx * (buffer[at + 1] - buffer[at])
            at += per_row
            lower = buffer[at] + fx * (buffer[at + 1] - buffer[at])
            patch[row, column] = upper + fy * (lower - upper)


@inlined
def _layout(table, octave, level):
    height, width, offset, per_level, per_row = table[octave]
    return height, width, offset + level * per_level, per_row


@inlined
def _turn(x, y):
    """Direction of a vector in turns, [0, 1], to 2e-6: Abramowitz and Stegun 4.4.49, without a branch."""
    ax, ay = abs(x), abs(y)
    t = min(ax, ay) / max(max(ax, ay), np.float32(1e-30))
    s = t * t
    p = np.float32(0.0208351) * s - np.float32(0.0851330)
    p = (p * s + np.float32(0.1801410)) * s - np.float32(0.3302995)
    turn = (p * s + np.float32(0.9998660)) * t * np.float32(0.5 / math.pi)
    turn = np.float32(0.25) - turn if ay > ax else turn
    turn = np.float32(0.5) - turn if x < 0 else turn
    return np.float32(1) - turn if y < 0 else turn


@compiled("(f4[::1], i8[:, ::1], f4[:, ::1], f4, f4[:, ::1], f4[:, ::1])")
def angles(buffer, table, keypoints, step, window, smooth):
    """Direction of the highest peak in the histogram of gradient directions.

    Args:
        buffer: (N,) float32 scale space.
        table: (octaves, 5) int64 layout.
        keypoints: (M, 6) float32.
        step: spacing of the samples where the growth is 1, in pixels of the octave.
        window: (S, S) float32 weights of the samples.
        smooth: (bins, bins) float32 circular smoothing of the histogram.

    Returns:
        (M,) float32 radians, from +x towards +y.
    """
    side, bins = len(window), len(smooth)
    patch = np.empty((side + 2, side + 2), np.float32)
    histogram, raw = np.empty(bins, np.float32), np.empty(bins + 1, np.float32)
    turns, sizes = np.empty(side, np.int32), np.empty(side, np.float32)
    line = np.empty(side + 2, np.int32), np.empty(side + 2, np.float32)
    out = np.empty(len(keypoints), np.float32)
    for i in range(len(keypoints)):
        u, v, growth, _, level, octave = keypoints[i]
        _sample_upright(buffer, _layout(table, int(octave), int(level)), u, v, growth * step, line, patch)
        raw[:] = 0
        for row in range(side):
            for x in range(side):
                gx = patch[row + 1, x + 2] - patch[row + 1, x]
                gy = patch[row + 2, x + 1] - patch[row, x + 1]
                turns[x] = np.int32(_turn(gx, gy) * np.float32(bins) + np.float32(0.5))
                sizes[x] = math.sqrt(gx * gx + gy * gy) * window[row, x]
            for x in range(side):
                raw[turns[x]] += sizes[x]
        raw[0] += raw[bins]
        out[i] = _highest_bin(raw, smooth, histogram) * (math.tau / bins)
    return out


@inlined
def _highest_bin(raw, smooth, histogram):
    """Position of the peak of a histogram once smoothed, in bins, by a parabola through its neighbours."""
    bins, best = len(smooth), 0
    for k in range(bins):
        total = np.float32(0)
        for j in range(bins):
            total += raw[j] * smooth[j, k]
        histogram[k] = total
        if total > histogram[best]:
            best = k
    left, top, right = histogram[best - 1], histogram[best], histogram[(best + 1) % bins]
    return best + 0.5 * (left - right) / min(left - 2 * top + right, -1e-12)


@compiled("(f4[::1], i8[:, ::1], f4[:, ::1], f4[::1], f4, f4[:, ::1])")
def descriptors(buffer, table, keypoints, angle, step, tent):
    """Lowe's cells of 8 orientations as RootSIFT, of unit L2 norm.

    Args:
        buffer: (N,) float32 scale space.
        table: (octaves, 5) int64 layout.
        keypoints: (M, 6) float32.
        angle: (M,) float32 radians.
        step: spacing of the samples where the growth is 1, in pixels of the octave.
        tent: (cells, S) float32 weights of a row's samples in the cells.

    Returns:
        (M, cells^2 * 8) float32, cells row by row.
    """
    cells, side = tent.shape
    patch = np.empty((side + 2, side + 2), np.float32)
    line = np.empty(side + 2, np.int32), np.empty(side + 2, np.float32)
    p = np.empty((8, side), np.float32)
    columns = np.empty((cells, 8, side), np.float32)
    out = np.empty((len(keypoints), cells * cells * 8), np.float32)
    for i in range(len(keypoints)):
        u, v, growth, _, level, octave = keypoints[i]
        layout, spacing = _layout(table, int(octave), int(level)), growth * step
        if angle[i] == 0:
            _sample_upright(buffer, layout, u, v, spacing, line, patch)
        else:
            cos, sin = spacing * np.float32(math.cos(angle[i])), spacing * np.float32(math.sin(angle[i]))
            _sample(buffer, layout, u, v, cos, sin, patch)
        columns[:] = 0
        for row in range(side):
            _orient_row(patch, row, p)
            for r in range(cells):
                weight = tent[r, row]
                if weight != 0:
                    for k in range(8):
                        for x in range(side):
                            columns[r, k, x] += weight * p[k, x]
        _pool(columns, tent, out[i])
        _normalise(out[i])
    return out


@inlined
def _normalise(values):
    """The roots of shares (RootSIFT), with entries bounded before (Lowe)."""
    bound, total = np.float32(_BOUND), _TINY
    for k in range(values.size):
        total += values[k] * values[k]
    gain = np.float32(1) / np.float32(math.sqrt(total))
    total = _TINY
    for k in range(values.size):
        value = min(values[k] * gain, bound)
        values[k] = value
        total += value
    gain = np.float32(1) / total
    for k in range(values.size):
        values[k] = math.sqrt(values[k] * gain)


@inlined
def _orient_row(patch, row, p):
    """Split a row's gradients between 8 directions: w_k = max(0, min(p_(k-1), p_(k+1))), see engine.sift."""
    half, zero = np.float32(math.sqrt(0.5)), np.float32(0)
    for x in range(p.shape[1]):
        gx = patch[row + 1, x + 2] - patch[row + 1, x]
        gy = patch[row + 2, x + 1] - patch[row, x + 1]
        diagonal, anti = half * (gx + gy), half * (gy - gx)
        p[0, x] = max(zero, min(-anti, diagonal))
        p[1, x] = max(zero, min(gx, gy))
        p[2, x] = max(zero, min(diagonal, anti))
        p[3, x] = max(zero, min(gy, -gx))
        p[4, x] = max(zero, min(anti, -diagonal))
        p[5, x] = max(zero, min(-gx, -gy))
        p[6, x] = max(zero, min(-diagonal, -anti))
        p[7, x] = max(zero, min(-gy, gx))


@inlined
def _pool(columns, tent, out):
    """Weight the samples of every row of cells along x, into (cells^2 * 8,)."""
    cells, side = tent.shape
    for r in range(cells):
        for c in range(cells):
            for k in range(8):
                total = np.float32(0)
                for x in range(side):
                    total += tent[c, x] * columns[r, k, x]
                out[(r * cells + c) * 8 + k] = total
