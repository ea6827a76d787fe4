"""Sub-pixel refinement of SIFT's extrema for the CPU, compiled by numba.

``buffer`` is the flat scale space of :mod:`engine.sift.scale_space`.
"""

import numpy as np

from engine.runtime.jit import compiled, inlined


@compiled("(f4[::1], UniTuple(i8, 5), i8[:, ::1], Tuple((i8, i8, f8, f8, f8)), i8)")
def refine_extrema(buffer, layout, voxels, limits, octave):
    """Fit a quadratic at voxels, move where the extremum is in a neighbour, drop low contrast and edges.

    Args:
        buffer: (N,) float32 scale space.
        layout: (height, width, offset, stride of a level, stride of a row) of one picture's octave.
        voxels: (M, 3) int64 of level, y, x.
        limits: (scales, moves, contrast threshold, largest shift, edge ratio).
        octave: number of the octave, for the result.

    Returns:
        (K, 6) float32: x, y, growth of sigma, contrast, level, octave.
    """
    height, width, offset, per_level, per_row = layout
    scales, moves, threshold, max_shift, edge_ratio = limits
    kept = np.empty((len(voxels), 6), np.float32)
    count = 0
    for level, y, x in voxels:
        for move in range(moves + 1):
            at = offset + level * per_level + y * per_row + x
            d, gradient, hessian = _derivatives(buffer, at, per_level, per_row)
            dx, dy, ds = _extremum(gradient, hessian)
            if move == moves or (abs(dx) <= 0.5 and abs(dy) <= 0.5 and abs(ds) <= 0.5):
                break
            x = min(max(x + _step(dx), 1), width - 2)
            y = min(max(y + _step(dy), 1), height - 2)
            level = min(max(level + _step(ds), 1), scales)
        contrast = abs(d + (gradient[0] * dx + gradient[1] * dy + gradient[2] * ds) / 2)
        if not (contrast >= threshold and max(abs(dx), abs(dy), abs(ds)) < max_shift):
            continue
        xx, yy, _, xy, _, _ = hessian
        determinant, trace = xx * yy - xy * xy, xx + yy
        if determinant > 0 and trace * trace * edge_ratio < (edge_ratio + 1) ** 2 * determinant:
            kept[count, 0], kept[count, 1] = x + dx, y + dy
            kept[count, 2] = 2 ** ((level + ds) / scales)
            kept[count, 3], kept[count, 4], kept[count, 5] = contrast, level, octave
            count += 1
    return kept[:count]


@inlined
def _derivatives(buffer, at, per_level, per_row):
    """The DoG at a voxel, its gradient (x, y, s) and its second derivatives (xx, yy, ss, xy, xs, ys)."""
    d = _dog(buffer, at, per_level)
    right, left = _dog(buffer, at + 1, per_level), _dog(buffer, at - 1, per_level)
    below, above = _dog(buffer, at + per_row, per_level), _dog(buffer, at - per_row, per_level)
    up, down = _dog(buffer, at + per_level, per_level), _dog(buffer, at - per_level, per_level)
    gradient = (right - left) / 2, (below - above) / 2, (up - down) / 2
    xx, yy, ss = right + left - 2 * d, below + above - 2 * d, up + down - 2 * d
    xy = _cross(buffer, at, 1, per_row, per_level)
    xs = _cross(buffer, at, 1, per_level, per_level)
    ys = _cross(buffer, at, per_row, per_level, per_level)
    return d, gradient, (xx, yy, ss, xy, xs, ys)


@inlined
def _extremum(gradient, hessian):
    """The shift -H^-1 g to the extremum of the quadratic, by the adjugate."""
    gx, gy, gs = gradient
    xx, yy, ss, xy, xs, ys = hessian
    a, b, c = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
    determinant = xx * a + xy * b + xs * c
    if determinant == 0:
        determinant = np.float32(1e-30)
    dx = -(a * gx + b * gy + c * gs) / determinant
    dy = -(b * gx + (xx * ss - xs * xs) * gy + (xy * xs - xx * ys) * gs) / determinant
    ds = -(c * gx + (xy * xs - xx * ys) * gy + (xx * yy - xy * xy) * gs) / determinant
    return dx, dy, ds


@inlined
def _dog(buffer, at, per_level):
    return buffer[at + per_level] - buffer[at]


@inlined
def _cross(buffer, at, i, j, per_level):
    """Mixed second difference of the DoG along the strides i and j."""
    same = _dog(buffer, at + i + j, per_level) + _dog(buffer, at - i - j, per_level)
    return (same - _dog(buffer, at + i - j, per_level) - _dog(buffer, at - i + j, per_level)) / 4


@inlined
def _step(shift):
    return 1 if shift > 0.5 else (-1 if shift < -0.5 else 0)
