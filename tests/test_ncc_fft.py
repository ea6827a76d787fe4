"""Normalised cross-correlation against OpenCV, scikit-image and the reference; its invariants; the peak."""

import re

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, shift

from engine import DtypeError, OptionError, ShapeError
from engine.ncc_fft import find_peak, ncc
from tests.support.refusals import refusal

MODES = {True: cv2.TM_CCOEFF_NORMED, False: cv2.TM_CCORR_NORMED}
LEVELS = {"uint8": (0, 256), "int16": (-3000, 3000), "uint16": (0, 65536), "int32": (-100_000, 100_000)}
LEVELS |= dict.fromkeys(("float16", "float32", "float64"), (-50, 200))
SIZES = [
    ((31, 47), (7, 11)),  # odd, prime
    ((64, 64), (16, 16)),
    ((63, 100), (50, 33)),
    ((1, 60), (1, 13)),  # one row
    ((60, 1), (13, 1)),  # one column
    ((29, 37), (29, 37)),  # template = window: one score
    ((23, 19), (23, 4)),
]


def draw(rng, dtype, shape):
    low, high = LEVELS[dtype]
    values = rng.uniform(low, high, shape)
    return (values if dtype.startswith("float") else np.floor(values)).astype(dtype)


@pytest.mark.parametrize("zero_mean", [True, False], ids=["ccoeff", "ccorr"])
@pytest.mark.parametrize("dtype", LEVELS)
@pytest.mark.parametrize(("size", "model"), SIZES)
def test_ncc_equals_opencv(size, model, dtype, zero_mean):
    rng = np.random.default_rng(11)
    search, templates = draw(rng, dtype, (2, *size)), draw(rng, dtype, (2, 3, *model))
    scores = ncc(torch.from_numpy(search), torch.from_numpy(templates), zero_mean=zero_mean)
    assert scores.shape == (2, 3, size[0] - model[0] + 1, size[1] - model[1] + 1)
    assert scores.dtype == (torch.float64 if dtype == "float64" else torch.float32)
    search, templates = search.astype(np.float32), templates.astype(np.float32)  # what matchTemplate takes
    for b, t in np.ndindex(2, 3):
        expected = cv2.matchTemplate(search[b], templates[b, t], MODES[zero_mean])
        np.testing.assert_allclose(scores[b, t].numpy(), expected, rtol=0, atol=1e-5)


def test_whole_numbers_are_not_rounded_to_float32():
    """Which holds steps of 32 at this height."""
    low = torch.randint(0, 64, (1, 20, 24), generator=torch.Generator().manual_seed(2), dtype=torch.int32)
    scores = ncc(low + 2**28, low[:, None, 5:13, 6:14].contiguous())
    assert float(scores[0, 0, 5, 6]) == pytest.approx(1.0, abs=1e-6)


def test_a_dark_window_in_a_batch_does_not_disturb_a_bright_one():
    rng = torch.Generator().manual_seed(4)
    search = torch.rand(2, 60, 60, generator=rng) * torch.tensor([1e-3, 1e4])[:, None, None]
    for scores in ncc(search, search[:, None, 20:40, 10:30]):
        assert float(scores[0, 20, 10]) == pytest.approx(1.0, abs=1e-6)


@given(
    seed=st.integers(0, 2**32 - 1),
    gain=st.floats(0.01, 100.0),
    offset=st.floats(-1000.0, 1000.0),
    at=st.tuples(st.integers(0, 20), st.integers(0, 25)),
)
def test_a_perfect_match_is_one_and_an_inverted_one_minus_one(seed, gain, offset, at):
    search = torch.from_numpy(np.random.default_rng(seed).normal(100.0, 20.0, (1, 36, 41)))
    y, x = at
    template = gain * search[:, None, y : y + 16, x : x + 16] + offset
    assert float(ncc(search, template)[0, 0, y, x]) == pytest.approx(1.0, abs=1e-9)
    assert float(ncc(search, -template)[0, 0, y, x]) == pytest.approx(-1.0, abs=1e-9)
    index = int(ncc(search, template)[0, 0].argmax())
    assert divmod(index, 26) == (y, x)  # surface[y, x] belongs to the template's top-left pixel on (x, y)


@pytest.mark.parametrize("zero_mean", [True, False])
def test_flat_patches_and_templates_score_zero_and_never_nan(zero_mean):
    rng = torch.Generator().manual_seed(6)
    search = torch.randint(0, 256, (2, 50, 60), generator=rng, dtype=torch.uint8)
    level = 200 if zero_mean else 0  # without the mean taken off only black has no energy
    search[:, :20, :30] = level
    templates = torch.randint(0, 256, (2, 2, 9, 12), generator=rng, dtype=torch.uint8)
    templates[:, 1] = level
    scores = ncc(search, templates, zero_mean=zero_mean)
    assert torch.isfinite(scores).all()
    assert not scores[:, 0, : 20 - 8, : 30 - 11].any()
    assert not scores[:, 1].any()
    assert scores[:, 0, 25:, 35:].any()


