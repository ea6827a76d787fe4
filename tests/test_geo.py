"""geo.py against formulas written out, its own inverses, and the signs of the conventions."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from engine import geo
from engine.geo import LocalFrame, attitude_from_rotation, chi_square, enu_from_body, wrap_difference_deg
from tests.support.ground import body_axes

LONGITUDES = st.floats(-180.0, 180.0)
PLACES = [(0.0, 0.0), (32.79, 34.99), (-33.9, 151.2), (71.0, -156.8), (89.9, 12.0), (-45.0, 179.9999)]


def on_earth(lat_deg, lon_deg):
    """Earth-centred, Earth-fixed points (..., 3) of the ellipsoid WGS84 (NIMA TR8350.2), written out."""
    lat, lon, e2 = np.radians(lat_deg), np.radians(lon_deg), 6.69437999014e-3
    normal = 6378137.0 / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    xyz = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), (1.0 - e2) * np.sin(lat)
    return np.stack([normal * each for each in xyz], axis=-1)


@pytest.mark.parametrize(("lat_deg", "lon_deg"), PLACES)
def test_enu_is_the_offset_along_the_earth_s_axes_turned(lat_deg, lon_deg):
    lat = lat_deg + np.array([[0.0, 0.02], [-0.03, 0.05]])
    lon = lon_deg + np.array([[0.0, 0.01], [0.04, -0.05]])
    phi, away = math.radians(lat_deg), math.radians(lon_deg)
    east = [-math.sin(away), math.cos(away), 0.0]
    north = [-math.sin(phi) * math.cos(away), -math.sin(phi) * math.sin(away), math.cos(phi)]
    expected = (on_earth(lat, lon) - on_earth(lat_deg, lon_deg)) @ np.array([east, north]).T
    np.testing.assert_allclose(LocalFrame(lat_deg, lon_deg).enu_from_geodetic(lat, lon), expected, atol=1e-6)


OFFSETS_M = arrays(np.float64, (2, 3), elements=st.floats(-20_000.0, 20_000.0))


@given(st.floats(-85.0, 85.0), LONGITUDES, OFFSETS_M, OFFSETS_M)
@settings(max_examples=80, deadline=None)
def test_enu_round_trip_closes_to_a_micrometre(lat_deg, lon_deg, east_m, north_m):
    frame = LocalFrame(lat_deg, lon_deg)
    lat, lon = frame.geodetic_from_enu(east_m, north_m)
    assert lat.shape == lon.shape == (2, 3)
    np.testing.assert_allclose(frame.enu_from_geodetic(lat, lon), np.stack([east_m, north_m], axis=-1), atol=1e-6)


@given(st.floats(-89.9, 89.9), LONGITUDES, st.floats(-0.5, 0.5), st.floats(-1.0, 1.0))
@settings(max_examples=150, deadline=None)
def test_true_north_is_where_a_step_of_latitude_leads(lat_deg, lon_deg, away_lat_deg, away_lon_deg):
    frame, step_deg = LocalFrame(lat_deg, lon_deg), 1e-4
    lat, lon = max(-89.9, min(lat_deg + away_lat_deg, 89.9)), lon_deg + away_lon_deg
    south, north = frame.enu_from_geodetic(np.array([lat - step_deg, lat + step_deg]), lon)
    expected = math.degrees(math.atan2(*(north - south)))
    assert abs(math.remainder(frame.convergence_deg(lat, lon) - expected, 360.0)) < 1e-5


@given(st.floats(-180.0, 180.0), st.floats(-90.0, 90.0), st.floats(0.0, 360.0))
def test_angles_turn_heading_then_pitch_then_roll(roll_deg, pitch_deg, heading_deg):
    """Clockwise from north, the nose up, the right side down: axis by axis, as the drawn grounds turn theirs."""
    forward, right, down = body_axes(roll_deg, pitch_deg, heading_deg)
    found = enu_from_body(roll_deg, pitch_deg, heading_deg)
    np.testing.assert_allclose(found, np.stack([forward, right, down], axis=1), atol=1e-12)


@given(st.floats(-179.0, 179.0), st.floats(-89.0, 89.0), st.floats(0.0, 359.999))
@example(0.0, 0.0, -1e-18)  # a hair west of north
@settings(max_examples=150, deadline=None)
def test_attitude_round_trip(roll_deg, pitch_deg, heading_deg):
    rotation = enu_from_body(roll_deg, pitch_deg, heading_deg)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    roll, pitch, heading = attitude_from_rotation(rotation)
    assert 0.0 <= heading < 360.0
    assert (roll, pitch) == pytest.approx((roll_deg, pitch_deg), abs=1e-7)
    assert abs((heading - heading_deg + 180.0) % 360.0 - 180.0) < 1e-7


@given(heading_deg=st.floats(-1e4, 1e4) | st.sampled_from([-1e-17, -5e-324, 360.0, -360.0]))
def test_a_heading_lies_in_the_half_open_circle(heading_deg):
    wrapped_deg = geo.wrap_heading_deg(heading_deg)
    assert 0.0 <= wrapped_deg < 360.0
    assert math.remainder(wrapped_deg - heading_deg, 360.0) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("given_deg", "expected_deg"), [(0.0, 0.0), (180.0, -180.0), (-190.0, 170.0), (725.0, 5.0)]
)
def test_differences_of_angles_wrap_to_half_a_turn(given_deg, expected_deg):
    assert wrap_difference_deg(given_deg) == expected_deg
    assert wrap_difference_deg(np.array([given_deg])) == [expected_deg]


def test_chi_square_counts_in_standard_deviations():
    assert chi_square(np.array([3.0, 8.0]), np.diag([9.0, 16.0])) == pytest.approx(5.0)


def test_chi_square_along_any_direction_that_a_singular_covariance_allows_is_finite():
    rng = np.random.default_rng(5)
    for along in rng.normal(size=(2000, 2)) * 10.0 ** rng.uniform(-6, 6, (2000, 1)):
        covariance = 4.0 * np.outer(along, along)
        assert chi_square(3.0 * along, covariance) == pytest.approx(2.25, rel=1e-6)
        assert chi_square(along + 1e-3 * np.array([-along[1], along[0]]), covariance) == math.inf


def test_chi_square_without_any_spread_is_nothing_or_infinite():
    assert chi_square(np.zeros(2), np.zeros((2, 2))) == 0.0
    assert chi_square(np.array([0.0, 1e-9]), np.zeros((2, 2))) == math.inf


def test_covariance_transport_is_first_order_and_symmetric():
    rng = np.random.default_rng(3)
    jacobian, root = rng.normal(size=(2, 3)), rng.normal(size=(3, 3))
    moved = geo.transport_covariance(jacobian, root @ root.T)
    assert np.array_equal(moved, moved.T)
    samples = rng.normal(size=(200_000, 3)) @ root.T @ jacobian.T
    np.testing.assert_allclose(np.cov(samples.T), moved, rtol=0.05, atol=0.05)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (10.0, -20.0, 250.0), (-40.0, 60.0, 5.0)])
def test_the_covariance_of_angles_is_that_of_small_turns_about_the_body(angles):
    root = np.array([[2.0, 0.3, 0.1], [0.0, 1.0, -0.4], [0.0, 0.0, 0.5]]) * 1e-3
    turns = np.random.default_rng(3).normal(size=(4000, 3)) @ root.T
    turned = [attitude_from_rotation(enu_from_body(*angles) @ cv2.Rodrigues(turn)[0]) for turn in turns]
    off = (np.array(turned) - angles + 180.0) % 360.0 - 180.0
    covariance = geo.angle_covariance_deg2(root @ root.T, *angles[:2])
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), off.T)
    assert np.cov(whitened) == pytest.approx(np.eye(3), abs=0.08)
    turn = enu_from_body(*angles)
    about_enu = geo.enu_turn_covariance_rad2(covariance, angles)
    assert about_enu == pytest.approx(turn @ root @ root.T @ turn.T, rel=1e-9, abs=1e-15)
