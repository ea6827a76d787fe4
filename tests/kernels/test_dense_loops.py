"""The loops of dense refinement and of the plane under a surface, by OpenCV, NumPy and difference quotients."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.kernels import dense_loops
from engine.kernels.dense_loops import CELLS, EDGE_PX, median
from engine.kernels.gauss_newton import EXCESS, information, normal_equations
from engine.kernels.lower_plane import lower_plane
from engine.kernels.small_matrices import solve, turn_between

SIDE_PX, HEIGHT_M = 120, 80.0
MATRIX = np.array([[130.0, 0.0, 59.5], [0.0, 128.0, 58.0], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def scene():
    """A smooth picture, samples below the camera and a little beyond its view, and a tilted pose."""
    rng = np.random.default_rng(5)
    picture = cv2.GaussianBlur(rng.normal(0, 40, (SIDE_PX, SIDE_PX)), (0, 0), 4.0).astype(np.float32)
    offset_m = np.vstack([rng.uniform(-45, 45, (2, 500)), rng.uniform(-3, 9, (1, 500))])
    rotation = cv2.Rodrigues(np.array([0.04, -0.03, 0.7]))[0] @ np.diag([1.0, -1.0, -1.0])
    return picture, offset_m, rotation, np.array([3.0, -2.0, HEIGHT_M]), np.array([0.02, -0.01])


def look(scene, *, center_m=None, rotation=None, slope=None, gradients=None):
    picture, offset_m, turned, center, leaning = scene
    count = offset_m.shape[1]
    return dense_loops.project(
        picture, MATRIX, turned if rotation is None else rotation, center if center_m is None else center_m,
        leaning if slope is None else slope, offset_m, np.zeros(3),
        np.zeros((count, 2)) if gradients is None else gradients, np.ones(count),
    )  # fmt: skip


def test_samples_are_seen_where_opencv_projects_them(scene):
    picture, offset_m, rotation, center_m, slope = scene
    levels, places, _, _, weights, cell, count = look(scene)
    points = offset_m.copy()
    points[2] += slope @ offset_m[:2]
    vector = cv2.Rodrigues(rotation)[0]
    at = cv2.projectPoints(points.T, vector, -rotation @ center_m, MATRIX, np.zeros(4))[0][:, 0]
    inside = ((at > EDGE_PX) & (at < SIDE_PX - 1 - EDGE_PX)).all(axis=1)
    assert 0 < count == inside.sum() < len(inside)
    np.testing.assert_array_equal(weights, inside)
    np.testing.assert_allclose(places, rotation @ (points - center_m[:, None]), atol=1e-9)
    for (u, v), level, number in zip(at[inside], levels[inside], cell[inside], strict=True):
        x, y = int(u), int(v)
        block = picture[y : y + 2, x : x + 2].astype(float)
        assert level == pytest.approx(np.array([1 - v + y, v - y]) @ block @ [1 - u + x, u - x], abs=1e-6)
        assert number == int(v / (SIDE_PX - 3) * CELLS) * CELLS + int(u / (SIDE_PX - 3) * CELLS)


def rows(by_points, points, offset_m, rotation):
    """(N, 8) by the definition: -R^T g, X x g, and the slope's share of the height."""
    by_place = -(rotation.T @ by_points).T
    turned = np.cross(points.T, by_points.T)
    return np.column_stack([by_place, turned, -by_place[:, 2:] * offset_m[:2].T])


@pytest.mark.parametrize("parameter", range(8))
def test_derivatives_foretell_what_a_moved_pose_sees(scene, parameter):
    """Central differences of the picture are its slope up to its curvature, so a small share may be missed."""
    _, offset_m, rotation, center_m, slope = scene
    _, places, shown, _, weights, _, _ = look(scene)
    foretold = rows(shown, places, offset_m, rotation)[:, parameter]
    step = 1e-3 * np.eye(8)[parameter] / (1.0 if parameter < 3 else HEIGHT_M)
    seen = []
    for moved in (-step, step):
        turned = cv2.Rodrigues(moved[3:6])[0] @ rotation
        seen.append(look(scene, center_m=center_m + moved[:3], rotation=turned, slope=slope + moved[6:]))
    both = (weights > 0) & (seen[0][4] > 0) & (seen[1][4] > 0)
    measured = (seen[1][0] - seen[0][0])[both] / (2.0 * step[parameter])
    error = np.linalg.norm(measured - foretold[both]) / np.linalg.norm(foretold[both])
    assert error < 0.15


def test_the_maps_gradients_let_expect_what_a_picture_of_the_map_shows(scene):
    """Where the camera's place on flat ground moves, level ground of a known gradient shows by how much."""
    _, offset_m, rotation, _, _ = scene
    gradients = np.random.default_rng(6).normal(0, 2, (offset_m.shape[1], 2))
    _, places, _, expected, weights, _, _ = look(scene, gradients=gradients, slope=np.zeros(2))
    moved = rows(expected, places, offset_m, rotation)
    seen = weights > 0
    np.testing.assert_allclose(moved[seen, :2], -gradients[seen], atol=1e-9)
    away = rotation.T @ places  # along its own ray a sample stays where it is in the picture
    np.testing.assert_allclose((expected * (rotation @ away))[:, seen].sum(axis=0), 0.0, atol=1e-9)


