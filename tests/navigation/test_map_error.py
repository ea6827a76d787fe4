"""The map's own error: one for all fixes of a map."""

import math

import numpy as np
import pytest

from engine import Fix, Navigator, Prior, Window
from tests.support.fixes import a_fix
from tests.support.matchers import ScriptedMatcher, a_site, at, flown

STILL = (0.0, 0.0)


def fix_at(east_m, north_m, sigma_m=0.5, map_sigma_m=3.0):
    stated = {"method": "sift", "confidence": 0.9999, "window": Window(0, 0, 1000, 1000)}
    return a_fix(east_m, north_m, math.hypot(sigma_m, map_sigma_m), map_sigma_m=map_sigma_m, **stated)


def scripted(*places):
    """A matcher that answers with places on a map that states nothing of its accuracy."""
    return ScriptedMatcher(*(fix_at(*place) for place in places), site=a_site(georeference_sigma_m=None))


def fly(places, given=None):
    """Frames a second apart, from a start."""
    return flown(scripted(*places), Prior(east_m=0.0, north_m=0.0, sigma_m=5.0), velocity=STILL, given=given)


def test_a_fix_tells_what_of_its_covariance_is_the_maps():
    fix = fix_at(0.0, 0.0, sigma_m=0.5, map_sigma_m=3.0)
    assert (fix.sigma_m, fix.relative_sigma_m) == pytest.approx((math.hypot(0.5, 3.0), 0.5))
    assert np.allclose(fix.relative_covariance_m2, 0.25 * np.eye(2))


def test_the_maps_error_cancels_between_fixes_on_it():
    """The window of the next frame is not wider for it, and a match 5 m off contradicts a fix known to 0.5 m."""
    run = fly([(0.0, 0.0), (5.0, 0.0)])
    assert run.fixed == [0]
    assert run.priors[1].sigma_m == pytest.approx(math.hypot(0.5, 0.5, math.sqrt(9.0 / 12.0)))
    predicted = fly([(0.0, 0.0), (90.0, 0.0)]).navigator.prediction
    assert predicted.sigma_m == pytest.approx(math.hypot(run.priors[1].sigma_m, 3.0))  # in the world


@pytest.mark.parametrize("is_start", [True, False])
def test_a_position_of_another_source_is_searched_with_the_maps_error(is_start):
    """Known to centimetres in the world, it is known to 3 m on a map that states nothing."""
    known, matcher = Prior(east_m=4.0, north_m=3.0, sigma_m=0.02), scripted((0.0, 0.0))
    start, given = (known, None) if is_start else (None, known)
    assert isinstance(Navigator(matcher, start).update(at(0.0, STILL), given), Fix)
    assert matcher.priors[0].sigma_m == pytest.approx(3.0, rel=1e-3)
