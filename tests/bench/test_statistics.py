"""The statistics of the integrity pages."""

from __future__ import annotations

import numpy as np
import pytest

from bench.accuracy.audit import Trial, fit
from bench.pages.integrity import auc, calibration_error, false_positives


def test_scores_are_ranked():
    """Right ones 3 and 1, wrong ones 2 and 0: of four pairs three are in order; 1 is kept, so 2 passes."""
    score, right = np.array([3.0, 1.0, 2.0, 0.0]), np.array([True, True, False, False])
    assert auc(score, right) == 0.75
    assert auc(np.ones(4), right) == 0.5
    assert np.isnan(auc(np.ones(2), right[[0, 1]]))
    assert false_positives(score, right, kept=1.0) == 0.5
    assert calibration_error(np.array([0.75] * 4), np.array([True, True, True, False])) == 0.0
    assert calibration_error(np.array([1.0] * 4), right) == 0.5


def test_the_fit_finds_the_weights_that_drew_the_outcomes():
    rng = np.random.default_rng(0)
    weights, features = np.array([-1.0, 0.5, 0.0, 2.0]), rng.normal(size=(20_000, 3))
    chance = 1.0 / (1.0 + np.exp(-weights[0] - features @ weights[1:]))
    right = rng.random(len(chance)) < chance
    found = [Trial(60.0, 0.5, row, bool(one), False) for row, one in zip(features, right, strict=True)]
    assert fit(found) == pytest.approx(weights, abs=0.1)
