"""One frame, one prior, one budget: fixes with a sound covariance, and a reason for every refusal."""

from dataclasses import astuple, replace
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from engine import AssumedErrors, Camera, DeviceError, OptionError, OrthoMap, SceneMatcher
from engine.budget import Budget, Deadline
from engine.features import match, sift
from engine.matching.align import to_gray
from engine.matching.candidates import PoseCandidate
from engine.matching.evidence import Evidence, needed_nats, probability
from engine.matching.feature_pose import FeatureMatcher
from engine.matching.for_reports import Explanation
from engine.matching.method import Method
from engine.matching.ncc import Ncc
from engine.matching.query import Query
from engine.options import MatcherOptions, NccOptions, SiftOptions
from engine.values import RISK, Fix, Frame, GridPose, NoFix, Prior, Reason, Window
from scenematch.runs.paper_recipe import RECIPES
from scenematch.runs.settings import TrackSettings
from tests.support.fixes import a_fix, px_off, values_of
from tests.support.ground import Ground
from tests.support.landmarks import landmarks_of
from tests.support.matches import pairs_of

METHODS = ("ncc", "sift")
NADIR = np.array([315.0, 296.0])


@pytest.fixture(scope="module", autouse=True)
def _landmarks_found_once():
    """Many matchers look at the same few maps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("engine.matching.sift.LandmarkMap", landmarks_of)
        yield


def with_telemetry(image, height_agl_m=150.0, heading_deg=25.0, roll_deg=3.0, pitch_deg=-2.0):
    return Frame(image, 77, height_agl_m, heading_deg, roll_deg, pitch_deg)


def assert_refused(result, reason, method=None):
    assert result.reason is reason, result
    assert result.timestamp_ns == 77
    assert result.detail
    assert method is None or result.method == method


# Fixes


@pytest.mark.parametrize("method", METHODS)
def test_a_fix_says_the_same_place_in_every_way(matchers, ground, frame, prior, method):
    fix, site = matchers[method].locate(frame, prior), ground.site
    assert px_off(fix, NADIR) < 0.3
    np.testing.assert_allclose(site.enu_from_pixel(fix.map_xy_px), [fix.east_m, fix.north_m], atol=2e-3)
    np.testing.assert_allclose(site.pixel_from_geodetic(fix.lat_deg, fix.lon_deg), fix.map_xy_px, atol=5e-3)
    assert (fix.timestamp_ns, fix.method) == (77, method)
    assert 0.5 < fix.score <= 1.0
    assert fix.timings.total_ms > 0
    assert fix.up_m == pytest.approx(150.0, abs=1.0)
    assert astuple(fix.attitude) == pytest.approx((3.0, -2.0, 25.0), abs=0.5)


@pytest.mark.parametrize("method", METHODS)
def test_looks_say_why_a_frame_was_accepted_or_refused(matchers, ground, camera, frame, prior, method):
    """The last look's evidence is the fix's probability; no look at another place has enough."""
    fix = matchers[method].locate(frame, prior)
    assert {look.method for look in fix.looks} == {method}
    assert fix.confidence == pytest.approx(probability(fix.looks[-1].nats))
    assert fix.looks[-1].nats >= needed_nats(RISK)
    elsewhere = matchers[method].locate(with_telemetry(frame.image[:, ::-1].copy()), prior)
    assert isinstance(elsewhere, NoFix)
    assert elsewhere.looks
    assert all((look.nats or 0.0) < needed_nats(RISK) for look in elsewhere.looks)


@pytest.mark.parametrize(
    ("method", "profile"),
    [("ncc", "engine"), ("sift", "engine"), ("ncc", "paper"),
     pytest.param("sift", "paper", marks=pytest.mark.slow)],
)  # fmt: skip
def test_the_same_question_has_the_same_answer_in_any_order(ground, camera, frame, prior, method, profile):
    settings = TrackSettings(method=method, profile=profile, device="cpu")
    other = ground.frame(camera, NADIR + 12.0, heading_deg=200.0, timestamp_ns=77)
    flat = with_telemetry(np.full((300, 300), 90, np.uint8))
    questions = [(frame, prior), (flat, prior), (other, ground.prior(NADIR + 12.0)), (frame, None)]
    forwards = settings.matcher(ground.site, camera)
    backwards = settings.matcher(ground.site, camera)
    first = [values_of(forwards.locate(*question)) for question in questions]
    again = [values_of(forwards.locate(*question)) for question in questions]
    last = [values_of(backwards.locate(*question)) for question in reversed(questions)]
    assert first == again == last[::-1]


def test_nothing_that_is_handed_in_is_changed(matchers, frame, prior):
    before = frame.image.copy()
    for matcher in matchers.values():
        matcher.locate(frame, prior)
        matcher.locate(frame)
    np.testing.assert_array_equal(frame.image, before)


@pytest.mark.parametrize("method", METHODS)
def test_a_prior_is_the_same_in_metres_or_in_degrees_of_either_longitude(matchers, ground, frame, method):
    east, north = ground.enu_from_pixel(NADIR)
    lat, lon = map(float, ground.site.geodetic_from_pixel(NADIR))
    metres = matchers[method].locate(frame, Prior(east_m=east, north_m=north, sigma_m=8.0))
    for lon_deg in (lon, lon - 360.0):
        degrees = matchers[method].locate(frame, Prior(lat_deg=lat, lon_deg=lon_deg, sigma_m=8.0))
        assert metres.map_xy_px == pytest.approx(degrees.map_xy_px, abs=0.1)


@pytest.mark.parametrize("method", METHODS)
def test_torch_and_numpy_images_agree_and_so_do_colours_and_their_luma(matchers, frame, prior, method):
    colour = np.dstack([frame.image, frame.image, frame.image[::-1]])
    for image in (colour, cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)):
        pictures = image, torch.from_numpy(image), np.asfortranarray(image), colour
        results = [matchers[method].locate(with_telemetry(picture), prior) for picture in pictures]
        assert px_off(results[0], NADIR) < 0.3
        assert all(values_of(result) == values_of(results[0]) for result in results)


@pytest.mark.parametrize("method", METHODS)
def test_a_distorted_frame_finds_the_place_of_the_ideal_one(ground, frame, prior, camera, method):
    lens = Camera(300, 300, camera.matrix, "plumb_bob", np.array([-0.12, 0.03, 0.001, -0.002, 0.0]))
    at = np.stack(np.meshgrid(np.arange(300.0), np.arange(300.0)), axis=-1).reshape(-1, 1, 2)
    # Where each pixel of the lens looks in the ideal picture.
    ideal = cv2.undistortPoints(at, lens.matrix, lens.distortion, P=lens.matrix)
    x, y = ideal.reshape(300, 300, 2).astype(np.float32).transpose(2, 0, 1)
    bent = cv2.remap(frame.image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    fix = SceneMatcher(ground.site, lens, method, "cpu").locate(with_telemetry(bent), prior)
    assert px_off(fix, NADIR) < 0.3


def test_warmup_leaves_no_trace(ground, camera, frame, prior):
    cold, brief, warm = (SceneMatcher(ground.site, camera, "ncc", "cpu") for _ in range(3))
    brief.warmup(brief=True)
    warm.warmup()
    answers = [values_of(matcher.locate(frame, prior)) for matcher in (cold, brief, warm)]
    assert answers[0] == answers[1] == answers[2]


def test_a_brief_warmup_matches_without_searches(ground, camera, monkeypatch):
    searched, located, locate = [], [], SceneMatcher.locate
    monkeypatch.setattr(Ncc, "warmup_search", lambda *asked: searched.append(asked))
    monkeypatch.setattr(SceneMatcher, "locate", lambda *asked: located.append(asked) or locate(*asked))
    matcher = SceneMatcher(ground.site, camera, "ncc", "cpu")
    matcher.warmup(brief=True)
    assert (len(searched), len(located)) == (0, 2)
    matcher.warmup()
    assert searched
    assert len(located) > 4


def test_auto_is_ncc_where_it_can_be_and_sift_where_it_must(matchers, ground, camera, frame, prior):
    auto = matchers["auto"]
    assert auto.locate(frame, prior).method == "ncc"
    for height, heading in ((None, 25.0), (150.0, None), (None, None)):
        fix = auto.locate(with_telemetry(frame.image, height, heading), prior)
        assert px_off(fix, NADIR) < 2.5
        assert fix.method == "sift"
    wrong = with_telemetry(frame.image, heading_deg=205.0)  # NCC finds nothing under this heading
    assert isinstance(matchers["ncc"].locate(wrong, prior), NoFix)
    free = MatcherOptions(sift=SiftOptions(use_attitude=False))
    fix = SceneMatcher(ground.site, camera, "auto", "cpu", free).locate(wrong, prior)
    assert px_off(fix, NADIR) < 2.5
    assert fix.method == "sift"


def test_nodata_about_the_flight_is_neither_matched_nor_in_the_way(ground, camera):
    valid = np.zeros(ground.gray.shape, bool)
    valid[60:560, 60:600] = True
    site = ground.map_of(np.where(valid, ground.gray, 255).astype(np.uint8), valid=valid)
    shown = ground.frame(camera, NADIR, heading_deg=10.0)
    for method in METHODS:
        matcher = SceneMatcher(site, camera, method, "cpu")
        assert px_off(matcher.locate(shown, ground.prior(NADIR)), NADIR) < 0.3
        assert px_off(matcher.locate(shown), NADIR) < 0.3


def test_a_place_counts_only_where_enough_of_the_frame_lies_on_the_map(ground, camera):
    """The patch is 242 px wide; the map ends so far right of the nadir that 95 or 75 in a hundred of it count."""
    shown = ground.frame(camera, NADIR)
    for right_px, kind in ((109, Fix), (60, NoFix)):
        valid = np.ones(ground.gray.shape, bool)
        valid[:, int(NADIR[0]) + right_px :] = False
        result = SceneMatcher(ground.map_of(valid=valid), camera, "ncc", "cpu").locate(shown, ground.prior(NADIR))
        assert isinstance(result, kind), result
        assert kind is NoFix or px_off(result, NADIR) < 0.5


# What SIFT does not need


def with_sift(ground, camera, **options):
    return SceneMatcher(ground.site, camera, "sift", "cpu", MatcherOptions(sift=SiftOptions(**options)))


@pytest.mark.parametrize(
    ("factor", "has_heading"),
    [(None, False), *(pytest.param(*case, marks=pytest.mark.slow) for case in (
        (0.5, False), (0.7, True), (1.0, False), (1.4, False), (2.0, True)))],
)  # fmt: skip
def test_sift_is_as_good_with_a_height_that_is_wrong_or_unknown(matchers, ground, camera, has_heading, factor):
    for height_m, turn in ((150.0, 200.0), (90.0, 25.0)):
        shown = ground.frame(camera, NADIR, height_m, heading_deg=turn)
        stated_m = None if factor is None else factor * height_m
        given = replace(shown, height_agl_m=stated_m, heading_deg=turn if has_heading else None)
        for prior in (ground.prior(NADIR), None):
            fix = matchers["sift"].locate(given, prior)
            # Without an attitude, tilt and place are separated by features alone.
            assert px_off(fix, NADIR) < (0.4 if has_heading else 2.0)
            assert (fix.up_m, fix.attitude.heading_deg) == pytest.approx((height_m, turn), abs=1.0)


def test_without_a_wide_search_a_height_off_by_two_is_refused(ground, camera, frame, prior):
    wrong = replace(frame, height_agl_m=300.0)
    assert isinstance(with_sift(ground, camera, search_widely=False).locate(wrong, prior), NoFix)


@pytest.mark.parametrize(("budget_ms", "looks"), [(50.0, 1), (60_000.0, 4)])
def test_a_wide_search_is_begun_only_if_there_is_time(ground, camera, frame, prior, monkeypatch, budget_ms, looks):
    hypotheses, clock = [], SimpleNamespace(now_ns=0)
    monkeypatch.setattr("engine.matching.matcher.Deadline", partial(Deadline, clock_ns=lambda: clock.now_ns))

    def look(matcher, hypothesis):
        clock.now_ns += 30_000_000
        hypotheses.append(hypothesis)
        return matcher.query.refuse(Reason.TOO_FEW_MATCHES, "none", "sift")

    monkeypatch.setattr(FeatureMatcher, "_find_with", look)
    result = with_sift(ground, camera).locate(frame, prior, Budget(total_ms=budget_ms))
    assert result.reason is Reason.TOO_FEW_MATCHES
    expected = [(False, (150.0, 150.0))] * 3 + [(True, (75.0, 300.0))]  # whether the heading is unknown, heights
    assert [(tried.x_axis_deg is None, tried.heights_m) for tried in hypotheses] == expected[:looks]


@pytest.mark.parametrize(
    ("found_nats", "looks", "fixed_at_m"),
    [
        ([12.0], 1, 0.0),  # as the telemetry has it
        ([None, 12.0, None, 500.0], 4, 300.0),  # a place found after it failed gives way to another
        ([None, 12.0, None, 15.0], 4, None),
        ([None, 12.0, None, None], 4, 100.0),
    ],
)
def test_a_late_place_must_be_surer(ground, camera, frame, prior, monkeypatch, found_nats, looks, fixed_at_m):
    mirrored, tried = np.ascontiguousarray(frame.image[:, ::-1]), []

    def look(matcher, hypothesis):
        if len(tried) == looks:
            assert np.array_equal(matcher.query.gray, to_gray(replace(frame, image=mirrored)))
            return matcher.query.refuse(Reason.BAD_POSE, "the null hypothesis", "sift")
        tried.append(hypothesis)
        nats = found_nats[len(tried) - 1]
        if nats is None:
            return matcher.query.refuse(Reason.BAD_POSE, "none", "sift")
        evidence = Evidence(nats + np.log(1000.0), 0.0, 1000.0, 1000.0, None)
        return PoseCandidate(a_fix(100.0 * (len(tried) - 1), confidence=probability(nats)), evidence)

    monkeypatch.setattr(FeatureMatcher, "_find_with", look)
    answer = with_sift(ground, camera, refine=False).locate(frame, prior)
    assert len(tried) == looks
    assert (answer.east_m if isinstance(answer, Fix) else None) == fixed_at_m


# The null hypothesis of SIFT: what the mirrored frame reaches is chance, and counts against the pose


class SymmetricalGround(Ground):
    """Its west mirrors its east, so that a frame from above the axis is its own mirror image."""

    def levels(self, east_m, north_m):
        return super().levels(np.abs(east_m), north_m)


def test_a_frame_of_the_map_beats_its_mirror_image(ground, camera, frame, prior):
    """At a risk that leaves nothing beyond doubt."""
    matcher = SceneMatcher(ground.site, camera, "sift", "cpu", MatcherOptions(risk=1e-20))
    assert px_off(matcher.locate(frame, prior), NADIR) < 0.3


@pytest.mark.parametrize("y_px", [240.0, 305.0, 400.0])
def test_a_frame_that_is_its_own_mirror_image_is_refused(camera, y_px):
    """By so few features that its evidence is in doubt: beyond doubt, no mirrored frame is matched."""
    ground, on_axis = SymmetricalGround(), np.array([319.5, y_px])
    matcher = with_sift(ground, camera, max_keypoints=25, keypoints_per_px=1e-6)
    result = matcher.locate(ground.frame(camera, on_axis, timestamp_ns=77), ground.prior(on_axis))
    assert_refused(result, Reason.AMBIGUOUS)
    assert "the mirrored frame fits the map as well" in result.detail


@pytest.mark.parametrize("has_heading", [True, False])
def test_sift_places_a_rolled_frame_whether_or_not_its_heading_is_known(matchers, ground, camera, has_heading):
    for heading in (45.0, 300.0):
        shown = ground.frame(camera, NADIR, heading_deg=heading, roll_deg=4.0)
        shown = shown if has_heading else replace(shown, heading_deg=None)
        fix = matchers["sift"].locate(shown, ground.prior(NADIR))
        assert px_off(fix, NADIR) < 0.3
        assert fix.score > 0.8


@pytest.mark.parametrize("mounted_deg", [0.0, 30.0, 60.0])
def test_an_error_of_one_sigma_weighs_one_however_the_camera_is_mounted(camera, mounted_deg):
    """Of roll, pitch and heading by turns; of the two tilts each by whether it was given."""
    lifted = cv2.Rodrigues(np.radians([0.0, mounted_deg, 0.0]))[0] @ camera.mount  # about the body's right
    frame = Frame(np.zeros((8, 8), np.uint8), 0, 100.0, 40.0, None, 3.0)
    known = GridPose(frame.height_agl_m, frame.heading_deg, frame.roll_deg, frame.pitch_deg)
    query = SimpleNamespace(telemetry=known, camera=replace(camera, mount=lifted))
    prior = Query.attitude_prior(query, 40.0, 1.5, AssumedErrors(tilt_deg=0.4, unknown_tilt_deg=5.0))
    for about_body_deg in np.diag([5.0, 0.4, 1.5]):
        about_camera = lifted.T @ np.radians(about_body_deg)
        assert about_camera @ prior.precision @ about_camera == pytest.approx(1.0)


def test_a_matcher_of_ones_own_takes_the_place_of_features(ground, camera, frame, prior):
    shapes, shifts = [], []

    def own(picture, crop):
        """Stands in for a network."""
        shapes.append(tuple(picture.shape))
        assert picture.dtype == crop.dtype == torch.float32
        assert 0.0 <= float(picture.min()) < float(picture.max()) <= 1.0
        first, second = sift(picture), sift(crop)
        query, train = torch.tensor(pairs_of(match(first, second))).T
        points = first.xy_px[0, query], second.xy_px[0, train]
        shifts.append((points[1] - points[0]).numpy())
        return points

    matcher = with_sift(ground, camera, matcher=own)
    fix = matcher.locate(frame, prior)
    assert px_off(fix, NADIR) < 0.5
    assert fix.up_m == pytest.approx(150.0, abs=1.0)
    # It was given the frame in the map's pixels and axes: nothing but a translation is between the two.
    assert np.median(np.abs(shifts[0] - np.median(shifts[0], axis=0))) < 0.5
    assert "frame features" not in fix.timings.stages_ms
    matcher.locate(replace(frame, heading_deg=None), prior)
    assert shapes[-1] == (1, 1, 150, 150)


def test_a_matcher_of_ones_own_that_finds_nothing_is_refused(ground, camera, frame, prior):
    nothing = with_sift(ground, camera, matcher=lambda *_: (torch.zeros(0, 2), torch.zeros(0, 2)))
    assert_refused(nothing.locate(frame, prior), Reason.TOO_FEW_MATCHES, "sift")


# Refusals


@pytest.mark.parametrize("method", ["ncc", "sift", "auto"])
@pytest.mark.parametrize("level", [0, 90, 255], ids=["black", "flat", "white"])
def test_a_frame_of_one_grey_level_has_no_texture(matchers, prior, method, level):
    shown = with_telemetry(np.full((300, 300), level, np.uint8))
    for given in (prior, None):
        assert_refused(matchers[method].locate(shown, given), Reason.NO_TEXTURE)


@pytest.mark.parametrize("method", ["ncc", "sift", "auto"])
@pytest.mark.parametrize(
    "where",
    [
        {"east_m": 2000.0, "north_m": 0.0},
        {"east_m": 0.0, "north_m": -1e9},
        {"lat_deg": -48.25, "lon_deg": -165.0},  # the other side of the Earth
        {"lat_deg": 90.0, "lon_deg": 0.0},
    ],
)
def test_a_prior_outside_the_map_is_refused(matchers, frame, method, where):
    assert_refused(matchers[method].locate(frame, Prior(**where, sigma_m=5.0)), Reason.OUTSIDE_MAP)


@pytest.mark.parametrize(
    ("method", "profile"),
    [("ncc", "engine"), ("sift", "engine"), ("auto", "engine"), ("ncc", "paper"), ("sift", "paper")],
)
def test_a_prior_that_the_maps_crs_cannot_show_is_refused(camera, frame, method, profile):
    """Null island, as a receiver without a fix reports it, and its opposite have no place in UTM's zone 46."""
    gray = np.random.default_rng(0).integers(0, 256, (400, 400), np.uint8)
    site = OrthoMap.from_arrays(gray, [[0.5, 0.0, 500_000.0], [0.0, -0.5, 3_600_000.0]], "EPSG:32646")
    matcher = TrackSettings(method=method, profile=profile, device="cpu").matcher(site, camera)
    for lon_deg in (0.0, 183.0, -177.0):
        nowhere = Prior(lat_deg=0.0, lon_deg=lon_deg, sigma_m=10.0)
        assert_refused(matcher.locate(frame, nowhere), Reason.OUTSIDE_MAP)


