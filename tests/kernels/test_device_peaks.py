"""Peaks found on a device: those of numpy, and those of the whole surface."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from engine.kernels.peaks import find_peak
from engine.kernels.tensors import peak_numbers
from engine.ncc_fft import match_template, prepare
from tests.support.fields import fields_of
from tests.support.pretended import DEVICE, pretended_device

SHAPES = [
    (1, 1),
    (1, 500),  # one row
    (500, 1),  # one column
    (63, 65),
]


def draw(shape):
    """A view into a larger buffer of NaN, as a transform's is, with many equal scores and some beyond 1."""
    rng = torch.Generator().manual_seed(sum(shape))
    scores = torch.full((shape[0] + 2, shape[1] + 5), math.nan)[: shape[0], : shape[1]]
    return scores.copy_(torch.randint(-40, 41, shape, generator=rng) / 32.0)


@pytest.mark.parametrize("radius_squared", [0, 2, 25, 1000, 10**10])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_peak_and_rival_are_numpys(shape, radius_squared):
    given = draw(shape)
    index, best, rival, *_ = peak_numbers(given, math.sqrt(radius_squared))
    scores = np.clip(given.numpy(), -1.0, 1.0)
    assert (index, best) == (scores.argmax(), scores.max())
    y, x = divmod(int(index), shape[1])
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    outside = np.where((rows - y) ** 2 + (columns - x) ** 2 > radius_squared, scores, np.float32(-1.0))
    assert rival == outside.max()


def test_nan_never_wins():
    """And infinities are cut off."""
    scores = draw((63, 65))
    scores[5, 6:9], scores[62, 64] = math.nan, math.inf
    expected = torch.nan_to_num(scores, nan=-1.0).clamp(-1.0, 1.0).flatten()
    assert peak_numbers(scores, 5.0)[:2] == [float(expected.argmax()), 1.0]
    assert peak_numbers(torch.full((63, 65), math.nan), 5.0)[:3] == [0.0, -1.0, -1.0]


@pytest.mark.parametrize("exclusion_px", [0.0, math.sqrt(2.0), 5.0, 5.5, 1000.0])
@pytest.mark.parametrize(
    "size",
    [
        (88, 82),  # a peak with 5 x 5 places about it
        (8, 8),  # 3 x 3
        (4, 2),  # none: on the border
        (1, 51),  # one row
        (1, 1),  # one place
    ],
)
def test_the_peak_on_a_device_is_that_on_the_host(size, exclusion_px):
    rough = torch.randn(1, 1, *size, generator=torch.Generator().manual_seed(size[0]))
    scores = torch.nn.functional.avg_pool2d(rough, 3, stride=1, padding=1)[0, 0].clamp(-1.0, 1.0)
    expected = find_peak(scores, exclusion_px=exclusion_px)
    with pretended_device():
        found = find_peak(scores.to(DEVICE), exclusion_px=exclusion_px)
    for one, other in zip(fields_of(found), fields_of(expected), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_peak_of_a_window_without_texture_is_finite():
    with pretended_device():
        search, template = prepare(torch.zeros(60, 70).to(DEVICE)), torch.rand(20, 30).to(DEVICE)
        found = match_template(search, template, exclusion_px=3.0)
    assert (found.x, found.y, found.score, found.second_score) == (0.0, 0.0, 0.0, 0.0)
