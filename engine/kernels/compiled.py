"""SIFT's loops for the CPU, compiled by numba: the steps of the tensor ops, without their detours through memory.

A processor's cache holds a few rows of a picture and not all its levels, so each step walks rows and keeps at
hand what it needs of them. ``buffer`` is the flat scale space of :mod:`engine.sift.scale_space`, ``table`` its
layout: for every octave height, width, offset, and the strides of level, row and image.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from engine.kernels.jit import compiled

Filters = tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]

TAPS = 4
"""Taps of a filter that one pass over a row takes; filters are padded with zeros to a multiple of it."""
_FITTED = 6  # x, y, growth, contrast, level, octave of a refined point


@lru_cache(maxsize=128)
def filters(inputs: int, outputs: int, sigmas: tuple[float, ...], reach: tuple[int, ...], up: int) -> Filters:
    """Gaussians along one axis as weights (levels, up, taps), reach (levels,) and gains (levels, outputs).

    Args:
        inputs: pixels along the axis.
        outputs: of the result.
        sigmas: of the levels, in pixels of the input; 0 copies.
        reach: how far each is taken to either side.
        up: outputs per input, 1 or 2.
    """
    near = np.array(reach)
    offsets = np.arange(-(-(2 * near.max() + up) // TAPS) * TAPS) - near[:, None, None]  # (levels, 1, taps)
    phase = np.arange(up).reshape(1, -1, 1) / up
    weights = np.exp(-0.5 * ((offsets - phase) / np.maximum(np.array(sigmas), 1e-3).reshape(-1, 1, 1)) ** 2)
    weights *= offsets < near[:, None, None] + up
    weights /= weights.sum(-1, keepdims=True)
    place = np.arange(outputs)
    source = place[:, None] // up + offsets
    inside = (source >= 0) & (source < inputs)
    used = weights[:, place % up]
    gains = np.where((inside | (used == 0)).all(-1), 1.0, 1.0 / (used * inside).sum(-1))
    return weights.astype(np.float32), near, gains.astype(np.float32)


@compiled
def search(source, across, down, buffer, place, rows, border, threshold):
    """Write the Gaussian levels of one picture's octave, and find the extrema of their differences.

    Row by row: what a row of the result needs is in the cache still when it is asked for.

    Args:
        source: (H, W) float32.
        across: (weights, reach, gains) of the rows, see :func:`filters`. Output ``up m + p`` of level l, p below
            ``up``, is its gain times the sum over k of ``weights[l, p, k] source[m + k - reach[l]]``, zero beyond
            the edges, which the gains make up for.
        down: as ``across``, of the columns.
        buffer: where the levels are written.
        place: (offset, stride of a level, stride of a row).
        rows: (first, end) of the rows to write; extrema are looked for in these, of which the neighbours are
            written too.
        border: rows and columns along the edge that are left out of the search.
        threshold: least |DoG| of an extremum.

    Returns:
        (M, 3) int64 level, y, x of the voxels where |DoG| is the largest of its 3 x 3 x 3.
    """
    height, width = down[2].shape[1], across[2].shape[1]
    up, dogs = across[0].shape[1], len(down[1]) - 1
    first, end = max(rows[0] - 1, 0), min(rows[1] + 1, height)
    tall, start = _between_zeros(source, down[1], first // up, (end - 1) // up + 1)
    lines = np.zeros((dogs + 1, up, source.shape[1] + 2 * _padding(across[1])), np.float32)
    sizes = np.zeros((3, dogs, width), np.float32)  # |DoG| of the last three rows
    work = np.empty((dogs + 1, width), np.float32), np.zeros((width + 7) // 8 * 8, np.uint8)
    found, count = np.empty((256, 3), np.int64), 0
    for y in range(first, end):
        for level in range(dogs + 1):
            at = place[0] + level * place[1] + y * place[2]
            out = buffer[at : at + width]
            if y % up == 0 or y == first:
                _down_rows(lines[level], tall, y // up - start, source.shape[1], level, down, _padding(across[1]))
            _across_row(out, lines[level, y % up], level, across, down[2][level, y])
            if level > 0:
                finer, size = buffer[at - place[1] : at - place[1] + width], sizes[y % 3, level - 1]
                for x in range(width):
                    size[x] = abs(out[x] - finer[x])
        middle = y - 1
        if max(rows[0], border) <= middle < min(rows[1], height - border) and width > 2 * border:
            found, count = _extrema_of_row(sizes, middle, border, threshold, work, found, count)
    return found[:count]


@compiled
def _padding(reach):
    return reach.max() + TAPS


@compiled
def _between_zeros(source, reach, first, end):
    """Rows that the filters of rows ``first`` to ``end`` take, zeros beyond the picture; number of the first."""
    height, width = source.shape
    start = first - _padding(reach)
    tall = np.zeros((end + _padding(reach) - start) * width, np.float32)
    for y in range(max(start, 0), min(end + _padding(reach), height)):
        tall[(y - start) * width : (y - start + 1) * width] = source[y]
    return tall, start


@compiled
def _taps(reach, up):
    """Taps of a filter, with the zeros behind them; of two phases the second lies one sample further on."""
    return (2 * reach + up + TAPS - 1) // TAPS * TAPS


@compiled
def _down_rows(lines, tall, row, width, level, down, margin):
    """Filter the columns about a row of the source: a line for each phase, a margin of zeros on either side."""
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
    """Filter a line of the source's width along itself, and make up for what lies beyond the edges."""
    weights, reach, gains = across
    up, width = weights.shape[1], out.size
    start, taps = _padding(reach) - reach[level], _taps(reach[level], up)
    if up == 1 and reach[level] == 0:
        out[:] = line[start : start + width]
    elif up == 1:
        _slide(out, line, start, 1, weights[level, 0], taps)
    else:
        _slide_double(out, line, start, weights[level, 0], weights[level, 1], taps)
    edge = min(width, up * (reach[level] + 1))
    for x in range(edge):
        out[x] *= gains[level, x]
    for x in range(max(edge, width - edge), width):
        out[x] *= gains[level, x]
    if gain != 1:
        for x in range(width):
            out[x] *= gain


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
    """:func:`_slide` with two filters at once: what both take is read once."""
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
    if out.size % 2:  # an upsampled row ends with an even place
        total = np.float32(0)
        for k in range(taps):
            total += even[k] * values[start + k + n]
        out[2 * n] = total


