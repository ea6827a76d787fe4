"""SIFT as tensor ops on any torch device: kornia's pyramid with Lowe's tests of its extrema.

kornia refines every extremum of the doubled picture and ranks by contrast. The tests of contrast and of edges, the
mask and the spread over the picture are those of the compiled loops (:mod:`engine.sift.loops`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from engine.runtime.tensors import Tensor, torch
from engine.sift.scale_space import EDGE_RATIO, SCALES
from engine.sift.values import Features, SiftChoice

_PX_PER_EXTREMUM = 4  # highest density of extrema; the weakest beyond it are dropped
_FRAME_SIGMAS = 6.0  # half the side of kornia's frames


@dataclass(frozen=True, slots=True)
class _Extrema:
    """N slots for the extrema of each of B pictures, and the levels that they were found on."""

    lafs: Tensor  # (B, N, 2, 3) upright frames of kornia's
    contrast: Tensor  # (B, N)
    valid: Tensor  # (B, N) bool
    octave: Tensor  # (B, N) int64
    level: Tensor  # (B, N) int64, the finer of the two Gaussians of the difference

    @property
    def xy_px(self) -> Tensor:
        """(B, N, 2) pixels of the picture."""
        return self.lafs[..., 2]

    @property
    def scale_px(self) -> Tensor:
        """(B, N) sigmas in pixels of the picture."""
        return self.lafs[..., 0, 0] / _FRAME_SIGMAS

    def take(self, index: Tensor, valid: Tensor) -> _Extrema:
        """Select slots (B, M), of which those are valid."""
        rows = torch.arange(len(index), device=index.device)[:, None]
        return _Extrema(
            self.lafs[rows, index], self.contrast[rows, index], valid, self.octave[rows, index],
            self.level[rows, index].where(valid, -1),
        )  # fmt: skip


def find_features(images: Tensor, mask: Tensor | None, choice: SiftChoice) -> Features:
    """The strongest features of pictures.

    Args:
        images: (B, H, W) float32.
        mask: (B, 1, H, W) bool, True where keypoints are allowed; None is everywhere.
        choice: which keypoints to keep and describe; pictures are always upsampled.

    Returns:
        Features on the pictures' device.
    """
    network = _network(images.device)
    # cuDNN's default, TF32, rounds a blurred picture to 10 bits: a tenth of the extrema would be others.
    with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        slots = math.ceil(images[0].numel() / _PX_PER_EXTREMUM)
        detect = network.detector._detect_with_pyramid
        contrast, lafs, filled, pyramid, octave, level = detect(images[:, None], slots)
        found = _Extrema(lafs, contrast, filled, octave, level)
        valid = filled & (contrast >= choice.contrast_threshold / SCALES) & ~_on_edges(found, pyramid)
        if mask is not None:
            valid &= _allowed(found.xy_px, mask)
        kept = found.take(*_strongest(found, valid, images.shape[1:], choice))
        return _described(kept, pyramid, network.descriptor, choice)


@lru_cache(maxsize=4)
def _network(device: torch.device) -> Any:
    from kornia.feature import SIFTFeatureScaleSpace  # takes a second

    # Calling the stages one by one describes only kept keypoints; kornia's version is pinned for this.
    return SIFTFeatureScaleSpace(rootsift=True, device=device, descriptor_backend="pyramid").eval()


def _on_edges(found: _Extrema, pyramid: list[Tensor]) -> Tensor:
    """Whether the curvatures of the difference of Gaussians are too unequal: (B, N) bool, Lowe's test."""
    is_edge, near = torch.zeros_like(found.valid), torch.arange(-1, 2, device=found.valid.device)
    for octave, gaussians in enumerate(pyramid):
        picture, slot = (found.valid & (found.octave == octave)).nonzero(as_tuple=True)
        column, row = (found.xy_px[picture, slot] * 2.0 ** (1 - octave)).round().long().unbind(1)
        level = found.level[picture, slot]
        at = (picture[:, None, None], row[:, None, None] + near[:, None], column[:, None, None] + near)
        finer, coarser = (gaussians[at[0], 0, level[:, None, None] + k, at[1], at[2]] for k in (0, 1))
        d = coarser - finer  # (K, 3, 3)
        xx, yy = d[:, 1, 2] + d[:, 1, 0] - 2.0 * d[:, 1, 1], d[:, 2, 1] + d[:, 0, 1] - 2.0 * d[:, 1, 1]
        xy = (d[:, 2, 2] + d[:, 0, 0] - d[:, 2, 0] - d[:, 0, 2]) / 4.0
        determinant, limit = xx * yy - xy * xy, (EDGE_RATIO + 1.0) ** 2 / EDGE_RATIO
        is_edge[picture, slot] = ~((determinant > 0.0) & ((xx + yy) ** 2 < limit * determinant))
    return is_edge


