"""What speaks for a peak, and the probability that follows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine import Reason
from engine.evidence import Evidence, evidence_of, probability
from engine.integrity import PeakRule, judge_evidence
from engine.types import Peak

MIDDLING = Evidence(sigmas=10.0, ratio=0.6, off_prior=4.0)


def peak(score, second):
    return Peak(0.0, 0.0, score, second, -np.eye(2))


def test_a_score_is_counted_in_sigmas_of_fishers_z():
    found = evidence_of(peak(0.5, 0.2), 0.1, 3.0)
    assert found.sigmas == pytest.approx(math.atanh(0.5) / 0.1)
    assert found.ratio == pytest.approx(0.4)
    assert found.off_prior == 3.0


@pytest.mark.parametrize(("score", "second", "ratio"), [(0.5, -1.0, 0.0), (0.5, 0.5, 1.0), (-0.2, -0.3, 0.0)])
def test_the_ratio_of_a_rival_is_a_share(score, second, ratio):
    assert evidence_of(peak(score, second), 0.1, 0.0).ratio == ratio


@pytest.mark.parametrize(
    ("name", "better", "worse"), [("sigmas", 20, 5), ("ratio", 0.3, 0.9), ("off_prior", 0, 9)]
)
def test_more_evidence_makes_a_peak_more_probable(name, better, worse):
    low, high = (probability(replace(MIDDLING, **{name: float(value)})) for value in (worse, better))
    assert low < probability(MIDDLING) < high


def test_a_prior_that_is_far_off_does_not_outweigh_a_plain_match():
    """The prior may be the one that is wrong; how far it is off then says nothing more."""
    plain = Evidence(sigmas=25.0, ratio=0.1, off_prior=50.0)
    assert probability(plain) == probability(replace(plain, off_prior=5000.0)) > PeakRule().min_confidence


def test_a_refusal_tells_its_figures():
    verdict = judge_evidence(replace(MIDDLING, ratio=0.9), PeakRule())
    assert verdict is not None
    assert verdict[0] is Reason.AMBIGUOUS
    for figure in ("0.97", "10.0 sigmas", "90%", "4.0"):
        assert figure in verdict[1]
    assert judge_evidence(Evidence(sigmas=20.0, ratio=0.2, off_prior=1.0), PeakRule()) is None


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(1e-3, 1), st.floats(0, 1e9))
def test_every_peak_has_a_probability(score, second, sigma, off_prior):
    assert 0.0 < probability(evidence_of(peak(score, second), sigma, off_prior)) < 1.0


def test_the_fit_finds_the_weights_that_drew_the_labels():
    """Labels drawn with known weights: the fit has them again, to the scatter of 20,000 draws."""
    from bench.confidence import Sample, fitted

    rng = np.random.default_rng(0)
    x = np.c_[np.ones(20_000), rng.uniform(0.5, 3.0, 20_000), rng.random(20_000), rng.uniform(0, 12, 20_000)]
    true = np.array([4.0, 1.0, -6.0, -0.3])
    right = rng.random(len(x)) < 1.0 / (1.0 + np.exp(-x @ true))
    found = fitted([Sample("", "", bool(r), True, (), row, 0.0, 0.0) for r, row in zip(right, x, strict=True)])
    weights = [found.constant, found.log_sigmas, found.ratio, found.off_prior]
    np.testing.assert_allclose(weights, true, rtol=0.1)
