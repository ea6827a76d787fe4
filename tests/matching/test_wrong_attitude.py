"""A telemetry whose roll and pitch are wrong: the picture outweighs it, by each method."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from engine import Fix, MatcherOptions, NoFix, Reason, SceneMatcher, SiftOptions
from engine.geo import chi_square_of
from engine.matching.evidence import Evidence, probability
from engine.matching.ncc import Ncc
from engine.matching.refinement import Refined, Refinement
from engine.matching.sift import Sift
from engine.runtime.scheduler import OutOfTime
from engine.values import SIGNIFICANCE

NADIR = np.array([310.0, 305.0])
TRUE = {"roll_deg": 4.0, "pitch_deg": -3.0, "heading_deg": 20.0}


@pytest.fixture(scope="module")
def site(ground):
    return ground.map_of(surface_m=np.zeros(ground.size, np.float32), georeference_sigma_m=0.1)


@pytest.fixture(scope="module")
def matchers(site, camera):
    return {method: SceneMatcher(site, camera, method, "cpu") for method in ("ncc", "sift", "auto")}


MOUNT_OFF = {"roll_deg": 6.0, "pitch_deg": -1.0}
WRONG = [
    MOUNT_OFF,
    {"roll_deg": -3.0, "pitch_deg": 4.0},  # swapped
    {"roll_deg": -4.0, "pitch_deg": 3.0},  # of the other sign
    {"roll_deg": 0.07, "pitch_deg": -0.05},  # radians
    *({**TRUE, "roll_deg": roll_deg} for roll_deg in (14.0, -6.0)),
    *({**TRUE, "pitch_deg": pitch_deg} for pitch_deg in (7.0, -13.0)),
    *({**TRUE, "pitch_deg": pitch_deg} for pitch_deg in (13.0, -19.0)),  # the position is 42 m from where it says
    {"roll_deg": -10.0, "pitch_deg": 9.0},
]


@pytest.mark.parametrize(
    ("method", "stated"), [*itertools.product(("ncc", "sift"), WRONG), ("auto", MOUNT_OFF), ("auto", WRONG[-1])]
)
def test_the_picture_outweighs_a_wrong_roll_and_pitch(ground, matchers, camera, method, stated):
    frame = replace(ground.frame(camera, NADIR, 150.0, **TRUE), **stated)
    fix = matchers[method].locate(frame, ground.prior(NADIR))
    assert np.hypot(*ground.off_m(fix, NADIR)) < 1.0
    assert ground.chi_square(fix, NADIR) < chi_square_of(SIGNIFICANCE, 2)
    assert abs(fix.attitude.roll_deg - TRUE["roll_deg"]) < 0.5
    assert abs(fix.attitude.pitch_deg - TRUE["pitch_deg"]) < 0.5


@pytest.mark.parametrize(
    "told", [{"roll_deg": -1.0, "pitch_deg": 0.0, "heading_deg": 110.0}, {"heading_deg": 200.0}]
)
def test_a_heading_that_the_matches_refute_makes_the_tilt_as_doubtful(ground, site, camera, told):
    """A mount that is turned by 90 degrees turns both; of few matches a wrong tilt would move the pose by 12 m."""
    nadir, few = np.array([330.0, 280.0]), MatcherOptions(sift=SiftOptions(max_keypoints=40))
    frame = replace(ground.frame(camera, nadir, 150.0, **TRUE), **told)
    fix = SceneMatcher(site, camera, "sift", "cpu", few).locate(frame, ground.prior(nadir))
    assert np.hypot(*ground.off_m(fix, nadir)) < 1.0
    assert ground.chi_square(fix, nadir) < chi_square_of(SIGNIFICANCE, 2)


@pytest.mark.parametrize("nadir_px", [(310.0, 305.0), (290.0, 320.0), (330.0, 280.0)])
def test_an_unconfirmed_pose_by_features_rests_on_no_told_tilt(ground, matchers, camera, monkeypatch, nadir_px):
    """Most of the picture is noise; a tilt wrong by 7 degrees, held to 0.4, would move the pose by a metre."""
    monkeypatch.setattr(Sift, "refined", lambda *_: None)
    frame, nadir = ground.frame(camera, np.array(nadir_px), 150.0, **TRUE), np.array(nadir_px)
    image = np.array(frame.image)
    hidden = image[:, round(0.3 * image.shape[1]) :]
    hidden[:] = np.random.default_rng(0).integers(0, 255, hidden.shape)
    fix = matchers["sift"].locate(replace(frame, image=image, roll_deg=-1.0, pitch_deg=2.0), ground.prior(nadir))
    assert np.hypot(*ground.off_m(fix, nadir)) < 0.5
    assert abs(fix.attitude.roll_deg - TRUE["roll_deg"]) < 0.5


@pytest.mark.parametrize("method", ["ncc", "auto"])
@pytest.mark.parametrize("pitch_deg", [6.0, 9.0, 12.0])
def test_over_a_map_alone_a_camera_that_says_it_is_level_gives_no_wrong_fix(ground, camera, method, pitch_deg):
    """Taken for a slope of the ground, its tilt would move the fix by 16 to 32 m."""
    frame = replace(ground.frame(camera, NADIR, 150.0, pitch_deg=pitch_deg), pitch_deg=0.0)
    matcher = SceneMatcher(ground.map_of(georeference_sigma_m=0.1), camera, method, "cpu")
    result = matcher.locate(frame, ground.prior(NADIR))
    assert isinstance(result, NoFix) or ground.chi_square(result, NADIR) < 9.0


@pytest.mark.parametrize(
    ("method", "knows_place"), [("ncc", True), ("ncc", False), ("sift", True), ("auto", True)]
)
def test_a_tilt_of_the_wrong_sign_never_displaces_a_fix(ground, matchers, camera, method, knows_place):
    """A braking vehicle's 14 degrees of pitch, told as -14: its position would be 75 m off."""
    frame = replace(ground.frame(camera, NADIR, 150.0, pitch_deg=14.0), pitch_deg=-14.0)
    answer = matchers[method].locate(frame, ground.prior(NADIR) if knows_place else None)
    if isinstance(answer, Fix):
        assert np.hypot(*ground.off_m(answer, NADIR)) < 1.0
    else:
        assert answer.reason in (Reason.BAD_POSE, Reason.LOW_SCORE, Reason.AMBIGUOUS)


