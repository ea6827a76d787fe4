"""Every NCC kernel against the reference, which ``test_ncc_fft`` holds to OpenCV by way of the front door."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from engine import ncc_fft
from engine.kernels import tensors
from tests.support.correlation import reference_scores

KERNELS = {"dispatch": ncc_fft.ncc, "tensors": tensors.ncc_surface}
TOLERANCE = {"float32": 1e-5, "float64": 1e-9}


@pytest.mark.parametrize("dtype", TOLERANCE)
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
@example(seed=3, model=(1, 7), more=(0, 22), batch=(1, 2), zero_mean=True, offset=0.0)  # one row
@example(seed=3, model=(13, 11), more=(0, 0), batch=(2, 2), zero_mean=True, offset=0.0)  # as large as the window
@example(seed=3, model=(1, 1), more=(4, 6), batch=(1, 1), zero_mean=True, offset=0.0)  # one pixel: always flat
def test_kernels_agree_with_the_reference_on_any_size_and_offset(
    name, dtype, seed, model, more, batch, zero_mean, offset
):
    """Odd sizes, windows that are larger by nothing or by one pixel, batches of windows and of templates."""
    rng = np.random.default_rng(seed)
    size = tuple(n + m for n, m in zip(model, more, strict=True))
    # Whole numbers: float32 holds them without rounding, so that both see the same input.
    search = np.rint(rng.normal(offset, 30.0, (batch[0], *size))).astype(dtype)
    templates = np.rint(rng.normal(offset, 30.0, (*batch, *model))).astype(dtype)
    before = search.copy(), templates.copy()
    scores = KERNELS[name](torch.from_numpy(search), torch.from_numpy(templates), zero_mean=zero_mean).numpy()
    assert scores.dtype == dtype
    np.testing.assert_allclose(scores, reference_scores(*before, zero_mean), rtol=0, atol=TOLERANCE[dtype])
    np.testing.assert_array_equal(search, before[0])  # input is left as it came
    np.testing.assert_array_equal(templates, before[1])
