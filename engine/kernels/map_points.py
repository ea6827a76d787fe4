"""Points of a map: bilinear heights and samples, compiled by numba.

One point costs a microsecond instead of thirty by NumPy calls; a frame needs some dozens.
"""

from __future__ import annotations

import numpy as np

from engine.runtime.jit import compiled


@compiled("(f4[:, ::1], f8[:, ::1], f8[::1])")
def bilinear_heights(grid, at, out):
    """Bilinear heights at places in pixels of their grid.

    Args:
        grid: (H, W) float32, NaN where unknown.
        at: (N, 2) columns and rows.
        out: (N,) takes the heights, NaN outside and next to unknown ones.
    """
    height, width = grid.shape
    for n in range(at.shape[0]):
        x, y = at[n, 0], at[n, 1]
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            out[n] = np.nan
            continue
        x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
        column, row = int(x), int(y)
        right, below = min(column + 1, width - 1), min(row + 1, height - 1)
        u, v = x - column, y - row
        top = grid[row, column] * (1.0 - u) + grid[row, right] * u
        bottom = grid[below, column] * (1.0 - u) + grid[below, right] * u
        out[n] = top * (1.0 - v) + bottom * v


@compiled("(Tuple((f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])), UniTuple(i8, 2), UniTuple(i8, 2), i8, i8)")
def every_nth(arrays, first, last, columns, step):
    """Every so manieth sample of a part of a grid of samples.

    Args:
        arrays: of (N, 3), (N,), (N, 2) and (N,) float64, row by row of the grid.
        first: (row, column) where the part begins.
        last: (row, column) behind its last ones.
        columns: of the whole grid.
        step: from one sample to the next, counted along the rows of the part.

    Returns:
        The same four arrays of these samples.
    """
    points, values, gradients, weights = arrays
    width = last[1] - first[1]
    count = ((last[0] - first[0]) * width + step - 1) // step  # 0 of an empty part
    some_points, some_values = np.empty((count, 3)), np.empty(count)
    some_gradients, some_weights = np.empty((count, 2)), np.empty(count)
    for n in range(count):
        at = (first[0] + n * step // width) * columns + first[1] + n * step % width
        some_values[n], some_weights[n] = values[at], weights[at]
        for k in range(3):
            some_points[n, k] = points[at, k]
        some_gradients[n, 0], some_gradients[n, 1] = gradients[at, 0], gradients[at, 1]
    return some_points, some_values, some_gradients, some_weights