@pytest.mark.parametrize("level", [0.0, 0.1, 1 / 3, 255.0, 1e6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_window_or_template_of_one_grey_level_scores_zero(level, dtype):
    """0.1 and 1/3 have no exact sum: what rounding leaves must not be taken for texture."""
    search = torch.rand(1, 41, 37, generator=torch.Generator().manual_seed(0), dtype=dtype)
    assert not ncc(torch.full_like(search, level), search[:, None, :7, :9]).any()
    assert float(ncc(search, torch.full((1, 1, 7, 9), level, dtype=dtype)).abs().max()) < 1e-6


@given(seed=st.integers(0, 2**32 - 1), bright=st.floats(1.0, 1e6), flat=st.booleans(), zero_mean=st.booleans())
def test_scores_stay_within_minus_one_and_one(seed, bright, flat, zero_mean):
    rng = np.random.default_rng(seed)
    search = rng.normal(0.0, 1.0, (1, 30, 30)).astype(np.float32)
    search[0, :10, :10] *= bright  # a glint in the window must not lift weak patches over 1
    if flat:
        search[0, 18:, 18:] = 3.0
    template = search[:, None, 12:20, 12:20] if seed % 2 else rng.normal(size=(1, 1, 8, 8)).astype(np.float32)
    scores = ncc(torch.from_numpy(search), torch.from_numpy(np.ascontiguousarray(template)), zero_mean=zero_mean)
    assert -1.0 <= float(scores.min()) <= float(scores.max()) <= 1.0


@pytest.mark.parametrize(
    ("search", "templates", "error", "names"),
    [
        (torch.zeros(8, 8), torch.zeros(1, 1, 2, 2), ShapeError, "search"),
        (torch.zeros(1, 0, 8), torch.zeros(1, 1, 2, 2), ShapeError, "search"),
        (torch.zeros(1, 8, 8), torch.zeros(1, 2, 2), ShapeError, "templates"),
        (torch.zeros(1, 8, 8), torch.zeros(1, 1, 0, 2), ShapeError, "templates"),
        (torch.zeros(2, 8, 8), torch.zeros(1, 1, 2, 2), ShapeError, "templates"),
        (torch.zeros(1, 8, 8), torch.zeros(1, 1, 9, 2), ShapeError, "templates"),
        (torch.zeros(1, 8, 8), torch.zeros(1, 1, 2, 9), ShapeError, "templates"),
        (torch.zeros(1, 8, 8, dtype=torch.int64), torch.zeros(1, 1, 2, 2), DtypeError, "search"),
        (torch.zeros(1, 8, 8), torch.zeros(1, 1, 2, 2, dtype=torch.bool), DtypeError, "templates"),
        (torch.zeros(1, 8, 8, dtype=torch.complex64), torch.zeros(1, 1, 2, 2), DtypeError, "search"),
        (torch.full((1, 8, 8), torch.nan), torch.zeros(1, 1, 2, 2), OptionError, "search"),
        (torch.zeros(1, 8, 8), torch.full((1, 1, 2, 2), torch.inf), OptionError, "templates"),
        (torch.zeros(1, 8, 8), torch.zeros(1, 1, 2, 2, dtype=torch.uint8, device="meta"), OptionError,
         "templates"),
    ],
)  # fmt: skip
def test_errors_name_the_argument_what_was_expected_and_what_came(search, templates, error, names):
    assert re.match(rf"{names}: expected .+, got .+", refusal(ncc, search, templates, error=error))


@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.3, -0.2), (-0.45, 0.4), (0.5, 0.1)])
def test_the_peak_of_a_shifted_picture_is_found_below_the_pixel(dx, dy):
    picture = gaussian_filter(np.random.default_rng(8).normal(size=(90, 90)), 2.0)
    # The content moves by (dx, dy), so that the template lies at (30 - dx, 25 - dy) of the picture.
    template = shift(picture, (dy, dx), order=5, mode="mirror")[25:65, 30:70]
    surface = ncc(torch.from_numpy(picture)[None], torch.from_numpy(template)[None, None])[0, 0]
    peak = find_peak(surface, exclusion_px=6.0)
    assert (peak.x, peak.y) == (pytest.approx(30 - dx, abs=0.03), pytest.approx(25 - dy, abs=0.03))
    assert peak.score > 0.95
    assert np.linalg.eigvalsh(peak.curvature).max() < 0


@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 14), st.integers(1, 14)),
    radius=st.one_of(st.floats(0.0, 20.0), st.integers(0, 15).map(float), st.just(np.sqrt(2.0)), st.just(5.0)),
)
def test_the_rival_is_the_best_score_outside_the_disc(seed, size, radius):
    surface = np.random.default_rng(seed).uniform(-0.9, 0.9, size).astype(np.float32)
    peak = find_peak(torch.from_numpy(surface), exclusion_px=radius)
    y, x = np.unravel_index(surface.argmax(), size)
    rows, columns = np.ogrid[: size[0], : size[1]]
    outside = (rows - y) ** 2 + (columns - x) ** 2 > radius * radius
    expected = surface[outside].max() if outside.any() else -1.0
    assert peak.score == surface[y, x]
    assert peak.second_score == pytest.approx(float(expected), abs=0)
    assert max(abs(peak.x - x), abs(peak.y - y)) <= 0.5


@pytest.mark.parametrize("place", [(0, 0), (0, 9), (6, 0), (6, 9), (0, 4), (3, 0), (6, 5), (2, 9)])
def test_a_peak_on_the_border_is_not_refined(place):
    y, x = place
    surface = torch.rand(7, 10, generator=torch.Generator().manual_seed(3)) * 0.5
    surface[y, x] = 0.9
    peak = find_peak(surface, exclusion_px=1.0)
    assert (peak.x, peak.y) == (x, y)
    assert not peak.curvature.any()


@pytest.mark.parametrize("size", [(4,), (0, 4), (1, 4, 4)])
def test_a_peak_needs_a_surface(size):
    with pytest.raises(ShapeError, match=r"^scores: expected \(H, W\) with no empty axis, got "):
        find_peak(torch.zeros(size), exclusion_px=1.0)
