"""The compiled loops of SIFT do what the tensor ops do."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from engine.features import sift
from engine.kernels import jit, sift_descriptors
from engine.sift import descriptors, keypoints, scale_space
from engine.threads import count, set_threads

CPU = torch.device("cpu")


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


@pytest.fixture(params=[(64, 80), (33, 121), (150, 149), (12, 12)], ids=str)
def shape(request):
    return request.param


@pytest.fixture(params=[1, 2], ids=["as it is", "doubled"])
def plan(shape, request):
    return scale_space.make_plan(*shape, 1, request.param, CPU)


def both(plan, contrast_threshold=0.02):
    """The picture's levels and points by either way."""
    image = picture(*plan.octaves[0].source)
    gaussians = scale_space.gaussian_levels(image, plan)
    buffer, points = keypoints.detect(image, plan, contrast_threshold)
    expected = keypoints.find_points(gaussians, plan, contrast_threshold)
    return (gaussians, expected.take(expected.valid.nonzero()[:, 0])), (buffer.clone(), points)


def test_levels_are_those_of_the_banded_matrices(plan):
    (expected, _), (got, _) = both(plan)
    for octave in plan.octaves:
        inner = np.s_[:, : octave.height, :, : octave.width]
        torch.testing.assert_close(octave.levels(got)[inner], octave.levels(expected)[inner], atol=2e-6, rtol=0)


def in_order(points: keypoints.Points) -> np.ndarray:
    columns = (points.octave, points.level, points.y, points.x, points.growth, points.contrast, points.pixel_px)
    table = torch.stack([c.double() for c in columns], dim=1).numpy()
    return table[np.lexsort(table[:, :4].round(2).T[::-1])]


def test_keypoints_are_those_of_the_tensor_ops(plan):
    """All but those that rounding moves across a threshold, of which there is at most one in a hundred."""
    (_, expected), (_, got) = both(plan)
    a, b = in_order(expected), in_order(got)
    near = [np.abs(b[:, :5] - row[:5]).max(axis=1).min(initial=np.inf) < 0.02 for row in a]
    assert len(a) - sum(near) <= 0.01 * len(a)
    assert abs(len(a) - len(b)) <= 0.01 * len(a)
    if min(plan.octaves[0].source) > 60:
        assert len(a) > 20


def test_angles_and_descriptors_are_those_of_the_tensor_ops(plan):
    (gaussians, points), _ = both(plan)
    expected = descriptors.angle_by_tensors(gaussians, points, plan)
    got = descriptors.dominant_angle(gaussians, points, plan)
    apart = ((got - expected + math.pi).remainder(math.tau) - math.pi).abs()
    assert (apart > 0.01).sum() <= 0.01 * len(apart)  # two peaks of one height
    cells = descriptors.cells_by_tensors(gaussians, points, expected, plan)
    torch.testing.assert_close(
        descriptors.describe(gaussians, points, expected, plan, root=True),
        descriptors.normalise(cells, root=True),
        atol=2e-4,
        rtol=0,
    )


def test_directions_are_the_arc_tangents():
    angle = np.linspace(0, 2 * np.pi, 4001)[:-1]
    got = [sift_descriptors._turn(np.float32(np.cos(a)), np.float32(np.sin(a))) for a in angle]
    error = np.abs((np.array(got) - angle / math.tau + 0.5) % 1 - 0.5)
    assert error.max() < 3e-6
    assert sift_descriptors._turn(np.float32(0), np.float32(0)) == 0


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
        torch.testing.assert_close(getattr(many, name), getattr(one, name), atol=1e-6, rtol=0)
        torch.testing.assert_close(getattr(batch_by_many, name), getattr(batch, name), atol=1e-6, rtol=0)


def test_without_a_folder_to_keep_it_the_code_is_compiled_anyway(monkeypatch):
    def njit(cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: function

    monkeypatch.setattr(jit, "njit", njit)
    monkeypatch.setattr(jit, "_loops", [])
    assert jit.compiled(len) is len
