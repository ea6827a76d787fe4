"""Local features: a batched SIFT that detects, describes and matches tensors on any torch device.

The detector is Lowe's: extrema of differences of Gaussians over position and scale, refined by a quadratic.
The descriptor is Lowe's 4 x 4 cells of 8 orientations. Where the usual loops run over levels and keypoints, the
work on a GPU is a fixed number of tensor ops, in three modules: :mod:`engine.sift.scale_space`,
:mod:`engine.sift.keypoints`, :mod:`engine.sift.descriptors`. On a CPU :mod:`engine.sift.loops` finds the same.

Convention:
    Points are (x, y) with pixel centres at integers and the origin at the centre of the top-left pixel.
    Angles turn from +x towards +y, which is clockwise on the screen. ``scale_px`` is Lowe's: the sigma of the
    finer of the two Gaussians whose difference is extremal; a Gaussian blob of sigma b gives about b / 2^(1/6).

References:
    Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004,
    https://doi.org/10.1023/B:VISI.0000029664.99615.94.
    Arandjelovic and Zisserman, Three things everyone should know to improve object retrieval, CVPR 2012,
    https://doi.org/10.1109/CVPR.2012.6248018 (RootSIFT).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.errors import DtypeError, OptionError, ShapeError
from engine.runtime.tensors import Tensor, torch
from engine.runtime.threads import in_parallel
from engine.sift.descriptors import describe, dominant_angle
from engine.sift.keypoints import Points, find_points, strongest
from engine.sift.matching import match
from engine.sift.scale_space import band, gaussian_levels, make_plan, octaves_of
from engine.sift.values import Features, Matches

Floats = NDArray[np.float32]
_FARTHEST = 1e6  # of a pixel's value
_MAX_SPREAD = 1000
__all__ = ["Features", "Matches", "match", "plans_created", "prepare_plans", "sift"]


def sift(
    images: Tensor,
    *,
    max_keypoints: int = 300,
    upright: bool = False,
    up_deg: float = 0.0,
    mask: Tensor | None = None,
    upsample: int = 2,
    contrast_threshold: float = 0.02,
    root: bool = True,
    spread: int = 6,
) -> Features:
    """Detect and describe at most ``max_keypoints`` SIFT features per image, spread over the image.

    Args:
        images: (B, 1, H, W) floating point, values in [0, 1].
        max_keypoints: Number of slots N.
        upright: Use ``up_deg`` as every angle instead of the dominant gradient's; faster, for a known heading.
        up_deg: From +x towards +y; that of two pictures must differ by the rotation between them.
        mask: (B, 1, H, W) bool, True where keypoints are allowed.
        upsample: Samples per image pixel of the first octave: 1, or 2. The scales are the same.
        contrast_threshold: Lowe's, as OpenCV counts it: a keypoint's DoG is at least a third of it.
        root: Return RootSIFT (square roots of the L1-normalised descriptor), also of unit L2 norm.
        spread: Cells along each side of the image; keypoints beyond a cell's double share rank after all others. 1
            ranks by strength alone, which is contrast times the root of scale.

    Returns:
        Features on the images' device; no value is NaN.

    Raises:
        ShapeError: The images or the mask have another shape.
        DtypeError: The images are not floating point, or the mask is not bool.
        OptionError: An option is out of range.
    """
    _check_images(images, mask)
    _check_options(max_keypoints, up_deg, upsample, contrast_threshold, spread)
    up_rad = math.radians(up_deg) if upright else None
    options = _SiftOptions(max_keypoints, up_rad, int(upsample), contrast_threshold, root, spread)
    # Sums of what is not near [0, 1] may overflow, and the loops index by them.
    pictures = images[:, 0].float().nan_to_num(0.0, 1.0, 0.0).clamp(-_FARTHEST, _FARTHEST)
    return (_by_loops if images.device.type == "cpu" else _by_tensors)(pictures, mask, options)


@dataclass(frozen=True, slots=True)
class _SiftOptions:
    """Options of :func:`sift`; ``up_rad`` is the angle of upright features, None the dominant gradient's."""

    max_keypoints: int
    up_rad: float | None
    upsample: int
    contrast_threshold: float
    root: bool
    spread: int


def _by_loops(images: Tensor, mask: Tensor | None, options: _SiftOptions) -> Features:
    """Features of images (B, H, W) on the CPU, one at a time: its scale space fits into the CPU's cache."""
    slots = [
        np.zeros((len(images), options.max_keypoints, *shape), np.float32) for shape in ((2,), (), (), (128,))
    ]
    valid = np.zeros((len(images), options.max_keypoints), np.bool_)
    pictures, allowed = images.detach().contiguous().numpy(), None if mask is None else mask.numpy()

    def work(image: int) -> None:
        found = _of_picture(pictures[image], None if allowed is None else allowed[image, 0], options)
        valid[image, : len(found[0])] = True
        for slot, values in zip(slots, found, strict=True):
            slot[image, : len(values)] = values

    in_parallel(work, range(len(images)))
    return Features(*map(torch.from_numpy, (*slots, valid)))


