"""Local features as tensor ops: a batched SIFT that detects, describes and matches on any torch device.

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

from engine.errors import DtypeError, OptionError, ShapeError, require
from engine.sift import loops
from engine.sift.descriptors import describe, dominant_angle
from engine.sift.keypoints import Points, find_points, strongest
from engine.sift.scale_space import band, gaussian_levels, make_plan
from engine.tensors import Tensor, torch
from engine.threads import in_parallel

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Features:
    """Keypoints and descriptors of a batch of images, in a fixed number of slots.

    A slot without keypoint is False in ``valid`` and zero elsewhere. The first slots hold the keypoints within
    their cell's share (see :func:`sift`), the next those beyond it, both by falling strength.

    Attributes:
        xy_px: (B, N, 2) positions (x, y), pixel centres at integers.
        scale_px: (B, N) sigma of the keypoint in pixels of the image.
        angle_deg: (B, N) in [0, 360), from +x towards +y (clockwise on the screen).
        descriptors: (B, N, 128) of unit L2 norm; 4 x 4 cells row by row, 8 orientations each.
        valid: (B, N) bool.
    """

    xy_px: Tensor
    scale_px: Tensor
    angle_deg: Tensor
    descriptors: Tensor
    valid: Tensor

    def lafs(self, magnification: float = 6.0) -> Tensor:
        """Return kornia's local affine frames, (B, N, 2, 3).

        Args:
            magnification: Half the side of the described square in sigmas; kornia's SIFT uses 6.

        Returns:
            (B, N, 2, 3) affine matrices.

        Raises:
            MissingExtraError: kornia is not installed.

        Convention:
            The first two columns are the images of the patch's x and y axes, the third is the centre.
            kornia's own angles turn the other way, so ``kornia.feature.get_laf_orientation`` gives -angle_deg.
        """
        kornia_feature = require("kornia.feature", "learned")
        scale = (magnification * self.scale_px)[..., None, None]
        lafs: Tensor = kornia_feature.laf_from_center_scale_ori(self.xy_px, scale, -self.angle_deg[..., None])
        return lafs


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
    _check_options(max_keypoints, upsample, contrast_threshold, spread)
    up_rad = math.radians(up_deg) if upright else None
    options = _SiftOptions(max_keypoints, up_rad, int(upsample), contrast_threshold, root, spread)
    pictures = images[:, 0].float().nan_to_num(0.0, 1.0, 0.0)
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
    pictures, allowed = images.contiguous().numpy(), None if mask is None else mask.numpy()

    def work(image: int) -> None:
        found = _of_picture(pictures[image], None if allowed is None else allowed[image, 0], options)
        valid[image, : len(found[0])] = True
        for slot, values in zip(slots, found, strict=True):
            slot[image, : len(values)] = values

    in_parallel(work, range(len(images)))
    return Features(*map(torch.from_numpy, (*slots, valid)))


def _of_picture(image: Floats, mask: NDArray[np.bool_] | None, options: _SiftOptions) -> tuple[Floats, ...]:
    """Positions, scales, angles in degrees and descriptors of the keypoints of one picture (H, W)."""
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
    for side_px, upsample in itertools.product(sides_px, (1, 2)):
        if device.type == "cpu":
            loops.plan_loops(side_px, side_px, upsample)
        else:
            make_plan(side_px, side_px, 1, upsample, device).prepare()


def plans_created() -> int:
    """Number of filters computed so far, by length of a picture's side; a flight of one camera needs a few."""
    return loops.filters.cache_info().misses + band.cache_info().misses


def _fields(features: Features) -> tuple[Tensor, ...]:
    return features.xy_px, features.scale_px, features.angle_deg, features.descriptors, features.valid


_TRAIN_CHUNK = 4096  # train slots that are compared at a time, which bounds the memory for a whole map's
_FAR = 1e30
_FORBIDDEN = -2.0  # below every cosine
_ROUNDING = 2e-3  # distance between a descriptor and itself by float32 rounding


