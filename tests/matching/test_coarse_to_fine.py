"""One template in a prepared map: coarse to fine against every place, positions below the pixel, rivals.

What holds: the peak is the exhaustive one. ``second_score`` is the exhaustive one where all places were scored;
coarse to fine it is that of half-resolution scores where the rival cannot win, and exact where it comes near.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from engine import ShapeError, ncc_fft
from engine.kernels import coarse_to_fine
from engine.kernels.scores import enhance
from engine.ncc_fft import match_template, prepare
from tests.support.towns import drawn_town

KINDS = ("fine", "broad", "mixed", "town", "tiles", "flat")
DETAIL_PX = {"fine": (0.8, 2.5), "broad": (4.0, 12.0)}
CASES_A_KIND = 30
EXCLUSION_PX = (12.0, 5.0)


def texture(rng, size, correlation_px):
    field = cv2.GaussianBlur(rng.standard_normal(size), (0, 0), correlation_px)
    return np.clip(np.rint(128.0 + 40.0 * field / field.std()), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def town():
    return cv2.cvtColor(drawn_town(1).ortho, cv2.COLOR_RGB2GRAY)


def ground(rng, kind, size, town):
    if kind in DETAIL_PX:
        return texture(rng, size, rng.uniform(*DETAIL_PX[kind]))
    if kind == "mixed":
        return texture(rng, size, 1.5) // 2 + texture(rng, size, 8.0) // 2
    if kind == "town":
        y, x = (int(rng.integers(0, n - m)) for n, m in zip(town.shape, size, strict=True))
        return town[y : y + size[0], x : x + size[1]]
    if kind == "tiles":
        return np.tile(texture(rng, rng.integers(40, 130, 2), 1.5), (11, 11))[: size[0], : size[1]]
    picture = texture(rng, size, 2.0)
    for _ in range(3):
        y, x = (int(rng.integers(0, n - 80)) for n in size)
        picture[y : y + 80, x : x + 110] = rng.integers(0, 255)
    return picture


def draw_case(kind, number, town):
    """A crop of a prepared picture and a noisy, sometimes foreign, template; true scores from 0.1 to 1."""
    rng = np.random.default_rng([KINDS.index(kind), number])
    height, width = (int(n) for n in rng.integers(200, 420, 2))
    picture = ground(rng, kind, (height, width), town)
    x0, y0 = (int(n) for n in rng.integers(0, 33, 2))
    if number % 3:
        x0, y0 = x0 & -8, y0 & -8  # as a prepared map cuts; others have no half-resolution levels
    h, w = int(rng.integers(96, min(height - y0, 300) - 18)), int(rng.integers(96, min(width - x0, 300) - 18))
    y, x = int(rng.integers(y0, height - h + 1)), int(rng.integers(x0, width - w + 1))
    noise = rng.choice([0.0, 2.0, 10.0, 40.0, 120.0])
    shown = picture[y : y + h, x : x + w] + rng.normal(0.0, 1.0, (h, w)) * noise
    patch = np.clip(np.rint(shown), 0, 255).astype(np.uint8)
    if number % 7 == 6:
        patch = texture(rng, (h, w), 1.5)
    search = prepare(torch.from_numpy(enhance(picture))).crop(x0, y0, width - x0, height - y0)
    return search, torch.from_numpy(enhance(patch))


def assert_same_peak(quick, full, search, template):
    assert quick.score == pytest.approx(full.score, abs=1e-5)
    if math.hypot(quick.x - full.x, quick.y - full.y) > 1e-3:  # of two equal places either may be taken
        surface = ncc_fft.surface(search, template[None])[0]
        assert float(surface[round(quick.y), round(quick.x)]) == pytest.approx(full.score, abs=1e-5)
        assert quick.second_score == pytest.approx(full.score, abs=1e-5)


@pytest.mark.parametrize(
    ("kind", "cases"),
    [("town", 10), ("flat", 10), *(pytest.param(kind, CASES_A_KIND, marks=pytest.mark.slow) for kind in KINDS)],
)
def test_coarse_to_fine_finds_what_an_exhaustive_search_finds(kind, cases, town):
    quicker = 0
    for number in range(cases):
        search, template = draw_case(kind, number, town)
        for exclusion_px in EXCLUSION_PX:
            full = match_template(search, template, exclusion_px=exclusion_px, exhaustive=True)
            assert_same_peak(match_template(search, template, exclusion_px=exclusion_px), full, search, template)
            quick = coarse_to_fine.peak(search, template.numpy(), exclusion_px)
            if quick is None:  # not trusted: every place is scored
                continue
            quicker += 1
            assert_same_peak(quick, full, search, template)
            # An ambiguity is never overlooked: near the peak a rival's score is exact, further below 0.15 off.
            assert quick.second_score >= full.second_score - 0.15
            if full.score - full.second_score < 0.1:
                assert quick.second_score == pytest.approx(full.second_score, abs=0.01)
    assert quicker > 0.2 * cases * len(EXCLUSION_PX)


@pytest.mark.parametrize("offset", [0, 1, 2, 3, 5, 7])
def test_a_double_between_the_pixels_of_a_coarse_level_is_an_equal_rival(offset):
    """The true place lies on whole coarse pixels, its exact double between them, where coarse scores are lower."""
    rng = np.random.default_rng(offset)
    picture = texture(rng, (300, 500), 1.2)
    picture[101 + offset : 221 + offset, 301:441] = picture[40:160, 48:188]
    enhanced = torch.from_numpy(enhance(picture))
    template = enhanced[50:150, 58:178]
    search = prepare(enhanced)
    for exhaustive in (False, True):
        peak = match_template(search, template, exclusion_px=10.0, exhaustive=exhaustive)
        assert peak.score == pytest.approx(1.0, abs=1e-5)
        assert peak.second_score == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    ("size", "model"),
    [((150, 160), (150, 160)), ((150, 160), (149, 160)), ((150, 160), (150, 159)), ((131, 257), (101, 97)),
     ((1, 300), (1, 120)), ((300, 1), (120, 1)), ((199, 400), (198, 111)), ((129, 129), (97, 113))],
)  # fmt: skip
def test_odd_sizes_and_windows_with_no_room_fall_back(size, model):
    rng = np.random.default_rng(4)
    picture = torch.from_numpy(rng.normal(size=size).astype(np.float32))
    y, x = (size[0] - model[0]) // 2, (size[1] - model[1]) // 2
    template = picture[y : y + model[0], x : x + model[1]]
    quick = match_template(prepare(picture), template, exclusion_px=3.0)
    full = match_template(prepare(picture), template, exclusion_px=3.0, exhaustive=True)
    assert (round(quick.x), round(quick.y)) == (x, y)
    assert quick.score == pytest.approx(1.0, abs=1e-5)
    assert (quick.x, quick.y) == pytest.approx((full.x, full.y), abs=1e-3)


@pytest.mark.parametrize("level", [0.0, 3.3, -0.1])
def test_flat_pictures_and_templates_never_match(level):
    rng = np.random.default_rng(5)
    noise = torch.from_numpy(rng.normal(size=(300, 320)).astype(np.float32))
    flat = torch.full((300, 320), level)
    half = noise.clone()
    half[:, 40:] = level
    for picture, template in (
        (flat, noise[:120, :130]), (noise, flat[:120, :130]), (flat, flat[:120, :130]),
        (half, -noise[:120, 50:180]),
    ):  # fmt: skip
        for exhaustive in (False, True):
            peak = match_template(prepare(picture), template, exclusion_px=5.0, exhaustive=exhaustive)
            assert math.isfinite(peak.score)
            assert peak.score < 0.2


@pytest.mark.parametrize("model", [(4,), (0, 4), (1, 4, 4), (33, 8), (8, 41)])
def test_a_template_that_does_not_fit_is_named(model):
    search = prepare(torch.rand(32, 40, generator=torch.Generator().manual_seed(0)))
    with pytest.raises(ShapeError, match=r"^templates?: expected .+, got "):
        match_template(search, torch.zeros(model), exclusion_px=3.0)


# Below the pixel


FINER = 8
FRACTIONS = (0, 1, 2, 3, 4)  # eighths of a pixel


@pytest.mark.slow
def test_positions_below_the_pixel_are_within_a_twentieth_and_drawn_to_no_pixel():
    """Errors (fraction, case, axis) in pixels over textures of detail from 0.7 to 1.5 pixels."""
    errors = np.zeros((len(FRACTIONS), 12, 2))
    for number in range(12):
        rng = np.random.default_rng(number)
        detail_px = (0.7, 1.0, 1.5)[number % 3]
        fine = cv2.GaussianBlur(
            rng.standard_normal((200 * FINER, 200 * FINER), dtype=np.float32), (0, 0), detail_px * FINER
        )
        fine = 128.0 + 45.0 * fine / fine.std()

        def photograph(y, x, n, fine=fine, rng=rng):
            part = fine[y : y + n * FINER, x : x + n * FINER]
            levels = part.reshape(n, FINER, n, FINER).mean(axis=(1, 3)) + rng.normal(0.0, 2.0, (n, n))
            return enhance(np.clip(np.rint(levels), 0, 255).astype(np.uint8))

        search = prepare(torch.from_numpy(photograph(0, 0, 200)))
        for i, fraction in enumerate(FRACTIONS):
            x, y = rng.integers(25, 60, 2)
            other = int(rng.integers(0, 5))
            template = photograph(y * FINER + other, x * FINER + fraction, 120)
            peak = match_template(search, torch.from_numpy(template), exclusion_px=10.0)
            errors[i, number] = peak.x - x - fraction / FINER, peak.y - y - other / FINER
    assert np.sqrt(np.mean(errors**2)) <= 0.05
    assert np.abs(errors[..., 0].mean(axis=1)).max() <= 0.02