@pytest.mark.parametrize("method", ["ncc", "sift", "auto"])
@pytest.mark.parametrize("vague", [{"sigma_m": 1e308}, {"sigma_m": 8.0, "moved_east_m": 1e308}])
def test_a_prior_wider_than_any_map_is_a_search_of_all_of_it(matchers, ground, frame, method, vague):
    east, north = ground.enu_from_pixel(NADIR)
    result = matchers[method].locate(frame, Prior(east_m=east, north_m=north, **vague))
    assert result.window.width_px == ground.site.width_px
    assert isinstance(result, NoFix) or px_off(result, NADIR) < 1.0


@pytest.mark.parametrize(
    ("missing", "reason"), [("height_agl_m", Reason.NO_HEIGHT), ("heading_deg", Reason.NO_HEADING)]
)
def test_ncc_needs_height_and_heading(matchers, frame, prior, missing, reason):
    assert_refused(matchers["ncc"].locate(replace(frame, **{missing: None}), prior), reason, "ncc")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("tilt", [(80.0, 0.0), (0.0, -70.0), (180.0, 0.0)])
def test_an_extreme_tilt_is_refused(matchers, frame, prior, method, tilt):
    tilted = with_telemetry(frame.image, 150.0, 25.0, *tilt)
    assert_refused(matchers[method].locate(tilted, prior), Reason.TILTED, method)


