"""NCC by the FFT in plain torch: one forward transform a picture, one inverse a template.

The numerator of equation 1 is a circular correlation; a period of the window's own size is enough, since the
shifts that wrap around are never returned. The denominator comes from running sums in float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

# A float32 transform leaves an error of about 1e-7 of the window's norm in every numerator. It is divided by the
# norm of a patch: where a patch is this many times weaker than the window, the transform runs in float64.
_FLOAT32_NORM_RATIO = 16.0
# Patches whose sum of squares is below this share of the window's are numerically flat.
_FLAT_SHARE = 1e-12


def fast_length(n: int) -> int:
    """The smallest length of at least ``n`` that has no prime factor above 5, which FFTs do fast."""
    best = 1 << (n - 1).bit_length()
    five = 1
    while five < best:
        three = five
        while three < best:
            length = three << max(0, (-(-n // three) - 1).bit_length())
            best = min(best, length)
            three *= 3
        five *= 5
    return best


def ncc_surface(search: Tensor, templates: Tensor, *, zero_mean: bool) -> Tensor:
    """Equation 1 of the paper, (B, H, W) and (B, T, h, w) to (B, T, H-h+1, W-w+1) in the input's dtype."""
    out_dtype, (h, w) = search.dtype, templates.shape[-2:]
    search, templates = search.double(), templates.double()
    if zero_mean:
        search = search - search.mean(dim=(-2, -1), keepdim=True)
        templates = templates - templates.mean(dim=(-2, -1), keepdim=True)
    patch_energy = _patch_energy(search, h, w, zero_mean)  # (B, H', W')
    template_norm = templates.square().sum(dim=(-2, -1)).sqrt()  # (B, T)
    window_energy = search.square().sum(dim=(-2, -1))[:, None, None]
    flat = patch_energy <= _FLAT_SHARE * window_energy
    patch_norm = patch_energy.masked_fill(flat, torch.inf).sqrt()
    weakest = patch_norm.amin(dim=(-2, -1))
    single = out_dtype != torch.float64 and bool(
        (window_energy.sqrt().flatten() <= _FLOAT32_NORM_RATIO * weakest).all()
    )
    work = torch.float32 if single else torch.float64
    numerator = _correlate(search.to(work), templates.to(work))
    scale = torch.where(template_norm > 0, 1.0 / template_norm, 0.0)  # a flat template scores 0 everywhere
    scores = numerator * (scale[..., None, None] / patch_norm[:, None]).to(work)
    return scores.clamp_(-1.0, 1.0).to(out_dtype)


def _correlate(search: Tensor, templates: Tensor) -> Tensor:
    """Sum of products at every valid shift, by the correlation theorem."""
    (H, W), (h, w) = search.shape[-2:], templates.shape[-2:]
    size = (fast_length(H), fast_length(W))
    product = torch.fft.rfft2(search, s=size)[:, None] * torch.fft.rfft2(templates, s=size).conj()
    products: Tensor = torch.fft.irfft2(product, s=size)
    return products[..., : H - h + 1, : W - w + 1]


def _patch_energy(search: Tensor, h: int, w: int, zero_mean: bool) -> Tensor:
    """Sum of squares of every h x w patch, about the patch's own mean when ``zero_mean``."""
    energy = _box_sum(search.square(), h, w)
    if zero_mean:
        energy = energy - _box_sum(search, h, w).square() / (h * w)
    return energy


def _box_sum(image: Tensor, h: int, w: int) -> Tensor:
    """Sums over every h x w patch of (B, H, W), from running sums."""
    total = torch.nn.functional.pad(image, (1, 0, 1, 0)).cumsum(-1).cumsum(-2)
    return total[:, h:, w:] - total[:, :-h, w:] - total[:, h:, :-w] + total[:, :-h, :-w]
