"""Descriptors: the dominant angle of a keypoint and Lowe's 4 x 4 cells of 8 orientations around it.

The number of tensor ops is fixed, however many keypoints there are: a rotated grid is sampled around each, its
spatial pooling is one matmul, and the split of a gradient between its two neighbouring orientations needs no arc
tangent (:func:`_orient`).
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from engine.runtime.tensors import Tensor, torch
from engine.sift.keypoints import Points
from engine.sift.scale_space import ScaleSpacePlan

Floats = NDArray[np.float32]

_ANGLE_BINS = 36
_ORIENT_SAMPLES = 13  # per side, 0.75 sigma apart: Lowe's window of 4.5 sigma
ORIENT_STEP = 0.75
_CELLS = 4
CELL_SIGMAS = 3.0
CELL_SAMPLES = 3
_DESC_SAMPLES = 12


def _sample(gaussians: Tensor, points: Points, plan: ScaleSpacePlan, x: Tensor, y: Tensor) -> Tensor:
    """Return the points' Gaussian levels at x, y (P, S) in octave pixels, bilinear, edges extended."""
    height, width, offset, per_level, per_row, per_image = plan.table[points.octave].unbind(1)
    base = (offset + points.level * per_level + points.image * per_image).to(plan.index)[:, None]
    height, width, per_row = height[:, None], width[:, None], per_row.to(plan.index)[:, None]
    x = torch.minimum(x.clamp_min(0), (width - 1).float() - 1e-3)
    y = torch.minimum(y.clamp_min(0), (height - 1).float() - 1e-3)
    left, top = x.floor(), y.floor()
    fx, fy = x - left, y - top
    corner = top.to(plan.index) * per_row + left.to(plan.index) + base
    a, b, c, d = (
        gaussians.index_select(0, at.flatten()).view_as(x)
        for at in (corner, corner + 1, corner + per_row, corner + per_row + 1)
    )
    upper = torch.lerp(a, b, fx)
    return torch.lerp(upper, torch.lerp(c, d, fx), fy)


def _gradients(
    gaussians: Tensor, points: Points, plan: ScaleSpacePlan, angle: Tensor | None, samples: int, step: float
) -> tuple[Tensor, Tensor]:
    """Return gx, gy (P, samples^2) on a grid around each point, in the point's frame turned by angle."""
    ramp = torch.arange(samples + 2, device=gaussians.device) - 0.5 * (samples + 1)
    v, u = (g.flatten() for g in torch.meshgrid(ramp, ramp, indexing="ij"))
    sigma = (plan.first_sigma * step * points.growth)[:, None]
    if angle is None:
        x, y = points.x[:, None] + sigma * u, points.y[:, None] + sigma * v
    else:
        cos, sin = sigma * angle.cos()[:, None], sigma * angle.sin()[:, None]
        x = points.x[:, None] + cos * u - sin * v
        y = points.y[:, None] + sin * u + cos * v
    patch = _sample(gaussians, points, plan, x, y).unflatten(1, (samples + 2, samples + 2))
    gx = patch[:, 1:-1, 2:] - patch[:, 1:-1, :-2]
    gy = patch[:, 2:, 1:-1] - patch[:, :-2, 1:-1]
    return gx.flatten(1), gy.flatten(1)


def dominant_angle(gaussians: Tensor, points: Points, plan: ScaleSpacePlan) -> Tensor:
    """Return the direction of the highest peak in the histogram of gradient directions.

    Args:
        gaussians: (N,) float32 levels.
        points: M keypoints.
        plan: of the levels.

    Returns:
        (M,) radians from +x towards +y.
    """
    gx, gy = _gradients(gaussians, points, plan, None, _ORIENT_SAMPLES, ORIENT_STEP)
    window, smooth = _orientation_weights(gaussians.device)
    bins = (torch.atan2(gy, gx) * (_ANGLE_BINS / math.tau)).round_().long()
    bins = torch.where(bins < 0, bins + _ANGLE_BINS, bins)
    histogram = gx.new_zeros(len(gx), _ANGLE_BINS).scatter_add_(1, bins, torch.hypot(gx, gy) * window) @ smooth
    peak = histogram.argmax(1, keepdim=True)
    left, top, right = (histogram.gather(1, (peak + k).remainder(_ANGLE_BINS)) for k in (-1, 0, 1))
    offset = 0.5 * (left - right) / (left - 2 * top + right).clamp_max(-1e-12)
    return ((peak + offset) * (math.tau / _ANGLE_BINS))[:, 0]