def _allowed(xy_px: Tensor, mask: Tensor) -> Tensor:
    """Whether the nearest pixel is: (B, N) bool."""
    x, y = xy_px.round().long().unbind(2)
    rows = torch.arange(len(mask), device=mask.device)[:, None]
    return mask[rows, 0, y.clamp(0, mask.shape[2] - 1), x.clamp(0, mask.shape[3] - 1)]


def _strongest(
    found: _Extrema, valid: Tensor, shape: tuple[int, ...], choice: SiftChoice
) -> tuple[Tensor, Tensor]:
    """Slots (B, M) to keep by precedence, and whether each holds a keypoint; M is at most the requested number."""
    strength = torch.where(valid, found.contrast * found.scale_px.sqrt(), -1.0)
    order = strength.argsort(dim=1, descending=True, stable=True)
    side, valid = choice.spread, valid.gather(1, order)
    x, y = (along.gather(1, order) for along in found.xy_px.unbind(2))
    column, row = ((v * (side / n)).long().clamp_(0, side - 1) for v, n in ((x, shape[1]), (y, shape[0])))
    is_crowded = _rank((row * side + column).where(valid, side * side)) >= 2 * choice.max_keypoints / side**2
    place = torch.where(valid, is_crowded.long(), 2).argsort(dim=1, stable=True)[:, : choice.max_keypoints]
    return order.gather(1, place), valid.gather(1, place)


def _rank(group: Tensor) -> Tensor:
    """How many before each element (B, N) of a row are of the same group."""
    ordered, order = group.sort(dim=1, stable=True)
    index = torch.arange(group.shape[1], device=group.device).expand_as(group)
    return torch.empty_like(group).scatter_(1, order, index - torch.searchsorted(ordered, ordered))


def _described(kept: _Extrema, pyramid: list[Tensor], descriptor: Any, choice: SiftChoice) -> Features:
    """The kept keypoints with angles and descriptors, in all requested slots."""
    lafs, valid = kept.lafs, kept.valid
    lafs = lafs * valid[..., None, None]  # frames of no size are not described
    if choice.up_rad is not None:
        cos, sin = math.cos(choice.up_rad), math.sin(choice.up_rad)
        turn = lafs.new_tensor([[cos, -sin], [sin, cos]])
        lafs = torch.cat([lafs[..., :2] @ turn, lafs[..., 2:]], dim=3)
    lafs, described = descriptor(pyramid, lafs, kept.octave, kept.level, upright=choice.up_rad is not None)
    described = described.unflatten(2, (8, 4, 4)).permute(0, 1, 3, 4, 2).flatten(2)  # cell by cell
    angle_deg = torch.rad2deg(torch.atan2(lafs[..., 1, 0], lafs[..., 0, 0])).remainder(360.0)
    columns = (lafs[..., 2], kept.scale_px * valid, angle_deg * valid, described * valid[..., None])
    missing = choice.max_keypoints - valid.shape[1]
    padded = [torch.nn.functional.pad(c, (0, 0) * (c.ndim - 2) + (0, missing)) for c in (*columns, valid)]
    return Features(*padded)
