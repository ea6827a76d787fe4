"""Kernels, and the interface to NCC's: each function selects its kernel with plain ifs.

Tests compare every kernel of NCC with :mod:`engine.kernels.reference`, which is slow, float64 and obvious.

Loops compiled by numba (SIFT, dense refinement, the plane under a surface) are imported where they are called,
since numba takes a while to import. Tests compare SIFT's with the equivalent tensor ops, the others with OpenCV
and difference quotients.
"""

from __future__ import annotations

import sys
from functools import cache
from importlib.util import find_spec

from torch import Tensor

from engine.kernels import eager, masked
from engine.kernels.local import LocalScores

__all__ = [
    "LocalScores",
    "halved",
    "integrals",
    "inverse_norm",
    "loops_compiled",
    "masked_ncc_surface",
    "ncc_surface",
    "peak",
    "prepared_surface",
    "products",
    "rival",
]


def ncc_surface(search: Tensor, templates: Tensor, *, zero_mean: bool) -> Tensor:
    """NCC of checked input (equation 1).

    Args:
        search: (B, H, W) floating point.
        templates: (B, T, h, w) of the same dtype and device, with h <= H and w <= W.
        zero_mean: subtract the means first.

    Returns:
        (B, T, H-h+1, W-w+1) of the same dtype, in [-1, 1].
    """
    return eager.ncc_surface(search, templates, zero_mean=zero_mean)


def masked_ncc_surface(
    search: Tensor, search_valid: Tensor, templates: Tensor, templates_valid: Tensor, *, min_overlap: float
) -> Tensor:
    """Zero-mean NCC over the pixels that are valid in both (Padfield, doi:10.1109/TIP.2011.2181402).

    Args:
        search: (B, H, W).
        search_valid: (B, H, W) bool.
        templates: (B, T, h, w).
        templates_valid: (B, T, h, w) bool.
        min_overlap: positions with a smaller share of the template's valid pixels in common score -1.

    Returns:
        (B, T, H-h+1, W-w+1) float64 in [-1, 1].
    """
    return masked.ncc_surface(search, search_valid, templates, templates_valid, min_overlap=min_overlap)


def integrals(image: Tensor) -> Tensor:
    """Integral images of a picture and of its square.

    Args:
        image: (H, W) float32.

    Returns:
        (2, H+1, W+1) float64 running sums; the first row and column are 0.
    """
    return eager.integrals(image)


def inverse_norm(sums: Tensor, h: int, w: int) -> Tensor:
    """Reciprocal norm about the mean of every patch.

    Args:
        sums: (2, H+1, W+1) from :func:`integrals`, or a crop of a larger picture's.
        h: rows of a patch.
        w: columns of a patch.

    Returns:
        (H-h+1, W-w+1) float32; 0 where a patch is flat.
    """
    return eager.inverse_norm(sums, h, w)


def prepared_surface(image: Tensor, inverse_norms: Tensor, templates: Tensor) -> Tensor:
    """Zero-mean NCC with a picture whose patches' norms are known.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        inverse_norms: (H-h+1, W-w+1) from :func:`inverse_norm`.
        templates: (T, h, w) float32 of zero mean.

    Returns:
        (T, H-h+1, W-w+1) float32 in [-1, 1].
    """
    return eager.prepared_surface(image, inverse_norms, templates)


def products(image: Tensor, templates: Tensor) -> Tensor:
    """Numerators of :func:`prepared_surface`, before the division by the patches' norms.

    Args:
        image: (H, W) float32.
        templates: (T, h, w) float32 of zero mean, scaled to a norm of 1 here.

    Returns:
        (T, H-h+1, W-w+1) float32.
    """
    return eager.products(image, templates)


def peak(products: Tensor, inverse_norms: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum of every template's surface; nothing is copied from the device.

    Args:
        products: (T, H', W') float32 from :func:`products`.
        inverse_norms: (H', W') float32.

    Returns:
        Score (T,) and flat index (T,) int64 in (H', W'), the lowest of equal ones.
    """
    if _by_triton(products):
        from engine.kernels import triton_peak

        return triton_peak.peak(products, inverse_norms)
    return eager.peak(products, inverse_norms)


def rival(products: Tensor, inverse_norms: Tensor, winner: Tensor, radius_squared: int) -> Tensor:
    """Maximum of every template's surface outside a disc.

    Args:
        products: (T, H', W') float32 from :func:`products`.
        inverse_norms: (H', W') float32.
        winner: one int64, the flat index of the disc's centre, on the device.
        radius_squared: positions of at most this squared distance are inside, in squared pixels.

    Returns:
        (T,) float32; -1 where nothing is outside.
    """
    if _by_triton(products):
        from engine.kernels import triton_peak

        return triton_peak.rival(products, inverse_norms, winner, radius_squared)
    return eager.rival(products, inverse_norms, winner, radius_squared)


def _by_triton(tensor: Tensor) -> bool:
    return tensor.device.type == "cuda" and _has_triton()


@cache
def _has_triton() -> bool:
    return find_spec("triton") is not None


def halved(image: Tensor) -> Tensor:
    """Means of 2 x 2 pixels.

    Args:
        image: (H, W) float32; an odd last row or column is left out.

    Returns:
        (H // 2, W // 2) float32.
    """
    return eager.halved(image)


def loops_compiled() -> int:
    """Number of loops that numba compiled, or loaded from its cache, so far; it is imported when needed."""
    jit = sys.modules.get("engine.kernels.jit")
    return 0 if jit is None else jit.count()
