"""The statistics of the integrity pages."""

from __future__ import annotations

import numpy as np


def test_the_fit_finds_the_weights_that_drew_the_labels():
    """Labels drawn with known weights: the fit has them again, to the scatter of 20,000 draws."""
    from bench.accuracy.audit import fitted

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
