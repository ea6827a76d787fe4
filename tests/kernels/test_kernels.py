"""Every NCC kernel against the reference, and the reference against numbers done by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine import ncc_fft
from engine.kernels import reference, tensors
from tests.support.correlation import reference_scores

KERNELS = {"dispatch": ncc_fft.ncc, "tensors": tensors.ncc_surface}
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-9}


def test_reference_as_the_equation_by_hand():
    plain = reference.ncc_surface([[1.0, 2.0, 4.0], [0.0, 3.0, 1.0]], [[1.0, 2.0]], zero_mean=False)
    by_hand = [
        [5 / math.sqrt(5 * 5), 10 / math.sqrt(5 * 20)],
        [6 / math.sqrt(5 * 9), 5 / math.sqrt(5 * 10)],
    ]
    np.testing.assert_allclose(plain, by_hand, rtol=1e-14)


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
    expected = reference_scores(search.numpy(), templates.numpy(), zero_mean)
    for name, kernel in KERNELS.items():
        scores = kernel(search, templates, zero_mean=zero_mean)
        assert scores.dtype == dtype
        np.testing.assert_allclose(scores.numpy(), expected, rtol=0, atol=TOLERANCE[dtype], err_msg=name)
        assert torch.equal(search, before[0])  # input is left as it came
        assert torch.equal(templates, before[1])


@pytest.mark.parametrize("name", KERNELS)
@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    model=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    more=st.tuples(st.integers(0, 30), st.integers(0, 30)),
    batch=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    zero_mean=st.booleans(),
    offset=st.sampled_from([0.0, 100.0, 20_000.0]),
)
def test_kernels_agree_with_the_reference_on_any_size_and_offset(
    name, seed, model, more, batch, zero_mean, offset
):
    """Odd sizes, windows that are larger by nothing or by one pixel, batches of windows and of templates."""
    rng = np.random.default_rng(seed)
    size = tuple(n + m for n, m in zip(model, more, strict=True))
    # Whole numbers: float32 holds them without rounding, so that both see the same input.
    search = np.rint(rng.normal(offset, 30.0, (batch[0], *size))).astype(np.float32)
    templates = np.rint(rng.normal(offset, 30.0, (*batch, *model))).astype(np.float32)
    scores = KERNELS[name](torch.from_numpy(search), torch.from_numpy(templates), zero_mean=zero_mean)
    expected = reference_scores(search, templates, zero_mean)
    np.testing.assert_allclose(scores.numpy(), expected, rtol=0, atol=1e-5)
