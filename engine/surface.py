"""The surface model of a map: its heights at map pixels, and the bare ground below roofs and crowns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engine.grids import Array, Warp

GROUND_PERCENT = 20.0
"""Percentile of the surface that is taken as the level of the ground."""
_PLACES = 15  # a side of the lattice on which a plane is looked for
_ROUNDS = 8
_ON_PLANE_M = 0.3  # heights closer to a plane than this lie on it


class Surface:
    """Heights on a grid of their own.

    Args:
        heights_m: (H, W), NaN where unknown.
        from_map: to its pixels from those of the map.
    """

    def __init__(self, heights_m: NDArray[np.float32], from_map: Warp) -> None:
        self._heights_m, self._from_map = heights_m, from_map

    def sample(self, map_xy: Array) -> Array:
        """Bilinear heights (...,) of map pixels (..., 2), NaN outside and next to nodata."""
        height, width = self._heights_m.shape
        last = np.array([width - 1.0, height - 1.0])
        at = self._from_map(map_xy)
        inside = np.asarray(((at >= -0.5) & (at <= last + 0.5)).all(axis=-1))
        at = np.clip(np.where(inside[..., None], at, 0.0), 0.0, last)
        low = at.astype(np.intp)
        (x0, y0), (x1, y1) = np.moveaxis(low, -1, 0), np.moveaxis(np.minimum(low + 1, last.astype(np.intp)), -1, 0)
        u, v = np.moveaxis(at - low, -1, 0)
        grid = self._heights_m
        top = grid[y0, x0] * (1.0 - u) + grid[y0, x1] * u
        bottom = grid[y1, x0] * (1.0 - u) + grid[y1, x1] * u
        return np.where(inside, top * (1.0 - v) + bottom * v, np.nan)

    def ground_plane(self, map_xy: Array, reach_px: float) -> tuple[float, Array] | None:
        """The plane with a fifth of the surface below it in a square about one map pixel (2,).

        Args:
            map_xy: the square's middle.
            reach_px: half its side.

        Returns:
            The plane's level at the middle and its slope (2,) in metres up per map pixel x and y; None where less
            than half of the square is known.
        """
        steps = np.linspace(-1.0, 1.0, _PLACES)
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        heights_m = self.sample(map_xy + offsets * reach_px)
        known = np.isfinite(heights_m)
        if 2 * np.count_nonzero(known) < len(known):
            return None
        plane = _lower_plane(offsets[known], heights_m[known])
        return float(plane[0]), plane[1:] / reach_px

    @property
    def range_m(self) -> tuple[float, float]:
        """Lowest and highest known height."""
        return float(np.nanmin(self._heights_m)), float(np.nanmax(self._heights_m))


def _lower_plane(offsets: Array, heights_m: Array) -> Array:
    """Level and rise per offset (3,) of the plane with a fifth of the heights (N,) at offsets (N, 2) below it.

    Quantile regression (Koenker and Bassett, Econometrica 1978) by reweighted least squares.
    """
    terms = np.column_stack([np.ones(len(offsets)), offsets])
    share, weights, plane = GROUND_PERCENT / 100.0, np.ones(len(offsets)), np.zeros(3)
    for _ in range(_ROUNDS):
        weighted = terms.T * weights
        plane = np.linalg.solve(weighted @ terms, weighted @ heights_m).astype(np.float64)
        above = heights_m - terms @ plane
        weights = np.where(above > 0.0, share, 1.0 - share) / np.maximum(np.abs(above), _ON_PLANE_M)
    return plane
