"""Keypoints: extrema of differences of Gaussians over position and scale, and the selection of the strongest.

An extremum is refined by a quadratic; those of low contrast or along an edge are dropped (Lowe's tests).
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from engine.runtime.tensors import Tensor, torch
from engine.sift.scale_space import FIRST_SIGMA_PX, SCALES, Octave, ScaleSpacePlan

BORDER = 4  # octave pixels along the edge without keypoints
EDGE_RATIO = 10.0
EARLY = 0.8  # share of the contrast threshold that a voxel must reach before it is refined
MOVES = 2  # times that a keypoint may move to a neighbouring voxel
# Extrema that tensor ops have room for in an octave: one to so many of its pixels, to four times as many where the
# picture is doubled, and at least so many. Photographs have half as many or fewer; else the coarsest are left out.
_PX_PER_EXTREMUM = 16
_MIN_EXTREMA = 256
MAX_SHIFT = 0.7  # distance from the last voxel, in voxels, beyond which a refinement has not converged


@dataclass(frozen=True, slots=True)
class Points:
    """M keypoints in the pixels of their octave, (M,) each."""

    octave: Tensor  # int64, as image and level
    image: Tensor
    level: Tensor
    x: Tensor
    y: Tensor
    growth: Tensor  # sigma over the sigma of the octave's first level
    contrast: Tensor
    pixel_px: Tensor  # image pixels per octave pixel
    valid: Tensor  # bool; those of tensor ops are fixed in number, and not all of them are keypoints

    def take(self, index: Tensor) -> "Points":
        """Select points.

        Args:
            index: (K,) int64.

        Returns:
            K points.
        """
        fields = (self.octave, self.image, self.level, self.x, self.y, self.growth, self.contrast, self.pixel_px)
        return Points(*(field[index] for field in (*fields, self.valid)))

    def within(self, mask: Tensor) -> "Points":
        """Keep as valid those whose nearest pixel is allowed.

        Args:
            mask: (B, 1, H, W) bool.

        Returns:
            As many points.
        """
        x = (self.x * self.pixel_px).round().long().clamp_(0, mask.shape[3] - 1)
        y = (self.y * self.pixel_px).round().long().clamp_(0, mask.shape[2] - 1)
        return replace(self, valid=self.valid & mask[self.image, 0, y, x])

    @property
    def xy_px(self) -> Tensor:
        """Positions (M, 2) in pixels of the image."""
        return torch.stack([self.x, self.y], dim=1) * self.pixel_px[:, None]

    @property
    def scale_px(self) -> Tensor:
        """Sigmas (M,) in pixels of the image."""
        return FIRST_SIGMA_PX * self.growth * torch.exp2(self.octave.float())


def find_points(gaussians: Tensor, plan: ScaleSpacePlan, contrast_threshold: float) -> Points:
    """Find and refine the points of all octaves in their Gaussian levels, as tensor ops of fixed shapes.

    Args:
        gaussians: (N,) float32 from :func:`engine.sift.scale_space.gaussian_levels`.
        plan: of these levels.
        contrast_threshold: Lowe's.

    Returns:
        As many points as the plan has room for; valid are those that pass the tests of contrast and edges.
    """
    threshold = contrast_threshold / SCALES
    found = [_extrema(gaussians, octave, plan.upsample, EARLY * threshold) for octave in plan.octaves]
    number = torch.cat([torch.full_like(f[:, 0], n) for n, f in enumerate(found)])
    level, y, image, x = torch.cat(found).unbind(1)
    is_found = level >= 0
    level, y, x, image = level.clamp_min(0) + 1, y + BORDER, x + BORDER, image.clamp_min(0)
    for last in (False,) * MOVES + (True,):
        value, gradient, hessian, shift = _fit_quadratic(gaussians, plan, number, level, image, y, x)
        if not last:
            step = torch.where(shift.abs() > 0.5, shift.sign(), 0.0).long().unbind(1)
            x = (x + step[0]).clamp_min_(1).minimum(plan.table[number, 1] - 2)
            y = (y + step[1]).clamp_min_(1).minimum(plan.table[number, 0] - 2)
            level = (level + step[2]).clamp_(1, SCALES)
    contrast = (value + 0.5 * (gradient * shift).sum(1)).abs()
    xx, yy, _, xy, _, _ = hessian.unbind(1)
    trace, determinant = xx + yy, xx * yy - xy * xy
    keep = (contrast >= threshold) & (shift.abs().amax(1) < MAX_SHIFT)
    keep &= is_found & (determinant > 0) & (trace * trace * EDGE_RATIO < (EDGE_RATIO + 1) ** 2 * determinant)
    shift = torch.where(keep[:, None], shift, 0.0)  # what is no keypoint still lies in its octave
    growth = torch.exp2((level + shift[:, 2]) / SCALES)
    pixel = torch.exp2(number.float()) / plan.upsample
    return Points(number, image, level, x + shift[:, 0], y + shift[:, 1], growth, contrast, pixel, keep)


def _extrema(gaussians: Tensor, octave: Octave, upsample: int, threshold: float) -> Tensor:
    """Return (M, 4) level, y, image, x where |DoG| is the largest of its 3 x 3 x 3 and above the threshold.

    They count from the first level and the first pixel that are searched. M is fixed; rows left over are -1.
    """
    edge = BORDER - 1
    levels = octave.levels(gaussians)[:, edge : octave.height - edge, :, edge : octave.width - edge]
    if levels.shape[1] < 3 or levels.shape[3] < 3:
        return torch.full((1, 4), -1, device=gaussians.device)
    size = (levels[1:] - levels[:-1]).abs_()
    top = torch.maximum(torch.maximum(size[:-2], size[1:-1]), size[2:])
    top = torch.maximum(torch.maximum(top[:, :-2], top[:, 1:-1]), top[:, 2:])
    top = torch.maximum(torch.maximum(top[..., :-2], top[..., 1:-1]), top[..., 2:]).clamp_min_(threshold)
    room = octave.height * octave.width // (_PX_PER_EXTREMUM * upsample**2)
    is_top = size[1:-1, 1:-1, :, 1:-1] >= top
    return is_top.nonzero_static(size=octave.shape[2] * max(room, _MIN_EXTREMA), fill_value=-1)


def _fit_quadratic(
    gaussians: Tensor, plan: ScaleSpacePlan, number: Tensor, level: Tensor, image: Tensor, y: Tensor, x: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Fit D(p) = D + g p + p H p / 2 at voxels: D (M,), g (M, 3), H as (M, 6), and the extremum -H^-1 g (M, 3)."""
    stencil, neighbours = _quadratic(gaussians.device)
    _, _, offset, per_level, per_row, per_image = plan.table[number].unbind(1)
    centre = offset + level * per_level + y * per_row + image * per_image + x
    s, v, u = neighbours.unbind(1)
    centre, per_level, per_row = (t.to(plan.index)[:, None] for t in (centre, per_level, per_row))
    index = centre + s * per_level + v * per_row + u
    voxels = gaussians.index_select(0, index.flatten()).view(-1, 4, 9)
    cube = (voxels[:, 1:] - voxels[:, :-1]).view(-1, 27)
    fit = cube @ stencil
    gradient, hessian = fit[:, :3], fit[:, 3:]
    xx, yy, ss, xy, xs, ys = hessian.unbind(1)
    rows = torch.stack([xx, xy, xs, xy, yy, ys, xs, ys, ss], dim=1).view(-1, 3, 3)
    adjugate = torch.linalg.cross(rows.roll(-1, 1), rows.roll(-2, 1))
    determinant = (rows[:, 0] * adjugate[:, 0]).sum(1, keepdim=True)
    shift = -(gradient[:, None, :] @ adjugate)[:, 0] / torch.where(determinant == 0, 1e-30, determinant)
    return cube[:, 13], gradient, hessian, shift.clamp(-9, 9)


