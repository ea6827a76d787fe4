"""Gauss-Newton's loop by NumPy's and OpenCV's own: rotations, the normal equations, their solution, the sums."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.kernels.gauss_newton import information, normal_equations
from engine.kernels.small_matrices import solve, turn, turn_between

ANGLES = st.floats(-1.5, 1.5)
VECTORS = st.tuples(ANGLES, ANGLES, ANGLES)


@pytest.fixture(scope="module")
def samples():
    """Derivatives by picture and map, points, offsets, a rotation, weights, differences and cells."""
    rng = np.random.default_rng(3)
    shown, expected, points, offset_m = (rng.normal(size=(3, 400)) for _ in range(4))
    weights = rng.uniform(0, 1, 400) * (rng.random(400) < 0.8)
    rotation = cv2.Rodrigues(np.array([0.1, -0.2, 0.9]))[0]
    return shown, expected, points, offset_m, rotation, weights, rng.normal(size=400), rng.integers(0, 64, 400)


def rows(by_points, points, offset_m, rotation):
    """(N, 8) by the definition: -R^T g, X x g, and the slope's share of the height."""
    by_place = -(rotation.T @ by_points).T
    turned = np.cross(points.T, by_points.T)
    return np.column_stack([by_place, turned, -by_place[:, 2:] * offset_m[:2].T])


def test_normal_equations_are_those_of_the_weighted_least_squares(samples):
    shown, expected, points, offset_m, rotation, weights, differences, _ = samples
    jacobian = rows(0.5 * (shown + expected), points, offset_m, rotation)
    scale = 1.0 / (1.6 * np.average(differences**2, weights=weights))
    normal, score = normal_equations(shown, expected, points, offset_m, rotation, weights, differences, 1.6)
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


@given(vector=VECTORS, other=VECTORS)
def test_rotations_are_those_of_opencv(vector, other):
    rotation, found = cv2.Rodrigues(np.array(other))[0], np.empty((3, 3))
    turn(rotation, np.array(vector), found)
    np.testing.assert_allclose(found, cv2.Rodrigues(np.array(vector))[0] @ rotation, atol=1e-9)


@given(seed=st.integers(0, 10_000), angle=st.floats(0.0, math.pi - 1e-6) | st.floats(2.7, math.pi - 1e-6))
def test_the_vector_between_two_rotations_is_that_of_their_difference_up_to_half_a_turn(seed, angle):
    axis, other = np.random.default_rng(seed).normal(size=(2, 3))
    vector = axis / np.linalg.norm(axis) * angle
    second, found = cv2.Rodrigues(other)[0], np.empty(3)
    turn_between(cv2.Rodrigues(vector)[0] @ second, second, found)
    np.testing.assert_allclose(found, vector, atol=1e-7)


@given(seed=st.integers(0, 10_000))
def test_solving_is_that_of_numpy(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(8, 8))
    matrix, right, out = root @ root.T + 1e-3 * np.eye(8), rng.normal(size=8), np.empty(8)
    assert solve(matrix.copy(), right, out)
    np.testing.assert_allclose(out, np.linalg.solve(matrix, right), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("last", [-1.0, 0.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_is_not_solved(last):
    assert not solve(np.diag([*np.ones(7), last]), np.ones(8), np.empty(8))
