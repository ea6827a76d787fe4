"""Peaks on a GPU: find the numbers that define them on the device, so that few are copied."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from engine.kernels import tensors
from engine.runtime.tensors import Tensor, torch

Array = NDArray[np.float64]
Group: TypeAlias = Sequence[tuple[Tensor, Tensor, Tensor]]

_REACH_PX = 2  # scores around a peak, on either side, that refine it


def summits(products: Tensor, inverse_norms: Tensor, *, exclusion_px: float) -> Tensor:
    """The numbers that define the surfaces' peaks, on their device: nothing is copied from a GPU.

    Args:
        products: (T, H', W') float32 numerators.
        inverse_norms: (H', W') float32, or (T, H', W').
        exclusion_px: radius about a peak within which no rival is counted.

    Returns:
        (T, 28) float64: flat index, score, the rival's score, and the 5 x 5 scores about it, those on the border
        repeated beyond it.
    """
    best, position = tensors.peak(products, inverse_norms)
    second = tensors.rival(products, inverse_norms, position, math.floor(exclusion_px * exclusion_px))
    count, height, width = products.shape
    near = torch.arange(-_REACH_PX, _REACH_PX + 1, device=position.device)
    rows = ((position // width)[:, None] + near).clamp_(0, height - 1)[:, :, None]
    columns = ((position % width)[:, None] + near).clamp_(0, width - 1)[:, None, :]
    of = torch.arange(count, device=position.device)[:, None, None]
    norms = inverse_norms.expand(products.shape)
    around = (products[of, rows, columns] * norms[of, rows, columns]).nan_to_num_(nan=-1.0).clamp_(-1.0, 1.0)
    return torch.cat([torch.stack([position.double(), best.double(), second.double()], 1), around.flatten(1)], 1)


def of_surface(scores: Tensor, exclusion_px: float) -> Array:
    """What the peak of one surface is made of.

    Args:
        scores: (H', W').
        exclusion_px: radius about the peak within which no rival is counted.

    Returns:
        (28,) of :func:`summits`.
    """
    with torch.inference_mode():
        ones = torch.ones((), device=scores.device).expand(scores.shape)
        found = summits(scores.float()[None], ones, exclusion_px=exclusion_px)
    return np.asarray(found.cpu().numpy()[0])


def of_groups(groups: Sequence[Group], exclusion_px: float) -> Array:
    """Match templates, those of a group of equal shapes at once.

    Args:
        groups: picture (H, W) and sums (2, H+1, W+1) of a :class:`engine.ncc_fft.Search`, and template (h, w).
        exclusion_px: radius about a peak within which no rival is counted.

    Returns:
        (N, 28) of :func:`summits`, group after group.
    """
    with torch.inference_mode():
        rows = [_matched(group, exclusion_px) for group in groups]
        return np.asarray(torch.cat(rows).cpu().numpy())


def _matched(group: Group, exclusion_px: float) -> Tensor:
    images, sums, templates = (torch.stack(parts) for parts in zip(*group, strict=True))
    return match(images, sums, templates, exclusion_px)


def match(images: Tensor, sums: Tensor, templates: Tensor, exclusion_px: float) -> Tensor:
    """Match a batch on its device: fixed shapes, no copy, no waiting.

    Args:
        images: (B, H, W) float32 of :class:`engine.ncc_fft.Search`.
        sums: (B, 2, H+1, W+1) of the same.
        templates: (B, h, w) float32.
        exclusion_px: radius about a peak within which no rival is counted.

    Returns:
        (B, 28) of :func:`summits`.
    """
    inverse_norms = tensors.inverse_norm(sums, *templates.shape[1:])
    centred = templates - templates.mean(dim=(-2, -1), keepdim=True)
    return summits(tensors.products(images, centred), inverse_norms, exclusion_px=exclusion_px)