@pytest.mark.parametrize("height_m", [0.01, 2.0, 5e3, 65_535.0, 1e7])
@pytest.mark.parametrize("method", ["ncc", "sift", "auto"])
def test_a_height_that_cannot_be_leads_nowhere_else(matchers, frame, prior, method, height_m):
    """NCC refuses, more ground than the map as outside of it; SIFT, which measures height, may find the place."""
    for given in (prior, None):
        result = matchers[method].locate(with_telemetry(frame.image, height_m), given)
        if method == "ncc" and height_m > 6e4:
            assert_refused(result, Reason.OUTSIDE_MAP, "ncc")
        assert isinstance(result, NoFix) or (result.method == "sift" and px_off(result, NADIR) < 4.0)


@pytest.mark.parametrize("method", ["ncc", "sift", "auto"])
def test_an_answer_after_the_budget_is_late(matchers, frame, prior, method):
    for given in (prior, None):
        assert_refused(matchers[method].locate(frame, given, Budget(total_ms=1e-6)), Reason.LATE)
    assert px_off(matchers[method].locate(frame, prior, Budget(total_ms=60_000.0)), NADIR) < 0.3


@pytest.mark.parametrize("method", METHODS)
def test_a_frame_of_another_place_is_refused(mirrored_site, sim_flight, method):
    matcher = SceneMatcher(mirrored_site, sim_flight.camera, method, "cpu")
    for shown in sim_flight.frames[:3]:
        assert isinstance(matcher.locate(shown, Prior(east_m=0.0, north_m=0.0, sigma_m=10.0)), NoFix)


