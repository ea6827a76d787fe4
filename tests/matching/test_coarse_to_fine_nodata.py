"""Coarse to fine over nodata: the peak is that of every place by the masked sums; quick looks in wide windows.

The reference is the masked surface, which has tests of its own against sums by hand.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from engine import Fix, MatcherOptions, NccOptions, SceneMatcher
from engine.budget import Budget
from engine.kernels import coarse_to_fine
from engine.kernels.coarse_to_fine import EarlyStop
from engine.kernels.local import LocalScores
from engine.kernels.peaks import find_peak
from engine.kernels.scores import enhance
from engine.kernels.search_levels import prepare
from engine.kernels.sums import counts
from engine.matching.correlation import _EVERY_PLACE
from engine.ncc_fft import ncc
from engine.values import Reason
from tests.support.ground import CAMERA, Ground

MIN_OVERLAP = 0.9
SHARES = (0.01, 0.1, 0.3, 0.6)


def texture(rng, size, detail_px=1.5):
    field = cv2.GaussianBlur(rng.standard_normal(size), (0, 0), detail_px)
    field += 2.0 * cv2.GaussianBlur(rng.standard_normal(size), (0, 0), 4.0 * detail_px)
    return np.clip(np.rint(128.0 + 40.0 * field / field.std()), 0, 255).astype(np.uint8)


def mask_of(rng, size, share):
    """A turned rectangle of map in nodata, with a hole."""
    valid, side = np.zeros(size, np.uint8), math.sqrt(1.0 - share)
    box = cv2.boxPoints(((size[1] / 2, size[0] / 2), (size[1] * side, size[0] * side), rng.uniform(-10.0, 10.0)))
    cv2.fillPoly(valid, [box.astype(np.int32)], 1)
    cv2.circle(valid, (size[1] // 4, size[0] // 4), 20, 0, -1)
    return valid.astype(bool)


def drawn(seed, share, size=(420, 460), model=(110, 130), noise=10.0, detail_px=1.5):
    """A window with nodata and a noisy template from where at least most of it is on the map."""
    rng = np.random.default_rng([seed, round(100 * share)])
    gray, valid = texture(rng, size, detail_px), mask_of(rng, size, share)
    h, w = model
    inside = counts(valid)
    inside = (inside[h:, w:] - inside[:-h, w:] - inside[h:, :-w] + inside[:-h, :-w]) >= MIN_OVERLAP * h * w
    y, x = rng.choice(np.argwhere(inside[8:-8, 8:-8])) + 8
    shown = gray[y : y + h, x : x + w] + rng.normal(0.0, noise, model)
    template = enhance(np.clip(np.rint(shown), 0, 255).astype(np.uint8))
    image = enhance(gray, valid=valid)
    return prepare(image, valid=valid), image, valid, template, (x, y)


def every_place(image, valid, template):
    return ncc(image[None], template[None, None], search_valid=valid[None], min_overlap=MIN_OVERLAP)[0, 0]


@pytest.mark.parametrize("share", SHARES)
def test_scores_at_a_few_places_are_those_of_the_masked_surface(share):
    search, image, valid, template, (x, y) = drawn(1, share)
    surface = every_place(image, valid, template)
    model = template - template.mean()
    for j, i in ((y, x), (6, 6), (100, 105), (surface.shape[0] - 7, 40)):
        scorer = LocalScores(search.image, model, (j, i), search.counts, MIN_OVERLAP)
        around = np.mgrid[j - 5 : j + 6, i - 5 : i + 6].reshape(2, -1)
        rows, columns = around[:, (around[0] < surface.shape[0]) & (around[1] < surface.shape[1])]
        np.testing.assert_allclose(scorer.at(rows, columns), surface[rows, columns], rtol=0, atol=2e-6)


@pytest.mark.parametrize("share", SHARES)
def test_the_peak_over_nodata_is_that_of_every_place(share):
    certain = 0
    for seed in range(9):
        search, image, valid, template, at = drawn(seed, share, noise=(0.0, 20.0, 80.0)[seed % 3])
        full = find_peak(every_place(image, valid, template), exclusion_px=9.0)
        quick = coarse_to_fine.peak(search, template, 9.0, min_overlap=MIN_OVERLAP)
        if quick is None:
            continue
        certain += 1
        assert (quick.x, quick.y) == pytest.approx((full.x, full.y), abs=1e-3)
        assert (quick.x, quick.y) == pytest.approx(at, abs=0.5)
        assert quick.score == pytest.approx(full.score, abs=2e-6)
        np.testing.assert_allclose(quick.curvature, full.curvature, rtol=0, atol=1e-4)
        assert quick.second_score >= full.second_score - 0.15
    assert certain >= 4


@pytest.mark.parametrize("share", SHARES)
def test_scores_with_nodata_as_zero_are_those_without_it_where_there_is_none(share):
    search, image, valid, template, _ = drawn(2, share)
    surface = every_place(image, valid, template)
    (quick,) = coarse_to_fine.surfaces_over_nodata(search, template[None], min_overlap=MIN_OVERLAP, group=1)
    whole = surface > -1.0
    np.testing.assert_array_equal(quick > -1.0, whole)
    h, w = template.shape
    inside = cv2.erode(valid.astype(np.uint8), np.ones((h, w), np.uint8), anchor=(0, 0)) > 0
    inside = inside[: surface.shape[0], : surface.shape[1]]
    np.testing.assert_allclose(quick[inside], surface[inside], rtol=0, atol=2e-6)
    partly = whole & ~inside & (surface > 0.0)
    assert np.abs(quick[partly] - surface[partly]).max(initial=0.0) < 0.06


def test_a_quick_look_is_kept_only_where_the_caller_says_so(monkeypatch):
    search, image, valid, template, _ = drawn(3, 0.3)
    template = np.ascontiguousarray(template[::-1])  # shows no place of the map
    surface = every_place(image, valid, template)

    def look(clear, hopeless):
        quick = EarlyStop(lambda _: clear, lambda _: hopeless)
        return coarse_to_fine.peak(search, template, 9.0, min_overlap=MIN_OVERLAP, stop=quick)

    assert look(True, True) is None  # not wide
    monkeypatch.setattr(coarse_to_fine, "WIDE_PX", 1000)
    assert look(False, False) is None
    clear, hopeless = look(True, False), look(False, True)
    for found in (clear, hopeless):
        assert found.score == pytest.approx(surface[round(found.y), round(found.x)], abs=2e-6)
        assert found.score <= surface.max() + 2e-6
    assert clear.second_score >= hopeless.second_score
    assert hopeless.second_score <= surface.max() + 2e-6


@pytest.mark.parametrize(("phase", "detail_px"), [(phase, (0.0, 0.6, 1.5)[phase % 3]) for phase in range(8)])
def test_a_quick_look_allows_for_a_twin_between_coarse_pixels(monkeypatch, detail_px, phase):
    """What is shown twice is never clear, however little of the twin a coarse level shows."""
    monkeypatch.setattr(coarse_to_fine, "WIDE_PX", 1000)
    rng = np.random.default_rng([5, phase])
    field = rng.standard_normal((1000, 1100))
    field = field if detail_px == 0.0 else cv2.GaussianBlur(field, (0, 0), detail_px)
    gray = np.clip(128.0 + 45.0 * field / field.std(), 0, 255).astype(np.uint8)
    y, x = 400 + phase, 420 + phase
    gray[y : y + 400, x : x + 400] = gray[8:408, 8:408]
    image = enhance(gray)
    seconds: list[float] = []

    def is_clear(peak):
        seconds.append(peak.second_score)
        return peak.second_score < 0.5

    shown = enhance(np.clip(gray[40:350, 40:350] + rng.normal(0.0, 15.0, (310, 310)), 0, 255).astype(np.uint8))
    quick = EarlyStop(is_clear, lambda _: False)
    found = coarse_to_fine.peak(prepare(image), shown, 9.0, stop=quick)
    assert found is None or found.second_score > 0.5
    assert all(second > 0.5 for second in seconds)


# By the matcher: a window of a few hundred pixels counts as wide, and every place of it is the reference

GROUND = Ground(size=(900, 960))


def site_with(share, seed):
    valid = mask_of(np.random.default_rng(seed), GROUND.size, share)
    gray = np.where(valid, GROUND.gray, 0).astype(np.uint8)
    return GROUND.map_of(gray, valid=valid), valid


@pytest.fixture
def wide(monkeypatch):
    monkeypatch.setattr(coarse_to_fine, "WIDE_PX", 100_000)


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize(
    ("share", "numbers"),
    [(0.6, (2,))] + [pytest.param(share, (0, 1, 2), marks=pytest.mark.slow) for share in SHARES],
)
def test_what_a_wide_window_over_nodata_answers_is_what_every_place_of_it_does(share, numbers):
    site, valid = site_with(share, 6)
    inner = cv2.distanceTransform(np.pad(valid, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    rng = np.random.default_rng(7)
    quick = SceneMatcher(site, CAMERA, "ncc", "cpu")
    full = SceneMatcher(site, CAMERA, "ncc", "cpu", MatcherOptions(ncc=NccOptions(exhaustive=True)))
    foreign = Ground(seed=99)
    for number in numbers:
        y, x = rng.choice(np.argwhere(inner > 0.7 * inner.max()))
        nadir = np.array([x, y], float)
        for ground in (GROUND, foreign):
            frame = ground.frame(CAMERA, nadir, heading_deg=40.0 * number)
            prior = GROUND.prior(nadir + rng.normal(0.0, 20.0, 2), sigma_m=40.0)
            found, expected = quick.locate(frame, prior), full.locate(frame, prior)
            assert type(found) is type(expected)
            assert isinstance(found, Fix) == (ground is GROUND)
            if isinstance(found, Fix):
                assert math.hypot(found.east_m - expected.east_m, found.north_m - expected.north_m) < 0.05
            else:
                assert found.reason == expected.reason


@pytest.mark.usefixtures("wide")
def test_a_wide_window_for_which_there_is_no_time_is_refused_at_once():
    """Costs are learned in small windows, and a wide one is refused by them and not begun."""
    site, _ = site_with(0.3, 6)
    nadir = np.array([480.0, 450.0])
    matcher = SceneMatcher(site, CAMERA, "ncc", "cpu")
    matcher.warmup()
    frame = GROUND.frame(CAMERA, nadir)
    small = [matcher.locate(frame, GROUND.prior(nadir, sigma_m=3.0)).timings.total_ms for _ in range(5)]
    result = matcher.locate(frame, GROUND.prior(nadir, sigma_m=80.0), budget=Budget(total_ms=0.5 * min(small)))
    assert result.reason is Reason.LATE
    assert "match" not in result.timings.stages_ms


@pytest.mark.usefixtures("wide")
def test_every_place_is_scored_only_where_there_is_time_for_it():
    """A quick look that settles nothing goes on by the cost of all places, not by its own."""
    site, _ = site_with(0.3, 6)
    nadir = np.array([480.0, 450.0])
    matcher = SceneMatcher(site, CAMERA, "ncc", "cpu", MatcherOptions(ncc=NccOptions(refine=False)))
    frame = Ground(seed=99).frame(CAMERA, nadir)  # shows no place of this map
    prior = GROUND.prior(nadir, sigma_m=80.0)
    asked: list[str] = []

    def can_afford(self, works):
        asked.extend(works)
        return _EVERY_PLACE not in works

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("engine.runtime.scheduler.Scheduler.can_afford", can_afford)
        patch.setattr("engine.matching.peak_evidence.is_hopeless", lambda *_: False)
        result = matcher.locate(frame, prior, budget=Budget(total_ms=3_600_000.0))
    assert _EVERY_PLACE in asked
    assert result.reason is Reason.LATE
