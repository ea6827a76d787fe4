"""Interface to NCC's kernels: a function with several kernels selects one with plain ifs.

Arrays are the CPU's, and go to OpenCV and to compiled loops; tensors go to tensor ops. Kernels are
imported where they are selected: torch and numba take a while.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from engine.kernels import sums
from engine.kernels.local import LocalScores
from engine.kernels.sums import counts
from engine.runtime.device import Picture, as_tensor

if TYPE_CHECKING:
    from engine.runtime.tensors import Tensor

__all__ = [
    "LocalScores",
    "counts",
    "halved",
    "inverse_norm",
    "masked_ncc_surface",
    "ncc_surface",
    "prepared_surface",
]


def ncc_surface(search: Picture, templates: Picture, *, zero_mean: bool) -> Picture:
    """NCC by equation 1.

    Args:
        search: (B, H, W) float32 array, or float32 or float64 tensor.
        templates: (B, T, h, w) of the same kind and type.
        zero_mean: subtract the means first.

    Returns:
        (B, T, H-h+1, W-w+1) of the same kind and type, in [-1, 1]; 0 where patch or template is flat.

    Raises:
        OptionError: NaN or infinity.
    """
    if isinstance(search, np.ndarray):
        from engine.kernels import blocks

        return blocks.ncc_surface(search, templates, zero_mean=zero_mean)
    from engine.kernels import tensors

    scores = tensors.ncc_surface(search, templates, zero_mean=zero_mean)
    tensors.check_finite(search=search, templates=templates)  # last: the host waits for it
    return scores


def masked_ncc_surface(
    search: Picture, search_valid: Picture, templates: Picture, templates_valid: Picture, *, min_overlap: float
) -> Picture:
    """Zero-mean NCC over the pixels that are valid in both.

    Args:
        search: (B, H, W).
        search_valid: (B, H, W) bool, of the same kind.
        templates: (B, T, h, w), of the same kind.
        templates_valid: (B, T, h, w) bool, of the same kind; arrays that are not all valid go to the tensor ops.
        min_overlap: positions with a smaller share of the template's valid pixels in common score -1.

    Returns:
        (B, T, H-h+1, W-w+1) in [-1, 1].

    Raises:
        OptionError: NaN or infinity.
    """
    if isinstance(search, np.ndarray) and templates_valid.all():
        from engine.kernels import masked_blocks

        sums.check_finite(search=search, templates=templates)
        return masked_blocks.ncc_surface(search, search_valid, templates, min_overlap=min_overlap)
    from engine.kernels import masked_tensors, tensors

    search, search_valid, templates, templates_valid = map(
        as_tensor, (search, search_valid, templates, templates_valid)
    )
    scores = masked_tensors.ncc_surface(search, search_valid, templates, templates_valid, min_overlap=min_overlap)
    tensors.check_finite(search=search, templates=templates)  # last: the host waits for it
    return scores


def prepared_surface(image: Picture, inverse_norms: Picture, templates: Picture) -> Picture:
    """Zero-mean NCC with a picture whose patches' norms are known.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        inverse_norms: (H-h+1, W-w+1) from :func:`inverse_norm`.
        templates: (T, h, w) float32 of zero mean.

    Returns:
        (T, H-h+1, W-w+1) float32 in [-1, 1].
    """
    if isinstance(image, np.ndarray):
        from engine.kernels import blocks

        return blocks.prepared_surface(image, inverse_norms, templates)
    from engine.kernels import tensors

    return tensors.prepared_surface(image, inverse_norms, templates)


def inverse_norm(image: Picture, running: Tensor | None, h: int, w: int) -> Picture:
    """Reciprocal norm about the mean of every patch.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        running: (2, H+1, W+1) sums of a tensor and its square, or a crop of a larger one's; None of an array.
        h: rows of a patch.
        w: columns of a patch.

    Returns:
        (H-h+1, W-w+1) float32; 0 where a patch is flat.
    """
    if isinstance(image, np.ndarray):
        from engine.kernels import blocks

        return blocks.inverse_norm(image, h, w)
    from engine.kernels import tensors

    assert running is not None
    return tensors.inverse_norm(running, h, w)


def halved(image: Picture) -> Picture:
    """Means (H // 2, W // 2) of 2 x 2 pixels of a picture (H, W) float32."""
    if isinstance(image, np.ndarray):
        return sums.halved(image)
    from engine.kernels import tensors

    return tensors.halved(image)
