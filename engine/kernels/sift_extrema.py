"""SIFT's scale space and the extrema in it for the CPU, compiled by numba.

A CPU's cache holds a few rows of a picture and not all its levels, so the work goes row by row and reuses rows
while they are cached. ``buffer`` is the flat scale space of :mod:`engine.sift.scale_space`.
"""

from __future__ import annotations

import numpy as np

from engine.kernels.jit import compiled

TAPS = 4
"""Taps of a filter that one pass over a row applies; filters are padded with zeros to a multiple of it."""


@compiled
def find_extrema(source, across, down, buffer, layout, rows, border, threshold):
    """Write the Gaussian levels of one picture's octave row by row, and find the extrema of their differences.

    Args:
        source: (H, W) float32.
        across: filters of the rows from :func:`engine.sift.loops.filters`: output ``up m + p`` of level l is its
            gain times the sum over k of ``weights[l, p, k] source[m + k - reach[l]]``, zero beyond the edges.
        down: filters of the columns.
        buffer: (N,) float32 that the levels are written to.
        layout: (height, width, offset, stride of a level, stride of a row) of the octave.
        rows: (first, end) of the rows that are searched; their neighbours are written too.
        border: rows and columns along the edge that are not searched.
        threshold: lower bound on |DoG| of an extremum.

    Returns:
        (M, 3) int64 level, y, x of the voxels where |DoG| is the maximum of its 3 x 3 x 3.
    """
    height, width, offset, per_level, per_row = layout
    up, dogs = across[0].shape[1], len(down[1]) - 1
    first, end = max(rows[0] - 1, 0), min(rows[1] + 1, height)
    tall, start = _between_zeros(source, down[1], first // up, (end - 1) // up + 1)
    lines = np.zeros((dogs + 1, up, source.shape[1] + 2 * _padding(across[1])), np.float32)
    sizes = np.zeros((3, dogs, width), np.float32)  # |DoG| of the last three rows
    work = np.empty((dogs + 1, width), np.float32), np.zeros((width + 7) // 8 * 8, np.uint8)
    found, count = np.empty((256, 3), np.int64), np.int64(0)  # by a literal 0, the callee compiles twice
    for y in range(first, end):
        for level in range(dogs + 1):
            at = offset + level * per_level + y * per_row
            out = buffer[at : at + width]
            if y % up == 0 or y == first:
                _down_rows(lines[level], tall, y // up - start, source.shape[1], level, down, _padding(across[1]))
            _across_row(out, lines[level, y % up], level, across, _gain_of(down[2], level, y, height))
            if level > 0:
                finer, size = buffer[at - per_level : at - per_level + width], sizes[y % 3, level - 1]
                for x in range(width):
                    size[x] = abs(out[x] - finer[x])
        middle = y - 1
        if max(rows[0], border) <= middle < min(rows[1], height - border) and width > 2 * border:
            found, count = _extrema_of_row(sizes, middle, border, threshold, work, found, count)
    return found[:count]


@compiled
def _padding(reach):
    largest = reach[0]
    for level in range(1, reach.size):
        largest = max(largest, reach[level])
    return largest + TAPS


@compiled
def _between_zeros(source, reach, first, end):
    """Rows that the filters of rows ``first`` to ``end`` read, zeros beyond the picture; index of the first."""
    height, width = source.shape
    start = first - _padding(reach)
    tall = np.zeros((end + _padding(reach) - start) * width, np.float32)
    for y in range(max(start, 0), min(end + _padding(reach), height)):
        row = tall[(y - start) * width : (y - start + 1) * width]
        for x in range(width):  # an assignment of slices would compile its message of unequal shapes
            row[x] = source[y, x]
    return tall, start


@compiled
def _taps(reach, up):
    """Taps of a filter with its padding; of two phases the second is one sample further on."""
    return (2 * reach + up + TAPS - 1) // TAPS * TAPS


@compiled
def _down_rows(lines, tall, row, width, level, down, margin):
    """Filter the columns about a row of the source: one line per phase, with a margin of zeros on either side."""
    weights, reach, _ = down
    start, taps = (row - reach[level]) * width, _taps(reach[level], len(lines))
    first = lines[0, margin : margin + width]
    if len(lines) == 1:
        _slide(first, tall, start, width, weights[level, 0], taps)
    else:
        second = lines[1, margin : margin + width]
        _slide_both(first, second, tall, start, width, weights[level, 0], weights[level, 1], taps)


@compiled
def _across_row(out, line, level, across, gain):
    """Filter a line along itself, and apply the gains that make up for the edges."""
    weights, reach, gains = across
    up, width = weights.shape[1], out.size
    start, taps = _padding(reach) - reach[level], _taps(reach[level], up)
    if up == 1 and reach[level] == 0:
        for x in range(width):
            out[x] = line[start + x]
    elif up == 1:
        _slide(out, line, start, 1, weights[level, 0], taps)
    else:
        _slide_double(out, line, start, weights[level, 0], weights[level, 1], taps)
    edge = gains.shape[2]
    for x in range(edge):
        out[x] *= gains[0, level, x]
    for x in range(max(edge, width - edge), width):
        out[x] *= gains[1, level, x - width + edge]
    if gain != 1:
        for x in range(width):
            out[x] *= gain


@compiled
def _gain_of(gains, level, y, height):
    """The gain of one output along an axis, of the first and the last of which they are kept."""
    edge = gains.shape[2]
    if y < edge:
        return gains[0, level, y]
    return gains[1, level, y - height + edge] if y >= height - edge else np.float32(1)


@compiled
def _slide(out, values, start, stride, weights, taps):
    """out[m] = sum over k of weights[k] values[start + k stride + m]."""
    n = out.size
    for k in range(0, taps, TAPS):
        a, b, c, d = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
        at = start + k * stride
        p = values[at : at + n]
        q = values[at + stride : at + stride + n]
        r = values[at + 2 * stride : at + 2 * stride + n]
        s = values[at + 3 * stride : at + 3 * stride + n]
        if k == 0:
            for m in range(n):
                out[m] = a * p[m] + b * q[m] + (c * r[m] + d * s[m])
        else:
            for m in range(n):
                out[m] += a * p[m] + b * q[m] + (c * r[m] + d * s[m])


@compiled
def _slide_both(first, second, values, start, stride, even, odd, taps):
    """:func:`_slide` with two filters at once, so that the values are read once."""
    n = first.size
    for k in range(0, taps, TAPS):
        a, b, c, d = even[k], even[k + 1], even[k + 2], even[k + 3]
        e, f, g, h = odd[k], odd[k + 1], odd[k + 2], odd[k + 3]
        at = start + k * stride
        p = values[at : at + n]
        q = values[at + stride : at + stride + n]
        r = values[at + 2 * stride : at + 2 * stride + n]
        s = values[at + 3 * stride : at + 3 * stride + n]
        if k == 0:
            for m in range(n):
                first[m] = a * p[m] + b * q[m] + (c * r[m] + d * s[m])
                second[m] = e * p[m] + f * q[m] + (g * r[m] + h * s[m])
        else:
            for m in range(n):
                first[m] += a * p[m] + b * q[m] + (c * r[m] + d * s[m])
                second[m] += e * p[m] + f * q[m] + (g * r[m] + h * s[m])


@compiled
def _slide_double(out, values, start, even, odd, taps):
    """out[2m + p] = sum over k of the weights of phase p[k] times values[start + k + m]."""
    n = out.size // 2
    for k in range(0, taps, TAPS):
        a, b, c, d = even[k], even[k + 1], even[k + 2], even[k + 3]
        e, f, g, h = odd[k], odd[k + 1], odd[k + 2], odd[k + 3]
        at = start + k
        p, q = values[at : at + n], values[at + 1 : at + 1 + n]
        r, s = values[at + 2 : at + 2 + n], values[at + 3 : at + 3 + n]
        if k == 0:
            for m in range(n):
                out[2 * m] = a * p[m] + b * q[m] + (c * r[m] + d * s[m])
                out[2 * m + 1] = e * p[m] + f * q[m] + (g * r[m] + h * s[m])
        else:
            for m in range(n):
                out[2 * m] += a * p[m] + b * q[m] + (c * r[m] + d * s[m])
                out[2 * m + 1] += e * p[m] + f * q[m] + (g * r[m] + h * s[m])
    if out.size % 2:  # an upsampled row ends with an even layout
        total = np.float32(0)
        for k in range(taps):
            total += even[k] * values[start + k + n]
        out[2 * n] = total


@compiled
def _extrema_of_row(sizes, y, border, threshold, work, found, count):
    """Append to ``found`` the extrema of row y, by |DoG| of three rows in ``sizes``."""
    highest, flags = work
    dogs, width = sizes.shape[1:]
    inner = width - 2 * border
    words = flags.view(np.uint64)
    top = highest[dogs]
    # Every loop runs over slices from 0 up: an index that might be negative would keep it from being vectorised.
    left, centre, right = top[border - 1 :], top[border:], top[border + 1 :]
    for s in range(dogs):
        a, b, c, row = sizes[0, s], sizes[1, s], sizes[2, s], highest[s]
        for x in range(width):
            row[x] = max(max(a[x], b[x]), c[x])
    for s in range(1, dogs - 1):
        a, b, c, row = highest[s - 1], highest[s], highest[s + 1], sizes[y % 3, s, border : border + inner]
        for x in range(width):
            top[x] = max(max(a[x], b[x]), c[x])
        for x in range(inner):
            flags[x] = row[x] >= max(max(left[x], centre[x]), max(right[x], threshold))
        for w in range(words.size):
            if words[w] == 0:
                continue
            for x in range(8 * w, 8 * w + 8):
                if flags[x]:
                    if count == len(found):
                        found = np.concatenate((found, np.empty_like(found)))
                    found[count, 0], found[count, 1], found[count, 2] = s, y, border + x
                    count += 1
    return found, count
