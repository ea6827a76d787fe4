"""The protection level of a fix: the radius that holds all but a risk."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine import OptionError
from tests.support.fixes import a_fix

FIX = a_fix(score=0.5, method="sift", confidence=0.99999)


@pytest.mark.parametrize("risk", [1e-1, 1e-2, 1e-4])
def test_the_protection_level_holds_all_but_the_risk(risk):
    """Of 200,000 positions drawn by a fix's own statement; a circle of the larger axis is at least as wide."""
    fix = replace(FIX, covariance_m2=np.diag([1.0, 0.25, 4.0]), confidence=1.0 - risk / 10)
    level_m = fix.protection_level_m(risk)
    assert math.isfinite(level_m)
    off_m = np.random.default_rng(0).multivariate_normal(np.zeros(2), fix.covariance_m2[:2, :2], 200_000)
    assert (np.hypot(*off_m.T) > level_m).mean() + risk / 10 <= risk


@pytest.mark.parametrize("confidence", [None, 0.99])
def test_no_circle_protects_where_the_place_may_be_a_wrong_one(confidence):
    assert replace(FIX, confidence=confidence).protection_level_m(1e-3) == math.inf


@pytest.mark.parametrize("risk", [0.0, 1.0, math.nan])
def test_a_risk_is_a_probability(risk):
    with pytest.raises(OptionError, match="risk: expected a probability above 0 and below 1"):
        FIX.protection_level_m(risk)
