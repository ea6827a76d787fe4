"""The interface to NCC's kernels: a function with two kernels selects one with plain ifs."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

from torch import Tensor

from engine.kernels import eager
from engine.kernels.eager import halved, integrals, inverse_norm, ncc_surface, prepared_surface, products
from engine.kernels.local import LocalScores
from engine.kernels.masked import ncc_surface as masked_ncc_surface

__all__ = [
    "LocalScores",
    "halved",
    "integrals",
    "inverse_norm",
    "masked_ncc_surface",
    "ncc_surface",
    "peak",
    "prepared_surface",
    "products",
    "rival",
]


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
