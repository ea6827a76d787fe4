"""Masked NCC by the FFT: all sums leave out pixels that are invalid in either picture.

Padfield, Masked object registration in the Fourier domain, IEEE TIP 2012, doi:10.1109/TIP.2011.2181402. Every
sum of the correlation coefficient is itself a correlation, of a picture, its square or its mask with another's;
their differences cancel, so all of it is in float64.
"""

from __future__ import annotations

import cv2

from engine.kernels.sums import FLAT_SHARE
from engine.kernels.tensors import check_all_finite
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
    (H, W), (h, w) = search.shape[-2:], templates.shape[-2:]
    size = (cv2.getOptimalDFTSize(H), cv2.getOptimalDFTSize(W))

    def sums(a: Tensor, b: Tensor) -> Tensor:
        product: Tensor = torch.fft.irfft2(a * b.conj(), s=size)
        return product[..., : H - h + 1, : W - w + 1]

    m, i, ii = (s[:, None] for s in _spectra(search, search_valid, size))
    n, t, tt = _spectra(templates, torch.ones_like(templates, dtype=torch.bool), size)
    common = sums(m, n).round_()  # a count of pixels
    safe = common.clamp_min(1.0)
    sum_i, sum_t = sums(i, n), sums(m, t)
    energy_i, energy_t = sums(ii, n), sums(m, tt)
    numerator = sums(i, t) - sum_i * sum_t / safe
    spread_i, spread_t = energy_i - sum_i.square() / safe, energy_t - sum_t.square() / safe
    textured = (spread_i > FLAT_SHARE * ii[..., :1, :1].real) & (spread_t > FLAT_SHARE * tt[..., :1, :1].real)
    scores = numerator / (spread_i.clamp_min(0.0) * spread_t.clamp_min(0.0)).sqrt().clamp_min(1e-300)
    scores = torch.where(textured, scores, 0.0).clamp_(-1.0, 1.0)
    scores = torch.where(common >= max(min_overlap * (h * w), 1.0), scores, -1.0)
    check_all_finite(search=search, templates=templates)  # last: the host waits for it
    return scores


def _spectra(picture: Tensor, valid: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Transforms of the mask, of the picture less its mean, and of its square, all 0 where not valid."""
    mask = valid.double()
    count = mask.sum(dim=(-2, -1), keepdim=True).clamp_min(1.0)
    mean = (picture.double() * mask).sum(dim=(-2, -1), keepdim=True) / count
    masked = (picture.double() - mean) * mask
    one, two, three = (torch.fft.rfft2(p, s=size) for p in (mask, masked, masked.square()))
    return one, two, three
