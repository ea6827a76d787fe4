"""Quantile regression of a plane through heights, compiled by numba: a few rounds over two hundred heights."""

import numpy as np

from engine.kernels.small_matrices import add_equation, solve
from engine.runtime.jit import compiled


@compiled("(f8[:, ::1], f8[::1], f8, f8, i8)")
def lower_plane(offsets, heights_m, share, on_plane_m, rounds):
    """The plane with a given share of the heights below it.

    Quantile regression (Koenker and Bassett, doi:10.2307/1913643) by iteratively reweighted least squares.

    Args:
        offsets: (N, 2) positions.
        heights_m: (N,) there; NaN where unknown.
        share: of the heights below the plane, 0 to 1.
        on_plane_m: residuals below this have equal weight.
        rounds: of reweighting.

    Returns:
        (3,) level at offset 0, and rise per unit of both offsets; and how many heights are known.
    """
    plane, weights, known = np.zeros(3), np.ones(len(heights_m)), 0
    normal, right, row = np.empty((3, 3)), np.empty(3), np.ones(3)
    for n in range(len(heights_m)):
        if np.isnan(heights_m[n]):
            weights[n] = 0.0
        else:
            known += 1
    for _ in range(rounds):
        normal[:], right[:] = 0.0, 0.0
        for n in range(len(heights_m)):
            if weights[n] > 0.0:
                row[1], row[2] = offsets[n, 0], offsets[n, 1]
                add_equation(normal, right, row, weights[n], heights_m[n])
        solve(normal, right, plane)
        for n in range(len(heights_m)):
            if weights[n] > 0.0:
                above = heights_m[n] - plane[0] - plane[1] * offsets[n, 0] - plane[2] * offsets[n, 1]
                weights[n] = (share if above > 0.0 else 1.0 - share) / max(abs(above), on_plane_m)
    return plane, known
