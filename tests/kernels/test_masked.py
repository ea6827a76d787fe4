"""Masked NCC: small windows against sums pixel by pixel, whole templates against sums over the whole window."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from engine import DtypeError, OptionError, ShapeError
from engine.kernels import masked_blocks, masked_tensors, reference
from engine.kernels.local import LocalScores
from engine.ncc_fft import ncc

CASES = [((9, 11), (4, 5)), ((13, 7), (13, 7)), ((1, 17), (1, 6)), ((12, 12), (3, 3)), ((8, 19), (7, 2))]


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


def masked(search, search_valid, template, min_overlap=0.5):
    return ncc(search[None], template[None, None], search_valid=search_valid[None], min_overlap=min_overlap)[0, 0]


def draw(rng, size, model, mean=100.0, deviation=20.0, share=0.8):
    pictures = [np.rint(rng.normal(mean, deviation, shape)) for shape in (size, model)]
    return pictures[0], rng.random(size) < share, pictures[1]


@pytest.mark.parametrize("min_overlap", [0.1, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("offset", [(100.0, 20.0), (20_000.0, 10.0)], ids=str)
@pytest.mark.parametrize(("size", "model"), CASES)
def test_masked_scores_are_those_done_by_hand(size, model, offset, min_overlap):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        given = draw(rng, size, model, *offset, share=rng.uniform(0.4, 1.0))
        expected = by_hand(*given, min_overlap)
        scores = masked(*given, min_overlap)
        assert scores.dtype == np.float64
        np.testing.assert_allclose(scores, expected, rtol=0, atol=1e-7)
        single = masked(given[0].astype(np.float32), given[1], given[2].astype(np.float32), min_overlap)
        assert single.dtype == np.float32
        np.testing.assert_allclose(single, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32, np.float64])
def test_a_mask_that_is_all_true_changes_nothing(dtype):
    rng = np.random.default_rng(2)
    search, template = (rng.integers(0, 256, shape).astype(dtype) for shape in ((40, 50), (13, 17)))
    whole = masked(search, np.ones(search.shape, bool), template)
    np.testing.assert_allclose(whole, ncc(search[None], template[None, None])[0, 0], rtol=0, atol=1e-6)


def test_a_batch_of_masks_is_its_members_one_by_one():
    rng = np.random.default_rng(3)
    search, templates = (rng.normal(size=size) for size in ((2, 30, 31), (2, 3, 9, 8)))
    valid = rng.random((2, 30, 31)) < 0.9
    together = ncc(search, templates, search_valid=valid)
    for b in range(2):
        for t in range(3):
            alone = masked(search[b], valid[b], templates[b, t])
            np.testing.assert_allclose(together[b, t], alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("rubbish", [0.0, -1e9, 1e15])
def test_what_lies_under_a_mask_is_never_seen(rubbish, dtype):
    rng = np.random.default_rng(4)
    search, search_valid, template = draw(rng, (33, 29), (11, 10))
    clean = masked(search.astype(dtype), search_valid, template.astype(dtype))
    search[~search_valid] = rubbish
    dirty = masked(search.astype(dtype), search_valid, template.astype(dtype))
    np.testing.assert_allclose(dirty, clean, rtol=0, atol=1e-9)


def test_without_a_valid_pixel_no_place_counts():
    search, _, template = draw(np.random.default_rng(5), (20, 24), (5, 6))
    assert (masked(search, np.zeros(search.shape, bool), template) == -1.0).all()


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


KINDS = ("border", "slanted", "holes", "speckles", "half", "nearly nothing")


def mask_of(kind, shape, rng):
    y, x = np.mgrid[: shape[0], : shape[1]]
    valid = np.ones(shape, bool)
    if kind == "border":
        valid[:9], valid[-4:], valid[:, :13] = False, False, False
    elif kind == "slanted":
        valid = (y > 0.05 * shape[0] + 0.1 * x) & (x < 0.97 * shape[1] - 0.03 * y)
    elif kind == "holes":
        for _ in range(4):
            j, i = (int(rng.integers(0, n - 10)) for n in shape)
            valid[j : j + 12, i : i + 25] = False
    elif kind == "speckles":
        valid = rng.random(shape) < 0.97
    elif kind == "half":
        valid[:, : shape[1] // 2] = False
    else:
        valid[:] = False
        valid[: shape[0] // 3, -shape[1] // 3 :] = True
    return valid


def drawn(kind, size, model):
    """A window with nodata, and templates of which the first is from it, under noise."""
    rng = np.random.default_rng([len(kind), *size, *model])
    window = cv2.GaussianBlur(rng.normal(0.0, 5.0, size), (0, 0), 1.5) + rng.normal(0.0, 0.3, size)
    templates = rng.normal(0.0, 1.0, (2, *model))
    y, x = ((n - m) // 2 for n, m in zip(size, model, strict=True))
    templates[0] += window[y : y + model[0], x : x + model[1]]
    return window, mask_of(kind, size, rng), templates


def by_whole_windows(window, valid, templates, min_overlap):
    tensors = torch.from_numpy(window)[None], torch.from_numpy(valid)[None], torch.from_numpy(templates)[None]
    return masked_tensors.ncc_surface(*tensors, min_overlap=min_overlap)[0].numpy()


@pytest.mark.parametrize("divisions", [(1,), (3,), (16,), None], ids=["whole", "in 3", "in 16", "small"])
@pytest.mark.parametrize("min_overlap", [0.3001, 0.8999])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("size", "model"), [((230, 317), (48, 61)), ((400, 260), (21, 20)), ((97, 90), (90, 90))])
def test_scores_are_those_of_the_whole_windows_sums(kind, min_overlap, size, model, divisions, monkeypatch):
    """Windows that count as small are neither divided nor scored in two ways."""
    if divisions is not None:
        monkeypatch.setattr(masked_blocks, "_SMALL_PX", 0)
        monkeypatch.setattr(masked_blocks, "_divisions", lambda places: divisions)
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
        scores = masked_blocks.ncc_surface(window.astype(dtype)[None], valid[None], flat[None], min_overlap=0.5)[0]
        assert np.abs(scores[scores > -1.0]).max(initial=0.0) < 1e-6
        half = window.astype(dtype)
        half[:, :80] = level
        scores = masked_blocks.ncc_surface(half[None], valid[None], templates.astype(dtype)[None], min_overlap=0.5)
        scores = scores[0, :, :, : 80 - 31]
        assert np.abs(scores[scores > -1.0]).max(initial=0.0) < 1e-6


# Scores at a handful of places


@pytest.mark.parametrize(
    ("size", "model"), [((40, 37), (21, 16)), ((9, 9), (9, 9)), ((12, 30), (11, 7)), ((1, 30), (1, 9))]
)
def test_local_scores_are_the_references_also_at_edges_and_corners(size, model):
    rng = np.random.default_rng(6)
    image = rng.normal(size=size).astype(np.float32)
    template = rng.normal(size=model).astype(np.float32)
    template -= template.mean()
    expected = reference.ncc_surface(image, template, zero_mean=True)
    rows, columns = expected.shape
    for middle in {(0, 0), (rows - 1, 0), (0, columns - 1), (rows - 1, columns - 1), (rows // 2, columns // 2)}:
        scorer = LocalScores(image, template, middle)
        assert scorer.limits == (rows - 1, columns - 1)
        reach = scorer.REACH
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1) + np.array(middle)[:, None]
        fits = (y >= 0) & (x >= 0) & (y < rows) & (x < columns)
        scores = scorer.at(y[fits], x[fits])
        np.testing.assert_allclose(scores, expected[y[fits], x[fits]], rtol=0, atol=1e-5)


def test_local_scores_of_flat_pixels_are_zero():
    rng = np.random.default_rng(7)
    template = rng.normal(size=(12, 13)).astype(np.float32)
    template -= template.mean()
    for picture in (np.zeros((30, 30), np.float32), np.full((30, 30), 0.5, np.float32)):
        scorer = LocalScores(picture, template, (8, 8))
        assert not scorer.at(np.arange(6, 10), np.arange(6, 10)).any()
    flat = LocalScores(picture, np.zeros((12, 13), np.float32), (8, 8))
    assert not flat.at(np.arange(6, 10), np.arange(6, 10)).any()
