"""Log-evidence of poses and peaks: what adds to it, what takes away, and the probability that follows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine import Reason
from engine.matching import evidence as evidences
from engine.matching.candidates import PeakCandidate, PoseCandidate
from engine.matching.evidence import Evidence, independent_places, needed_nats, prior_chi_square, probability
from engine.matching.refusals import of_candidate
from engine.values import Peak
from tests.support.fixes import a_fix

PLAIN = Evidence(40.0, 8.0, 1000.0, 1000.0, 2.0, 1.0)
known = st.one_of(st.none(), st.floats(0, 1e9))


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ({"surprise": 70.0}, {"surprise": 30.0}),
        ({"prior_chi_square": 0.0}, {"prior_chi_square": 9.0}),
        ({"height_chi_square": 0.0}, {"height_chi_square": 9.0}),
        ({"rival": 7.0}, {"rival": 20.0}),
        ({}, {"null": 20.0}),
        ({}, {"tried": 1e5}),
    ],
    ids=lambda changed: " ".join(changed) or "no more",
)
def test_more_evidence_makes_a_place_more_probable(better, worse):
    assert replace(PLAIN, **better).nats >= PLAIN.nats > replace(PLAIN, **worse).nats


def test_a_prior_or_a_height_that_is_wrong_costs_no_more_than_its_reliability():
    """Either may be the one that is wrong, once in a hundred times."""
    for field in ("prior_chi_square", "height_chi_square"):
        without, against = (replace(PLAIN, **{field: value}).nats for value in (None, 1e9))
        assert without - against == pytest.approx(math.log(100.0))


def test_a_height_that_agrees_says_nothing():
    assert replace(PLAIN, height_chi_square=0.0).nats == replace(PLAIN, height_chi_square=None).nats


@given(st.floats(0, 1e6), st.floats(0, 1e6), st.floats(2.0, 1e12), known, known, st.floats(0, 1e6))
def test_every_place_has_a_probability(surprise, rival, places, prior_chi_square, height_chi_square, null):
    evidence = Evidence(surprise, rival, places, places, prior_chi_square, height_chi_square, null)
    assert 0.0 < probability(evidence.nats) < 1.0


@given(st.floats(-25, 25))
def test_a_probability_tells_its_evidence(nats):
    assert evidences.nats_of(probability(nats)) == pytest.approx(nats, abs=1e-3)


@given(st.floats(1e-12, 0.5), st.floats(0, 300), known, known)
def test_what_is_handed_out_is_wrong_with_no_more_than_the_risk(risk, surprise, prior, height):
    evidence = Evidence(surprise, 0.0, 1000.0, 1000.0, prior, height, is_tested=True)
    handed_out = evidence.suffices(risk)
    assert handed_out == (evidence.nats >= needed_nats(risk))
    if handed_out and evidence.nats < 30.0:
        assert 1.0 - probability(evidence.nats) <= risk * (1 + 1e-6) + 1e-15


def test_a_refusal_of_a_pose_tells_its_figures():
    weak = Evidence(3.5 * math.log(10.0), 0.0, 1000.0, 1000.0, None)
    pose = PoseCandidate(a_fix(), weak)
    assert not pose.suffices(1e-4)
    reason, text = of_candidate(pose, 1e-4)
    assert reason is Reason.BAD_POSE
    for figure in ("0.0001 is allowed", "10^3.5", "rival once in 10^0.0", "chi-square unknown"):
        assert figure in text
    assert "chi-square 3.2" in of_candidate(pose.weighed(replace(weak, prior_chi_square=3.2)), 1e-4)[1]


@given(st.floats(1e-12, 0.1), st.floats(0, 300))
def test_without_the_null_hypothesis_only_evidence_beyond_doubt_is_handed_out(risk, surprise):
    untested = Evidence(surprise, 0.0, 1000.0, 1000.0, None)
    assert untested.promises(risk) == replace(untested, is_tested=True).suffices(risk)
    assert untested.suffices(risk) == (untested.nats >= 3.0 * needed_nats(risk))


def test_a_pose_that_there_was_no_time_to_test_is_late():
    untested = PoseCandidate(a_fix(), Evidence(32.0, 0.0, 1000.0, 1000.0, None))
    assert untested.promises(1e-4)
    assert of_candidate(untested, 1e-4)[0] is Reason.LATE


# ------------------------------------------------------------------------------------------------------- peaks

PEAK = Evidence(32.0, 10.0, 1000.0, 1000.0, 2.0, is_tested=True)


def a_peak(evidence):
    return PeakCandidate(a_fix(), evidence, Peak(1.0, 1.0, 0.9, 0.1, -0.02 * np.eye(2)), None)


def test_the_best_of_many_places_is_worth_what_chance_makes_of_so_many():
    """n draws reach s sigmas with a probability of n exp(-s^2 / 2); without a prior that is all."""
    alone = Evidence(32.0, 0.0, 1000.0, 1000.0, None)
    assert alone.nats == pytest.approx(32.0 - math.log(1000.0))
    assert replace(alone, tried=1e6).nats == pytest.approx(32.0 - math.log(1e6))


def test_look_alikes_make_a_surprise_worth_as_much_less():
    """By hand: of 1000 places the best is expected at log 1000; a rival at four times that makes all a quarter."""
    expected = math.log(1000.0)
    twins = Evidence(128.0, 4.0 * expected, 1000.0, 1000.0, None)
    assert twins.nats == pytest.approx(Evidence(32.0, expected, 1000.0, 1000.0, None).nats)


@given(st.floats(7.0, 1e6), st.booleans())
def test_a_rival_that_is_as_good_leaves_no_evidence_but_the_priors(surprise, mirrored):
    rival = {"null" if mirrored else "rival": surprise}
    assert replace(Evidence(surprise, 0.0, 1000.0, 1000.0, None), **rival).nats <= 1e-9


def test_the_rate_of_alarms_is_what_the_evidence_allows():
    """Peaks of 20,000 surfaces of chance: evidence e comes no more often than exp(-e)."""
    scores = np.sort(np.random.default_rng(1).normal(size=(20_000, 500)), axis=1)[:, -2:] ** 2 / 2.0
    nats = np.array([Evidence(high, rival, 500.0, 500.0, None).nats for rival, high in scores])
    for e in (1.0, 2.0, 4.0, 6.0):
        assert np.mean(nats > e) <= math.exp(-e)


def test_a_score_is_counted_in_sigmas_of_fishers_z():
    assert evidences.surprise_of(0.5, 0.1) == pytest.approx((math.atanh(0.5) / 0.1) ** 2 / 2.0)
    assert evidences.surprise_of(-0.5, 0.1) == 0.0
    assert independent_places(1600.0) == pytest.approx(100.0)
    assert independent_places(0.0) == pytest.approx(math.e)


def test_a_place_is_held_against_the_errors_of_both():
    fix = a_fix(east_m=3.0, north_m=4.0, sigma_m=3.0)
    assert prior_chi_square(fix, np.zeros(2), 4.0) == pytest.approx(25.0 / 25.0)


@pytest.mark.parametrize(
    ("evidence", "risk", "reason"),
    [
        (PEAK, 1e-3, None),
        (PEAK, 1e-9, Reason.AMBIGUOUS),
        (replace(PEAK, rival=31.2), 1e-3, Reason.AMBIGUOUS),
        (replace(PEAK, surprise=4.5, rival=2.0), 1e-3, Reason.LOW_SCORE),  # what chance reaches
        (replace(PEAK, prior_chi_square=40.0), 1e-6, Reason.AMBIGUOUS),
    ],
)
def test_a_peak_is_believed_if_the_risk_allows_it(evidence, risk, reason):
    found = a_peak(evidence)
    assert found.suffices(risk) == (reason is None)
    if reason is not None:
        why, figures = of_candidate(found, risk)
        assert why is reason
        assert f"{math.sqrt(2.0 * evidence.surprise):.1f}" in figures


def test_what_a_search_fitted_waits_for_the_structure_about_the_place():
    searched = replace(a_peak(replace(PEAK, surprise=1250.0)), by_search=True, is_fitted=True)
    assert not searched.suffices(1e-4)
    assert of_candidate(searched, 1e-4)[0] is Reason.UNCONFIRMED
    assert replace(searched, by_structure=True).suffices(1e-4)


def test_a_peak_that_still_rises_at_the_edge_of_the_window_is_refused():
    certain = a_peak(Evidence(1e3, 0.0, 1e3, 1e3, None))
    at_edge = replace(certain, peak=replace(certain.peak, curvature=np.zeros((2, 2))))
    assert certain.suffices(1e-4)
    assert not at_edge.suffices(1e-4)
    assert of_candidate(at_edge, 1e-4) == (Reason.AMBIGUOUS, "NCC 0.900 still rises at the window's edge")


def test_of_a_peak_and_its_refined_pose_the_greater_evidence_counts():
    strong, unknown, none = (replace(PLAIN, refined=refined).nats for refined in (90.0, None, -math.inf))
    assert strong > unknown > none
    assert math.exp(none - unknown) == pytest.approx(0.02)  # few right places have no pose that can be refined


@given(st.floats(7.0, 1e3))
def test_a_refined_pose_is_no_evidence_against_a_rival_as_good_as_its_peak(surprise):
    assert Evidence(surprise, surprise, 1000.0, 1000.0, None, refined=1e4).nats <= 1e-9
