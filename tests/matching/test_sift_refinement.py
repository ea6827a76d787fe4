"""SIFT's pose refined densely, from few features where these are beyond doubt."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from engine import Budget, Fix, MatcherOptions, SceneMatcher, SiftOptions
from engine.budget import Deadline
from engine.matching import feature_matching
from engine.matching.feature_pose import FeatureMatcher
from engine.matching.refinement import Refinement
from engine.matching.sift import Sift
from engine.matching.views import drawn_px
from tests.matching.test_scheduler import FixedCosts, out_of_time

NADIR = np.array([310.0, 305.0])
PLACES = [np.array([x, y]) for x in (270.0, 330.5, 371.25) for y in (262.5, 301.0, 340.75)]


@pytest.fixture(scope="module")
def matcher(site, camera):
    return SceneMatcher(site, camera, "sift", "cpu")


@pytest.fixture(scope="module")
def plain(site, camera):
    return SceneMatcher(site, camera, "sift", "cpu", MatcherOptions(sift=SiftOptions(refine=False)))


def costs_of(others_ms=0.0, **ms):
    """Costs by step, whatever the work."""
    costs = FixedCosts()
    costs.needed_ms = lambda step, work, **_: ms.get(
        (step if isinstance(step, str) else step[0]).replace(" ", "_"), others_ms
    )
    return costs


def refuse_to_refine(monkeypatch):
    for name in ("refine_at_once", "refine_pose"):
        monkeypatch.setattr(Refinement, name, lambda _self, _fix: None)


def shot(ground, camera, nadir_px=NADIR, heading_deg=25.0):
    return ground.frame(camera, nadir_px, heading_deg=heading_deg, roll_deg=3.0, pitch_deg=-2.0)


def test_a_refined_pose_is_nearer_and_says_so(ground, camera, matcher, plain):
    """Within its covariance, on average over places and headings."""
    errors_m, chi_squares = {"refined": [], "fine": []}, []
    for heading_deg, place in enumerate(PLACES):
        frame = shot(ground, camera, place, 40.0 * heading_deg)
        for one, stage in ((matcher, "refined"), (plain, "fine")):
            fix = one.locate(frame, ground.prior(place))
            assert (fix.stage, fix.method) == (stage, "sift")
            off_m = ground.off_m(fix, place)
            errors_m[stage].append(float(np.hypot(*off_m)))
            if stage == "refined":
                chi_squares.append(float(off_m @ np.linalg.solve(fix.relative_covariance_m2, off_m)))
    refined, fine = (np.sqrt(np.mean(np.square(errors_m[stage]))) for stage in ("refined", "fine"))
    assert refined < fine
    assert np.mean(chi_squares) / 2.0 < 3.0


def test_doubtful_few_features_give_way_to_all(ground, camera, matcher, monkeypatch):
    few = []
    honest = FeatureMatcher.find_at_once

    def doubtful(self):
        few.append(honest(self))
        return replace(few[-1], fix=replace(few[-1].fix, confidence=0.9))

    by_few = matcher.locate(shot(ground, camera), ground.prior(NADIR))
    monkeypatch.setattr(FeatureMatcher, "find_at_once", doubtful)
    by_all = matcher.locate(shot(ground, camera), ground.prior(NADIR))
    assert len(few) == 1
    assert by_few.stage == by_all.stage == "refined"
    apart_m = np.hypot(by_few.east_m - by_all.east_m, by_few.north_m - by_all.north_m)
    assert apart_m < by_few.relative_sigma_m  # the same picture agrees with the map at the same pose


@pytest.mark.parametrize("abandoned", [False, True])
def test_without_refinement_all_features_give_the_pose(ground, camera, matcher, plain, monkeypatch, abandoned):
    frame, prior = shot(ground, camera), ground.prior(NADIR)
    expected = plain.locate(frame, prior)
    refuse_to_refine(monkeypatch)
    if abandoned:
        monkeypatch.setattr(Refinement, "refine_pose", out_of_time)
    fix = matcher.locate(frame, prior)
    assert fix.stage == "fine"
    if abandoned:
        assert (fix.east_m, fix.north_m, fix.up_m) == (expected.east_m, expected.north_m, expected.up_m)
        np.testing.assert_array_equal(fix.covariance_m2, expected.covariance_m2)
    else:  # it then rests on the matches, and less on the stated tilt
        assert np.hypot(fix.east_m - expected.east_m, fix.north_m - expected.north_m) < 0.01
        assert fix.sigma_m > expected.sigma_m


@pytest.fixture
def clock_stands(monkeypatch):
    """Budgets are compared with what is said to be the cost, and no work takes any time."""
    monkeypatch.setattr("engine.matching.matcher.Deadline", partial(Deadline, clock_ns=lambda: 0))


@pytest.mark.parametrize(
    "known",
    [{"roll_deg": None, "pitch_deg": None}, {"heading_deg": None}, {"height_agl_m": None}],
    ids=["no tilt", "no heading", "no height"],
)
def test_without_a_telemetry_to_hold_to_the_features_do_it_alone(ground, camera, matcher, known):
    assert matcher.locate(replace(shot(ground, camera), **known), ground.prior(NADIR)).stage == "fine"


@pytest.mark.parametrize(
    "wrong", [{"height_agl_m": 100.0}, {"roll_deg": 9.0}, {"heading_deg": 35.0}], ids=["height", "roll", "heading"]
)
def test_wrong_telemetry_does_not_draw_the_pose_away(ground, camera, matcher, plain, wrong):
    """The pose by features rests less on it than the refinement, which must then agree or not count."""
    frame = replace(shot(ground, camera), **wrong)
    assert isinstance(plain.locate(frame, ground.prior(NADIR)), Fix)
    fix = matcher.locate(frame, ground.prior(NADIR))
    assert ground.chi_square(fix, NADIR) < 9.21  # of 2 degrees of freedom, 99 %


@pytest.mark.usefixtures("clock_stands")
@pytest.mark.parametrize("wrong", [{}, {"roll_deg": 5.0}, {"pitch_deg": 0.0}], ids=str)
def test_where_time_is_short_few_features_give_a_fix_that_covers_a_wrong_telemetry(ground, site, camera, wrong):
    """With no time for all features nor for refinement; a tilt off by 2 degrees displaces them by metres."""
    matcher = SceneMatcher(site, camera, "sift", "cpu")
    matcher._costs = costs_of(1e9, sift_by_few_features=0.0)
    chi_squares = []
    for place in PLACES:
        frame = replace(shot(ground, camera, place), **wrong)
        fix = matcher.locate(frame, ground.prior(place), Budget(total_ms=1000.0))
        assert fix.stage == "coarse"
        chi_squares.append(ground.chi_square(fix, place))
    assert np.mean(chi_squares) / 2.0 < 2.0


@pytest.mark.usefixtures("clock_stands")
def test_few_features_leave_the_time_for_all(ground, camera, site, monkeypatch):
    """A frame whose few features may fail is not lost to them: with time for one of both it is all features'."""
    matcher, tried = SceneMatcher(site, camera, "sift", "cpu"), []
    matcher._costs = costs_of(sift_by_few_features=600.0, sift=1000.0)
    honest = FeatureMatcher.find_at_once
    monkeypatch.setattr(FeatureMatcher, "find_at_once", lambda self: tried.append(self) or honest(self))
    for total_ms, few in ((1300.0, 0), (1700.0, 1), (800.0, 1)):
        tried.clear()
        fix = matcher.locate(shot(ground, camera), ground.prior(NADIR), Budget(total_ms=total_ms))
        assert isinstance(fix, Fix)
        assert len(tried) == few


