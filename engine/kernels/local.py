"""NCC at a handful of neighbouring places on the CPU: one BLAS dot product a place.

A patch and a template that are laid out with the same row length, the template's rows padded with zeros, turn a
two-dimensional sum of products into one dot product of contiguous memory; the next place is the next offset.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Sums = NDArray[np.float64]
Index = NDArray[np.int64]


class LocalScores:
    """Scores of one template at places of one picture that are near each other.

    Args:
        image: (H, W) float32 of small mean.
        sums: (2, H+1, W+1) running sums of it and of its square.
        template: (h, w) float32 of zero mean.
        middle: (y, x); places that are asked for lie within ``REACH`` of it.
    """

    REACH = 3

    def __init__(self, image: Image, sums: Sums, template: Image, middle: tuple[int, int]) -> None:
        self._sums = sums
        self._h, self._w = h, w = template.shape
        self.limits = (image.shape[0] - h, image.shape[1] - w)
        """The last row and column at which the template fits."""
        y0, x0 = (max(0, v - self.REACH) for v in middle)
        y1, x1 = (min(limit, v + self.REACH) for limit, v in zip(self.limits, middle, strict=True))
        self._row = w + x1 - x0
        self._corner = y0 * self._row + x0
        self._patch = np.ascontiguousarray(image[y0 : y1 + h, x0 : x1 + w]).ravel()
        padded = np.zeros((h, self._row), np.float32)
        padded[:, :w] = template
        self._template = padded.ravel()[: (h - 1) * self._row + w]
        self._template_energy = float(np.dot(self._template, self._template))

    def at(self, y: Index, x: Index) -> Sums:
        """Scores (N,) at rows ``y`` and columns ``x``, all of them places at which the template fits."""
        starts = (y * self._row + x - self._corner).tolist()
        size = self._template.size
        products = [np.dot(self._patch[k : k + size], self._template) for k in starts]
        bottom, right, sums = y + self._h, x + self._w, self._sums
        total, square = sums[:, bottom, right] - sums[:, y, right] - sums[:, bottom, x] + sums[:, y, x]
        energy = np.maximum(square - total * total / (self._h * self._w), 0.0)
        norm = np.sqrt(energy * self._template_energy)
        scores: Sums = np.divide(products, norm, out=np.zeros(len(products)), where=norm > 0)
        return scores.clip(-1.0, 1.0)
