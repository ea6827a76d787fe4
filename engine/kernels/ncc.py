"""The interface to NCC's kernels: a function with two kernels selects one with plain ifs."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import torch
from torch import Tensor

from engine.kernels import eager
from engine.kernels.eager import check_finite, halved, integrals, products
from engine.kernels.local import LocalScores
from engine.kernels.masked import ncc_surface as masked_ncc_surface

__all__ = [
    "LocalScores",
    "check_finite",
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


def ncc_surface(search: Tensor, templates: Tensor, *, zero_mean: bool) -> Tensor:
    """NCC by equation 1.

    Args:
        search: (B, H, W) float32 or float64.
        templates: (B, T, h, w) of the same dtype.
        zero_mean: subtract the means first.

    Returns:
        (B, T, H-h+1, W-w+1) of the same dtype, in [-1, 1]; 0 where patch or template is flat.

    Raises:
        OptionError: NaN or infinity.
    """
    if _by_opencv(search, templates):
        from engine.kernels import by_opencv

        return by_opencv.ncc_surface(search, templates, zero_mean=zero_mean)
    scores = eager.ncc_surface(search, templates, zero_mean=zero_mean)
    eager.check_finite(search=search, templates=templates)  # last: the host waits for it
    return scores


def prepared_surface(image: Tensor, inverse_norms: Tensor, templates: Tensor) -> Tensor:
    """Zero-mean NCC with a picture whose patches' norms are known.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        inverse_norms: (H-h+1, W-w+1) from :func:`inverse_norm`.
        templates: (T, h, w) float32 of zero mean.

    Returns:
        (T, H-h+1, W-w+1) float32 in [-1, 1].
    """
    if _by_opencv(image, templates):
        from engine.kernels import by_opencv

        return by_opencv.prepared_surface(image, inverse_norms, templates)
    return eager.prepared_surface(image, inverse_norms, templates)


def inverse_norm(sums: Tensor, h: int, w: int) -> Tensor:
    """Reciprocal norm about the mean of every patch.

    Args:
        sums: (2, H+1, W+1) from :func:`integrals`, or a crop of a larger picture's, or (B, 2, H+1, W+1).
        h: rows of a patch.
        w: columns of a patch.

    Returns:
        (H-h+1, W-w+1) float32, or (B, H-h+1, W-w+1); 0 where a patch is flat.
    """
    if sums.device.type == "cpu" and sums.ndim == 3:
        from engine.kernels import by_opencv

        return by_opencv.inverse_norm(sums, h, w)
    return eager.inverse_norm(sums, h, w)


def peak(products: Tensor, inverse_norms: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum of every template's surface; nothing is copied from the device.

    Args:
        products: (T, H', W') float32 from :func:`products`.
        inverse_norms: (H', W') float32, or (T, H', W').

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
        inverse_norms: (H', W') float32, or (T, H', W').
        winner: (T,) int64, the flat index of the disc's centre, on the device.
        radius_squared: positions of at most this squared distance are inside, in squared pixels.

    Returns:
        (T,) float32; -1 where nothing is outside.
    """
    if _by_triton(products):
        from engine.kernels import triton_peak

        return triton_peak.rival(products, inverse_norms, winner, radius_squared)
    return eager.rival(products, inverse_norms, winner, radius_squared)


def _by_opencv(search: Tensor, templates: Tensor) -> bool:
    """Whether both are float32 on the CPU, and no gradient is asked for."""
    return (
        search.dtype == templates.dtype == torch.float32
        and search.device.type == "cpu"
        and not (search.requires_grad or templates.requires_grad)
    )


def _by_triton(tensor: Tensor) -> bool:
    return tensor.device.type == "cuda" and _has_triton()


@cache
def _has_triton() -> bool:
    return find_spec("triton") is not None
