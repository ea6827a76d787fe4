"""Peaks found on a device: those of numpy, and those of the whole surface."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from engine.errors import ShapeError
from engine.kernels import tensors
from engine.kernels.peaks import find_peak
from engine.ncc_fft import Search, match_template, match_templates, prepare, surface

SHAPES = [
    (1, 1, 1),
    (2, 1, 500),  # one row
    (2, 500, 1),  # one column
    (3, 63, 65),
]


def whole_surface(search, template):
    """The surface by tensor ops, as a device has it."""
    return surface(of_tensors(search), template[None])[0]


def of_tensors(search):
    """A map that is prepared as arrays, as the tensors that a device has."""
    image = torch.as_tensor(search.image)
    return Search(image, sums=tensors.integrals(image))


def on_device(search, template, exclusion_px):
    """The peak as a device finds it, wherever the tensors are."""
    return match_template(of_tensors(search), template, exclusion_px=exclusion_px)


def draw(shape):
    """Views into larger buffers of NaN, as a transform's are, with many equal scores and some beyond 1."""
    rng = torch.Generator().manual_seed(sum(shape))
    t, height, width = shape
    products = torch.full((t, height + 2, width + 5), math.nan)[:, :height, :width]
    products.copy_(torch.randint(-40, 41, shape, generator=rng) / 32.0)
    norms = torch.full((height, width + 3), math.nan)[:, :width]
    norms.copy_(torch.randint(0, 5, (height, width), generator=rng) / 4.0)
    return products, norms


def scores_of(products, norms):
    return np.clip(products.cpu().numpy() * norms.cpu().numpy(), -1.0, 1.0)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_peak_is_numpys(shape):
    given = draw(shape)
    best, places = tensors.peak(*given)
    assert (best.dtype, places.dtype) == (torch.float32, torch.int64)
    flat = scores_of(*given).reshape(shape[0], -1)
    np.testing.assert_array_equal(places, flat.argmax(axis=1))
    np.testing.assert_array_equal(best, flat.max(axis=1))


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_rival_is_numpys(shape):
    given = draw(shape)
    scores = scores_of(*given)
    height, width = shape[1:]
    rows, columns = np.ogrid[:height, :width]
    for place in {0, width - 1, height * width // 2, height * width - 1}:
        distance = (rows - place // width) ** 2 + (columns - place % width) ** 2
        for radius_squared in (0, 2, 25, 1000, 10**10):
            best = tensors.rival(*given, torch.tensor([place]).expand(shape[0]), radius_squared)
            outside = np.where(distance > radius_squared, scores, np.float32(-1.0))
            np.testing.assert_array_equal(best, outside.max(axis=(1, 2)))


def test_of_equal_scores_the_first_is_the_peak():
    products, norms = torch.zeros(3, 70, 90), torch.ones(70, 90)
    products[0, 50, 7] = products[0, 50, 8] = products[0, 69, 89] = 0.5
    products[1] = 7.0  # all of them 1 once they are cut off
    products[2] = -7.0
    best, places = tensors.peak(products, norms)
    assert best.tolist() == [0.5, 1.0, -1.0]
    assert places.tolist() == [50 * 90 + 7, 0, 0]
    assert tensors.rival(products, norms, places, 10**10).tolist() == [-1.0] * 3


def test_nan_never_wins():
    """And infinities are cut off."""
    products, norms = draw((3, 63, 65))
    products[0, 5, 6:9], products[1], products[2, 62, 64] = math.nan, math.nan, math.inf
    norms[62, 64] = 1.0
    expected = torch.nan_to_num(products * norms, nan=-1.0).clamp(-1.0, 1.0).flatten(1).max(dim=1)
    best, places = tensors.peak(products, norms)
    torch.testing.assert_close(best, expected.values, rtol=0, atol=0)
    assert (best[1].item(), places[1].item(), best[2].item()) == (-1.0, 0, 1.0)
    assert tensors.rival(products, norms, places, 30)[1].item() == -1.0


def test_a_batch_is_matched_as_its_templates_one_by_one():
    """Every template with norms and a winner of its own."""
    drawn = [draw((1, 41, 53)) for _ in range(4)]
    products = torch.cat([p.roll(i, 1) for i, (p, _) in enumerate(drawn)])
    norms = torch.stack([n.roll(2 * i, 0) for i, (_, n) in enumerate(drawn)])
    best, places = tensors.peak(products, norms)
    second = tensors.rival(products, norms, places, 25)
    for i in range(4):
        one = products[i : i + 1], norms[i]
        torch.testing.assert_close(tensors.peak(*one), (best[i : i + 1], places[i : i + 1]), rtol=0, atol=0)
        torch.testing.assert_close(tensors.rival(*one, places[i : i + 1], 25), second[i : i + 1], rtol=0, atol=0)


def picture(size, model, device="cpu"):
    """A smooth picture, and a template of it that lies at a fifth of the way."""
    rng = torch.Generator().manual_seed(size[0])
    rough = torch.randn(1, 1, *size, generator=rng)
    image = torch.nn.functional.avg_pool2d(rough, 3, stride=1, padding=1)[0, 0]
    y, x = ((n - m) // 5 for n, m in zip(size, model, strict=True))
    template = image[y : y + model[0], x : x + model[1]] + 0.05 * torch.randn(*model, generator=rng)
    return prepare(image.to(device)), template.to(device)


def assert_same(found, expected):
    for field in dataclasses.fields(expected):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name), field.name)


@pytest.mark.parametrize("exclusion_px", [0.0, math.sqrt(2.0), 5.0, 5.5, 1000.0])
@pytest.mark.parametrize(
    ("size", "model"),
    [
        ((150, 131), (63, 50)),  # a peak with 5 x 5 places about it
        ((70, 71), (63, 64)),  # 3 x 3
        ((66, 64), (63, 63)),  # none: on the border
        ((63, 100), (63, 50)),  # one row
        ((40, 40), (40, 40)),  # one place
    ],
)
def test_the_peak_on_a_device_is_that_of_the_whole_surface(size, model, exclusion_px):
    search, template = picture(size, model)
    found = on_device(search, template, exclusion_px)
    assert_same(found, find_peak(whole_surface(search, template), exclusion_px=exclusion_px))


def test_the_peak_of_a_window_without_texture_is_finite():
    found = on_device(prepare(torch.zeros(60, 70)), torch.rand(20, 30), 3.0)
    assert (found.x, found.y, found.score, found.second_score) == (0.0, 0.0, 0.0, 0.0)


def test_a_surface_does_not_leave_its_device(monkeypatch):
    copies, real = [], torch.Tensor.cpu
    monkeypatch.setattr(torch.Tensor, "cpu", lambda self: copies.append(self.numel()) or real(self))
    on_device(*picture((150, 131), (63, 50)), 5.0)
    assert copies == [28]


def test_a_template_larger_than_the_window_is_refused():
    with pytest.raises(ShapeError, match=r"^templates: expected at most 20 x 20 \(search\), got 21 x 5$"):
        match_templates([prepare(torch.rand(20, 20))], [torch.rand(21, 5)], exclusion_px=3.0)