@lru_cache(maxsize=8)
def _quadratic(where: torch.device) -> tuple[Tensor, Tensor]:
    """Return (27, 9), Lowe's differences for x, y, s, xx, yy, ss, xy, xs, ys of the neighbours (s, y, x) of a DoG.

    And (36, 3) int32, the Gaussians (s, y, x) that they are differences of: one level more.
    """
    gaussians = np.stack(np.meshgrid([-1, 0, 1, 2], [-1, 0, 1], [-1, 0, 1], indexing="ij"), -1).reshape(36, 3)
    s, y, x = gaussians[:27].T

    def first(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.asarray(a / 2 * (b == 0) * (c == 0))

    def second(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.asarray(np.where(a == 0, -2.0, 1.0) * (b == 0) * (c == 0))

    def cross(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.asarray(a * b / 4 * (c == 0))

    columns = [first(x, y, s), first(y, s, x), first(s, x, y), second(x, y, s), second(y, s, x), second(s, x, y)]
    columns += [cross(x, y, s), cross(x, s, y), cross(y, s, x)]
    stencil = torch.from_numpy(np.stack(columns, 1).astype(np.float32)).to(where)
    return stencil, torch.from_numpy(gaussians.astype(np.int32)).to(where)


def strongest(
    points: Points, plan: ScaleSpacePlan, batch: int, max_keypoints: int, spread: int
) -> tuple[Tensor, Tensor]:
    """Return the points to keep, in slots by image and then by precedence.

    Strength is contrast times the root of scale, since of two keypoints of equal contrast the coarser is detected
    more reliably.

    Args:
        points: M keypoints.
        plan: of their images.
        batch: number of images.
        max_keypoints: slots per image.
        spread: cells along each side of the image; keypoints beyond a cell's double share come last.

    Returns:
        Indices of the points (batch * max_keypoints,) int64, and whether the slot has one, bool.
    """
    strength = torch.where(points.valid, points.contrast * points.scale_px.sqrt(), -1.0)
    order = strength.argsort(descending=True, stable=True)  # the invalid are last, and no other's rank counts them
    octave = plan.octaves[0]
    image, valid = points.image[order], points.valid[order]
    x = (points.x * points.pixel_px)[order] * (plan.upsample * spread / octave.width)
    y = (points.y * points.pixel_px)[order] * (plan.upsample * spread / octave.height)
    cell = (image * spread + y.long().clamp_(0, spread - 1)) * spread + x.long().clamp_(0, spread - 1)
    share = 2 * max_keypoints / spread**2
    crowded = rank(cell) >= share if spread > 1 else torch.zeros_like(image, dtype=torch.bool)
    precedence = (image * 3 + torch.where(valid, crowded.long(), 2)).argsort(stable=True)
    order, image, valid = order[precedence], image[precedence], valid[precedence]
    place = rank(image)
    slots = batch * max_keypoints
    slot = torch.where(valid & (place < max_keypoints), image * max_keypoints + place, slots)
    index = order.new_zeros(slots + 1).scatter_(0, slot, order)[:slots]
    return index, valid.new_zeros(slots + 1).scatter_(0, slot, True)[:slots]


def rank(group: Tensor) -> Tensor:
    """Return for each element how many before it are of the same group.

    Args:
        group: (M,) int64.

    Returns:
        (M,) int64 from 0.
    """
    order = group.argsort(stable=True)
    ordered = group[order]
    index = torch.arange(group.numel(), device=group.device)
    return torch.empty_like(group).scatter_(0, order, index - torch.searchsorted(ordered, ordered))
