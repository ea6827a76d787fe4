"""Log-evidence of a pose: what adds to it, what takes away, and the probability that follows."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine import Reason
from engine.matching.acceptance import judge_pose
from engine.matching.evidence import PoseEvidence, nats_of, needed_nats, probability

PLAIN = PoseEvidence(-10.0, 2.0, 1.0, 0.3)
known = st.one_of(st.none(), st.floats(0, 1e9))


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ({"log10_nfa": -30.0}, {"log10_nfa": -7.0}),
        ({"prior_chi_square": 0.0}, {"prior_chi_square": 9.0}),
        ({"height_chi_square": 0.0}, {"height_chi_square": 9.0}),
        ({"rival_share": 0.1}, {"rival_share": 0.9}),
        ({}, {"null_log10_nfa": -6.0}),
    ],
    ids=lambda changed: " ".join(changed) or "no null",
)
def test_more_evidence_makes_a_pose_more_probable(better, worse):
    assert replace(PLAIN, **better).nats >= PLAIN.nats > replace(PLAIN, **worse).nats


def test_a_rival_with_as_many_votes_leaves_no_evidence_but_the_priors():
    both = replace(PLAIN, rival_share=1.0)
    assert both.nats == replace(PLAIN, log10_nfa=0.0).nats < needed_nats(0.01)


def test_a_prior_or_a_height_that_is_wrong_costs_no_more_than_its_reliability():
    """Either may be the one that is wrong, once in a hundred times."""
    for field in ("prior_chi_square", "height_chi_square"):
        without, against = (replace(PLAIN, **{field: value}).nats for value in (None, 1e9))
        assert without - against == pytest.approx(math.log(100.0))


def test_a_height_that_agrees_says_nothing():
    assert replace(PLAIN, height_chi_square=0.0).nats == replace(PLAIN, height_chi_square=None).nats


@given(st.floats(-1e6, 1e6), known, known, st.floats(0, 1), st.floats(-1e6, 0))
def test_every_pose_has_a_probability(log10_nfa, prior_chi_square, height_chi_square, rival_share, null):
    evidence = PoseEvidence(log10_nfa, prior_chi_square, height_chi_square, rival_share, null)
    assert 0.0 < probability(evidence.nats) < 1.0


@given(st.floats(-25, 25))
def test_a_probability_tells_its_evidence(nats):
    assert nats_of(probability(nats)) == pytest.approx(nats, abs=1e-3)


@given(st.floats(1e-12, 0.5), st.floats(-100, 0), known, known)
def test_what_is_handed_out_is_wrong_with_no_more_than_the_risk(risk, log10_nfa, prior, height):
    evidence = PoseEvidence(log10_nfa, prior, height)
    handed_out = judge_pose(evidence, risk) is None
    assert handed_out == (evidence.nats >= needed_nats(risk))
    if handed_out and evidence.nats < 30.0:
        assert 1.0 - probability(evidence.nats) <= risk * (1 + 1e-6) + 1e-15


def test_a_refusal_of_a_pose_tells_its_figures():
    reason, text = judge_pose(PoseEvidence(-1.5, None, None), 1e-4)
    assert reason is Reason.BAD_POSE
    for figure in ("0.0001 is allowed", "-1.5", "rival at 0%", "chi-square unknown"):
        assert figure in text
    assert "chi-square 3.2" in judge_pose(PoseEvidence(-1.5, 3.2, None), 1e-4)[1]
