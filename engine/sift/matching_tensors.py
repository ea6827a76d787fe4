"""Match descriptors on a GPU: tensor ops over all pairs, by chunks that bound the memory."""

from __future__ import annotations

import math

from engine.runtime.tensors import Tensor, torch
from engine.sift.values import TRAIN_CHUNK, Features, Limits, fields_of


def nearest(query: Features, train: Features, limits: Limits) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The nearest and the second nearest of each query.

    Args:
        query: features of B images, or of one.
        train: features of B images, or of one.
        limits: on their scales.

    Returns:
        (B, N) each: the largest cosine, its slot, the second largest, and whether the query is its slot's nearest.
        Pairs that are not allowed have a cosine of minus infinity.
    """
    found = []
    with torch.inference_mode():
        for start in range(0, max(1, train.valid.shape[1]), TRAIN_CHUNK):
            part = Features(*(values[:, start : start + TRAIN_CHUNK] for values in fields_of(train)))
            first, index, second, is_mutual = _two_nearest(query, part, limits)
            found.append((first, index + start, second, is_mutual))
        return found[0] if len(found) == 1 else _merged(found)


def _two_nearest(query: Features, train: Features, limits: Limits) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """:func:`nearest` in one piece."""
    cosine, (scale, max_scale_factor) = query.descriptors @ train.descriptors.mT, limits
    cosine.masked_fill_(~query.valid[:, :, None], -torch.inf).masked_fill_(~train.valid[:, None, :], -torch.inf)
    if max_scale_factor is not None:
        own, other = (query.scale_px * scale).clamp_min(1e-9).log(), train.scale_px.clamp_min(1e-9).log()
        is_near = (other[:, None, :] - own[:, :, None]).abs_() <= math.log(max_scale_factor)
        cosine.masked_fill_(~is_near, -torch.inf)
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
