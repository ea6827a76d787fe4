"""Masked NCC: all sums leave out invalid pixels of the window.

Padfield, Masked object registration in the Fourier domain, IEEE TIP 2012, doi:10.1109/TIP.2011.2181402. A template
has no mask: three sums of the correlation coefficient are correlations, the others are sums over boxes. Their
differences cancel, so all of it is in float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from engine.kernels.sums import FLAT_SHARE, box_sum, masked_scores
from engine.runtime.device import Picture, as_float


def ncc_surface(
    kernels: Any, search: Picture, search_valid: Picture, templates: Picture, *, min_overlap: float
) -> Picture:
    """Zero-mean NCC over the valid pixels of windows.

    Args:
        kernels: :mod:`engine.kernels.blocks` for arrays, :mod:`engine.kernels.tensors` for tensors.
        search: (B, H, W).
        search_valid: (B, H, W) bool.
        templates: (B, T, h, w).
        min_overlap: positions where a smaller share of the template lies on valid pixels score -1.

    Returns:
        (B, T, H-h+1, W-w+1) float64 in [-1, 1].

    Raises:
        OptionError: NaN or infinity.
    """
    (h, w), both = templates.shape[-2:], (-2, -1)
    window, mask, model = (as_float(given, "float64") for given in (search, search_valid, templates))
    with np.errstate(invalid="ignore"):  # of values that are refused below
        mean = (window * mask).sum(both, keepdims=True) / mask.sum(both, keepdims=True).clip(1.0)
        window = (window - mean) * mask
        model = model - model[..., :1, :1]  # of one level are exact zeros
        model = model - model.mean(both, keepdims=True)
        count = box_sum(kernels.integrals(mask)[0], h, w)[:, None]
        total, square = box_sum(kernels.integrals(window), h, w)[:, :, None]
        energy, own = ((v * v).sum(both, keepdims=True) for v in (window[:, None], model))
        products, of_model, of_squares = kernels.masked_products(window, mask, model)
        floors = FLAT_SHARE * energy, FLAT_SHARE * own
        scores = masked_scores(products, of_model, of_squares, total, square, count, floors)
    kernels.check_all_finite(search=search, templates=templates)  # last: the host waits for it
    is_on = count >= max(min_overlap * (h * w), 1.0)
    return scores * is_on + ~is_on * -1.0