@dataclass(frozen=True, slots=True)
class Matches:
    """The nearest train slot of every query slot, and whether the pair passes the tests.

    Attributes:
        train_index: (B, N) int64.
        distance: (B, N) Euclidean distance of the descriptors, in [0, 2]; infinite where none was allowed.
        ratio: (B, N) distance over the second nearest's, in [0, 1]; 0 where there is no second, 1 where both are
            0.
        valid: (B, N) bool.
    """

    train_index: Tensor
    distance: Tensor
    ratio: Tensor
    valid: Tensor

    def pairs(self, element: int = 0) -> Tensor:
        """Return the accepted pairs of one element of the batch.

        Args:
            element: Index in the batch.

        Returns:
            (M, 2) int64 slots (query, train).
        """
        query = self.valid[element].nonzero()[:, 0]
        return torch.stack([query, self.train_index[element, query]], dim=1)


def match(
    query: Features,
    train: Features,
    *,
    ratio: float = 0.8,
    mutual: bool = True,
    rotation_deg: float = 0.0,
    max_angle_diff_deg: float | None = None,
    scale: float = 1.0,
    max_scale_factor: float | None = None,
) -> Matches:
    """Match descriptors by Euclidean distance, with Lowe's ratio test and a mutual test.

    Pairs that contradict the known rotation or scale have an infinite distance, all others sqrt(2 - 2 <q, t>).

    Args:
        query: Features of B images, or of one for all of the train's.
        train: Features of B images, or of one for all of the query's.
        ratio: Upper bound, in (0, 1], on nearest over second nearest distance; 1 accepts all.
        mutual: Require that the query is also the train's nearest.
        rotation_deg: Known angle of a train keypoint less that of its query.
        max_angle_diff_deg: Exclude pairs whose angles differ from ``rotation_deg`` by more.
        scale: Known scale of a train keypoint over that of its query.
        max_scale_factor: Exclude pairs whose scales differ from ``scale`` by more than this factor.

    Returns:
        For each of the N query slots.

    Raises:
        OptionError: The ratio is not in (0, 1].
    """
    _check_ratio(ratio)
    with torch.inference_mode():
        limits = (rotation_deg, max_angle_diff_deg, scale, max_scale_factor)
        first, index, second, is_mutual = _nearest(query, train, limits)
        nearest, next_nearest = _distance(first), _distance(second)
        # Two equal distances give a ratio of 1, also where rounding puts one of them at 0.
        quotient = (nearest.clamp_min(_ROUNDING) / next_nearest.clamp_min(_ROUNDING)).nan_to_num(1.0)
        valid = nearest.isfinite() & (quotient <= ratio)
    return Matches(index, nearest, quotient, valid & is_mutual if mutual else valid)


def _check_ratio(ratio: float) -> None:
    if not 0 < ratio <= 1:
        raise OptionError(f"ratio: expected a number in (0, 1], got {ratio}")


