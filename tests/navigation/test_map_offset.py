"""The map's own error: one for all fixes of a map, and what another source says of it in flight."""

import math

import numpy as np
import pytest

from engine import Fix, Navigator, Prior, Window
from engine.geo import LocalFrame
from engine.navigation.map_offset import MapOffset, MapOffsetEstimator
from engine.navigation.motion import PositionEstimate
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
    assert fix.sigma_m == pytest.approx(math.hypot(0.5, 3.0))
    assert fix.relative_sigma_m == pytest.approx(0.5)
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


def test_the_offset_is_estimated_in_flight_and_moves_no_fix():
    rng = np.random.default_rng(1)
    places = rng.normal([2.0, -1.0], 0.3, (300, 2))
    given = [Prior(east_m=float(e), north_m=float(n), sigma_m=0.5) for e, n in places]
    run = fly([(0.0, 0.0)] * 300, given)
    assert all(isinstance(result, Fix) and result.east_m == 0.0 for result in run.results)
    offset = run.navigator.map_offset
    sigma_m = np.sqrt(np.diag(offset.covariance_m2))
    assert (np.abs(offset.en_m - [2.0, -1.0]) < 3.0 * sigma_m).all()
    assert sigma_m.min() > 0.1  # five minutes count as some six differences
    assert sigma_m.max() < 0.5


def test_without_another_source_nothing_is_known_of_the_offset():
    assert fly([(0.0, 0.0)] * 3).navigator.map_offset is None
    estimator = MapOffsetEstimator()
    estimator.add(fix_at(0.0, 0.0, map_sigma_m=0.0), PositionEstimate(np.ones(2), 1.0), 0.0)
    assert estimator.offset is None


def test_a_corrected_fix_is_moved_in_all_its_coordinates():
    frame = LocalFrame(48.0, 15.0)
    fix = fix_at(0.0, 0.0)
    moved = MapOffset(np.array([30.0, -40.0]), 0.04 * np.eye(2)).corrected(fix, frame)
    assert (moved.east_m, moved.north_m, moved.map_sigma_m) == (30.0, -40.0, 0.0)
    assert np.allclose(frame.enu_from_geodetic(moved.lat_deg, moved.lon_deg), [30.0, -40.0], atol=1e-6)
    assert moved.sigma_m == pytest.approx(math.hypot(0.5, 0.2))
    assert moved.covariance_m2[2, 2] == fix.covariance_m2[2, 2]
