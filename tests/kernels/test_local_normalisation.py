"""Local normalisation in one pass: the definition in float64, mirrored at the edges as OpenCV does."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.kernels import local_normalisation
from engine.kernels.scores import MAX_RADIUS_PX


def normalised(picture: np.ndarray, radius_px: int, noise_variance: float) -> np.ndarray:
    padded = cv2.copyMakeBorder(picture, *(radius_px,) * 4, cv2.BORDER_REFLECT_101)
    return local_normalisation.normalised(padded, radius_px, noise_variance)


def by_definition(picture: np.ndarray, radius_px: int, noise_variance: float) -> np.ndarray:
    """The same in float64 by OpenCV's box filter."""
    wide, box = picture.astype(np.float64), (2 * radius_px + 1,) * 2
    mean = cv2.boxFilter(wide, cv2.CV_64F, box, borderType=cv2.BORDER_REFLECT_101)
    square = cv2.boxFilter(wide * wide, cv2.CV_64F, box, borderType=cv2.BORDER_REFLECT_101)
    return (wide - mean) / np.sqrt(np.maximum(square - mean * mean, 0.0) + noise_variance)


@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    radius_px=st.integers(1, 12),
    seed=st.integers(0, 2**31),
    spread=st.integers(0, 255),
)
@settings(deadline=None, max_examples=60)
def test_it_is_the_definition(height, width, radius_px, seed, spread):
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 256 - spread)
    picture = rng.integers(low, low + spread + 1, (height, width)).astype(np.uint8)
    found = normalised(picture, radius_px, 4.0)
    assert (found.shape, found.dtype) == (picture.shape, np.float32)
    padded = np.pad(picture, radius_px, mode="reflect")  # as often as necessary, of one pixel too
    inner = by_definition(padded, radius_px, 4.0)[radius_px:-radius_px, radius_px:-radius_px]
    assert np.abs(found - inner).max() < 3e-4


@pytest.mark.parametrize("level", [0, 128, 255])
def test_flat_ground_is_exactly_0(level):
    assert not normalised(np.full((50, 60), level, np.uint8), 8, 4.0).any()


def test_the_largest_neighbourhood_does_not_overflow():
    picture = np.zeros((400, 400), np.uint8)
    picture[::2] = 255
    found = normalised(picture, MAX_RADIUS_PX, 4.0)
    assert np.abs(found - by_definition(picture, MAX_RADIUS_PX, 4.0)).max() < 1e-3