# What is wrong is said at once


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_a_device_that_is_missing_is_an_error_and_only_auto_falls_back(ground, camera):
    with pytest.raises(DeviceError, match=r"^device: cuda was requested"):
        SceneMatcher(ground.site, camera, device="cuda")
    assert SceneMatcher(ground.site, camera, device="auto").device.type == "cpu"


def test_options_are_refused_by_name(ground, camera):
    with pytest.raises(OptionError, match=r"^method: expected one of ncc, sift, auto, learned, got 'orb'"):
        SceneMatcher(ground.site, camera, "orb")


class TheMapsMiddle(Method):
    """A method of a user's own: wherever the frame was taken."""

    name = "middle"

    def __init__(self, site, device, options):
        self.middle_px = site.inner_px

    def locate(self, query):
        return query.fix(self.name, self.middle_px, np.eye(3), score=1.0, window=Window(0, 0, 9, 9))

    def explain(self, query, window):
        return Explanation(query.gray)


def test_a_method_of_ones_own_is_given_as_its_class(ground, camera, frame, prior):
    matcher = SceneMatcher(ground.site, camera, TheMapsMiddle, "cpu")
    for each in (matcher, matcher.twin()):
        fix = each.locate(frame, prior)
        assert (fix.method, each.method) == ("middle", "middle")
        np.testing.assert_allclose(fix.map_xy_px, ground.site.inner_px)


