"""The only door to fast code: each function picks its kernel with plain ifs.

Tests compare every kernel with :mod:`engine.kernels.reference`, which is slow, float64 and obvious.
"""

from __future__ import annotations

from torch import Tensor

from engine.kernels import eager

__all__ = ["ncc_surface"]


def ncc_surface(search: Tensor, templates: Tensor, *, zero_mean: bool) -> Tensor:
    """NCC of checked input: (B, H, W) and (B, T, h, w) of one floating dtype to (B, T, H-h+1, W-w+1)."""
    return eager.ncc_surface(search, templates, zero_mean=zero_mean)
