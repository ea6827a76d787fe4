"""Select SIFT's keypoints: those within their cell's share first. Compiled by numba."""

from __future__ import annotations

import numpy as np

from engine.runtime.jit import compiled


@compiled("(i8[::1], i8, f8, i8)")
def spread_out(cells, count, share, most):
    """Choose among keypoints by falling strength: those beyond their cell's share come after all others.

    Args:
        cells: (M,) int64, the cell of each keypoint, the strongest first.
        count: of cells.
        share: keypoints of a cell from which it is crowded.
        most: keypoints that are kept.

    Returns:
        (K,) int64 indices of those kept, in order.
    """
    held = np.zeros(count, np.int64)
    kept, crowded = np.empty(min(most, cells.size), np.int64), np.empty(cells.size, np.int64)
    n = late = 0
    for i in range(cells.size):
        if n == kept.size:
            break
        if held[cells[i]] < share:
            kept[n] = i
            n += 1
        else:
            crowded[late] = i
            late += 1
        held[cells[i]] += 1
    for i in range(min(late, kept.size - n)):
        kept[n] = crowded[i]
        n += 1
    return kept
