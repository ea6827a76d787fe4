"""Every NCC kernel against the reference, which ``test_ncc_fft`` holds to OpenCV by way of the front door."""

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from engine.kernels import blocks, tensors
from engine.kernels.local import LocalScores
from engine.ncc_fft import MapRegion, ncc, prepare, surface
from engine.runtime import threads as chosen
from tests.support import ncc_reference as reference
from tests.support.tensors import assert_close

KERNELS = {"dispatch": ncc, "tensors": tensors.ncc_surface}
TOLERANCE = {"float32": 1e-5, "float64": 1e-9}
SIDES = st.integers(1, 40) | st.sampled_from([63, 64, 65, 96, 97, 127])


def reference_scores(search, templates, zero_mean=True):
    """Scores (B, T, Y, X) in float64 of windows (B, H, W) and templates (B, T, h, w)."""
    pairs = zip(search, templates, strict=True)
    return np.stack([[reference.ncc_surface(window, t, zero_mean=zero_mean) for t in of] for window, of in pairs])


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("name", KERNELS)
@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    model=st.tuples(SIDES, SIDES),
    more=st.tuples(st.integers(0, 33), st.integers(0, 33)),
    batch=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    zero_mean=st.booleans(),
    offset=st.sampled_from([0.0, 100.0, 20_000.0]),
)
@example(seed=3, model=(1, 7), more=(0, 22), batch=(1, 2), zero_mean=True, offset=0.0)  # one row
@example(seed=3, model=(13, 11), more=(0, 0), batch=(2, 2), zero_mean=True, offset=0.0)  # as large as the window
@example(seed=3, model=(64, 65), more=(1, 2), batch=(1, 2), zero_mean=True, offset=100.0)
@example(seed=3, model=(127, 127), more=(33, 34), batch=(1, 1), zero_mean=True, offset=100.0)
@example(seed=3, model=(1, 1), more=(4, 6), batch=(1, 1), zero_mean=True, offset=0.0)  # one pixel: always flat
def test_kernels_agree_with_the_reference_on_any_size(name, dtype, seed, model, more, batch, zero_mean, offset):
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


# In blocks, as the CPU does it


def assert_scores_are_the_references(search, templates):
    scores = ncc(torch.from_numpy(search), torch.from_numpy(templates)).numpy()
    np.testing.assert_allclose(scores, reference_scores(search, templates), rtol=0, atol=1e-5)


def divide_small_windows(patch):
    """A cost that grows past 32 px a side: small windows are divided as large ones are."""
    patch.setattr(blocks, "_CACHED_SIDE", 32)
    patch.setattr(blocks, "_division", blocks._division.__wrapped__)


@settings(max_examples=12)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(30, 70), st.integers(30, 70)),
    model=st.tuples(st.integers(2, 20), st.integers(2, 20)),
    count=st.integers(1, 3),
    threads=st.integers(1, 2),
)
def test_blocks_are_the_window(seed, size, model, count, threads):
    rng = np.random.default_rng(seed)
    search = rng.normal(0.0, 30.0, (1, *size)).astype(np.float32)
    templates = rng.normal(0.0, 30.0, (1, count, *model)).astype(np.float32)
    before = chosen.count()
    with pytest.MonkeyPatch.context() as patch:
        divide_small_windows(patch)
        chosen.set_threads(threads)
        try:
            assert_scores_are_the_references(search, templates)
        finally:
            chosen.set_threads(before)


@pytest.mark.parametrize("divided", [False, True])
def test_weak_patches_beside_strong_ones(divided, monkeypatch):
    """A thousand times the contrast in one corner: float32 transforms would lose the rest."""
    if divided:
        divide_small_windows(monkeypatch)
    rng = np.random.default_rng(7)
    search = rng.normal(0.0, 1.0, (1, 80, 90)).astype(np.float32)
    search[0, :20, :20] *= 1000.0
    templates = np.stack([search[0, 50:62, 60:75], rng.normal(0.0, 1.0, (12, 15))])[None].astype(np.float32)
    for count in (1, 2):
        assert_scores_are_the_references(search, np.ascontiguousarray(templates[:, :count]))


