"""Points of a map: polynomials of its georeference and bilinear heights, compiled by numba.

One point costs a microsecond instead of thirty by NumPy calls; a frame needs some dozens.
"""

import numpy as np

from engine.runtime.jit import compiled


@compiled("(f8[:, ::1], f8[::1], f8[::1], f8[:, :, ::1], f8[:, ::1])")
def polynomials(points, centre, half, coefficients, out):
    """Evaluate two polynomials of the plane.

    Args:
        points: (N, 2).
        centre: (2,) of their domain.
        half: (2,) half its sides.
        coefficients: (P, P, 2) of the powers of x, of y, and of which polynomial; of points in units of the box.
        out: (N, 2) takes the values.

    Returns:
        Whether all points are inside the box; if not, the rest of ``out`` is undefined.
    """
    last = coefficients.shape[0] - 1
    for n in range(points.shape[0]):
        x, y = (points[n, 0] - centre[0]) / half[0], (points[n, 1] - centre[1]) / half[1]
        if not (abs(x) <= 1.0 and abs(y) <= 1.0):
            return False
        first = second = 0.0
        for i in range(last, -1, -1):
            one = two = 0.0
            for j in range(last, -1, -1):
                one, two = one * y + coefficients[i, j, 0], two * y + coefficients[i, j, 1]
            first, second = first * x + one, second * x + two
        out[n, 0], out[n, 1] = first, second
    return True


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
