"""Gauss-Newton's loop by NumPy's and OpenCV's own: rotations, the normal equations, their solution, the sums."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from engine.kernels.gauss_newton import by_parameters, information, normal_equations
from engine.kernels.small_matrices import solve, turn, turn_between

ANGLES = st.floats(-1.5, 1.5)


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


def test_derivatives_are_those_of_the_definition(samples):
    shown, _, points, offset_m, rotation, *_ = samples
    row = np.empty(8)
    for n, right in enumerate(rows(shown, points, offset_m, rotation)[:50]):
        by_parameters(row, *shown[:, n], points, offset_m, rotation, n)
        np.testing.assert_allclose(row, right, atol=1e-12)


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
        shown, expected, points, offset_m, rotation, weights, differences, cells, 64
    )
    for found, a, b in ((own, one, one), (common, one, two), (of_map, two, two)):
        right = (a.T * weights) @ b
        np.testing.assert_allclose(found, 0.5 * (right + right.T), rtol=1e-10, atol=1e-9)
    scores = 0.5 * (one + two) * (weights * differences)[:, None]
    right = np.array([np.bincount(cells, score, 64) for score in scores.T])
    np.testing.assert_allclose(by_cell, right, rtol=1e-10, atol=1e-10)


def turned(rotation, vector):
    out = np.empty((3, 3))
    turn(rotation, np.array(vector), out)
    return out


def between(rotation, other):
    out = np.empty(3)
    turn_between(rotation, other, out)
    return out


@given(vector=st.tuples(ANGLES, ANGLES, ANGLES), other=st.tuples(ANGLES, ANGLES, ANGLES))
def test_rotations_are_those_of_opencv(vector, other):
    rotation = cv2.Rodrigues(np.array(other))[0]
    np.testing.assert_allclose(turned(rotation, vector), cv2.Rodrigues(np.array(vector))[0] @ rotation, atol=1e-9)


@given(axis=st.tuples(ANGLES, ANGLES, ANGLES), angle=st.floats(0.0, math.pi - 1e-6))
def test_rotation_vectors_are_those_of_the_rotation_up_to_half_a_turn(axis, angle):
    axis = np.array(axis)
    assume(np.linalg.norm(axis) > 1e-3)
    vector = axis / np.linalg.norm(axis) * angle
    np.testing.assert_allclose(between(cv2.Rodrigues(vector)[0], np.eye(3)), vector, atol=1e-7)


@given(vector=st.tuples(ANGLES, ANGLES, ANGLES), other=st.tuples(ANGLES, ANGLES, ANGLES))
def test_turning_by_the_difference_leads_from_one_rotation_to_the_other(vector, other):
    first, second = (cv2.Rodrigues(np.array(v))[0] for v in (vector, other))
    np.testing.assert_allclose(turned(second, between(first, second)), first, atol=1e-7)


@given(seed=st.integers(0, 10_000))
def test_solving_is_that_of_numpy(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(8, 8))
    matrix, right, out = root @ root.T + 1e-3 * np.eye(8), rng.normal(size=8), np.empty(8)
    assert solve(matrix.copy(), right, out)
    np.testing.assert_allclose(out, np.linalg.solve(matrix, right), rtol=1e-6, atol=1e-6)


def test_a_matrix_that_is_not_positive_definite_is_not_solved():
    assert not solve(np.diag([1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0]), np.ones(8), np.empty(8))
    assert not solve(np.zeros((8, 8)), np.ones(8), np.empty(8))
    assert not solve(np.full((8, 8), np.nan), np.ones(8), np.empty(8))
