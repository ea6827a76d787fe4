"""Masked NCC on the CPU for whole templates, by OpenCV's transforms in float64.

The sums are those of :mod:`engine.kernels.masked_tensors`. A template without a mask needs three of their six
correlations; the others are sums over boxes.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.kernels.blocks import fast_side, spectrum_of, transform
from engine.kernels.sums import FLAT_SHARE, box_sum, check_finite, counts, integrals, masked_scores

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def ncc_surface(search: NDArray[Any], search_valid: Mask, templates: NDArray[Any], *, min_overlap: float) -> Array:
    """Zero-mean NCC over the valid pixels of windows.

    Args:
        search: (B, H, W).
        search_valid: (B, H, W) bool.
        templates: (B, T, h, w).
        min_overlap: positions where a smaller share of the template lies on valid pixels score -1.

    Returns:
        (B, T, H-h+1, W-w+1) in [-1, 1].

    Raises:
        OptionError: NaN or infinity.
    """
    check_finite("search", bool(np.isfinite(search).all()))
    check_finite("templates", bool(np.isfinite(templates).all()))
    windows = zip(search, search_valid, templates, strict=True)
    return np.stack([_surfaces(*window, min_overlap) for window in windows])


def _surfaces(window: NDArray[Any], valid: Mask, templates: NDArray[Any], min_overlap: float) -> Array:
    """The scores (T, H-h+1, W-w+1) of templates (T, h, w) in one window (H, W) with a mask (H, W)."""
    h, w = templates.shape[1:]
    size = fast_side(window.shape[0]), fast_side(window.shape[1])
    mean = float(window.mean(dtype=np.float64, where=valid)) if valid.any() else 0.0
    values = np.where(valid, window - np.float64(mean), 0.0)
    count, (total, square) = box_sum(counts(valid), h, w), box_sum(integrals(values), h, w)
    seen, mask = (spectrum_of(picture, np.empty(size)) for picture in (values, valid))
    floor, product = FLAT_SHARE * float(np.vdot(values, values)), np.empty(size)

    def correlated(one: NDArray[Any], other: NDArray[Any]) -> Array:
        cv2.mulSpectrums(one, other, 0, product, True)
        transform(product, cv2.DFT_INVERSE, count.shape[0])
        return product[: count.shape[0], : count.shape[1]] / product.size

    out = np.empty((len(templates), *count.shape))
    for scores, template in zip(out, templates, strict=True):
        model = template.astype(np.float64)
        model -= model[0, 0]  # of one level are exact zeros
        model -= model.mean()
        own, squares = (spectrum_of(part, np.empty(size)) for part in (model, model * model))
        sums = correlated(seen, own), correlated(mask, own), correlated(mask, squares)
        scores[:] = masked_scores(*sums, total, square, count, (floor, FLAT_SHARE * float(np.vdot(model, model))))
    out[:, count < max(min_overlap * (h * w), 1.0)] = -1.0
    return out
