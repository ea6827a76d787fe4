"""The compiled pose fit: derivatives by differences, OpenCV's projection, and poses that are found again."""

import cv2
import numpy as np
import pytest

from engine.kernels.pose_fit import normal_equations, reproject

MATRIX = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
CENTER = np.array([3.0, -4.0, 120.0])
ROTATION = cv2.Rodrigues(np.array([np.pi - 0.05, 0.03, 0.02]))[0]  # looks down


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(1).uniform([-40, -40, 0], [40, 40, 15], (60, 3)).T.copy()


def pixels_of(points, rotation, center):
    rotvec, shift = cv2.Rodrigues(rotation)[0], -rotation @ center
    return cv2.projectPoints(points.T.copy(), rotvec, shift, MATRIX, None)[0][:, 0].T.copy()


def test_pixels_are_those_of_opencv_and_points_behind_are_far_off(points):
    pixels = pixels_of(points, ROTATION, CENTER)
    _, projected, squared = reproject(points, pixels + 2.0, MATRIX, ROTATION, CENTER)
    np.testing.assert_allclose(projected, pixels, atol=1e-9)
    np.testing.assert_allclose(squared, 8.0, atol=1e-9)
    behind = reproject(points + np.array([[0.0], [0.0], [500.0]]), pixels, MATRIX, ROTATION, CENTER)
    assert (behind[2] > 1e12).all()
    assert all(np.isfinite(values).all() for values in behind)


def test_normal_equations_are_those_of_finite_differences(points):
    rng = np.random.default_rng(2)
    pixels = pixels_of(points, ROTATION, CENTER) + rng.normal(0, 2.0, (2, points.shape[1]))
    weights, reach, variance = rng.uniform(0.5, 2.0, points.shape[1]), 12.0, 1.7
    view = reproject(points, pixels, MATRIX, ROTATION, CENTER)
    normal, gradient = normal_equations(*view, pixels, MATRIX, weights, reach, variance)

    def projected(step):
        rotation = cv2.Rodrigues(step[3:])[0] @ ROTATION
        return reproject(points, pixels, MATRIX, rotation, CENTER + ROTATION.T @ step[:3])[1].ravel()

    steps = 1e-5 * np.eye(6)
    jacobian = np.stack([(projected(s) - projected(-s)) / 2e-5 for s in steps], axis=1)
    agreement = np.maximum(1.0 - view[2] / reach, 0.0) ** 2
    weighted = np.tile(weights * agreement / variance, 2)
    assert 0 < np.count_nonzero(agreement) < len(agreement)
    np.testing.assert_allclose(normal, (jacobian.T * weighted) @ jacobian, rtol=1e-5, atol=1e-3)
    expected = jacobian.T @ (weighted * (pixels - view[1]).ravel())
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-4)
