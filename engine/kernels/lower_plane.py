"""The plane with most of some heights above it, compiled by numba: a dozen rounds over two hundred heights."""

from __future__ import annotations

import numpy as np

from engine.kernels.jit import compiled


@compiled
def lower_plane(offsets, heights_m, share, on_plane_m, rounds):
    """Level and rise per offset (3,) of the plane with a share of the heights (N,) at offsets (N, 2) below it.

    Quantile regression (Koenker and Bassett, Econometrica 1978) by reweighted least squares.

    Args:
        offsets: (N, 2) places.
        heights_m: (N,) there.
        share: 0 to 1 of the heights that is below.
        on_plane_m: heights closer to a plane than this lie on it.
        rounds: of reweighting.
    """
    plane, weights = np.zeros(3), np.ones(len(heights_m))
    for _ in range(rounds):
        normal, side = np.zeros((3, 3)), np.zeros(3)
        for n in range(len(heights_m)):
            weight, x, y, z = weights[n], offsets[n, 0], offsets[n, 1], heights_m[n]
            normal[0, 0] += weight
            normal[0, 1] += weight * x
            normal[0, 2] += weight * y
            normal[1, 1] += weight * x * x
            normal[1, 2] += weight * x * y
            normal[2, 2] += weight * y * y
            side[0] += weight * z
            side[1] += weight * x * z
            side[2] += weight * y * z
        normal[1, 0], normal[2, 0], normal[2, 1] = normal[0, 1], normal[0, 2], normal[1, 2]
        plane[:] = np.linalg.solve(normal, side)
        for n in range(len(heights_m)):
            above = heights_m[n] - plane[0] - plane[1] * offsets[n, 0] - plane[2] * offsets[n, 1]
            weights[n] = (share if above > 0.0 else 1.0 - share) / max(abs(above), on_plane_m)
    return plane
