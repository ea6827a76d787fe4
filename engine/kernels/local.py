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

    REACH = 5

    def __init__(self, image: Image, sums: Sums, template: Image, middle: tuple[int, int]) -> None:
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
        # The patches' sums of squares about their means, at every place within reach.
        s = sums[:, y0 : y1 + h + 1, x0 : x1 + w + 1]
        total, square = s[:, h:, w:] - s[:, :-h, w:] - s[:, h:, :-w] + s[:, :-h, :-w]
        energy = np.maximum(square - total * total / (h * w), 0.0) * float(np.dot(self._template, self._template))
        self._inverse_norm = np.divide(1.0, np.sqrt(energy), out=np.zeros_like(energy), where=energy > 0)

    def at(self, y: Index, x: Index) -> Sums:
        """Scores (N,) at rows ``y`` and columns ``x``, all of them places at which the template fits."""
        j, i = y - self._corner[0], x - self._corner[1]
        template, patch, size = self._template, self._patch, self._template.size
        products = [np.dot(patch[k : k + size], template) for k in (j * self._row + i).tolist()]
        scores: Sums = products * self._inverse_norm[j, i]
        return scores.clip(-1.0, 1.0)
