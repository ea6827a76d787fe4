"""Polynomials and bilinear heights by NumPy's and OpenCV's own."""

import cv2
import numpy as np
from numpy.polynomial.polynomial import polyval2d

from engine.kernels.map_points import bilinear_heights, polynomials

CENTRE, HALF = np.array([300.0, -200.0]), np.array([50.0, 20.0])


def test_polynomials_are_those_of_numpy():
    rng = np.random.default_rng(1)
    coefficients, unit = rng.normal(size=(6, 6, 2)), rng.uniform(-1, 1, (100, 2))
    out = np.empty((100, 2))
    assert polynomials(CENTRE + HALF * unit, CENTRE, HALF, coefficients, out)
    for k in (0, 1):
        np.testing.assert_allclose(out[:, k], polyval2d(*unit.T, coefficients[..., k]), atol=1e-12)


def test_points_outside_the_box_are_not_evaluated():
    out = np.empty((2, 2))
    for far in ((351.0, -200.0), (300.0, -221.0), (np.nan, 0.0), (np.inf, 0.0)):
        assert not polynomials(np.stack([CENTRE, far]), CENTRE, HALF, np.ones((6, 6, 2)), out)
    assert polynomials(np.stack([CENTRE + HALF, CENTRE - HALF]), CENTRE, HALF, np.ones((6, 6, 2)), out)


def test_heights_inside_are_those_of_opencv():
    rng = np.random.default_rng(2)
    grid, out = rng.normal(size=(20, 30)).astype(np.float32), np.empty(500)
    at = np.round(rng.uniform(0, [29, 19], (500, 2)) * 32) / 32  # OpenCV's remap knows 32 places within a pixel
    bilinear_heights(grid, at, out)
    mapped = cv2.remap(grid, at.astype(np.float32)[None], None, cv2.INTER_LINEAR)[0]
    np.testing.assert_allclose(out, mapped, atol=1e-5)


def test_heights_are_unknown_outside_and_next_to_nodata():
    grid = np.arange(12.0, dtype=np.float32).reshape(3, 4)
    grid[1, 1] = np.nan
    at = np.array([[-0.6, 2.0], [-0.5, 2.0], [3.5, 2.5], [3.6, 2.0], [0.5, 0.5], [2.5, 1.5], [np.nan, 0.0]])
    out = np.empty(len(at))
    bilinear_heights(grid, at, out)
    np.testing.assert_array_equal(out, [np.nan, 8.0, 11.0, np.nan, np.nan, 8.5, np.nan])
