"""The loops of dense refinement and of the plane under a surface, by OpenCV and NumPy."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.kernels.gauss_newton import EXCESS, information, normal_equations
from engine.kernels.lower_plane import lower_plane
from engine.kernels.small_matrices import turn_between


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


# The normal equations and the sums for the covariance


def rows(by_points, points, offset_m, rotation):
    """(N, 8) by the definition: -R^T g, X x g, and the slope's share of the height."""
    by_place = -(rotation.T @ by_points).T
    turned = np.cross(points.T, by_points.T)
    return np.column_stack([by_place, turned, -by_place[:, 2:] * offset_m[:2].T])


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
    own, common, of_map, by_cell = information(
        shown, expected, points, offset_m, rotation, weights, differences, cells
    )
    for found, a, b in ((own, one, one), (common, one, two), (of_map, two, two)):
        right = (a.T * weights) @ b
        np.testing.assert_allclose(found, 0.5 * (right + right.T), rtol=1e-10, atol=1e-9)
    scores = 0.5 * (one + two) * (weights * differences)[:, None]
    right = np.array([np.bincount(cells, score, 64) for score in scores.T])
    np.testing.assert_allclose(by_cell, right, rtol=1e-10, atol=1e-10)


@given(seed=st.integers(0, 10_000), angle=st.floats(0.0, math.pi - 1e-6) | st.floats(2.7, math.pi - 1e-6))
def test_the_vector_between_two_rotations_is_that_of_their_difference_up_to_half_a_turn(seed, angle):
    axis, other = np.random.default_rng(seed).normal(size=(2, 3))
    vector = axis / np.linalg.norm(axis) * angle
    second, found = cv2.Rodrigues(other)[0], np.empty(3)
    turn_between(cv2.Rodrigues(vector)[0] @ second, second, found)
    np.testing.assert_allclose(found, vector, atol=1e-7)
