"""Every NCC kernel against the reference, and the reference against numbers done by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from engine import ncc_fft
from engine.kernels import reference, tensors

KERNELS = {"dispatch": ncc_fft.ncc, "tensors": tensors.ncc_surface}
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-9}


def reference_batch(search, templates, zero_mean):
    return np.stack(
        [
            [reference.ncc_surface(window, template, zero_mean=zero_mean) for template in hypotheses]
            for window, hypotheses in zip(search.numpy(), templates.numpy(), strict=True)
        ]
    )


def test_reference_as_the_equation_by_hand():
    search = [[1.0, 2.0, 4.0], [0.0, 3.0, 1.0]]
    template = [[1.0, 2.0]]
    plain = reference.ncc_surface(search, template, zero_mean=False)
    by_hand = [
        [5 / math.sqrt(5 * 5), 10 / math.sqrt(5 * 20)],
        [6 / math.sqrt(5 * 9), 5 / math.sqrt(5 * 10)],
    ]
    np.testing.assert_allclose(plain, by_hand, rtol=1e-14)
    zero_mean = reference.ncc_surface(search, template, zero_mean=True)
    np.testing.assert_allclose(zero_mean, [[1.0, 1.0], [1.0, -1.0]], rtol=1e-14)  # two pixels: sign of the slope


def test_reference_is_the_correlation_coefficient():
    rng = np.random.default_rng(0)
    search, template = rng.normal(size=(9, 8)), rng.normal(size=(4, 3))
    scores = reference.ncc_surface(search, template, zero_mean=True)
    for y in range(6):
        for x in range(6):
            pearson = np.corrcoef(search[y : y + 4, x : x + 3].ravel(), template.ravel())[0, 1]
            assert scores[y, x] == pytest.approx(pearson, abs=1e-12)


def test_reference_scores_flat_patches_and_templates_zero():
    search = np.zeros((6, 6))
    search[:, 4:] = np.arange(12).reshape(6, 2)
    assert reference.ncc_surface(search, np.eye(3), zero_mean=True)[0, 0] == 0.0
    assert not reference.ncc_surface(search, np.full((3, 3), 7.0), zero_mean=True).any()
    assert not reference.ncc_surface(np.zeros((5, 5)), np.eye(3), zero_mean=False).any()


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("zero_mean", [True, False])
@pytest.mark.parametrize(
    ("batch", "hypotheses", "size", "model"),
    [
        (1, 1, (8, 8), (3, 3)),
        (2, 3, (63, 50), (17, 31)),  # odd and prime
        (1, 2, (1, 29), (1, 7)),  # one row
        (3, 1, (31, 1), (5, 1)),  # one column
        (2, 2, (13, 11), (13, 11)),  # as large as the window
        (1, 1, (5, 7), (1, 1)),  # one pixel
        (1, 1, (40, 3), (2, 3)),
    ],
)
def test_kernels_agree_with_the_reference(dtype, zero_mean, batch, hypotheses, size, model):
    rng = torch.Generator().manual_seed(3)
    search = torch.randn(batch, *size, generator=rng, dtype=torch.float64).to(dtype)
    templates = torch.randn(batch, hypotheses, *model, generator=rng, dtype=torch.float64).to(dtype)
    before = search.clone(), templates.clone()
    expected = reference_batch(search, templates, zero_mean)
    for name, kernel in KERNELS.items():
        scores = kernel(search, templates, zero_mean=zero_mean)
        assert scores.dtype == dtype
        assert scores.shape == (batch, hypotheses, size[0] - model[0] + 1, size[1] - model[1] + 1)
        np.testing.assert_allclose(scores.numpy(), expected, rtol=0, atol=TOLERANCE[dtype], err_msg=name)
        assert torch.equal(search, before[0])  # input is left as it came
        assert torch.equal(templates, before[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", KERNELS)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 26), st.integers(1, 26)),
    share=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    offset=st.sampled_from([0.0, 100.0, 20_000.0]),
    zero_mean=st.booleans(),
)
def test_kernels_agree_with_the_reference_on_any_size_and_offset(name, seed, size, share, offset, zero_mean):
    rng = np.random.default_rng(seed)
    model = tuple(max(1, round(n * s)) for n, s in zip(size, share, strict=True))
    # Whole numbers: float32 holds them without rounding, so that both see the same input.
    search = torch.from_numpy(np.rint(rng.normal(offset, 30.0, (1, *size))))
    templates = torch.from_numpy(np.rint(rng.normal(offset, 30.0, (1, 2, *model))))
    scores = KERNELS[name](search.float(), templates.float(), zero_mean=zero_mean)
    expected = reference_batch(search, templates, zero_mean)
    np.testing.assert_allclose(scores.numpy(), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", KERNELS)
def test_kernels_write_every_cell(name, monkeypatch):
    """Fresh memory full of NaN shows an unwritten cell."""
    real = torch.empty

    def poisoned(*args, **kwargs):
        made = real(*args, **kwargs)
        return made.fill_(math.nan) if made.is_floating_point() else made

    monkeypatch.setattr(torch, "empty", poisoned)
    rng = torch.Generator().manual_seed(1)
    scores = KERNELS[name](
        torch.rand(2, 33, 21, generator=rng), torch.rand(2, 3, 8, 5, generator=rng), zero_mean=True
    )
    assert torch.isfinite(scores).all()