@compiled
def _extrema_of_row(sizes, y, border, threshold, work, found, count):
    """Add to ``found`` the extrema of row y, whose |DoG| and those of its neighbours lie in ``sizes``."""
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


@compiled
def refine(buffer, layout, voxels, limits, octave):
    """Fit a quadratic at voxels, move where the extremum lies in a neighbour, drop the weak and the edges.

    Args:
        buffer: the scale space.
        layout: (height, width, offset, stride of a level, stride of a row) of one picture's octave.
        voxels: (M, 3) int64 of level, y, x.
        limits: (scales, moves, contrast threshold, farthest shift, edge ratio).
        octave: number of the octave, for the result.

    Returns:
        (K, 6) float32: x, y, growth of sigma, contrast, level, octave.
    """
    height, width, offset, per_level, per_row = layout
    scales, moves, threshold, farthest, edge_ratio = limits
    kept = np.empty((len(voxels), _FITTED), np.float32)
    count = 0
    for level, y, x in voxels:
        for move in range(moves + 1):
            at = offset + level * per_level + y * per_row + x
            d = _dog(buffer, at, per_level)
            right, left = _dog(buffer, at + 1, per_level), _dog(buffer, at - 1, per_level)
            below, above = _dog(buffer, at + per_row, per_level), _dog(buffer, at - per_row, per_level)
            up, down = _dog(buffer, at + per_level, per_level), _dog(buffer, at - per_level, per_level)
            gx, gy, gs = (right - left) / 2, (below - above) / 2, (up - down) / 2
            xx, yy, ss = right + left - 2 * d, below + above - 2 * d, up + down - 2 * d
            xy = _cross(buffer, at, 1, per_row, per_level)
            xs = _cross(buffer, at, 1, per_level, per_level)
            ys = _cross(buffer, at, per_row, per_level, per_level)
            a, b, c = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
            determinant = xx * a + xy * b + xs * c
            if determinant == 0:
                determinant = np.float32(1e-30)
            dx = -(a * gx + b * gy + c * gs) / determinant
            dy = -(b * gx + (xx * ss - xs * xs) * gy + (xy * xs - xx * ys) * gs) / determinant
            ds = -(c * gx + (xy * xs - xx * ys) * gy + (xx * yy - xy * xy) * gs) / determinant
            if move == moves or (abs(dx) <= 0.5 and abs(dy) <= 0.5 and abs(ds) <= 0.5):
                break
            x = min(max(x + _step(dx), 1), width - 2)
            y = min(max(y + _step(dy), 1), height - 2)
            level = min(max(level + _step(ds), 1), scales)
        contrast = abs(d + (gx * dx + gy * dy + gs * ds) / 2)
        determinant, trace = xx * yy - xy * xy, xx + yy
        if not (contrast >= threshold and max(abs(dx), abs(dy), abs(ds)) < farthest):
            continue
        if determinant > 0 and trace * trace * edge_ratio < (edge_ratio + 1) ** 2 * determinant:
            kept[count, 0], kept[count, 1] = x + dx, y + dy
            kept[count, 2] = 2 ** ((level + ds) / scales)
            kept[count, 3], kept[count, 4], kept[count, 5] = contrast, level, octave
            count += 1
    return kept[:count]


@compiled
def _dog(buffer, at, per_level):
    return buffer[at + per_level] - buffer[at]


@compiled
def _cross(buffer, at, i, j, per_level):
    """Mixed second difference of the DoG along the strides i and j."""
    same = _dog(buffer, at + i + j, per_level) + _dog(buffer, at - i - j, per_level)
    return (same - _dog(buffer, at + i - j, per_level) - _dog(buffer, at - i + j, per_level)) / 4


@compiled
def _step(shift):
    return 1 if shift > 0.5 else (-1 if shift < -0.5 else 0)


