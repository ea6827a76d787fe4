"""Match descriptors by distance: Lowe's ratio test, a mutual test, and limits on rotation and scale."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError
from engine.runtime.tensors import Tensor, torch
from engine.sift.values import Features, Matches

Floats = NDArray[np.float32]

_TRAIN_CHUNK = 4096  # train slots compared at a time, to bound memory for a whole map
_FAR = 1e30
_FORBIDDEN = -2.0  # below every cosine
_ROUNDING = 2e-3  # distance between a descriptor and itself by float32 rounding


def match(
    query: Features,
    train: Features,
    *,
    ratio: float = 0.8,
    rotation_deg: float = 0.0,
    max_angle_diff_deg: float | None = None,
    scale: float = 1.0,
    max_scale_factor: float | None = None,
) -> Matches:
    """Match descriptors by Euclidean distance, with Lowe's ratio test; each must be the other's nearest.

    Pairs that contradict the known rotation or scale have an infinite distance, all others sqrt(2 - 2 <q, t>).

    Args:
        query: Features of B images, or of one for all of the train's.
        train: Features of B images, or of one for all of the query's.
        ratio: Upper bound, in (0, 1], on nearest over second nearest distance; 1 accepts all.
        rotation_deg: Known angle of a train keypoint less that of its query.
        max_angle_diff_deg: Exclude pairs whose angles differ from ``rotation_deg`` by more.
        scale: Known scale of a train keypoint over that of its query.
        max_scale_factor: Exclude pairs whose scales differ from ``scale`` by more than this factor.

    Returns:
        For each of the N query slots.

    Raises:
        OptionError: The ratio is not in (0, 1].
    """
    if not 0 < ratio <= 1:
        raise OptionError(f"ratio: expected a number in (0, 1], got {ratio}")
    limits = (rotation_deg, max_angle_diff_deg, scale, max_scale_factor)
    two_nearest = _nearest_by_loops if query.descriptors.device.type == "cpu" else _nearest_by_tensors
    with torch.inference_mode():
        first, index, second, is_mutual = two_nearest(query, train, limits)
        nearest, next_nearest = _distance(first), _distance(second)
        # Two equal distances give a ratio of 1, even if rounding makes one of them 0.
        quotient = (nearest.clamp_min(_ROUNDING) / next_nearest.clamp_min(_ROUNDING)).nan_to_num(1.0)
        valid = nearest.isfinite() & (quotient <= ratio) & is_mutual
    return Matches(index, nearest, quotient, valid)


def _distance(cosine: Tensor) -> Tensor:
    """Distance of unit vectors; infinite for a forbidden pair."""
    return (2 - 2 * cosine).clamp_min_(0).sqrt_().masked_fill_(cosine < _FORBIDDEN, torch.inf)


_Limits = tuple[float, float | None, float, float | None]  # rotation and its largest error, scale and its factor
# For each query (B, N) the largest cosine, its slot, the second largest, and whether it is the slot's best.
_Nearest = tuple[Tensor, Tensor, Tensor, Tensor]


# -------------------------------------------------------------------------------------------------- tensor ops


def _nearest_by_tensors(query: Features, train: Features, limits: _Limits) -> _Nearest:
    """:func:`_two_nearest` over all train slots, by chunks that bound the memory."""
    found = []
    for start in range(0, max(1, train.valid.shape[1]), _TRAIN_CHUNK):
        first, index, second, is_mutual = _two_nearest(query, _slots(train, start, start + _TRAIN_CHUNK), limits)
        found.append((first, index + start, second, is_mutual))
    return found[0] if len(found) == 1 else _merged(found)


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


def _two_nearest(query: Features, train: Features, limits: _Limits) -> _Nearest:
    cosine = query.descriptors @ train.descriptors.mT
    _forbid(cosine, query, train, *limits)
    if 0 in cosine.shape:
        none = cosine.new_full(cosine.shape[:2], -torch.inf)
        return none, torch.zeros_like(none, dtype=torch.int64), none, none > 0
    index = cosine.argmax(2)[:, :, None]
    first = cosine.gather(2, index)
    is_mutual = first[:, :, 0] == cosine.amax(dim=1).gather(1, index[:, :, 0])
    second = cosine.scatter_(2, index, -torch.inf).amax(dim=2)
    return first[:, :, 0], index[:, :, 0], second, is_mutual


def _merged(found: list[_Nearest]) -> _Nearest:
    """The nearest over all chunks, and the second nearest: of the same chunk or the nearest of another."""
    first, index, second, is_mutual = (torch.stack(values) for values in zip(*found, strict=True))
    best = first.argmax(dim=0, keepdim=True)
    others = first.scatter(0, best, second.gather(0, best))
    return first.gather(0, best)[0], index.gather(0, best)[0], others.amax(dim=0), is_mutual.gather(0, best)[0]


# -------------------------------------------------------------------------------------------------------- loops


def _nearest_by_loops(query: Features, train: Features, limits: _Limits) -> _Nearest:
    """The same on the CPU: a matrix product by torch, and one pass over it."""
    from engine.kernels import nearest  # numba takes a while to import

    rotation_deg, max_angle_diff_deg, scale, max_scale_factor = limits
    count, slots = max(len(query.valid), len(train.valid)), query.valid.shape[1]
    first, second = np.full((2, count, slots), -np.inf, np.float32)
    index, is_mutual = np.zeros((count, slots), np.int64), np.zeros((count, slots), np.bool_)
    least_cos = -2.0 if max_angle_diff_deg is None else math.cos(math.radians(min(max_angle_diff_deg, 180.0)))
    most_log = np.float32(math.inf if max_scale_factor is None else math.log(max_scale_factor))
    own = _angles_and_scales(query, rotation_deg, scale, max_scale_factor is not None)
    other = _angles_and_scales(train, 0.0, 1.0, max_scale_factor is not None)
    for n in range(count):
        q, t = min(n, len(query.valid) - 1), min(n, len(train.valid) - 1)
        out = (first[n], index[n], second[n], is_mutual[n])
        for start in range(0, train.valid.shape[1], _TRAIN_CHUNK):
            end = start + _TRAIN_CHUNK
            cosine = torch.mm(train.descriptors[t, start:end], query.descriptors[q].T).float().numpy()
            angles = np.ascontiguousarray(other[:, t, start:end])
            nearest.two_nearest(
                cosine, np.ascontiguousarray(own[:, q]), angles, np.float32(least_cos), most_log, start, *out
            )
    return tuple(map(torch.from_numpy, (first, index, second, is_mutual)))  # type: ignore[return-value]


def _angles_and_scales(features: Features, rotation_deg: float, scale: float, is_limited: bool) -> Floats:
    """(3, B, N) logarithm of scale if used, NaN without a keypoint; cosine and sine of the angle."""
    sizes = features.scale_px.float().numpy() if is_limited else np.ones(features.valid.shape, np.float32)
    angle = np.deg2rad(features.angle_deg.float().numpy() + np.float32(rotation_deg))
    log = np.log(np.where(features.valid.numpy(), np.maximum(sizes * np.float32(scale), 1e-9), np.nan))
    return np.stack([log, np.cos(angle), np.sin(angle)]).astype(np.float32)


def _fields(features: Features) -> tuple[Tensor, ...]:
    return features.xy_px, features.scale_px, features.angle_deg, features.descriptors, features.valid
