"""Match descriptors by distance: Lowe's ratio test, a mutual test, and a limit on scale.

On the host, whatever the device: a frame's descriptors are few, and the map's many are kept there.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError
from engine.runtime.device import as_float, on_host, same_kind_as
from engine.sift.values import Features, Matches

Floats = NDArray[np.float32]

TRAIN_CHUNK = 4096  # train slots compared at a time, to bound memory for a whole map
_ROUNDING = math.sqrt(128 * np.finfo(np.float32).eps)  # most between a descriptor and itself, by rounding
_MAX = float(np.finfo(np.float32).max)


def match(
    query: Features,
    train: Features,
    *,
    ratio: float = 0.8,
    scale: float = 1.0,
    max_scale_factor: float | None = None,
) -> Matches:
    """Match descriptors by Euclidean distance, with Lowe's ratio test; each must be the other's nearest.

    Pairs that contradict the known scale have an infinite distance, all others sqrt(2 - 2 <q, t>).

    Args:
        query: Features of B images, or of one for all of the train's.
        train: Features of B images, or of one for all of the query's.
        ratio: Upper bound, in (0, 1], on nearest over second nearest distance; 1 accepts all.
        scale: Known scale of a train keypoint over that of its query.
        max_scale_factor: Exclude pairs whose scales differ from ``scale`` by more than this factor.

    Returns:
        For each of the N query slots: arrays, or tensors in host memory, as the query's are.

    Raises:
        OptionError: The ratio is not in (0, 1].
    """
    if not 0 < ratio <= 1:
        raise OptionError(f"ratio: expected a number in (0, 1], got {ratio}")
    first, index, second, is_mutual = _nearest(query, train, scale, max_scale_factor)
    distance, next_distance = ((2 - 2 * cosine).clip(0) ** 0.5 for cosine in (first, second))
    # Two equal distances have a ratio of 1, even if rounding makes one of them 0, or if both are infinite.
    quotient = distance.clip(_ROUNDING, _MAX) / next_distance.clip(_ROUNDING, _MAX)
    valid = (distance < math.inf) & (quotient <= ratio) & is_mutual
    return Matches(*(same_kind_as(query.descriptors, values) for values in (index, distance, quotient, valid)))


def _nearest(
    query: Features, train: Features, scale: float, max_scale_factor: float | None
) -> tuple[NDArray[Any], ...]:
    """For each query (B, N) the largest cosine, its slot, the second largest, whether it is the slot's best.

    Pairs that are not allowed have a cosine of minus infinity.
    """
    from engine.kernels import nearest  # numba takes a while to import

    (own, own_log), (other, other_log) = (
        _described(features, factor, max_scale_factor is not None)
        for features, factor in ((query, scale), (train, 1.0))
    )
    count, slots = max(len(own), len(other)), own.shape[1]
    first, second = np.full((2, count, slots), -np.inf, np.float32)
    index, is_mutual = np.zeros((count, slots), np.int64), np.zeros((count, slots), np.bool_)
    most_log = np.float32(math.inf if max_scale_factor is None else math.log(max_scale_factor))
    for n in range(count):
        q, t = min(n, len(own) - 1), min(n, len(other) - 1)
        out = (first[n], index[n], second[n], is_mutual[n])
        for start in range(0, other.shape[1], TRAIN_CHUNK):
            end = start + TRAIN_CHUNK
            cosine = other[t, start:end] @ own[q].T
            nearest.two_nearest(cosine, own_log[q], other_log[t, start:end], most_log, start, *out)
    return first, index, second, is_mutual


def _described(features: Features, scale: float, is_limited: bool) -> tuple[Floats, Floats]:
    """Descriptors (B, N, 128), and logarithm of scale (B, N) if limited, else 0; NaN without keypoint."""
    valid = on_host(features.valid)
    sizes = on_host(as_float(features.scale_px, "float32")) if is_limited else np.ones(valid.shape, np.float32)
    log = np.log(np.where(valid, np.maximum(sizes * np.float32(scale), 1e-9), np.nan))
    return on_host(as_float(features.descriptors, "float32")), log.astype(np.float32, copy=False)