def _nearest(
    query: Features, train: Features, limits: tuple[float, float | None, float, float | None]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """:func:`_two_nearest` over all train slots, by chunks that bound the memory."""
    found = []
    for start in range(0, max(1, train.valid.shape[1]), _TRAIN_CHUNK):
        part = _slots(train, start, start + _TRAIN_CHUNK)
        cosine = query.descriptors @ part.descriptors.mT
        _forbid(cosine, query, part, *limits)
        found.append(_two_nearest(cosine, start))
    return found[0] if len(found) == 1 else _merged(found)


def _distance(cosine: Tensor) -> Tensor:
    """Distance of unit vectors; infinite where the pair was forbidden."""
    return (2 - 2 * cosine).clamp_min_(0).sqrt_().masked_fill_(cosine < _FORBIDDEN, torch.inf)


def _slots(features: Features, start: int, end: int) -> Features:
    """A range of the slots."""
    return Features(*(values[:, start:end] for values in _fields(features)))


def _forbid(
    cosine: Tensor,
    query: Features,
    train: Features,
    rotation_deg: float,
    max_angle_diff_deg: float | None,
    scale: float,
    max_scale_factor: float | None,
) -> None:
    """Lower the cosine (B, N, M) of excluded pairs by a large number, in place; faster than masks."""
    for valid, dim in ((query.valid, 2), (train.valid, 1)):
        if valid.device.type != "cpu" or not bool(valid.all()):
            cosine.sub_((~valid).to(cosine.dtype).unsqueeze(dim), alpha=_FAR)
    if max_angle_diff_deg is not None and max_angle_diff_deg < 180:
        expected, actual = torch.deg2rad(query.angle_deg + rotation_deg), torch.deg2rad(train.angle_deg)
        cos_diff = torch.stack([expected.cos(), expected.sin()], dim=2) @ torch.stack(
            [actual.cos(), actual.sin()], dim=1
        )
        excess = math.cos(math.radians(max_angle_diff_deg)) - cos_diff
        cosine.sub_(excess.clamp_min_(0), alpha=_FAR)
    if max_scale_factor is not None:
        own, other = (query.scale_px * scale).clamp_min(1e-9).log(), train.scale_px.clamp_min(1e-9).log()
        excess = (other[:, None, :] - own[:, :, None]).abs_().sub_(math.log(max_scale_factor))
        cosine.sub_(excess.clamp_min_(0), alpha=_FAR)


def _two_nearest(cosine: Tensor, start: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """For each query (B, N) the largest cosine, its slot, the second largest, and whether it is its slot's best.

    ``cosine`` (B, N, M) is overwritten. Slots count from ``start``.
    """
    if 0 in cosine.shape:
        none = cosine.new_full(cosine.shape[:2], -torch.inf)
        return none, torch.zeros_like(none, dtype=torch.int64), none, none > 0
    index = _argmax(cosine)[:, :, None]
    first = cosine.gather(2, index)
    is_mutual = first[:, :, 0] == cosine.amax(dim=1).gather(1, index[:, :, 0])
    second = cosine.scatter_(2, index, -torch.inf).amax(dim=2)
    return first[:, :, 0], index[:, :, 0] + start, second, is_mutual


def _argmax(values: Tensor) -> Tensor:
    """``values.argmax(2)``; on a CPU by numpy, which is ten times as fast."""
    if values.device.type == "cpu":
        return torch.from_numpy(values.numpy().argmax(2))
    return values.argmax(2)


def _merged(found: list[tuple[Tensor, Tensor, Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The nearest over all chunks, and the second nearest: of the same chunk or the nearest of another."""
    first, index, second, is_mutual = (torch.stack(values) for values in zip(*found, strict=True))
    best = first.argmax(dim=0, keepdim=True)
    others = first.scatter(0, best, second.gather(0, best))
    return first.gather(0, best)[0], index.gather(0, best)[0], others.amax(dim=0), is_mutual.gather(0, best)[0]


def _check_images(images: Tensor, mask: Tensor | None) -> None:
    if images.ndim != 4 or images.shape[1] != 1 or 0 in images.shape:
        raise ShapeError(f"images: expected (B, 1, H, W), got {tuple(images.shape)}")
    if not images.is_floating_point():
        raise DtypeError(f"images: expected floating point, got {images.dtype}")
    if mask is not None and mask.shape != images.shape:
        raise ShapeError(f"mask: expected {tuple(images.shape)} as the images, got {tuple(mask.shape)}")
    if mask is not None and mask.dtype != torch.bool:
        raise DtypeError(f"mask: expected bool, got {mask.dtype}")


def _check_options(max_keypoints: int, upsample: int, contrast_threshold: float, spread: int) -> None:
    if max_keypoints < 1:
        raise OptionError(f"max_keypoints: expected at least 1, got {max_keypoints}")
    if upsample not in (1, 2):
        raise OptionError(f"upsample: expected 1 or 2, got {upsample}")
    if not contrast_threshold >= 0:
        raise OptionError(f"contrast_threshold: expected a number from 0 up, got {contrast_threshold}")
    if spread < 1:
        raise OptionError(f"spread: expected at least 1, got {spread}")


def _to_slots(points: Points, angle: Tensor, descriptors: Tensor, filled: Tensor, batch: int) -> Features:
    """Columns of all slots as (B, N), zero where they are empty."""

    def slots(values: Tensor) -> Tensor:
        out = torch.where(filled.view(-1, *[1] * (values.ndim - 1)), values, 0)
        return out.view(batch, -1, *values.shape[1:])

    degrees = torch.rad2deg(angle).remainder(360)
    xy_px, scale_px, angle_deg, described = map(slots, (points.xy_px, points.scale_px, degrees, descriptors))
    return Features(xy_px, scale_px, angle_deg, described, filled.view(batch, -1))