def test_certain_few_features_are_kept_where_all_come_too_late(ground, camera, matcher, monkeypatch):
    refuse_to_refine(monkeypatch)
    monkeypatch.setattr(Sift, "at_scale", out_of_time)
    assert matcher.locate(shot(ground, camera), ground.prior(NADIR)).stage == "coarse"


def test_a_pose_refined_to_another_height_is_not_taken(ground, camera, matcher, plain):
    """Refinement is held to the telemetry's height, the features measure their own."""
    frame = replace(shot(ground, camera), height_agl_m=162.0)
    fix, by_features = (one.locate(frame, ground.prior(NADIR)) for one in (matcher, plain))
    sigma_m = np.sqrt(fix.covariance_m2[2, 2] + by_features.covariance_m2[2, 2])
    assert abs(fix.up_m - by_features.up_m) < 4.0 * sigma_m


@pytest.mark.parametrize("scale", [0.35, 1.0])
def test_the_cost_of_features_goes_by_the_pixels_that_are_drawn(ground, camera, matcher, monkeypatch, scale):
    """Not by the frame's: at one height they are up to four times as many as at another. Borders are not shown."""
    shown = []
    drawn = feature_matching.orthorectify

    def noting(*args):
        photo = drawn(*args)
        shown.append(np.count_nonzero(photo.valid))
        return photo

    monkeypatch.setattr(feature_matching, "orthorectify", noting)
    for height_m in (90.0, 110.0, 130.0, 150.0):
        frame = ground.frame(camera, NADIR, height_m, heading_deg=25.0)
        query = matcher._query(frame, ground.prior(NADIR), Deadline(Budget()))
        FeatureMatcher(query, matcher._method.landmarks, SiftOptions(scale=scale)).find_at_once()
        assert 1.0 < drawn_px(query, height_m, scale) / shown[-1] < 1.35
