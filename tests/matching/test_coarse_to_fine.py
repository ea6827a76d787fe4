"""One template in a prepared map: coarse to fine against every place, positions below the pixel, rivals.

What holds: the peak is the exhaustive one. ``second_score`` is the exhaustive one where all places were scored;
coarse to fine it is that of half-resolution scores where the rival cannot win, and exact where it comes near. Over
nodata the peak is that of every place by the masked sums, and wide windows are looked at quickly.
"""

import math

import cv2
import numpy as np
import pytest
import torch
from scipy.signal import correlate

from engine import Fix, MatcherOptions, NccOptions, Reason, SceneMatcher, ShapeError, ncc_fft
from engine.budget import Budget, Deadline
from engine.kernels import coarse_to_fine
from engine.kernels.coarse_to_fine import EarlyStop
from engine.kernels.scores import enhance
from engine.kernels.sums import counts
from engine.matching.correlation import _EVERY_PLACE
from engine.ncc_fft import find_peak, match_template, prepare
from tests.support.ground import CAMERA, Ground
from tests.support.towns import drawn_town

KINDS = ("fine", "broad", "mixed", "town", "tiles", "flat")
DETAIL_PX = {"fine": (0.8, 2.5), "broad": (4.0, 12.0)}
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
    [("town", 10), ("flat", 10), *(pytest.param(kind, 30, marks=pytest.mark.slow) for kind in KINDS)],
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
    picture = texture(np.random.default_rng(offset), (300, 500), 1.2)
    picture[101 + offset : 221 + offset, 301:441] = picture[40:160, 48:188]
    enhanced = torch.from_numpy(enhance(picture))
    template = enhanced[50:150, 58:178]
    search = prepare(enhanced)
    for exhaustive in (False, True):
        peak = match_template(search, template, exclusion_px=10.0, exhaustive=exhaustive)
        assert (peak.score, peak.second_score) == pytest.approx((1.0, 1.0), abs=1e-5)


@pytest.mark.parametrize(
    ("size", "model"),
    [((150, 160), (150, 160)), ((150, 160), (149, 160)), ((150, 160), (150, 159)), ((131, 257), (101, 97)),
     ((1, 300), (1, 120)), ((300, 1), (120, 1)), ((199, 400), (198, 111)), ((129, 129), (97, 113))],
)  # fmt: skip
def test_odd_sizes_and_windows_with_no_room_fall_back(size, model):
    picture = torch.from_numpy(np.random.default_rng(4).normal(size=size).astype(np.float32))
    y, x = (size[0] - model[0]) // 2, (size[1] - model[1]) // 2
    template = picture[y : y + model[0], x : x + model[1]]
    quick = match_template(prepare(picture), template, exclusion_px=3.0)
    full = match_template(prepare(picture), template, exclusion_px=3.0, exhaustive=True)
    assert (round(quick.x), round(quick.y)) == (x, y)
    assert quick.score == pytest.approx(1.0, abs=1e-5)
    assert (quick.x, quick.y) == pytest.approx((full.x, full.y), abs=1e-3)


@pytest.mark.parametrize("level", [0.0, 3.3, -0.1])
def test_flat_pictures_and_templates_never_match(level):
    noise = torch.from_numpy(np.random.default_rng(5).normal(size=(300, 320)).astype(np.float32))
    flat = torch.full((300, 320), level)
    half = noise.clone()
    half[:, 40:] = level
    for picture, template in (
        (flat, noise[:120, :130]), (noise, flat[:120, :130]), (flat, flat[:120, :130]),
        (half, -noise[:120, 50:180]),
    ):  # fmt: skip
        for exhaustive in (False, True):
            peak = match_template(prepare(picture), template, exclusion_px=5.0, exhaustive=exhaustive)
            assert -1.0 <= peak.score < 0.2


@pytest.mark.parametrize("model", [(4,), (0, 4), (1, 4, 4), (33, 8), (8, 41)])
def test_a_template_that_does_not_fit_is_named(model):
    search = prepare(torch.rand(32, 40, generator=torch.Generator().manual_seed(0)))
    with pytest.raises(ShapeError, match=r"^templates?: expected .+, got "):
        match_template(search, torch.zeros(model), exclusion_px=3.0)


# Over nodata: the reference is every place at full resolution


MIN_OVERLAP = 0.9
SHARES = (0.01, 0.1, 0.3, 0.6)


