"""SIFT's scale space and the extrema in it for the CPU, compiled by numba.

A CPU's cache holds a few rows of a picture and not all its levels, so the work goes by strips of rows and reuses
them while they are cached. To the loops a strip is one long row: entering a loop costs as much as many pixels.
``buffer`` is the flat scale space of :mod:`engine.sift.scale_space`.
"""

import numpy as np

from engine.runtime.jit import compiled, inlined

TAPS = 4
"""Taps of a filter that one pass over a strip applies; filters are padded with zeros to a multiple of it."""
_STRIP = np.dtype(np.uint64).itemsize  # rows of the octave written at a time: as many as a word has flags


@compiled("(f4[:, ::1], Tuple((f4[:, :, ::1], i8[::1])), f4[::1], UniTuple(i8, 5), UniTuple(i8, 2), i8, f4)")
def find_extrema(padded, filters, buffer, layout, rows, border, threshold):
    """Write the Gaussian levels of one picture's octave, and find the extrema of their differences.

    Args:
        padded: (H, W) float32, the picture extended beyond all its edges by a margin of :data:`TAPS` more than the
            longest reach.
        filters: of both axes, from :func:`engine.sift.loops.filters`: output ``up m + p`` of level l is the sum
            over k of ``weights[l, p, k] source[m + k - reach[l]]``.
        buffer: (N,) float32 that the levels are written to.
        layout: (height, width, offset, stride of a level, stride of a row) of the octave.
        rows: (first, end) of the rows that are searched; their neighbours are written too.
        border: rows and columns along the edge that are not searched.
        threshold: lower bound on |DoG| of an extremum.

    Returns:
        (M, 3) int64 level, y, x of the voxels where |DoG| is the maximum of its 3 x 3 x 3.
    """
    height, width, _, _, _ = layout
    up, dogs = filters[0].shape[1], len(filters[1]) - 1
    low, high = max(rows[0] - 1, 0) // up, min(rows[1], height - 1) // up + 1  # rows of the source
    searched = max(rows[0], border), min(rows[1], height - border)
    weights, reach = filters
    wide, flat, margin = padded.shape[1], padded.reshape(padded.size), reach.max() + TAPS
    lines = np.empty((up, _STRIP // up * wide), np.float32)
    filtered = np.empty((2, _STRIP // up * wide), np.float32)
    sizes = np.zeros((dogs, (_STRIP + 2) * width), np.float32)  # |DoG| of a strip and of the two rows before it
    work = np.empty((dogs + 1, _STRIP * width), np.float32), np.zeros(_STRIP * width, np.uint8)
    found, count = np.empty((256, 3), np.int64), np.int64(0)  # by a literal 0, the callee compiles twice
    for row in range(low, high, _STRIP // up):
        held = min(_STRIP // up, high - row)
        strip = up * row, min(up * (row + held), height)
        for level in range(dogs + 1):
            start, taps = (margin + row - reach[level]) * wide, _taps(reach[level], up)
            _slide_phases(lines, held * wide, flat, start, wide, weights[level], taps)
            _filter_across(buffer, lines, held * wide, filtered, wide, strip, level, filters, layout, margin)
        _differ(sizes, buffer, strip, layout)
        if width > 2 * border:
            found, count = _extrema_of_strip(sizes, width, strip, searched, border, threshold, work, found, count)
    return found[:count]


@inlined
def _taps(reach, up):
    """Taps of a filter with its padding; of two phases the second is one sample further on."""
    return (2 * reach + up + TAPS - 1) // TAPS * TAPS


@inlined
def _filter_across(buffer, lines, size, filtered, wide, strip, level, filters, layout, margin):
    """Filter a strip along its rows, and write it."""
    _, width, offset, per_level, per_row = layout
    weights, reach = filters
    up, along = len(lines), np.int64(1)
    start, taps = margin - reach[level], _taps(reach[level], up)
    size -= 2 * margin  # the last row's margin is only read
    for phase in range(up):
        _slide_phases(filtered, size, lines[phase], start, along, weights[level], taps)
        for y in range(strip[0] + phase, strip[1], up):
            at, begin = offset + level * per_level + y * per_row, (y - strip[0]) // up * wide
            _interleave(buffer[at : at + width], filtered, begin, up)


@inlined
def _interleave(out, filtered, begin, up):
    if up == 1:
        row = filtered[0, begin : begin + out.size]
        for x in range(out.size):
            out[x] = row[x]
        return
    even, odd = filtered[0, begin:], filtered[1, begin:]
    for x in range(out.size // 2):
        out[2 * x] = even[x]
        out[2 * x + 1] = odd[x]
    if out.size % 2:  # an upsampled row ends with an even place
        out[out.size - 1] = even[out.size // 2]


@inlined
def _slide_phases(out, size, values, start, stride, weights, taps):
    """Filter values by the one phase of the weights (up, taps), or by both."""
    if len(weights) == 1:
        _slide(out[0, :size], values, start, stride, weights[0], taps)
    else:
        _slide_both(out[0, :size], out[1, :size], values, start, stride, weights[0], weights[1], taps)


@compiled()
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


@compiled()
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


@inlined
def _differ(sizes, buffer, strip, layout):
    """Append |DoG| of a strip to that of the two rows before it."""
    _, width, offset, per_level, per_row = layout
    for dog in range(len(sizes)):
        size = sizes[dog]
        for x in range(2 * width):
            size[x] = size[size.size - 2 * width + x]
        for y in range(strip[0], strip[1]):
            at, begin = offset + dog * per_level + y * per_row, (y - strip[0] + 2) * width
            finer, coarser = buffer[at : at + width], buffer[at + per_level : at + per_level + width]
            row = size[begin : begin + width]
            for x in range(width):
                row[x] = abs(coarser[x] - finer[x])


@inlined
def _extrema_of_strip(sizes, width, strip, searched, border, threshold, work, found, count):
    """Append to ``found`` the extrema of all rows but the last of a strip, and of the last before it."""
    highest, flags = work
    dogs, n = len(sizes), (strip[1] - strip[0]) * width
    top, words = highest[dogs], flags.view(np.uint64)
    for s in range(dogs):
        above, middle, below, row = sizes[s], sizes[s, width:], sizes[s, 2 * width :], highest[s]
        for x in range(n):
            row[x] = max(max(above[x], middle[x]), below[x])
    for s in range(1, dogs - 1):
        a, b, c = highest[s - 1], highest[s], highest[s + 1]
        for x in range(n):
            top[x] = max(max(a[x], b[x]), c[x])
        # Slices from 0 up: an index that might be negative would keep the loop from being vectorised. Neighbours
        # at the ends of rows are of other rows, where nothing is searched.
        size, flag, left, centre, right = sizes[s, width + 1 :], flags[1:], top, top[1:], top[2:]
        for x in range(n - 2):
            flag[x] = size[x] >= max(max(left[x], centre[x]), max(right[x], threshold))
        for w in range((n + _STRIP - 1) // _STRIP):
            if words[w] == 0:
                continue
            for at in range(_STRIP * w, min(_STRIP * (w + 1), n - 1)):
                y, x = strip[0] - 1 + at // width, at % width
                if flags[at] and searched[0] <= y < searched[1] and border <= x < width - border:
                    if count == len(found):
                        found = np.concatenate((found, np.empty_like(found)))
                    found[count, 0], found[count, 1], found[count, 2] = s, y, x
                    count += 1
    return found, count
