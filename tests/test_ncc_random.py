"""Ten thousand random surfaces against sliding windows in float64; the quick tests take a tenth of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view

from engine.ncc_fft import ncc

DTYPES = ("uint8", "int16", "uint16", "int32", "float16", "float32", "float64")
SIZES = [(63, 63), (100, 100), (257, 17), (1, 257), (101, 1), (97, 53), (16, 16), (31, 29)]
BATCHES = 160  # of a type, of 9.9 surfaces on average
MEANS = [(0.0, 1.0), (100.0, 30.0), (20_000.0, 10.0)]


def sliding(search, templates):
    """Scores (B, T, Y, X) in float64, 0 where the patch or the template is flat."""
    window = search.astype(np.float64)
    window -= window.mean(axis=(1, 2), keepdims=True)
    model = templates.astype(np.float64)
    flat_model = np.ptp(templates.astype(np.float64), axis=(2, 3)) == 0
    model -= model.mean(axis=(2, 3), keepdims=True)
    patches = sliding_window_view(window, model.shape[2:], axis=(1, 2))
    count = model.shape[2] * model.shape[3]
    energy = np.einsum("byxhw,byxhw->byx", patches, patches) - count * patches.mean(axis=(-2, -1)) ** 2
    flat = energy <= 1e-12 * np.square(window).sum(axis=(1, 2))[:, None, None]
    norm = np.sqrt(np.where(flat, 1.0, energy)[:, None] * np.square(model).sum(axis=(2, 3))[..., None, None])
    products = np.einsum("byxhw,bthw->btyx", patches, model, optimize=True)
    dead = flat[:, None] | flat_model[..., None, None]
    return np.where(dead, 0.0, products / np.where(dead, 1.0, norm))


def draw(rng, dtype, shape, mean, deviation):
    if dtype == "uint8":
        return rng.integers(0, 256, shape).astype(dtype)
    values = rng.normal(mean, deviation, shape)
    if dtype == "uint16":
        values = np.abs(values)
    return (np.rint(values) if "int" in dtype else values).astype(dtype)


@pytest.mark.parametrize("batches", [BATCHES // 10, pytest.param(BATCHES, marks=pytest.mark.slow)])
@pytest.mark.parametrize("dtype", DTYPES)
def test_surfaces_are_those_of_sliding_windows(dtype, batches):
    for number in range(batches):
        rng = np.random.default_rng([DTYPES.index(dtype), number])
        height, width = SIZES[number % len(SIZES)]
        h, w = (int(rng.integers(1, min(n, 24) + 1)) for n in (height, width))
        count, hypotheses = int(rng.integers(1, 4)), int(rng.integers(1, 10))
        mean, deviation = MEANS[int(rng.integers(0, 3))]
        search = draw(rng, dtype, (count, height, width), mean, deviation)
        templates = draw(rng, dtype, (count, hypotheses, h, w), mean, deviation)
        y, x = int(rng.integers(0, height - h + 1)), int(rng.integers(0, width - w + 1))
        kind = number % 4  # of the first template: chance, a perfect match, an inverted one, flat
        if kind in (1, 2):
            patch = search[:, y : y + h, x : x + w]
            templates[:, 0] = patch if kind == 1 else patch.max() - patch + patch.min()
        elif kind == 3:
            templates[:, 0] = templates[0, 0, 0, 0]
        scores = ncc(torch.from_numpy(search), torch.from_numpy(templates)).double().numpy()
        np.testing.assert_allclose(scores, sliding(search, templates), rtol=0, atol=1e-5)
        assert np.abs(scores).max() <= 1.0
