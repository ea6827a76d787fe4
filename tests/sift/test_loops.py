"""The compiled loops of SIFT do what the paper says, written out in float64."""

import math

import cv2
import numpy as np
import pytest
import torch

from engine.features import sift
from engine.runtime import jit
from engine.runtime.threads import count, set_threads
from engine.sift import loops
from engine.sift.scale_space import FIRST_SIGMA_PX, octaves_of
from tests.support import sift_reference as reference
from tests.support.tensors import assert_close


def picture(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Blobs of all sizes, an edge, a flat part and some noise, (1, H, W) in [0, 1]."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 0.5, np.float32)
    for sigma in (1.0, 2.5, 6.0):
        noise = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), sigma)
        image += 0.12 * noise / noise.std()
    image[:, width // 2 :] += 0.2
    image[: height // 4] = 0.4
    image += rng.normal(0, 0.01, image.shape).astype(np.float32)
    return torch.from_numpy(image.clip(0, 1))[None]


SIZES = ((64, 80), (33, 121), (150, 149), (3, 60))


@pytest.fixture(scope="module", params=[(*size, upsample) for size in SIZES for upsample in (1, 2)], ids=str)
def octaves(request):
    return octaves_of(*request.param)


def shaped(buffer, octaves):
    """The levels (L, H, W) of each octave in the flat buffer."""
    return [buffer[o.offset : o.end].reshape(-1, o.height, o.width) for o in octaves]


@pytest.fixture(scope="module")
def both(octaves):
    """The picture's levels and keypoints by the reference, and by the loops."""
    image, contrast_threshold = picture(*octaves[0].source)[0].numpy(), 0.02
    levels = reference.levels_of(image, octaves)
    buffer, rows = loops.detect(image, octaves, contrast_threshold)
    return levels, reference.keypoints_of(levels, contrast_threshold), buffer.copy(), rows


def test_levels_are_those_of_the_equation(octaves, both):
    expected, _, buffer, _ = both
    for wanted, got in zip(expected, shaped(buffer, octaves), strict=True):
        np.testing.assert_allclose(got, wanted, atol=2e-6)


def test_keypoints_are_those_of_the_reference(octaves, both):
    """All but those that rounding moves across a threshold, of which there is at most one in a hundred."""
    _, expected, _, got = both
    near = [np.abs(got - row).max(axis=1).min(initial=np.inf) < 0.02 for row in expected]
    assert len(expected) - sum(near) <= 0.01 * len(expected)
    assert abs(len(expected) - len(got)) <= 0.01 * len(expected)
    if min(octaves[0].source) > 60:
        assert len(expected) > 20


@pytest.mark.parametrize("spread", [1, 3, 6])
@pytest.mark.parametrize("most", [7, 60, 5000])
def test_the_strongest_are_those_of_the_reference(octaves, both, spread, most):
    rows = both[3]
    mask = np.random.default_rng(3).random(octaves[0].source) > 0.3
    kept = reference.strongest(rows, mask, octaves[0].up, most, spread)
    np.testing.assert_array_equal(loops.strongest(rows, octaves, mask, most, spread), rows[kept])


@pytest.mark.parametrize("turn_rad", [None, 0.0], ids=["turned", "upright"])
def test_angles_and_descriptors_are_those_of_the_reference(octaves, both, turn_rad):
    _, _, buffer, rows = both
    rows, levels, sigma = rows[:20], shaped(buffer.astype(np.float64), octaves), FIRST_SIGMA_PX * octaves[0].up
    pictures = [levels[int(row[5])][int(row[4])] for row in rows]
    expected = np.array([reference.angle_of(p, row, sigma) for p, row in zip(pictures, rows, strict=True)])
    turns, got = loops.describe(buffer, rows, turn_rad, octaves)
    apart = np.abs((turns - (expected if turn_rad is None else turn_rad) + math.pi) % math.tau - math.pi)
    assert (apart > 0.01).sum() <= 0.05 * len(apart)  # two peaks of one height
    each = zip(pictures, rows, turns, strict=True)
    described = [reference.descriptor_of(picture, row, sigma, turn) for picture, row, turn in each]
    np.testing.assert_allclose(got, np.array(described).reshape(-1, 128), atol=3e-4)


def test_more_threads_give_the_same():
    image = picture(260, 420)[None]
    before = count()
    try:
        set_threads(1)
        one, batch = sift(image), sift(image.expand(3, -1, -1, -1))
        set_threads(4)
        many, batch_by_many = sift(image), sift(image.expand(3, -1, -1, -1))
    finally:
        set_threads(before)
    for name in ("xy_px", "scale_px", "angle_deg", "descriptors", "valid"):
        assert_close(getattr(many, name), getattr(one, name), atol=1e-6, rtol=0)
        assert_close(getattr(batch_by_many, name), getattr(batch, name), atol=1e-6, rtol=0)


def test_without_a_folder_to_keep_it_the_code_is_compiled_anyway(monkeypatch):
    def njit(cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: function

    monkeypatch.setattr(jit, "njit", njit)
    assert jit.compiled()(len) is len
