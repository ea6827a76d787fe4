"""NCC literally by the equation, in float64: the reference for the other kernels' tests."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray


def ncc_surface(search: ArrayLike, template: ArrayLike, *, zero_mean: bool) -> NDArray[np.float64]:
    """Equation 1 of the paper: R(x, y) = sum T I / sqrt(sum T^2 * sum I^2) over the template's pixels.

    Args:
        search: (H, W).
        template: (h, w) with h <= H and w <= W.
        zero_mean: subtract the mean of the template and that of each patch first.

    Returns:
        (H-h+1, W-w+1) in [-1, 1]; 0 where patch or template is flat.
    """
    window, model = np.asarray(search, np.float64), np.asarray(template, np.float64)
    scores = np.zeros((window.shape[0] - model.shape[0] + 1, window.shape[1] - model.shape[1] + 1))
    if zero_mean:
        window = window - window.mean()  # NCC is invariant to it; the squares below stay small
        model = model - model.mean()
    patches = sliding_window_view(window, model.shape)
    for y in range(scores.shape[0]):
        for x in range(scores.shape[1]):
            patch = patches[y, x]
            if zero_mean:
                patch = patch - patch.mean()
            energy = np.sum(patch * patch) * np.sum(model * model)
            if energy > 0:
                scores[y, x] = np.sum(model * patch) / np.sqrt(energy)
    return scores
