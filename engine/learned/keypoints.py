"""Extractors: networks that detect keypoints in a picture and describe them, behind one signature.

Convention:
    Pixel centres are integers, the origin is the centre of the top-left pixel. DISK's keypoints lie on whole
    pixels, ALIKED's between them.

References:
    Tyszkiewicz et al., DISK: Learning local features with policy gradient, NeurIPS 2020.
    Zhao et al., ALIKED: A lighter keypoint and descriptor extraction network via deformable transformation,
    IEEE TIM 2023, https://doi.org/10.1109/TIM.2023.3271000.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from engine.runtime.tensors import Tensor, nn, torch


@dataclass(frozen=True, slots=True)
class Keypoints:
    """Keypoints of one picture, the strongest first.

    Attributes:
        xy_px: (N, 2).
        descriptors: (N, D).
    """

    xy_px: Tensor
    descriptors: Tensor

    def __len__(self) -> int:
        return len(self.xy_px)

    def only(self, chosen: Tensor) -> Keypoints:
        """The keypoints selected by a mask (N,) or by indices."""
        return Keypoints(self.xy_px[chosen], self.descriptors[chosen])


Extractor: TypeAlias = Callable[[Tensor, int], Keypoints]
"""The strongest keypoints of a picture (1, 1, H, W), float in [0, 1], at most so many."""


def by_disk(network: nn.Module, picture: Tensor, count: int) -> Keypoints:
    """The keypoints by kornia's DISK; with its network an :data:`Extractor`."""
    found = network(picture.expand(-1, 3, -1, -1), n=count, pad_if_not_divisible=True)[0]
    return _ranked(found.keypoints, found.detection_scores, found.descriptors, count)


def by_aliked(network: nn.Module, picture: Tensor, count: int) -> Keypoints:
    """The keypoints by kornia's ALIKED, which returns every local maximum; likewise."""
    found = network(picture.expand(-1, 3, -1, -1))[0]
    return _ranked(found.keypoints, found.keypoint_scores, found.descriptors, count)


def _ranked(xy_px: Tensor, strength: Tensor, descriptors: Tensor, count: int) -> Keypoints:
    order = torch.argsort(strength, descending=True, stable=True)[:count]
    return Keypoints(xy_px, descriptors).only(order)
