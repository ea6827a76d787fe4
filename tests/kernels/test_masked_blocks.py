"""Masked NCC of whole templates: sums over the whole window in float64 are the reference."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from engine.kernels import masked_blocks, masked_tensors
from engine.ncc_fft import ncc

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


def drawn(kind, size, model, count=2, mean=0.0):
    """A window with nodata, and templates of which the first is from it, under noise."""
    rng = np.random.default_rng([len(kind), *size, *model])
    window = cv2.GaussianBlur(rng.normal(0.0, 5.0, size), (0, 0), 1.5) + rng.normal(0.0, 0.3, size) + mean
    templates = rng.normal(0.0, 1.0, (count, *model)) + mean
    y, x = ((n - m) // 2 for n, m in zip(size, model, strict=True))
    templates[0] += window[y : y + model[0], x : x + model[1]] - mean
    return window, mask_of(kind, size, rng), templates


def reference(window, valid, templates, min_overlap):
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
        monkeypatch.setattr(masked_blocks, "_DIVISIONS", divisions)
    window, valid, templates = drawn(kind, size, model)
    window, templates = (values.astype(np.float32).astype(np.float64) for values in (window, templates))
    expected = reference(window, valid, templates, min_overlap)
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
