"""Fast code, and the only door to NCC's: each function picks its kernel with plain ifs.

Tests compare every kernel of NCC with :mod:`engine.kernels.reference`, which is slow, float64 and obvious.

The loops that numba compiles (of SIFT, of dense refinement, of the plane under a surface) have no door: who needs
one imports it where it is called, since numba takes a while to import. Tests compare SIFT's with the tensor ops
that they stand for, the others with OpenCV and difference quotients.
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
    """NCC of checked input: (B, H, W) and (B, T, h, w) of one floating dtype to (B, T, H-h+1, W-w+1)."""
    return eager.ncc_surface(search, templates, zero_mean=zero_mean)


def masked_ncc_surface(
    search: Tensor, search_valid: Tensor, templates: Tensor, templates_valid: Tensor, *, min_overlap: float
) -> Tensor:
    """Zero-mean NCC over the pixels that are valid in both, same shapes as :func:`ncc_surface`."""
    return masked.ncc_surface(search, search_valid, templates, templates_valid, min_overlap=min_overlap)


def integrals(image: Tensor) -> Tensor:
    """Running sums (2, H+1, W+1) of a picture (H, W) and of its square, float64."""
    return eager.integrals(image)


def inverse_norm(sums: Tensor, h: int, w: int) -> Tensor:
    """One over the norm about its mean of every h x w patch, from running sums; 0 where a patch is flat."""
    return eager.inverse_norm(sums, h, w)


def prepared_surface(image: Tensor, inverse_norms: Tensor, templates: Tensor) -> Tensor:
    """Zero-mean NCC of (T, h, w) zero-mean float32 templates with a picture whose patches' norms are known."""
    return eager.prepared_surface(image, inverse_norms, templates)


def products(image: Tensor, templates: Tensor) -> Tensor:
    """What :func:`prepared_surface` is before its division by the patches' norms: numerators (T, H', W')."""
    return eager.products(image, templates)


def peak(products: Tensor, inverse_norms: Tensor) -> tuple[Tensor, Tensor]:
    """Best score (T,) of every template's numerators and its flat place (T,) in (H', W'), the lowest of equals.

    Nothing leaves the device.
    """
    if _by_triton(products):
        from engine.kernels import triton_peak

        return triton_peak.peak(products, inverse_norms)
    return eager.peak(products, inverse_norms)


def rival(products: Tensor, inverse_norms: Tensor, winner: Tensor, radius_squared: int) -> Tensor:
    """Best score (T,) of every template's numerators outside a disc about a flat place; -1 where nothing is.

    Places whose squared distance from ``winner`` (one int64) is at most ``radius_squared`` lie inside.
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
    """Means of 2 x 2 pixels of (H, W) float32; an odd last row or column is left out."""
    return eager.halved(image)


def loops_compiled() -> int:
    """How many loops numba compiled, or loaded from where they are kept, so far; it is imported when needed."""
    jit = sys.modules.get("engine.kernels.jit")
    return 0 if jit is None else jit.count()