def _of_picture(image: Floats, mask: NDArray[np.bool_] | None, options: _SiftOptions) -> tuple[Floats, ...]:
    """Positions, scales, angles in degrees and descriptors of the keypoints of one picture (H, W)."""
    from engine.sift import loops  # numba takes a while to import

    plan = loops.plan_loops(*image.shape, options.upsample)
    gaussians, keypoints = loops.detect(image, plan, options.contrast_threshold)
    keypoints = loops.strongest(keypoints, plan, mask, options.max_keypoints, options.spread)
    if options.up_rad is None:
        angle_rad = loops.dominant_angle(gaussians, keypoints, plan)
    else:
        angle_rad = np.full(len(keypoints), options.up_rad, np.float32)
    descriptors = loops.describe(gaussians, keypoints, angle_rad, plan, root=options.root)
    angle_deg = np.remainder(np.rad2deg(angle_rad), np.float32(360))
    return loops.xy_px(keypoints, plan), loops.scale_px(keypoints), angle_deg, descriptors


def _by_tensors(images: Tensor, mask: Tensor | None, options: _SiftOptions) -> Features:
    """Features of images (B, H, W) in one scale space, in tensor ops whose number and shapes are fixed."""
    plan = make_plan(images.shape[1], images.shape[2], len(images), options.upsample, images.device)
    with torch.inference_mode():
        gaussians = gaussian_levels(images, plan)
        points = find_points(gaussians, plan, options.contrast_threshold)
        if mask is not None:
            points = points.within(mask)
        index, filled = strongest(points, plan, len(images), options.max_keypoints, options.spread)
        points = points.take(index)  # empty slots are described too: how many there are is not known to the host
        if options.up_rad is None:
            angle = dominant_angle(gaussians, points, plan)
        else:
            angle = torch.full_like(points.x, options.up_rad)
        descriptors = describe(gaussians, points, angle, plan, root=options.root)
        return _to_slots(points, angle, descriptors, filled, len(images))


def prepare_plans(sides_px: Iterable[int], device: torch.device) -> None:
    """Compute the filters of pictures whose sides are among these, so that none is computed in flight.

    Args:
        sides_px: of the pictures.
        device: where they will be.
    """
    from engine.sift import loops  # numba takes a while to import

    for side_px, upsample in itertools.product(sides_px, (1, 2)):
        for octave in octaves_of(side_px, side_px, 1, upsample):
            if device.type == "cpu":
                loops.filters_of(octave, octave.source[0])
            else:
                band(octave.source[0], octave.sigmas, octave.up, device)


def plans_created() -> int:
    """Number of filters computed so far, by length of a picture's side; a flight of one camera needs a few."""
    from engine.sift import loops  # numba takes a while to import

    return loops.filters.cache_info().misses + band.cache_info().misses


def _check_images(images: Tensor, mask: Tensor | None) -> None:
    if images.ndim != 4 or images.shape[1] != 1 or 0 in images.shape:
        raise ShapeError(f"images: expected (B, 1, H, W), got {tuple(images.shape)}")
    if not images.is_floating_point():
        raise DtypeError(f"images: expected floating point, got {images.dtype}")
    if mask is not None and mask.shape != images.shape:
        raise ShapeError(f"mask: expected {tuple(images.shape)} as the images, got {tuple(mask.shape)}")
    if mask is not None and mask.dtype != torch.bool:
        raise DtypeError(f"mask: expected bool, got {mask.dtype}")


def _check_options(
    max_keypoints: int, up_deg: float, upsample: int, contrast_threshold: float, spread: int
) -> None:
    if max_keypoints < 1:
        raise OptionError(f"max_keypoints: expected at least 1, got {max_keypoints}")
    if not math.isfinite(up_deg):
        raise OptionError(f"up_deg: expected a finite number, got {up_deg}")
    if upsample not in (1, 2):
        raise OptionError(f"upsample: expected 1 or 2, got {upsample}")
    if not contrast_threshold >= 0:
        raise OptionError(f"contrast_threshold: expected a number from 0 up, got {contrast_threshold}")
    if not 1 <= spread <= _MAX_SPREAD:
        raise OptionError(f"spread: expected 1 to {_MAX_SPREAD}, got {spread}")


def _to_slots(points: Points, angle: Tensor, descriptors: Tensor, filled: Tensor, batch: int) -> Features:
    """Columns of all slots as (B, N), zero where they are empty."""

    def slots(values: Tensor) -> Tensor:
        out = torch.where(filled.view(-1, *[1] * (values.ndim - 1)), values, 0)
        return out.view(batch, -1, *values.shape[1:])

    degrees = torch.rad2deg(angle).remainder(360)
    xy_px, scale_px, angle_deg, described = map(slots, (points.xy_px, points.scale_px, degrees, descriptors))
    return Features(xy_px, scale_px, angle_deg, described, filled.view(batch, -1))