@pytest.mark.parametrize("knows_better", [True, False, None])
def test_a_pose_that_is_hardly_confirmed_gives_way_to_one_that_is(ground, site, camera, monkeypatch, knows_better):
    """And stands where the doubt leads nowhere, or there is no time for it (None): it has evidence."""

    def refine_pose(self, fix):
        if self.doubts_tilt and knows_better is None:
            raise OutOfTime
        better, hardly = refined(fix, 0.9), refined(fix, 0.3)
        return (better if knows_better else None) if self.doubts_tilt else hardly

    monkeypatch.setattr(Refinement, "refine_at_once", lambda _self, _fix: None)
    monkeypatch.setattr(Refinement, "refine_pose", refine_pose)
    monkeypatch.setattr(Refinement, "surprise_of", lambda _self, pose: 300.0 * pose.fix.score)
    frame = ground.frame(camera, NADIR, 150.0, **TRUE)
    fix = SceneMatcher(site, camera, "ncc", "cpu").locate(frame, ground.prior(NADIR))
    assert (fix.stage, fix.score) == ("refined", 0.9 if knows_better else 0.3)


@pytest.mark.parametrize(
    ("nats", "refined_nats", "stage", "left"),
    [
        (7.0, 30.0, "refined", 30.0),
        (7.0, 5.0, None, None),  # chance reaches that as well
        (7.0, None, None, None),
        (11.0, 30.0, "refined", 11.0),  # enough: nothing more is measured
        (11.0, None, None, None),
        (14.0, None, "unconfirmed", 14.0 + math.log(0.02)),
    ],
)
def test_a_refined_pose_is_evidence_of_place(ground, site, camera, monkeypatch, nats, refined_nats, stage, left):
    """Without it the prior alone confirms the attitude. The usual risk asks for 9.2 nats."""
    monkeypatch.setattr(Ncc, "find", weakened(nats))
    monkeypatch.setattr(Ncc, "match_structure", lambda *_: None)
    monkeypatch.setattr(Refinement, "refine_at_once", lambda _self, _fix: None)
    found = (lambda _, fix: None) if refined_nats is None else lambda _, fix: refined(fix, 0.9)
    monkeypatch.setattr(Refinement, "refine_pose", found)
    monkeypatch.setattr(Refinement, "surprise_of", lambda *_: (refined_nats or 0.0) + math.log(1000.0))
    frame = ground.frame(camera, NADIR, 150.0, **TRUE)
    prior = ground.prior(NADIR)
    answer = SceneMatcher(site, camera, "ncc", "cpu").locate(frame, prior)
    if stage is None:
        assert isinstance(answer, NoFix)
        return
    assert answer.stage == stage
    assert (answer.sigma_m > prior.sigma_m) == (stage == "unconfirmed")
    assert answer.confidence == pytest.approx(probability(left), rel=1e-9)


