"""Quantile regression of a plane through heights, compiled by numba: a few rounds over two hundred heights."""

from __future__ import annotations

import numpy as np

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
    for n in range(len(heights_m)):
        if np.isnan(heights_m[n]):
            weights[n] = 0.0
        else:
            known += 1
    for _ in range(rounds):
        one = x = y = xx = xy = yy = z = xz = yz = 0.0
        for n in range(len(heights_m)):
            weight = weights[n]
            if weight == 0.0:
                continue
            east, north, up = weight * offsets[n, 0], weight * offsets[n, 1], weight * heights_m[n]
            one += weight
            x += east
            y += north
            z += up
            xx += east * offsets[n, 0]
            xy += east * offsets[n, 1]
            yy += north * offsets[n, 1]
            xz += east * heights_m[n]
            yz += north * heights_m[n]
        # About the means, which leaves two equations; numba's own solver asks for SciPy.
        xx, xy, yy = xx - x * x / one, xy - x * y / one, yy - y * y / one
        xz, yz = xz - x * z / one, yz - y * z / one
        size = xx * yy - xy * xy
        plane[1], plane[2] = (yy * xz - xy * yz) / size, (xx * yz - xy * xz) / size
        plane[0] = (z - plane[1] * x - plane[2] * y) / one
        for n in range(len(heights_m)):
            if weights[n] == 0.0:
                continue
            above = heights_m[n] - plane[0] - plane[1] * offsets[n, 0] - plane[2] * offsets[n, 1]
            weights[n] = (share if above > 0.0 else 1.0 - share) / max(abs(above), on_plane_m)
    return plane, known
