"""Masked NCC by the FFT in plain torch: all sums leave out invalid pixels of the window.

Padfield, Masked object registration in the Fourier domain, IEEE TIP 2012, doi:10.1109/TIP.2011.2181402. A template
has no mask: three sums of the correlation coefficient are correlations, the others are sums over boxes. Their
differences cancel, so all of it is in float64.
"""

from __future__ import annotations

from engine.kernels.sums import FLAT_SHARE, box_sum, masked_scores
from engine.kernels.tensors import check_all_finite, correlate, integrals
from engine.runtime.tensors import Tensor, torch


def ncc_surface(search: Tensor, search_valid: Tensor, templates: Tensor, *, min_overlap: float) -> Tensor:
    """Zero-mean NCC over the valid pixels of windows.

    Args:
        search: (B, H, W).
        search_valid: (B, H, W) bool.
        templates: (B, T, h, w).
        min_overlap: positions where a smaller share of the template lies on valid pixels score -1.

    Returns:
        (B, T, H-h+1, W-w+1) float64 in [-1, 1].

    Raises:
        OptionError: NaN or infinity.
    """
    h, w = templates.shape[-2:]
    mask = search_valid.double()
    mean = (search.double() * mask).sum(dim=(-2, -1)) / mask.sum(dim=(-2, -1)).clamp_min(1.0)
    window = (search.double() - mean[:, None, None]) * mask
    model = templates.double()
    model = model - model.mean(dim=(-2, -1), keepdim=True)
    (common, _), sums = box_sum(integrals(mask), h, w)[:, :, None], integrals(window)
    total, square = box_sum(sums, h, w)[:, :, None]
    floors = FLAT_SHARE * sums[1, :, None, -1:, -1:], FLAT_SHARE * model.square().sum(dim=(-2, -1), keepdim=True)
    products, of_model, of_squares = (
        correlate(window, model),
        correlate(mask, model),
        correlate(mask, model.square()),
    )
    scores = masked_scores(products, of_model, of_squares, total, square, common, floors)
    scores = torch.where(common >= max(min_overlap * (h * w), 1.0), scores, -1.0)
    check_all_finite(search=search, templates=templates)  # last: the host waits for it
    return scores
