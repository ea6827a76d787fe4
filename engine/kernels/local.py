"""NCC at a few neighbouring positions on the CPU: one BLAS dot product per position.

With patch and template stored at the same row length, the template's rows padded with zeros, a two-dimensional sum
of products is one dot product of contiguous memory, and the next position is the next offset.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from engine.kernels.sums import over_nodata, share_on_map

FloatImage = NDArray[np.float32]


class LocalScores:
    """Scores of one template at positions in one picture that are near each other.

    Args:
        image: (H, W) float32, its mean small against its standard deviation; 0 where not valid.
        template: (h, w) float32 of zero mean.
        middle: (y, x); scores can be computed within ``REACH`` of it.
        counts: (H+1, W+1) running sums of the valid pixels; None if all are.
        min_overlap: positions where a smaller share of the template lies on valid pixels score -1.
    """

    REACH = 5

    def __init__(
        self,
        image: FloatImage,
        template: FloatImage,
        middle: tuple[int, int],
        counts: NDArray[np.int32] | None = None,
        min_overlap: float = 0.0,
    ) -> None:
        from engine.kernels import blocks  # numba takes a while to import

        h, w = template.shape
        self.limits = (image.shape[0] - h, image.shape[1] - w)
        """The last row and column at which the template fits."""
        y0, x0 = self._corner = (max(0, middle[0] - self.REACH), max(0, middle[1] - self.REACH))
        y1, x1 = min(self.limits[0], middle[0] + self.REACH), min(self.limits[1], middle[1] + self.REACH)
        self._row = w + x1 - x0
        patch = np.ascontiguousarray(image[y0 : y1 + h, x0 : x1 + w])
        padded = np.zeros((h, self._row), np.float32)
        padded[:, :w] = template
        self._patch, self._template = patch.ravel(), padded.ravel()[: (h - 1) * self._row + w]
        energy = float(np.dot(self._template, self._template))
        self._inverse_norm = blocks.inverse_norm(patch, h, w) * (1.0 / math.sqrt(energy) if energy > 0.0 else 0.0)
        self._off = np.zeros_like(self._inverse_norm)
        if counts is not None:
            share = share_on_map(counts[y0 : y1 + h + 1, x0 : x1 + w + 1], h, w)
            self._inverse_norm, self._off = over_nodata(self._inverse_norm, share, min_overlap)

    def at(self, y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.float64]:
        """Scores at positions at which the template fits.

        Args:
            y: (N,) rows of the template's top-left pixel.
            x: (N,) columns.

        Returns:
            (N,) float64 in [-1, 1].
        """
        j, i = y - self._corner[0], x - self._corner[1]
        places, model = (j * self._row + i).tolist(), self._template
        products = np.array([np.dot(self._patch[k : k + model.size], model) for k in places], np.float64)
        return np.asarray((products * self._inverse_norm[j, i]).clip(-1.0, 1.0) + self._off[j, i])