# The paper's profile


@pytest.mark.parametrize("method", METHODS)
def test_the_papers_profile_finds_the_place_of_a_level_frame(ground, camera, prior, method):
    matcher = SceneMatcher(ground.site, camera, RECIPES[method], "cpu")
    for heading, given in ((0.0, prior), (60.0, None), (250.0, prior)):
        fix = matcher.locate(ground.frame(camera, NADIR, heading_deg=heading), given)
        assert px_off(fix, NADIR) < (1.0 if method == "ncc" else 2.0)  # whole pixels; no attitude to lean on
        assert fix.method == method


@pytest.mark.parametrize("method", METHODS)
def test_the_papers_profile_refuses_what_it_cannot_do(ground, camera, frame, prior, method):
    matcher = SceneMatcher(ground.site, camera, RECIPES[method], "cpu")
    assert_refused(matcher.locate(with_telemetry(frame.image, None), prior), Reason.NO_HEIGHT, method)
    assert_refused(matcher.locate(frame, Prior(east_m=9e3, north_m=0.0, sigma_m=5.0)), Reason.OUTSIDE_MAP, method)
    assert_refused(matcher.locate(frame, prior, Budget(total_ms=1e-6)), Reason.LATE, method)
    flat = matcher.locate(with_telemetry(np.zeros((300, 300), np.uint8)), prior)
    assert isinstance(flat, Fix) or flat.reason is Reason.TOO_FEW_MATCHES  # NCC always has a peak
    if method == "ncc":
        assert_refused(matcher.locate(with_telemetry(frame.image, heading_deg=None), prior), Reason.NO_HEADING)
        for height in (0.01, 65_535.0, 1e7):
            assert_refused(matcher.locate(with_telemetry(frame.image, height), prior), Reason.OUTSIDE_MAP)


def test_a_place_that_contradicts_its_prior_is_less_certain(ground, camera, frame):
    """In noise: of a clear picture any prior leaves no doubt."""
    noise = np.random.default_rng(1).normal(0.0, 200.0, frame.image.shape)
    noisy = replace(frame, image=np.clip(0.5 * frame.image + 64.0 + noise, 0, 255).astype(np.uint8))
    near, far = (ground.prior(NADIR, sigma_m=2.0, off_m=off) for off in ((1.0, -1.0), (9.0, -8.0)))
    by_peak = MatcherOptions(risk=0.5, ncc=NccOptions(refine=False))
    matcher = SceneMatcher(ground.site, camera, "ncc", "cpu", by_peak)
    assert matcher.locate(noisy, near).confidence > matcher.locate(noisy, far).confidence
