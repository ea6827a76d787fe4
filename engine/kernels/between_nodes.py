"""Places in a frame between the nodes of a grid, bilinear: two products with sparse weights."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]


def places_between_nodes(
    nodes: FloatImage, frame: tuple[int, ...], size: tuple[int, int]
) -> tuple[FloatImage, FloatImage, NDArray[np.bool_]]:
    """Interpolate a grid of nodes at every pixel of a picture, from corner to corner.

    Args:
        nodes: (n, n, 3) float32 place x and y in the frame, and 1 where the frame can show it, else 0.
        frame: its rows and columns.
        size: rows and columns (h, w) of the picture.

    Returns:
        Places x and y (h, w), and whether each is in the frame and all nodes around can be shown.
    """
    down, across = (_weights(len(nodes), count) for count in size)
    x, y, shown = down @ nodes.transpose(2, 0, 1) @ across.T
    inside = (x >= 0) & (x <= frame[1] - 1) & (y >= 0) & (y <= frame[0] - 1)
    return x, y, inside & (shown > 0.999)  # of weights that sum to 1 up to rounding


@lru_cache(maxsize=256)
def _weights(nodes: int, count: int) -> FloatImage:
    """(count, nodes): the shares of the two nodes about each of ``count`` pixels from end to end."""
    at = np.linspace(0.0, nodes - 1.0, count)
    first = np.minimum(at.astype(np.intp), nodes - 2)
    weights, pixel, share = np.zeros((count, nodes), np.float32), np.arange(count), at - first
    weights[pixel, first], weights[pixel, first + 1] = 1.0 - share, share
    return weights