def test_comparing_is_a_robust_regression_of_the_picture_on_the_map():
    rng = np.random.default_rng(7)
    values, weights = rng.normal(0, 1, 900), rng.uniform(0, 1, 900) * (rng.random(900) < 0.8)
    levels = 3.0 * values - 7.0 + rng.normal(0, 0.1, 900)
    wrong = rng.random(900) < 0.05
    levels[wrong] += rng.uniform(30, 60, wrong.sum())
    differences, robust, correlation, gain = dense_loops.compare_levels(levels, values, weights)
    assert gain == pytest.approx(3.0, abs=0.15)
    assert not robust[wrong].any()
    assert robust[~wrong].sum() > 0.8 * weights[~wrong].sum()
    assert np.average(differences, weights=robust + 1e-30) == pytest.approx(0.0, abs=0.2)
    covariance = np.cov(levels, values, aweights=weights, ddof=0)
    assert correlation == pytest.approx(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
    exact = dense_loops.compare_levels(3.0 * values - 7.0, values, weights)
    assert exact[2:4] == pytest.approx((1.0, 3.0))
    assert np.abs(exact[0]).max() < 1e-9


@pytest.mark.parametrize("share", [0.2, 0.5, 0.7])
def test_a_share_of_the_heights_is_below_their_plane(share):
    rng = np.random.default_rng(8)
    offsets = rng.uniform(-1, 1, (225, 2))
    heights_m = 100.0 + offsets @ [2.0, -5.0] + rng.exponential(6.0, 225)
    plane, known = lower_plane(offsets, heights_m, share, 0.01, 60)
    assert known == len(heights_m)
    above = heights_m - plane[0] - offsets @ plane[1:]
    assert np.mean(above < 0) == pytest.approx(share, abs=0.01)

    def loss(terms):
        off = heights_m - terms[0] - offsets @ terms[1:]
        return np.where(off > 0, share, share - 1.0) @ off

    # No other plane nearby has a smaller loss by more than lying on it allows: Koenker and Bassett's minimum.
    others = plane + rng.normal(0, 0.5, (300, 3))
    assert loss(plane) < min(map(loss, others)) + 0.01 * loss(plane)


@given(values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60))
def test_the_median_is_numpys(values):
    assert median(np.array(values)) == pytest.approx(np.median(values), abs=1e-9)


def test_the_median_of_equal_values_and_of_none():
    assert median(np.full(1000, 3.0)) == 3.0
    assert np.isnan(median(np.zeros(0)))


# The normal equations, their solution, and rotations


@pytest.fixture(scope="module")
def samples():
    """Derivatives by picture and map, points, offsets, a rotation, weights, differences and cells."""
    rng = np.random.default_rng(3)
    shown, expected, points, offset_m = (rng.normal(size=(3, 400)) for _ in range(4))
    weights = rng.uniform(0, 1, 400) * (rng.random(400) < 0.8)
    rotation = cv2.Rodrigues(np.array([0.1, -0.2, 0.9]))[0]
    return shown, expected, points, offset_m, rotation, weights, rng.normal(size=400), rng.integers(0, 64, 400)


def test_normal_equations_are_those_of_the_weighted_least_squares(samples):
    shown, expected, points, offset_m, rotation, weights, differences, _ = samples
    jacobian = rows(0.5 * (shown + expected), points, offset_m, rotation)
    scale = 1.0 / (EXCESS * np.average(differences**2, weights=weights))
    normal, score = normal_equations(shown, expected, points, offset_m, rotation, weights, differences)
    np.testing.assert_allclose(normal, scale * (jacobian.T * weights) @ jacobian, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(score, -scale * jacobian.T @ (weights * differences), rtol=1e-10, atol=1e-10)


def test_sums_for_the_covariance_are_those_of_the_definition(samples):
    shown, expected, points, offset_m, rotation, weights, differences, cells = samples
    one, two = (rows(g, points, offset_m, rotation) for g in (shown, expected))
    own, common, of_map, by_cell = information(*samples)
    for found, a, b in ((own, one, one), (common, one, two), (of_map, two, two)):
        right = (a.T * weights) @ b
        np.testing.assert_allclose(found, 0.5 * (right + right.T), rtol=1e-10, atol=1e-9)
    scores = 0.5 * (one + two) * (weights * differences)[:, None]
    right = np.array([np.bincount(cells, score, 64) for score in scores.T])
    np.testing.assert_allclose(by_cell, right, rtol=1e-10, atol=1e-10)


@given(seed=st.integers(0, 10_000), angle=st.floats(0.0, np.pi - 1e-6) | st.floats(2.7, np.pi - 1e-6))
def test_the_vector_between_two_rotations_is_that_of_their_difference_up_to_half_a_turn(seed, angle):
    axis, other = np.random.default_rng(seed).normal(size=(2, 3))
    vector = axis / np.linalg.norm(axis) * angle
    second, found = cv2.Rodrigues(other)[0], np.empty(3)
    turn_between(cv2.Rodrigues(vector)[0] @ second, second, found)
    np.testing.assert_allclose(found, vector, atol=1e-7)


@pytest.mark.parametrize("last", [-1.0, 0.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_is_not_solved(last):
    assert not solve(np.diag([*np.ones(7), last]), np.ones(8), np.empty(8))
