"""Extractors: networks that detect keypoints in a picture and describe them, behind one signature.

Convention:
    Pixel centres are integers, the origin is the centre of the top-left pixel. DISK's and SuperPoint's keypoints
    lie on whole pixels, ALIKED's between them.

References:
    Tyszkiewicz et al., DISK: Learning local features with policy gradient, NeurIPS 2020.
    Zhao et al., ALIKED: A lighter keypoint and descriptor extraction network via deformable transformation,
    IEEE TIM 2023, https://doi.org/10.1109/TIM.2023.3271000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from engine.learned import superpoint
from engine.runtime.tensors import Tensor, functional, nn, torch


@dataclass(frozen=True, slots=True)
class Keypoints:
    """Keypoints of one picture, the strongest first.

    Attributes:
        xy_px: (N, 2).
        strength: (N,) larger if the keypoint is likelier to be found again; comparable within one network.
        descriptors: (N, D).
    """

    xy_px: Tensor
    strength: Tensor
    descriptors: Tensor

    def __len__(self) -> int:
        return len(self.xy_px)

    def only(self, chosen: Tensor) -> Keypoints:
        """The keypoints selected by a mask (N,) or by indices."""
        return Keypoints(self.xy_px[chosen], self.strength[chosen], self.descriptors[chosen])


class Extractor(Protocol):
    """Detects and describes keypoints."""

    def __call__(self, picture: Tensor, count: int) -> Keypoints:
        """The strongest keypoints of a picture.

        Args:
            picture: (1, 1, H, W) float, values in [0, 1].
            count: upper bound on the keypoints.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Disk:
    """DISK as an :class:`Extractor`; ``network`` is kornia's."""

    network: nn.Module

    def __call__(self, picture: Tensor, count: int) -> Keypoints:
        """The strongest keypoints; see :class:`Extractor`."""
        found = self.network(picture.expand(-1, 3, -1, -1), n=count, pad_if_not_divisible=True)[0]
        return _ranked(found.keypoints, found.detection_scores, found.descriptors, count)


@dataclass(frozen=True, slots=True, eq=False)
class Aliked:
    """ALIKED as an :class:`Extractor`; ``network`` is kornia's, which returns every local maximum."""

    network: nn.Module

    def __call__(self, picture: Tensor, count: int) -> Keypoints:
        """The strongest keypoints; see :class:`Extractor`."""
        found = self.network(picture.expand(-1, 3, -1, -1))[0]
        return _ranked(found.keypoints, found.keypoint_scores, found.descriptors, count)


@dataclass(frozen=True, slots=True, eq=False)
class SuperPointKeypoints:
    """SuperPoint as an :class:`Extractor`."""

    network: nn.Module

    def __call__(self, picture: Tensor, count: int) -> Keypoints:
        """The strongest keypoints; see :class:`Extractor`."""
        height, width = picture.shape[2:]
        scores, descriptors = self.network(padded(picture, superpoint.CELL_PX))
        xy, strength = superpoint.strongest(scores[0, :height, :width], count)
        return Keypoints(xy, strength, superpoint.sample(descriptors[0], xy))


def padded(picture: Tensor, cell_px: int) -> Tensor:
    """The picture, padded at the right and bottom to whole cells by replicating its edge."""
    height, width = picture.shape[2:]
    return functional.pad(picture, (0, -width % cell_px, 0, -height % cell_px), mode="replicate")


def _ranked(xy_px: Tensor, strength: Tensor, descriptors: Tensor, count: int) -> Keypoints:
    order = torch.argsort(strength, descending=True, stable=True)[:count]
    return Keypoints(xy_px, strength, descriptors).only(order)
