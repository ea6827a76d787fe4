"""Matching a frame's descriptors with many of the map: in chunks as in one piece, and as written down plainly."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from engine.errors import OptionError
from engine.features import Features, Matches, match
from engine.sift import matching, matching_tensors
from engine.sift.values import fields_of
from tests.support.matches import pairs_of
from tests.support.tensors import assert_close


def described(count, seed, *, like=None):
    """Random features; the first of them are noisy copies of ``like``."""
    generator = torch.Generator().manual_seed(seed)
    descriptors = torch.rand(1, count, 128, generator=generator)
    if like is not None:
        shared = like.descriptors.shape[1]
        descriptors[:, :shared] = like.descriptors * 11.0 + 0.3 * descriptors[:, :shared]
    return Features(
        xy_px=torch.zeros(1, count, 2),
        scale_px=1.0 + 3.0 * torch.rand(1, count, generator=generator),
        angle_deg=360.0 * torch.rand(1, count, generator=generator),
        descriptors=torch.nn.functional.normalize(descriptors, dim=2),
        valid=torch.rand(1, count, generator=generator) < 0.9,
    )


def all_valid(features):
    return replace(features, valid=torch.ones_like(features.valid))


def plainly(query, train, ratio, scale, factor):
    """Pair by pair, in float64: nearest, ratio and mutual test among the pairs that are allowed."""
    q, t = query.descriptors[0].double().numpy(), train.descriptors[0].double().numpy()
    distance = np.sqrt(np.maximum(0.0, 2.0 - 2.0 * q @ t.T))
    grown = train.scale_px[0].numpy()[None] / query.scale_px[0].numpy()[:, None] / scale
    allowed = query.valid[0].numpy()[:, None] & train.valid[0].numpy()[None]
    allowed &= np.abs(np.log(grown)) <= np.log(factor)
    distance[~allowed] = np.inf
    pairs = []
    for i, row in enumerate(distance):
        first, second = np.sort(row)[:2]
        j = int(row.argmin())
        if first < np.inf and first <= ratio * second and distance[:, j].argmin() == i:
            pairs.append((i, j))
    return pairs


def by_tensor_ops(query, train, *, ratio=0.8, scale=1.0, max_scale_factor=None):
    """As on a device."""
    found = matching_tensors.nearest(query, train, (scale, max_scale_factor))
    return Matches(*matching.tested(found, ratio))


WAYS = pytest.mark.parametrize("way", [match, by_tensor_ops], ids=["loops", "tensor ops"])


@WAYS
@pytest.mark.parametrize("chunk", [7, 64, 4096])
@pytest.mark.parametrize(("ratio", "factor"), [(1.0, None), (0.9, None), (0.9, 1.5), (0.9, 2.0)])
def test_matches_are_those_of_every_pair_looked_at_by_itself(monkeypatch, way, chunk, ratio, factor):
    """Of one frame with two parts of the map."""
    for module in (matching, matching_tensors):
        monkeypatch.setattr(module, "TRAIN_CHUNK", chunk)
    query = described(60, 1)
    trains = [described(333, seed, like=query) for seed in (2, 3)]
    train = Features(*(torch.cat(values) for values in zip(*map(fields_of, trains), strict=True)))
    found = way(query, train, ratio=ratio, scale=1.2, max_scale_factor=factor)
    for element, part in enumerate(trains):
        expected = plainly(query, part, ratio, 1.2, factor or 1e9)
        assert len(expected) > 3
        assert [tuple(pair) for pair in pairs_of(found, element)] == expected


@pytest.mark.parametrize("kind", [torch.float64, torch.float16])
def test_features_of_another_precision_match_likewise(kind):
    query = described(50, 3)
    train = described(90, 4, like=query)
    expected = pairs_of(match(query, train, ratio=0.9))
    assert len(expected) > 10
    cast = (replace(f, descriptors=f.descriptors.to(kind), scale_px=f.scale_px.to(kind)) for f in (query, train))
    found = pairs_of(match(*cast, ratio=0.9))
    assert len({tuple(p) for p in found} ^ {tuple(p) for p in expected}) <= 1


def test_unknown_scales_count_only_where_they_are_limited():
    query = described(50, 3)
    train = described(90, 4, like=query)
    unknown = replace(query, scale_px=query.scale_px * torch.nan)
    assert pairs_of(match(unknown, train, ratio=0.9)) == pairs_of(match(query, train, ratio=0.9))
    assert not match(unknown, train, ratio=0.9, max_scale_factor=1.5).valid.any()


def test_nothing_matches_a_map_without_valid_features_and_one_feature_needs_no_second():
    query = all_valid(described(70, 1))
    train = described(90, 2, like=query)
    for none in (described(0, 3), replace(train, valid=torch.zeros_like(train.valid))):
        assert pairs_of(match(query, none)) == pairs_of(match(none, query)) == []
    assert pairs_of(match(query, replace(train, valid=torch.arange(90)[None] == 10))) == [[10, 10]]


@WAYS
def test_distances_are_those_of_the_pairs(way):
    query = all_valid(described(70, 1))
    train = all_valid(described(90, 2, like=query))
    found = way(query, train)
    full = torch.cdist(query.descriptors, train.descriptors)
    assert_close(found.distance, full.amin(2), atol=1e-4, rtol=1e-4)
    two = full.topk(2, largest=False).values
    assert_close(found.ratio, two[..., 0] / two[..., 1], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("stored", [torch.float32, torch.float16], ids=str)
def test_of_two_alike_neither_is_matched(stored):
    """Nothing tells which of them is right, also where rounding puts one at 0 and the other a hair off."""
    query = all_valid(described(300, 4))
    first = query.descriptors.to(stored).float()
    twins = Features(*(torch.cat([values, values], dim=1) for values in fields_of(query)))
    twins = replace(twins, descriptors=torch.cat([first, torch.nextafter(first, torch.ones(()))], dim=1))
    found = match(query, twins)
    assert found.distance.max() < 0.02
    assert not found.valid.any()
    assert_close(found.ratio, torch.ones(1, 300), atol=0.1, rtol=0)
    lone = match(query, replace(twins, valid=torch.arange(600)[None] < 300))
    assert lone.valid.all()
    assert lone.ratio.max() < 0.05
    assert pairs_of(lone) == [[n, n] for n in range(300)]


def test_a_wrong_ratio_is_named():
    with pytest.raises(OptionError, match="ratio"):
        match(described(5, 1), described(5, 1), ratio=1.5)