@compiled
def _sample(buffer, layout, x, y, cos, sin, patch):
    """Fill a square patch with bilinear samples on a grid turned and scaled by (cos, sin), edges extended."""
    height, width, base, per_row = layout
    side = len(patch)
    half = np.float32(0.5 * (side - 1))
    most_x, most_y = np.float32(width - 1.001), np.float32(height - 1.001)
    zero = np.float32(0)
    for row in range(side):
        v = row - half
        for column in range(side):
            u = column - half
            px = min(max(np.float32(x + cos * u - sin * v), zero), most_x)
            py = min(max(np.float32(y + sin * u + cos * v), zero), most_y)
            left, top = int(px), int(py)
            fx, fy = px - np.float32(left), py - np.float32(top)
            at = base + top * per_row + left
            upper = buffer[at] + fx * (buffer[at + 1] - buffer[at])
            at += per_row
            lower = buffer[at] + fx * (buffer[at + 1] - buffer[at])
            patch[row, column] = upper + fy * (lower - upper)


@compiled
def _layout(table, octave, image, level):
    height, width, offset, per_level, per_row, per_image = table[octave]
    return height, width, offset + level * per_level + image * per_image, per_row


@compiled
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


@compiled
def angles(buffer, table, where, places, step, window, smooth):
    """Angle (M,) in radians of the highest peak in the histogram of gradient directions.

    Args:
        buffer: the scale space.
        table: its layout.
        where: (M, 3) int64 octave, image, level.
        places: (M, 3) float32 x, y and sigma, in pixels of the octave.
        step: distance of the samples in sigmas.
        window: (S, S) float32 weights of the samples.
        smooth: (bins, bins) float32 circular smoothing of the histogram.
    """
    side, bins = len(window), len(smooth)
    patch = np.empty((side + 2, side + 2), np.float32)
    histogram, raw = np.empty(bins, np.float32), np.empty(bins + 1, np.float32)
    turns, sizes = np.empty(side, np.int32), np.empty(side, np.float32)
    out = np.empty(len(where), np.float32)
    for i in range(len(where)):
        layout = _layout(table, where[i, 0], where[i, 1], where[i, 2])
        _sample(buffer, layout, places[i, 0], places[i, 1], places[i, 2] * step, np.float32(0), patch)
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
        best = 0
        for k in range(bins):
            total = np.float32(0)
            for j in range(bins):
                total += raw[j] * smooth[j, k]
            histogram[k] = total
            if total > histogram[best]:
                best = k
        left, top, right = histogram[best - 1], histogram[best], histogram[(best + 1) % bins]
        offset = 0.5 * (left - right) / min(left - 2 * top + right, -1e-12)
        out[i] = (best + offset) * (math.tau / bins)
    return out


@compiled
def descriptors(buffer, table, where, places, angle, step, tent):
    """Lowe's cells of 8 orientations, (M, cells^2 * 8), not normalised.

    Args:
        buffer: the scale space.
        table: its layout.
        where: (M, 3) int64 octave, image, level.
        places: (M, 3) float32 x, y and sigma, in pixels of the octave.
        angle: (M,) radians.
        step: distance of the samples in sigmas.
        tent: (cells, S) float32 weights of a row's samples in the cells.
    """
    cells, side = tent.shape
    half = np.float32(math.sqrt(0.5))
    zero = np.float32(0)
    patch = np.empty((side + 2, side + 2), np.float32)
    p = np.empty((8, side), np.float32)
    columns = np.empty((cells, 8, side), np.float32)
    out = np.empty((len(where), cells * cells * 8), np.float32)
    for i in range(len(where)):
        layout = _layout(table, where[i, 0], where[i, 1], where[i, 2])
        reach = places[i, 2] * step
        cos, sin = reach * np.float32(math.cos(angle[i])), reach * np.float32(math.sin(angle[i]))
        _sample(buffer, layout, places[i, 0], places[i, 1], cos, sin, patch)
        columns[:] = 0
        for row in range(side):
            for x in range(side):
                gx = patch[row + 1, x + 2] - patch[row + 1, x]
                gy = patch[row + 2, x + 1] - patch[row, x + 1]
                diagonal, anti = half * (gx + gy), half * (gy - gx)
                # w_k = max(0, min(p_(k-1), p_(k+1))), see engine.sift.descriptors
                p[0, x] = max(zero, min(-anti, diagonal))
                p[1, x] = max(zero, min(gx, gy))
                p[2, x] = max(zero, min(diagonal, anti))
                p[3, x] = max(zero, min(gy, -gx))
                p[4, x] = max(zero, min(anti, -diagonal))
                p[5, x] = max(zero, min(-gx, -gy))
                p[6, x] = max(zero, min(-diagonal, -anti))
                p[7, x] = max(zero, min(-gy, gx))
            for r in range(cells):
                weight = tent[r, row]
                if weight != 0:
                    for k in range(8):
                        for x in range(side):
                            columns[r, k, x] += weight * p[k, x]
        for r in range(cells):
            for c in range(cells):
                for k in range(8):
                    total = zero
                    for x in range(side):
                        total += tent[c, x] * columns[r, k, x]
                    out[i, (r * cells + c) * 8 + k] = total
    return out
