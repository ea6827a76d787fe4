"""What speaks for a peak, and the probability that follows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine import Fix, Reason
from engine.matching.acceptance import judge_peak
from engine.matching.confidence import (
    PeakFeatures,
    PriorAgreement,
    peak_features,
    prior_agreement,
    probability,
)
from engine.options import PeakRule
from engine.values import Peak, Timings, Window

NEAR = PriorAgreement(prior_chi_square=4.0, spread_m=8.0)
MIDDLING = PeakFeatures(sigmas=10.0, ratio=0.6, score=0.4, agreement=NEAR)


def made_fix(east_m, north_m, variance_m2):
    return Fix(
        timestamp_ns=None,
        lat_deg=0.0,
        lon_deg=0.0,
        east_m=east_m,
        north_m=north_m,
        up_m=None,
        covariance_m2=np.eye(3) * variance_m2,
        attitude=None,
        score=0.5,
        method="ncc",
        window=Window(0, 0, 1, 1),
        timings=Timings(),
        map_xy_px=(0.0, 0.0),
    )


def peak(score, second):
    return Peak(0.0, 0.0, score, second, -np.eye(2))


def test_a_score_is_counted_in_sigmas_of_fishers_z():
    found = peak_features(peak(0.5, 0.2), 0.1, NEAR)
    assert found.sigmas == pytest.approx(math.atanh(0.5) / 0.1)
    assert found.ratio == pytest.approx(0.4)
    assert found.agreement is NEAR


@pytest.mark.parametrize(("score", "second", "ratio"), [(0.5, -1.0, 0.0), (0.5, 0.5, 1.0), (-0.2, -0.3, 0.0)])
def test_the_ratio_of_a_rival_is_a_share(score, second, ratio):
    assert peak_features(peak(score, second), 0.1, NEAR).ratio == ratio


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ({"sigmas": 20.0}, {"sigmas": 5.0}),
        ({"ratio": 0.3}, {"ratio": 0.9}),
        ({"agreement": PriorAgreement(0.0, 8.0)}, {"agreement": PriorAgreement(9.0, 8.0)}),
        ({"agreement": PriorAgreement(4.0, 4.0)}, {"agreement": PriorAgreement(4.0, 20.0)}),
    ],
)
def test_more_evidence_makes_a_peak_more_probable(better, worse):
    low, high = (probability(replace(MIDDLING, **changes)) for changes in (worse, better))
    assert low < probability(MIDDLING) < high


def test_a_prior_that_is_far_off_does_not_outweigh_a_plain_match():
    """The prior may be the one that is wrong; how far it is off then says nothing more."""
    plain = PeakFeatures(sigmas=25.0, ratio=0.1, score=0.6, agreement=PriorAgreement(50.0, 8.0))
    farther = replace(plain, agreement=PriorAgreement(5000.0, 8.0))
    assert probability(plain) == probability(farther) > PeakRule().min_confidence


def test_a_place_is_held_against_the_errors_of_both():
    fix = made_fix(east_m=3.0, north_m=4.0, variance_m2=9.0)
    found = prior_agreement(fix, np.zeros(2), 4.0)
    assert found.prior_chi_square == pytest.approx(25.0 / 25.0)
    assert found.spread_m == pytest.approx(5.0)


def test_a_refusal_tells_its_figures():
    clear, rule = peak(0.9, 0.1), PeakRule()
    verdict = judge_peak(clear, 2500, replace(MIDDLING, ratio=0.9), 0.979, rule)
    assert verdict is not None
    assert verdict[0] is Reason.AMBIGUOUS
    for figure in ("0.979", "0.99", "10.0 sigmas", "90%", "4.0"):
        assert figure in verdict[1]
    assert judge_peak(clear, 2500, MIDDLING, 0.99, rule) is None


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(1e-3, 1), st.floats(0, 1e9))
def test_every_peak_has_a_probability(score, second, sigma, prior_chi_square):
    assert (
        0.0 < probability(peak_features(peak(score, second), sigma, PriorAgreement(prior_chi_square, 8.0))) < 1.0
    )


def test_the_fit_finds_the_weights_that_drew_the_labels():
    """Labels drawn with known weights: the fit has them again, to the scatter of 20,000 draws."""
    from bench.accuracy.confidence import fitted

    rng = np.random.default_rng(0)
    x = np.c_[np.ones(20_000), rng.uniform(0.5, 3.0, 20_000), rng.random(20_000), rng.uniform(0, 12, 20_000)]
    true = np.array([4.0, 1.0, -6.0, -0.3])
    right = rng.random(len(x)) < 1.0 / (1.0 + np.exp(-x @ true))
    np.testing.assert_allclose(fitted(x, right), true, rtol=0.1)


def test_scores_are_ranked():
    """Right ones 3 and 1, wrong ones 2 and 0: of four pairs three are in order; 1 is kept, so 2 passes."""
    from bench.pages.integrity import auc, calibration_error, false_positives

    score, right = np.array([3.0, 1.0, 2.0, 0.0]), np.array([True, True, False, False])
    assert auc(score, right) == 0.75
    assert false_positives(score, right, kept=1.0) == 0.5
    assert calibration_error(np.array([0.75] * 4), np.array([True, True, True, False])) == 0.0
    assert calibration_error(np.array([1.0] * 4), right) == 0.5
