"""Keypoints with their descriptors in a fixed number of slots, and pairs of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.runtime.device import Picture
from engine.values import check

Limits = tuple[float, float | None]
"""Ratio of the scales of matched keypoints, and the factor that it may be off by; None allows all."""
TRAIN_CHUNK = 4096  # train slots compared at a time, to bound memory for a whole map
ROUNDING = math.sqrt(128 * np.finfo(np.float32).eps)  # most between a descriptor and itself, by rounding


@dataclass(frozen=True, slots=True)
class SiftChoice:
    """What of a picture is kept and how it is described; see :func:`engine.features.sift`.

    Attributes:
        max_keypoints: number of slots.
        up_rad: angle of upright features, None the dominant gradient's.
        upsample: samples per pixel of the first octave.
        contrast_threshold: Lowe's.
        spread: cells along each side of a picture.
    """

    max_keypoints: int
    up_rad: float | None
    upsample: int
    contrast_threshold: float
    spread: int

    def __post_init__(self) -> None:
        check(self, "max_keypoints", "at least 1", lambda count: count >= 1)
        check(self, "upsample", "1 or 2", lambda factor: factor in (1, 2))
        check(self, "contrast_threshold", "a number from 0 up", lambda contrast: contrast >= 0)
        check(self, "spread", "1 or more", lambda cells: cells >= 1)


@dataclass(frozen=True, slots=True)
class Features:
    """Keypoints and descriptors of a batch of images, in a fixed number of slots: arrays or tensors.

    A slot without keypoint is False in ``valid`` and zero elsewhere. The first slots hold the keypoints within
    their cell's share (see :func:`sift`), the next those beyond it, both by falling strength.

    Attributes:
        xy_px: (B, N, 2) positions (x, y), pixel centres at integers.
        scale_px: (B, N) sigma of the keypoint in pixels of the image.
        angle_deg: (B, N) in [0, 360), from +x towards +y (clockwise on the screen).
        descriptors: (B, N, 128) of unit L2 norm; 4 x 4 cells row by row, 8 orientations each.
        valid: (B, N) bool.
    """

    xy_px: Picture
    scale_px: Picture
    angle_deg: Picture
    descriptors: Picture
    valid: Picture


def fields_of(features: Features) -> tuple[Picture, ...]:
    """The five fields, in their order."""
    return features.xy_px, features.scale_px, features.angle_deg, features.descriptors, features.valid


def ranks_within(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many elements before each are of the same group.

    Args:
        group: (N,) of each, such as its cell of a picture.

    Returns:
        (N,).
    """
    order = np.argsort(group, kind="stable")
    ranks, ordered = np.empty_like(order), group[order]
    ranks[order] = np.arange(len(group)) - np.searchsorted(ordered, ordered)
    return ranks


@dataclass(frozen=True, slots=True)
class Matches:
    """The nearest train slot of every query slot, and whether the pair passes the tests.

    Attributes:
        train_index: (B, N) int64.
        distance: (B, N) Euclidean distance of the descriptors, in [0, 2]; infinite if none was allowed.
        ratio: (B, N) distance over the second nearest's, in [0, 1]; 0 where there is no second, 1 where both are
            0.
        valid: (B, N) bool.
    """

    train_index: Picture
    distance: Picture
    ratio: Picture
    valid: Picture
