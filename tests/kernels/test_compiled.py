"""The compiled loops of SIFT do what the tensor ops do."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from engine.features import sift
from engine.kernels import sift_descriptors
from engine.runtime import jit
from engine.runtime.threads import count, set_threads
from engine.sift import descriptors, keypoints, loops, scale_space

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
    """The picture's levels and keypoints by the tensor ops, and by the loops with their plan."""
    image = picture(*plan.octaves[0].source)
    gaussians = scale_space.gaussian_levels(image, plan)
    points = keypoints.find_points(gaussians, plan, contrast_threshold)
    by_loops = loops.plan_loops(*image.shape[1:], plan.upsample)
    levels, rows = loops.detect(image[0].numpy(), by_loops, contrast_threshold)
    return (gaussians, points.take(points.valid.nonzero()[:, 0])), (levels.copy(), rows, by_loops)


def as_rows(points: keypoints.Points) -> np.ndarray:
    """Keypoints (K, 6) as the loops have them."""
    columns = (points.x, points.y, points.growth, points.contrast, points.level, points.octave)
    return torch.stack([column.float() for column in columns], dim=1).numpy()


def test_levels_are_those_of_the_banded_matrices(plan):
    (expected, _), (got, _, _) = both(plan)
    for octave in plan.octaves:
        inner = np.s_[:, : octave.height, :, : octave.width]
        levels = octave.levels(torch.from_numpy(got))
        torch.testing.assert_close(levels[inner], octave.levels(expected)[inner], atol=2e-6, rtol=0)


def test_keypoints_are_those_of_the_tensor_ops(plan):
    """All but those that rounding moves across a threshold, of which there is at most one in a hundred."""
    (_, points), (_, got, _) = both(plan)
    expected = as_rows(points)
    near = [np.abs(got - row).max(axis=1).min(initial=np.inf) < 0.02 for row in expected]
    assert len(expected) - sum(near) <= 0.01 * len(expected)
    assert abs(len(expected) - len(got)) <= 0.01 * len(expected)
    if min(plan.octaves[0].source) > 60:
        assert len(expected) > 20


@pytest.mark.parametrize("spread", [1, 3, 6])
@pytest.mark.parametrize("most", [7, 60, 5000])
def test_the_strongest_are_those_of_the_tensor_ops(plan, spread, most):
    (_, points), (_, _, by_loops) = both(plan)
    height, width = plan.octaves[0].source
    mask = np.random.default_rng(3).random((height, width)) > 0.3
    allowed = points.within(torch.from_numpy(mask)[None, None])
    index, filled = keypoints.strongest(allowed, plan, 1, most, spread)
    expected = as_rows(points.take(index[filled]))
    got = loops.strongest(as_rows(points), by_loops, mask, most, spread)
    np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("root", [True, False])
@pytest.mark.parametrize("turn_rad", [None, 0.0], ids=["turned", "upright"])
def test_angles_and_descriptors_are_those_of_the_tensor_ops(plan, turn_rad, root):
    (gaussians, points), (_, _, by_loops) = both(plan)
    levels, rows = gaussians.numpy(), as_rows(points)
    expected = descriptors.dominant_angle(gaussians, points, plan)
    apart = (
        (torch.from_numpy(loops.dominant_angle(levels, rows, by_loops)) - expected + math.pi) % math.tau
    ).abs()
    assert ((apart - math.pi).abs() > 0.01).sum() <= 0.01 * len(apart)  # two peaks of one height
    angle = expected if turn_rad is None else torch.full_like(expected, turn_rad)
    torch.testing.assert_close(
        torch.from_numpy(loops.describe(levels, rows, angle.numpy(), by_loops, root=root)),
        descriptors.describe(gaussians, points, angle, plan, root=root),
        atol=2e-4,
        rtol=0,
    )


def test_a_filter_at_the_edge_has_the_weight_of_one_inside():
    """A picture of one grey level keeps it, at every level, also where it is a few pixels wide."""
    for inputs in (3, 12, 40):
        for upsample in (1, 2):
            plan = loops.plan_loops(inputs, 60, upsample)
            levels, _ = loops.detect(np.full((inputs, 60), 0.7, np.float32), plan, 0.02)
            for octave, _, _ in plan.octaves:
                inner = octave.levels(torch.from_numpy(levels))[:, : octave.height, :, : octave.width]
                torch.testing.assert_close(inner, torch.full_like(inner, 0.7), atol=2e-6, rtol=0)


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
    assert jit.compiled()(len) is len
