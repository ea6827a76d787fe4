"""Masked NCC: small windows against sums pixel by pixel, whole templates against sums over the whole window."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine import DtypeError, OptionError, ShapeError
from engine.kernels import masked, tensors
from engine.ncc_fft import ncc


def by_hand(search, search_valid, template, min_overlap):
    """The correlation coefficient over valid pixels, place by place, in float64."""
    (H, W), (h, w) = search.shape, template.shape
    scores = np.zeros((H - h + 1, W - w + 1))
    for y, x in np.ndindex(scores.shape):
        common = search_valid[y : y + h, x : x + w]
        if common.sum() < min_overlap * common.size:
            scores[y, x] = -1.0
            continue
        a, b = search[y : y + h, x : x + w][common].astype(float), template[common].astype(float)
        if a.size and np.ptp(a) > 0 and np.ptp(b) > 0:
            a, b = a - a.mean(), b - b.mean()
            scores[y, x] = (a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum())
    return scores


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-6), (np.float64, 1e-7)])
@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    model=st.tuples(st.integers(1, 13), st.integers(1, 13)),
    more=st.tuples(st.integers(0, 11), st.integers(0, 11)),
    batch=st.tuples(st.integers(1, 2), st.integers(1, 3)),
    levels=st.sampled_from([(0.0, 1.0), (100.0, 20.0), (20_000.0, 10.0)]),
    share=st.sampled_from([0.0, 0.4, 0.8, 1.0]) | st.floats(0.4, 1.0),
    min_overlap=st.sampled_from([0.1, 0.5, 0.9, 1.0]),
    rubbish=st.sampled_from([None, 0.0, -1e9, 1e15]),
)
def test_masked_scores_are_those_done_by_hand(
    dtype, tolerance, seed, model, more, batch, levels, share, min_overlap, rubbish
):
    """Whatever lies under the mask; batches of windows and of templates are their members one by one."""
    rng = np.random.default_rng(seed)
    size = tuple(n + m for n, m in zip(model, more, strict=True))
    search, templates = (np.rint(rng.normal(*levels, shape)) for shape in ((batch[0], *size), (*batch, *model)))
    valid = rng.random(search.shape) < share
    seen = search if rubbish is None else np.where(valid, search, rubbish)
    scores = ncc(seen.astype(dtype), templates.astype(dtype), search_valid=valid, min_overlap=min_overlap)
    assert scores.dtype == dtype
    for b, t in np.ndindex(batch):
        expected = by_hand(search[b], valid[b], templates[b, t], min_overlap)
        np.testing.assert_allclose(scores[b, t], expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32, np.float64])
def test_a_mask_that_is_all_true_changes_nothing(dtype):
    rng = np.random.default_rng(2)
    search, templates = (rng.integers(0, 256, shape).astype(dtype) for shape in ((1, 40, 50), (1, 1, 13, 17)))
    masked = ncc(search, templates, search_valid=np.ones(search.shape, bool))
    np.testing.assert_allclose(masked, ncc(search, templates), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("changed", "error", "names"),
    [
        ({"search_valid": torch.ones(1, 8, 8)}, DtypeError, "search_valid"),
        ({"search_valid": torch.ones(8, 8, dtype=torch.bool)}, ShapeError, "search_valid"),
        ({"zero_mean": False}, OptionError, "zero_mean"),
        ({"min_overlap": 0.0}, OptionError, "min_overlap"),
        ({"min_overlap": 1.1}, OptionError, "min_overlap"),
        ({"min_overlap": float("nan")}, OptionError, "min_overlap"),
    ],
)
def test_errors_name_the_argument(changed, error, names):
    options = {"search_valid": torch.ones(1, 8, 8, dtype=torch.bool), **changed}
    with pytest.raises(error, match=rf"^{names}: expected .+, got .+"):
        ncc(torch.rand(1, 8, 8), torch.rand(1, 1, 3, 3), **options)


# In blocks


MASKS = {
    "border": lambda y, x, rng: (y >= 9) & (y < y.max() - 3) & (x >= 13),
    "slanted": lambda y, x, rng: (y > 0.05 * y.max() + 0.1 * x) & (x < 0.97 * x.max() - 0.03 * y),
    "holes": lambda y, x, rng: ((y + x // 2) % 90 >= 12) | (x % 70 >= 25),
    "speckles": lambda y, x, rng: rng.random(y.shape) < 0.97,
    "half": lambda y, x, rng: x >= x.max() // 2,
    "nearly nothing": lambda y, x, rng: (y < y.max() // 3) & (x > 2 * x.max() // 3),
}
"""Where there is map, by rows and columns."""


def drawn(kind, size, model):
    """A window with nodata, and templates of which the first is from it, under noise."""
    rng = np.random.default_rng([len(kind), *size, *model])
    window = cv2.GaussianBlur(rng.normal(0.0, 5.0, size), (0, 0), 1.5) + rng.normal(0.0, 0.3, size)
    templates = rng.normal(0.0, 1.0, (2, *model))
    y, x = ((n - m) // 2 for n, m in zip(size, model, strict=True))
    templates[0] += window[y : y + model[0], x : x + model[1]]
    return window, MASKS[kind](*np.indices(size), rng), templates


def by_whole_windows(window, valid, templates, min_overlap):
    given = (torch.from_numpy(values)[None] for values in (window, valid, templates))
    return masked.ncc_surface(tensors, *given, min_overlap=min_overlap)[0].numpy()


@pytest.mark.parametrize("min_overlap", [0.3001, 0.8999])
@pytest.mark.parametrize("kind", MASKS)
@pytest.mark.parametrize(("size", "model"), [((230, 317), (48, 61)), ((400, 260), (21, 20)), ((97, 90), (90, 90))])
def test_scores_are_those_of_the_whole_windows_sums(kind, min_overlap, size, model):
    window, valid, templates = drawn(kind, size, model)
    window, templates = (values.astype(np.float32).astype(np.float64) for values in (window, templates))
    expected = by_whole_windows(window, valid, templates, min_overlap)
    for dtype, tolerance in ((np.float64, 1e-9), (np.float32, 1e-6)):
        picture, patches = window.astype(dtype), templates.astype(dtype)
        scores = ncc(picture[None], patches[None], search_valid=valid[None], min_overlap=min_overlap)[0]
        assert scores.dtype == dtype
        np.testing.assert_array_equal(scores == -1.0, expected == -1.0)
        np.testing.assert_allclose(scores, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("level", [0.1, 77.0, -3.3])
def test_flat_templates_and_flat_ground_score_zero_also_across_an_edge(level):
    window, valid, templates = drawn("border", (120, 130), (30, 31))
    for dtype in (np.float32, np.float64):
        flat = np.full((1, 30, 31), level, dtype)
        scores = ncc(window.astype(dtype)[None], flat[None], search_valid=valid[None], min_overlap=0.5)[0]
        assert np.abs(scores[scores > -1.0]).max(initial=0.0) < 1e-6
        half = window.astype(dtype)
        half[:, :80] = level
        scores = ncc(half[None], templates.astype(dtype)[None], search_valid=valid[None], min_overlap=0.5)
        scores = scores[0, :, :, : 80 - 31]
        assert np.abs(scores[scores > -1.0]).max(initial=0.0) < 1e-6
