"""NCC at a few neighbouring positions on the CPU: one BLAS dot product per position.

With patch and template stored at the same row length, the template's rows padded with zeros, a two-dimensional sum
of products is one dot product of contiguous memory, and the next position is the next offset.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
Sums = NDArray[np.float64]
Index = NDArray[np.int64]


class LocalScores:
    """Scores of one template at positions in one picture that are near each other.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        sums: (2, H+1, W+1) float64 running sums of it and of its square.
        template: (h, w) float32 of zero mean.
        middle: (y, x); scores can be computed within ``REACH`` of it.
    """

    REACH = 5

    def __init__(self, image: FloatImage, sums: Sums, template: FloatImage, middle: tuple[int, int]) -> None:
        h, w = template.shape
        self.limits = (image.shape[0] - h, image.shape[1] - w)
        """The last row and column at which the template fits."""
        y0, x0 = self._corner = (max(0, middle[0] - self.REACH), max(0, middle[1] - self.REACH))
        y1, x1 = min(self.limits[0], middle[0] + self.REACH), min(self.limits[1], middle[1] + self.REACH)
        self._row = w + x1 - x0
        self._patch = np.ascontiguousarray(image[y0 : y1 + h, x0 : x1 + w]).ravel()
        padded = np.zeros((h, self._row), np.float32)
        padded[:, :w] = template
        self._template = padded.ravel()[: (h - 1) * self._row + w]
        # The patches' sums of squares about their means, at every position within reach.
        s = sums[:, y0 : y1 + h + 1, x0 : x1 + w + 1]
        total, square = s[:, h:, w:] - s[:, :-h, w:] - s[:, h:, :-w] + s[:, :-h, :-w]
        energy = np.maximum(square - total * total / (h * w), 0.0) * float(np.dot(self._template, self._template))
        self._inverse_norm = np.divide(1.0, np.sqrt(energy), out=np.zeros_like(energy), where=energy > 0)

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
        scores: Sums = products * self._inverse_norm[j, i]
        return scores.clip(-1.0, 1.0)