def weakened(nats):
    """Ncc.find, whose peaks have this evidence, and none but that."""
    find = Ncc.find

    def weak(self, query, *, coarser=0, widely=False):
        if widely or coarser:
            return query.refuse(Reason.LOW_SCORE, "not looked for", "ncc")
        found = find(self, query)
        return found.weighed(Evidence(nats + math.log(1000.0), 0.0, 1000.0, 1000.0, None, is_tested=True))

    return weak


def refined(fix, score):
    return Refined(replace(fix, stage="refined", score=score), None, None, None, is_consistent=True)


def test_a_refined_pose_does_not_replace_the_structure_that_a_search_must_show(ground, site, camera, monkeypatch):
    """Of a place found without a prior, the best of a whole map."""
    monkeypatch.setattr(Evidence, "nats", 20.0)
    monkeypatch.setattr(Ncc, "match_structure", lambda *_: None)
    monkeypatch.setattr(Refinement, "refine_pose", lambda _, fix: refined(fix, 0.9))
    monkeypatch.setattr(Refinement, "surprise_of", lambda *_: 50.0)
    frame = ground.frame(camera, NADIR, 150.0, **TRUE)
    assert SceneMatcher(site, camera, "ncc", "cpu").locate(frame).reason is Reason.UNCONFIRMED


@pytest.mark.parametrize(("pose_nats", "stage"), [(11.0, "refined"), (8.0, "fine")])
def test_a_pose_must_outdo_chance_at_its_place_alone(ground, camera, monkeypatch, pose_nats, stage):
    """The peak has settled the place: a blurred map shows a weak pose there, whose tilt counts all the same."""
    monkeypatch.setattr(Ncc, "find", weakened(14.0))
    monkeypatch.setattr(Refinement, "refine_pose", lambda _, fix: refined(fix, 0.3))
    tried = 25.0 * 100.0  # tilts, and places that a refinement reaches
    monkeypatch.setattr(Refinement, "surprise_of", lambda *_: pose_nats + math.log(tried))
    frame = replace(ground.frame(camera, NADIR, 150.0, **TRUE), roll_deg=None, pitch_deg=None)
    fix = SceneMatcher(ground.map_of(), camera, "ncc", "cpu").locate(frame, ground.prior(NADIR))
    assert fix.stage == stage


@pytest.mark.parametrize("height_agl_m", [110.0, 120.0, 190.0])
def test_a_frame_is_drawn_anew_at_the_height_that_its_matches_show(ground, site, camera, height_agl_m):
    """A few features of the reduced frame, which are found at any scale, are ten times as far off."""
    few = MatcherOptions(sift=SiftOptions(max_keypoints=20, refine=False))
    frame = replace(ground.frame(camera, NADIR, 150.0, **TRUE), height_agl_m=height_agl_m)
    fix = SceneMatcher(site, camera, "sift", "cpu", few).locate(frame, ground.prior(NADIR))
    assert np.hypot(*ground.off_m(fix, NADIR)) < 0.15
    assert abs(fix.up_m - 150.0) < 1.0
