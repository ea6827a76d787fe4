"""NCC at a few neighbouring positions on the CPU: one BLAS dot product per position.

With patch and template stored at the same row length, the template's rows padded with zeros, a two-dimensional sum
of products is one dot product of contiguous memory, and the next position is the next offset.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engine.kernels.sums import FLAT_SHARE, box_sum

FloatImage = NDArray[np.float32]
Sums = NDArray[np.float64]
Index = NDArray[np.int64]
Counts = NDArray[np.int32]


class LocalScores:
    """Scores of one template at positions in one picture that are near each other.

    Args:
        image: (H, W) float32, its mean small against its standard deviation; 0 where not valid.
        template: (h, w) float32 of zero mean.
        middle: (y, x); scores can be computed within ``REACH`` of it.
        counts: (H+1, W+1) running sums of the valid pixels; all sums use only these. None if all pixels are valid.
        min_overlap: positions where a smaller share of the template lies on valid pixels score -1.
    """

    REACH = 5

    def __init__(
        self,
        image: FloatImage,
        template: FloatImage,
        middle: tuple[int, int],
        counts: Counts | None = None,
        min_overlap: float = 0.0,
    ) -> None:
        from engine.kernels import surface_loops

        h, w = template.shape
        self.limits = (image.shape[0] - h, image.shape[1] - w)
        """The last row and column at which the template fits."""
        y0, x0 = self._corner = (max(0, middle[0] - self.REACH), max(0, middle[1] - self.REACH))
        y1, x1 = min(self.limits[0], middle[0] + self.REACH), min(self.limits[1], middle[1] + self.REACH)
        self._row = w + x1 - x0
        patch = np.ascontiguousarray(image[y0 : y1 + h, x0 : x1 + w])
        self._patch = patch.ravel()
        padded = np.zeros((h, self._row), np.float32)
        padded[:, :w] = template
        self._template = padded.ravel()[: (h - 1) * self._row + w]
        # The patches' sums of squares about their means, at every position within reach.
        self._total, square = surface_loops.box_sums(patch, h, w)
        self._energy = float(np.dot(self._template, self._template))
        energy = np.maximum(square - self._total * self._total / (h * w), 0.0) * self._energy
        self._inverse_norm = np.divide(1.0, np.sqrt(energy), out=np.zeros_like(energy), where=energy > 0)
        self._count: NDArray[np.float64] | None = None
        if counts is not None:
            counts = counts[y0 : y1 + h + 1, x0 : x1 + w + 1]
            count = box_sum(counts, h, w)
            if (count < h * w).any():
                self._mask(counts, count.astype(np.float64), square, max(min_overlap * (h * w), 1.0))

    def _mask(self, counts: Counts, count: Sums, square: Sums, least: float) -> None:
        """Prepare the sums of positions that reach over the mask's edge."""
        valid = box_sum(counts, 1, 1).astype(np.float32)
        self._valid, self._squares = valid.ravel(), self._template * self._template
        self._count, self._least = count, least
        self._spread = square - self._total * self._total / np.maximum(count, 1.0)
        self._floor = FLAT_SHARE * float(square.max(initial=0.0))

    def at(self, y: Index, x: Index) -> Sums:
        """Scores at positions at which the template fits.

        Args:
            y: (N,) rows of the template's top-left pixel.
            x: (N,) columns.

        Returns:
            (N,) float64 in [-1, 1].
        """
        j, i = y - self._corner[0], x - self._corner[1]
        template, patch, size = self._template, self._patch, self._template.size
        products = [np.dot(patch[k : k + size], template) for k in (j * self._row + i).tolist()]
        if self._count is not None:
            return self._masked(np.array(products, np.float64), j, i)
        scores: Sums = products * self._inverse_norm[j, i]
        return scores.clip(-1.0, 1.0)

    def _masked(self, products: Sums, j: Index, i: Index) -> Sums:
        """Scores over only the valid pixels, from products of the picture (0 elsewhere) with the template."""
        assert self._count is not None
        size, places = self._template.size, (j * self._row + i).tolist()
        sums = np.array([np.dot(self._valid[k : k + size], self._template) for k in places], np.float64)
        squares = np.array([np.dot(self._valid[k : k + size], self._squares) for k in places], np.float64)
        count = np.maximum(self._count[j, i], 1.0)
        spread, model_spread = self._spread[j, i], squares - sums * sums / count
        textured = (spread > self._floor) & (model_spread > FLAT_SHARE * self._energy)
        norm = np.sqrt(spread * model_spread, out=np.ones_like(spread), where=textured)
        scores = np.where(textured, (products - self._total[j, i] * sums / count) / norm, 0.0).clip(-1.0, 1.0)
        return np.asarray(np.where(self._count[j, i] < self._least, -1.0, scores))
