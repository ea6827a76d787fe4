"""Match descriptors on a GPU: tensor ops over all pairs, by chunks that bound the memory."""

from __future__ import annotations

import math

from engine.runtime.tensors import Tensor, torch
from engine.sift.values import FORBIDDEN, ROUNDING, TRAIN_CHUNK, Features, Limits, Matches, fields_of


def match_tensors(query: Features, train: Features, limits: Limits, ratio: float) -> Matches:
    """The matches of features on a GPU; see :func:`engine.sift.matching.match`."""
    with torch.inference_mode():
        first, index, second, is_mutual = _nearest(query, train, limits)
        nearest, next_nearest = _distance(first), _distance(second)
        # Two equal distances give a ratio of 1, even if rounding makes one of them 0.
        quotient = (nearest.clamp_min(ROUNDING) / next_nearest.clamp_min(ROUNDING)).nan_to_num(1.0)
        valid = nearest.isfinite() & (quotient <= ratio) & is_mutual
    return Matches(index, nearest, quotient, valid)


def _nearest(query: Features, train: Features, limits: Limits) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """:func:`_two_nearest` over all train slots, by chunks that bound the memory."""
    found = []
    for start in range(0, max(1, train.valid.shape[1]), TRAIN_CHUNK):
        part = Features(*(values[:, start : start + TRAIN_CHUNK] for values in fields_of(train)))
        first, index, second, is_mutual = _two_nearest(query, part, limits)
        found.append((first, index + start, second, is_mutual))
    return found[0] if len(found) == 1 else _merged(found)


def _distance(cosine: Tensor) -> Tensor:
    """Distance of unit vectors; infinite for a forbidden pair."""
    return (2 - 2 * cosine).clamp_min_(0).sqrt_().masked_fill_(cosine < FORBIDDEN, torch.inf)


def _forbid(cosine: Tensor, query: Features, train: Features, limits: Limits) -> None:
    """Lower the cosine (B, N, M) of excluded pairs by a large number, in place; faster than masks."""
    (scale, max_scale_factor), far = limits, torch.finfo(cosine.dtype).max
    for valid, dim in ((query.valid, 2), (train.valid, 1)):
        cosine.sub_((~valid).to(cosine.dtype).unsqueeze(dim), alpha=far)
    if max_scale_factor is not None:
        own, other = (query.scale_px * scale).clamp_min(1e-9).log(), train.scale_px.clamp_min(1e-9).log()
        excess = (other[:, None, :] - own[:, :, None]).abs_().sub_(math.log(max_scale_factor))
        cosine.sub_(excess.clamp_min_(0), alpha=far)


def _two_nearest(query: Features, train: Features, limits: Limits) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """For each query (B, N) the largest cosine, its slot, the second largest, whether it is the slot's best."""
    cosine = query.descriptors @ train.descriptors.mT
    _forbid(cosine, query, train, limits)
    if 0 in cosine.shape:
        none = cosine.new_full(cosine.shape[:2], -torch.inf)
        return none, torch.zeros_like(none, dtype=torch.int64), none, none > 0
    index = cosine.argmax(2)[:, :, None]
    first = cosine.gather(2, index)
    is_mutual = first[:, :, 0] == cosine.amax(dim=1).gather(1, index[:, :, 0])
    second = cosine.scatter_(2, index, -torch.inf).amax(dim=2)
    return first[:, :, 0], index[:, :, 0], second, is_mutual


def _merged(found: list[tuple[Tensor, Tensor, Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The nearest over all chunks, and the second nearest: of the same chunk or the nearest of another."""
    first, index, second, is_mutual = (torch.stack(values) for values in zip(*found, strict=True))
    best = first.argmax(dim=0, keepdim=True)
    others = first.scatter(0, best, second.gather(0, best))
    return first.gather(0, best)[0], index.gather(0, best)[0], others.amax(dim=0), is_mutual.gather(0, best)[0]