def mask_of(rng, size, share):
    """A turned rectangle of map in nodata, with a hole."""
    valid, side = np.zeros(size, np.uint8), math.sqrt(1.0 - share)
    box = cv2.boxPoints(((size[1] / 2, size[0] / 2), (size[1] * side, size[0] * side), rng.uniform(-10.0, 10.0)))
    cv2.fillPoly(valid, [box.astype(np.int32)], 1)
    cv2.circle(valid, (size[1] // 4, size[0] // 4), 20, 0, -1)
    return valid.astype(bool)


def drawn(seed, share, noise=10.0):
    """A window with nodata and a noisy template from where at least most of it is on the map."""
    rng, size, model = np.random.default_rng([seed, round(100 * share)]), (420, 460), (110, 130)
    gray, valid = texture(rng, size, 1.5) // 3 + texture(rng, size, 6.0) // 3 * 2, mask_of(rng, size, share)
    h, w = model
    inside = counts(valid)
    inside = (inside[h:, w:] - inside[:-h, w:] - inside[h:, :-w] + inside[:-h, :-w]) >= MIN_OVERLAP * h * w
    y, x = rng.choice(np.argwhere(inside[8:-8, 8:-8])) + 8
    shown = gray[y : y + h, x : x + w] + rng.normal(0.0, noise, model)
    template = enhance(np.clip(np.rint(shown), 0, 255).astype(np.uint8))
    image = enhance(gray, valid=valid)
    return prepare(image, valid=valid), image, valid, template, (x, y)


def every_place(search, template):
    return ncc_fft.surface(search, template[None], min_overlap=MIN_OVERLAP)[0]


def without_nodata(image, valid, template):
    """The correlation coefficient over valid pixels at every place (Padfield 2012), in float64."""

    def correlated(one, other):
        return correlate(one, other, mode="valid", method="fft")

    mask, window, model = valid.astype(float), np.where(valid, image, 0.0).astype(float), template.astype(float)
    model -= model.mean()
    ones = np.ones(model.shape)
    count = np.maximum(correlated(mask, ones), 1.0)
    total, square = correlated(window, ones), correlated(window**2, ones)
    of_model, of_squares = correlated(mask, model), correlated(mask, model**2)
    spread, model_spread = square - total**2 / count, of_squares - of_model**2 / count
    both = np.sqrt(np.maximum(spread * model_spread, 1e-9))
    scores = (correlated(window, model) - total * of_model / count) / both
    return np.where(count >= MIN_OVERLAP * model.size - 0.5, scores, -1.0)


@pytest.mark.parametrize("share", SHARES)
def test_the_peak_over_nodata_is_that_of_every_place(share):
    certain = 0
    for seed in range(9):
        search, _, _, template, at = drawn(seed, share, noise=(0.0, 20.0, 80.0)[seed % 3])
        full = find_peak(every_place(search, template), exclusion_px=9.0)
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
def test_scores_over_nodata_are_about_those_that_leave_it_out(share):
    search, image, valid, template, _ = drawn(2, share)
    surface, exact = every_place(search, template), without_nodata(image, valid, template)
    whole = exact > -1.0
    np.testing.assert_array_equal(surface > -1.0, whole)
    h, w = template.shape
    inside = cv2.erode(valid.astype(np.uint8), np.ones((h, w), np.uint8), anchor=(0, 0)) > 0
    inside = inside[: surface.shape[0], : surface.shape[1]]
    np.testing.assert_allclose(surface[inside], exact[inside], rtol=0, atol=2e-6)
    assert np.abs(surface - exact)[whole & ~inside].max(initial=0.0) < 0.03


def test_a_quick_look_is_kept_only_where_the_caller_says_so(monkeypatch):
    search, _, _, template, _ = drawn(4, 0.3)
    template = np.ascontiguousarray(template[::-1])  # shows no place of the map
    surface = every_place(search, template)

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


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize(("phase", "detail_px"), [(phase, (0.0, 0.6, 1.5)[phase % 3]) for phase in range(8)])
def test_a_quick_look_allows_for_a_twin_between_coarse_pixels(detail_px, phase):
    """What is shown twice is never clear, however little of the twin a coarse level shows."""
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
    found = coarse_to_fine.peak(prepare(image), shown, 9.0, stop=EarlyStop(is_clear, lambda _: False))
    assert found is None or found.second_score > 0.5
    assert all(second > 0.5 for second in seconds)


# By the matcher: a window of a few hundred pixels counts as wide, and every place of it is the reference

GROUND = Ground(size=(900, 960))


def site_with(share, seed):
    valid = mask_of(np.random.default_rng(seed), GROUND.size, share)
    return GROUND.map_of(np.where(valid, GROUND.gray, 0).astype(np.uint8), valid=valid), valid


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
        for shown in (GROUND, foreign):
            frame = shown.frame(CAMERA, nadir, heading_deg=40.0 * number)
            prior = GROUND.prior(nadir + rng.normal(0.0, 20.0, 2), sigma_m=40.0)
            found, expected = quick.locate(frame, prior), full.locate(frame, prior)
            assert type(found) is type(expected)
            assert isinstance(found, Fix) == (shown is GROUND)
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
    vague = GROUND.prior(nadir, sigma_m=80.0)
    works = matcher._method.works(matcher._query(frame, vague, Deadline(Budget())))
    least_ms = min(matcher._costs.least_ms(step, work) for step, work in works.items())
    result = matcher.locate(frame, vague, budget=Budget(total_ms=0.5 * least_ms))
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
