"""Match descriptors by distance: Lowe's ratio test, a mutual test, and a limit on scale."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError
from engine.runtime.device import Picture, as_float, device_of, on_host, same_kind_as
from engine.sift.values import ROUNDING, TRAIN_CHUNK, Features, Limits, Matches

Floats = NDArray[np.float32]

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
        For each of the N query slots.

    Raises:
        OptionError: The ratio is not in (0, 1].
    """
    if not 0 < ratio <= 1:
        raise OptionError(f"ratio: expected a number in (0, 1], got {ratio}")
    limits, given = (scale, max_scale_factor), query.descriptors
    if device_of(given).type == "cpu":
        found: tuple[Picture, ...] = _nearest(query, train, limits)
    else:
        from engine.sift.matching_tensors import nearest  # torch takes a while to import

        found = nearest(query, train, limits)
    return Matches(*(same_kind_as(given, values) for values in tested(found, ratio)))


def tested(nearest: tuple[Picture, ...], ratio: float) -> tuple[Picture, ...]:
    """The four fields of the matches.

    Args:
        nearest: (B, N) each: cosine of the nearest, minus infinity if none was allowed; its slot; cosine of the
            second nearest, likewise; whether the query is its slot's nearest, too.
        ratio: see :func:`match`.
    """
    first, index, second, is_mutual = nearest
    distance, next_distance = ((2 - 2 * as_float(cosine, "float32")).clip(0) ** 0.5 for cosine in (first, second))
    # Two equal distances have a ratio of 1, even if rounding makes one of them 0, or if both are infinite.
    quotient = distance.clip(ROUNDING, _MAX) / next_distance.clip(ROUNDING, _MAX)
    return index, distance, quotient, (distance < math.inf) & (quotient <= ratio) & is_mutual


def _nearest(query: Features, train: Features, limits: Limits) -> tuple[NDArray[Any], ...]:
    """For each query (B, N) the largest cosine, its slot, the second largest, whether it is the slot's best."""
    from engine.kernels import nearest  # numba takes a while to import

    scale, max_scale_factor = limits
    own, own_log = _described(query, scale, max_scale_factor is not None)
    other, other_log = _described(train, 1.0, max_scale_factor is not None)
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
    """Descriptors (B, N, 128); (B, N) logarithm of scale if that is limited, else 0, NaN without a keypoint."""
    valid, descriptors = on_host(features.valid), on_host(as_float(features.descriptors, "float32"))
    sizes = on_host(as_float(features.scale_px, "float32")) if is_limited else np.ones(valid.shape, np.float32)
    log = np.log(np.where(valid, np.maximum(sizes * np.float32(scale), 1e-9), np.nan))
    return descriptors, log.astype(np.float32, copy=False)