@lru_cache(maxsize=1)
def orientation_weights() -> tuple[Floats, Floats]:
    """Return the window (S, S) of sigma 1.5 keypoint sigmas, and the (36, 36) circular smoothing 1 4 6 4 1."""
    ramp = (np.arange(_ORIENT_SAMPLES) - (_ORIENT_SAMPLES - 1) / 2) * ORIENT_STEP
    window = np.exp(-0.5 * (ramp[:, None] ** 2 + ramp**2) / 1.5**2)
    taps = zip((-2, -1, 0, 1, 2), (1, 4, 6, 4, 1), strict=True)
    smooth = sum(weight / 16 * np.roll(np.eye(_ANGLE_BINS), shift, 1) for shift, weight in taps)
    return window.astype(np.float32), np.asarray(smooth, np.float32)


@lru_cache(maxsize=8)
def _orientation_weights(where: torch.device) -> tuple[Tensor, Tensor]:
    window, smooth = (torch.from_numpy(weights).to(where) for weights in orientation_weights())
    return window.flatten(), smooth


def describe(gaussians: Tensor, points: Points, angle: Tensor, plan: ScaleSpacePlan, *, root: bool) -> Tensor:
    """Return descriptors: 4 x 4 cells of 8 orientations in the keypoint's frame.

    Args:
        gaussians: (N,) float32 levels.
        points: M keypoints.
        angle: (M,) radians from +x towards +y.
        plan: of the levels.
        root: return RootSIFT.

    Returns:
        (M, 128) of unit L2 norm.
    """
    step = CELL_SIGMAS / CELL_SAMPLES
    gx, gy = _gradients(gaussians, points, plan, angle, _DESC_SAMPLES, step)
    pooled = _orient(gx, gy) @ _pooling(gaussians.device)  # (8, P, 16)
    return normalise(pooled.permute(1, 2, 0).flatten(1), root=root)


def _orient(gx: Tensor, gy: Tensor) -> Tensor:
    """Split gradients between their two neighbouring of 8 directions, (8, ...).

    A vector in the sector of e_k and e_(k+1), 45 degrees apart, is a e_k + b e_(k+1) with a, b >= 0. The weight
    a is (g x e_(k+1)) / sin 45, b of the next sector (e_(k-1) x g) / sin 45, and the smaller of the two is
    positive in e_k's two sectors only. As e_j x g = <g, e_(j+2)>, with p_j = <g, e_j> up to a factor:
    w_k = max(0, min(p_(k-1), p_(k+1))).
    """
    half = math.sqrt(0.5)
    diagonal, anti = half * (gx + gy), half * (gy - gx)
    p = torch.stack([gx, diagonal, gy, anti, -gx, -diagonal, -gy, -anti])
    return torch.minimum(p.roll(1, 0), p.roll(-1, 0)).clamp_min_(0)


@lru_cache(maxsize=8)
def _pooling(where: torch.device) -> Tensor:
    """Return (S, 16): bilinear weights of the samples in the cells, times a Gaussian of half the width."""
    weights = np.einsum("ry,cx->yxrc", tents(), tents()).reshape(_DESC_SAMPLES**2, _CELLS**2)
    return torch.from_numpy(weights).to(where)


@lru_cache(maxsize=1)
def tents() -> Floats:
    """Return (cells, samples) float32: the weights of :func:`_pooling` along one axis."""
    ramp = (np.arange(_DESC_SAMPLES) - (_DESC_SAMPLES - 1) / 2) / CELL_SAMPLES
    centres = np.arange(_CELLS) - (_CELLS - 1) / 2
    weights = np.maximum(0, 1 - np.abs(ramp - centres[:, None])) * np.exp(-0.5 * (ramp / (_CELLS / 2)) ** 2)
    return np.asarray(weights, np.float32)


def normalise(descriptors: Tensor, *, root: bool) -> Tensor:
    """Return unit vectors, entries bounded by 0.2 before the last normalisation (Lowe).

    Args:
        descriptors: (..., 128) not negative.
        root: return RootSIFT, the square roots of the L1-normalised vectors.

    Returns:
        (..., 128) of unit L2 norm.
    """
    unit = torch.nn.functional.normalize(descriptors, dim=-1).clamp_max_(0.2)
    if root:
        return torch.nn.functional.normalize(unit, p=1.0, dim=-1).sqrt()
    return torch.nn.functional.normalize(unit, dim=-1)