@pytest.mark.parametrize("scale", [1e-15, 1e15])
def test_dim_and_bright_pictures_score_as_others(scale):
    rng = np.random.default_rng(8)
    search = (scale * rng.normal(5.0, 1.0, (1, 40, 50))).astype(np.float32)
    templates = (scale * rng.normal(5.0, 1.0, (1, 1, 12, 15))).astype(np.float32)
    scores = ncc(torch.from_numpy(search), torch.from_numpy(templates)).numpy()
    np.testing.assert_allclose(scores, reference_scores(search / scale, templates / scale), rtol=0, atol=1e-5)


@given(seed=st.integers(0, 2**32 - 1), model=st.tuples(st.integers(2, 20), st.integers(2, 20)))
@settings(max_examples=12)
def test_a_prepared_crop_scores_as_the_reference(seed, model):
    """By the loops and, as on a device, by running sums, which take four times the picture's memory."""
    rng = np.random.default_rng(seed)
    image, templates = (rng.normal(0.0, 1.0, shape).astype(np.float32) for shape in ((60, 70), (2, *model)))
    expected = reference_scores(image[None, 3:40, 7:48], templates[None])[0]
    picture = torch.from_numpy(image)
    with_sums = MapRegion(picture, sums=tensors.integrals(picture))
    for whole, has_sums in ((prepare(picture), False), (with_sums, True)):
        part = whole.crop(7, 3, 41, 37)
        assert (part.sums is not None) == has_sums
        for count in (1, 2):
            scores = surface(part, torch.from_numpy(templates[:count]))
            np.testing.assert_allclose(scores.numpy(), expected[:count], rtol=0, atol=1e-5)


@given(
    seed=st.integers(0, 2**32 - 1),
    model=st.tuples(st.integers(1, 21), st.integers(2, 16)),
    more=st.tuples(st.integers(0, 20), st.integers(0, 30)),
    flat=st.sampled_from([(0.5, 0.0), (0.0, 0.5)]),
)
@settings(max_examples=40)
def test_scores_at_a_few_places_are_the_references(seed, model, more, flat):
    """About the middle and both ends of a picture of which the right half, or all, is flat."""
    rng = np.random.default_rng(seed)
    image = rng.normal(size=[n + m for n, m in zip(model, more, strict=True)]).astype(np.float32)
    image[:, round(flat[0] * image.shape[1]) :] = flat[1]
    template = rng.normal(size=model).astype(np.float32)
    template -= template.mean()
    expected = reference.ncc_surface(image, template, zero_mean=True)
    last = np.array(expected.shape) - 1
    for middle in (0 * last, last // 2, last):
        scorer = LocalScores(image, template, tuple(middle.tolist()))
        places = np.argwhere(np.ones(expected.shape))
        y, x = places[np.abs(places - middle).max(axis=1) <= scorer.REACH].T
        np.testing.assert_allclose(scorer.at(y, x), expected[y, x], rtol=0, atol=1e-5)


def test_views_are_taken():
    search = torch.randn(2, 50, 60, generator=torch.Generator().manual_seed(0)).transpose(1, 2)
    templates = torch.randn(1, 1, 9, 11, generator=torch.Generator().manual_seed(1)).expand(2, 3, -1, -1)
    assert_close(ncc(search, templates), ncc(search.contiguous(), templates.contiguous()))


def test_gradients_of_templates_come_from_the_tensor_ops():
    templates = torch.randn(1, 1, 8, 9, generator=torch.Generator().manual_seed(1)).requires_grad_()
    ncc(torch.randn(1, 20, 22, generator=torch.Generator().manual_seed(0)), templates).max().backward()
    assert templates.grad is not None
