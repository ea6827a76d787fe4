"""Samples of the map for dense refinement: its steepest pixels with their 3D positions, taken once."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.kernels.dense import Samples
from engine.maps.prepared import enhanced_part
from engine.maps.rasters import COARSE_LIMIT_PX
from engine.maps.recently_used import RecentlyUsed
from engine.maps.tiles import cells_under
from engine.values import Window

if TYPE_CHECKING:  # a map is built on what lies here
    from engine.orthomap import OrthoMap

BLOCK_PX = 4
"""Every block with this side gives one sample: the pixel with the steepest gradient."""
MAX_SAMPLES = 2000
ROUGH_REACH_PX = 1.5
"""Distance from a point of the map, in pixels, at which the roughness of its surface is measured."""


class SampleMap:
    """Cache of samples of one map for dense refinement.

    Args:
        site: the map.

    Attributes:
        cells: sampled so far, by window and level; the least recently used are evicted.
    """

    def __init__(self, site: OrthoMap) -> None:
        self._site = site
        self.cells = RecentlyUsed(self._sampled, lambda key, _: int(key[0].area_px), COARSE_LIMIT_PX)

    def find(self, window: Window, level: int, max_samples: int = MAX_SAMPLES) -> Samples:
        """Samples of a window.

        Args:
            window: in pixels of the level, inside it, at least :data:`BLOCK_PX` wide and high.
            level: of the map's pyramid.
            max_samples: approximate upper bound.

        Returns:
            Samples: in metres east, north and up.
        """
        step, parts = math.ceil(window.area_px / BLOCK_PX**2 / max_samples), []
        under = cells_under(window, self._site.level_shape(level))
        # The remainder beyond a level's last whole cell may be narrower than a block: it gives no sample.
        cells = [cell for cell in under if min(cell.width_px, cell.height_px) >= BLOCK_PX]
        found = self.cells.get(*((cell, level) for cell in cells))
        for cell, (samples, blocks) in zip(cells, found, strict=True):
            x, y = window.x0 - cell.x0, window.y0 - cell.y0
            rows = slice(max(0, y // BLOCK_PX), -(-(y + window.height_px) // BLOCK_PX))
            columns = slice(max(0, x // BLOCK_PX), -(-(x + window.width_px) // BLOCK_PX))
            at = blocks[rows, columns].ravel()[::step]
            fields = (samples.points_m, samples.values, samples.gradients, samples.weights)
            parts.append([field.take(at, axis=0) for field in fields])
        return Samples(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def _sampled(self, cell: Window, level: int) -> tuple[Samples, NDArray[np.intp]]:
        """Samples of a cell, and their indices by row and column of their block; a remainder beyond has none."""
        picture, mask = enhanced_part(self._site, cell, level)
        across, down = (cv2.Sobel(picture, cv2.CV_32F, i, 1 - i, ksize=1, scale=0.5) for i in (1, 0))
        shape = (picture.shape[0] // BLOCK_PX, picture.shape[1] // BLOCK_PX)
        rows, columns = _steepest(cv2.magnitude(across, down), shape)
        xy_px = self._site.full_from_level(np.stack([columns + cell.x0, rows + cell.y0], axis=-1), level)
        weights = self._site.roughness_weight_at(xy_px, ROUGH_REACH_PX * 2.0**level)
        if mask is not None:
            weights = weights * mask[rows, columns]
        points = self._site.surface_points(xy_px)
        per_px = np.stack([across[rows, columns], down[rows, columns]], axis=-1).astype(np.float64)
        metres_per_px = self._site.enu_jacobian(xy_px[len(xy_px) // 2]) * 2.0**level  # nearly constant over a cell
        gradients = per_px @ np.linalg.inv(metres_per_px)
        blocks = np.arange(len(rows)).reshape(shape)
        return Samples(points, picture[rows, columns].astype(np.float64), gradients, weights), blocks


def _steepest(size: NDArray[np.float32], shape: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of the largest value in each block, block row by block row."""
    blocks = size[: shape[0] * BLOCK_PX, : shape[1] * BLOCK_PX].reshape(shape[0], BLOCK_PX, shape[1], BLOCK_PX)
    best = blocks.transpose(0, 2, 1, 3).reshape(shape[0], shape[1], -1).argmax(axis=-1)
    rows = np.arange(shape[0])[:, None] * BLOCK_PX + best // BLOCK_PX
    columns = np.arange(shape[1])[None] * BLOCK_PX + best % BLOCK_PX
    return rows.ravel(), columns.ravel()
