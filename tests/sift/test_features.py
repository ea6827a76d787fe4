"""Truths about the features: where a blob lies, what a rotation does, what OpenCV and kornia find."""

import math

import cv2
import numpy as np
import pytest
import torch

from bench.accuracy.quality import ViewPair, judge, mean
from bench.inputs.views import by_homography
from bench.speed.detectors import detectors
from engine.errors import DtypeError, OptionError, ShapeError
from engine.features import Features, chosen_backend, match, sift
from tests.support.matches import pairs_of
from tests.support.tensors import assert_close

NAMES = {"compiled": "scenematch", "kornia": "kornia SIFT"}  # among the detectors of the benchmarks


@pytest.fixture(params=["compiled", "kornia"])
def backend(request):
    return request.param


def texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Rectangles over smooth noise, uint8: corners, edges and blobs of many sizes."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width), np.float32)
    for sigma in (1.5, 4.0, 10.0):
        noise = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), sigma)
        image += noise / (noise.std() + 1e-6) * 12
    for _ in range(height * width // 900):
        x, y = rng.integers(0, (width, height))
        w, h = rng.integers(4, 24, 2)
        image[y : y + h, x : x + w] += rng.uniform(-70, 70)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.7) + 128, 0, 255).astype(np.uint8)


def tensor(*images: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.stack(images))[:, None].float() / 255


def blob(x: float, y: float, sigma: float, size: int = 64) -> torch.Tensor:
    v, u = np.mgrid[:size, :size]
    values = 0.2 + 0.6 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2))
    return torch.from_numpy(values)[None, None]


def valid_xy(features: Features) -> np.ndarray:
    return features.xy_px[0, features.valid[0]].numpy()


# Where and how large.


@pytest.mark.parametrize(("upsample", "tolerance_px"), [(1.0, 0.35), (2.0, 0.05)])
@pytest.mark.parametrize("sigma", [2.3, 3.1, 4.6])
@pytest.mark.parametrize("centre", [(31.0, 31.0), (30.25, 33.5), (32.7, 29.1), (31.5, 31.75)])
def test_a_blob_lies_at_its_centre_and_has_its_scale(upsample, tolerance_px, sigma, centre, backend):
    if backend == "kornia":  # it asks for a strict maximum, and a blob midway between two samples has two alike
        centre = (centre[0] + 0.2, centre[1] - 0.2)
    found = sift(blob(*centre, sigma), upsample=upsample, backend=backend)
    best = 0  # slots are ordered by contrast
    assert found.valid[0, best]
    assert np.abs(found.xy_px[0, best].numpy() - centre).max() < tolerance_px
    scene = math.sqrt(sigma**2 - 0.5**2)  # the camera's blur is taken out
    assert found.scale_px[0, best] == pytest.approx(scene / math.sqrt(2 ** (1 / 3)), rel=0.05)


def test_positions_have_no_bias(backend):
    centres = np.random.default_rng(5).uniform(28, 36, (60, 2))
    images = torch.cat([blob(x, y, 3.0) for x, y in centres])
    errors = sift(images, max_keypoints=1, backend=backend).xy_px[:, 0].numpy() - centres
    assert np.abs(errors.mean(0)).max() < 0.004  # OpenCV's is 0.25


def test_a_quarter_turn_of_the_image_turns_the_features(backend):
    size = 129
    image = tensor(texture(size, size, 3))
    plain = sift(image, spread=1, backend=backend)
    turned = sift(torch.rot90(image, 1, (2, 3)), spread=1, backend=backend)  # (x, y) goes to (y, size - 1 - x)
    assert plain.valid.sum() > 60
    xy = plain.xy_px[0]
    expected = torch.stack([xy[:, 1], size - 1 - xy[:, 0]], 1)[plain.valid[0]]
    distance, nearest = torch.cdist(expected, turned.xy_px[0]).min(1)
    same = distance < 0.05
    assert same.float().mean() > {"compiled": 0.97, "kornia": 0.95}[backend]  # whose octaves end at even sizes
    turn = turned.angle_deg[0, nearest] - plain.angle_deg[0, plain.valid[0]] + 90
    assert ((turn + 180).remainder(360) - 180)[same].abs().quantile(0.9) < 2
    cosine = (turned.descriptors[0, nearest] * plain.descriptors[0, plain.valid[0]]).sum(1)
    assert cosine[same].median() > 0.999


def test_the_angle_turns_from_x_towards_y(backend):
    v, u = np.mgrid[:64, :64]
    direction = math.radians(40)
    ramp = 0.02 * ((u - 32) * math.cos(direction) + (v - 32) * math.sin(direction))
    found = sift(blob(32, 32, 3) * 0.3 + torch.from_numpy(ramp), max_keypoints=1, backend=backend)
    assert found.angle_deg[0, 0] == pytest.approx(40, abs=5)
    assert sift(blob(32, 32, 3), upright=True, backend=backend).angle_deg.abs().max() == 0
    turned = sift(blob(32, 32, 3), upright=True, up_deg=-30.0, max_keypoints=1, backend=backend)
    assert turned.angle_deg[0, 0] == pytest.approx(330.0, abs=1e-3)


# What is kept.


@pytest.mark.parametrize(
    ("shape", "upright"),
    [((1, 1), False), ((5, 40), True), ((16, 16), False), ((17, 23), True), ((63, 500), False)],
)
@pytest.mark.parametrize("spoilt_by", [None, math.nan, math.inf, -math.inf, 3e38, -3e38])
def test_any_image_gives_finite_features(shape, spoilt_by, upright, backend):
    image = torch.full((2, 1, *shape), 0.5)
    image[0] = tensor(texture(*shape))
    if spoilt_by is not None:
        image[:, :, ::7, ::5] = spoilt_by
    found = sift(image, max_keypoints=20, upright=upright, backend=backend)
    for name in ("xy_px", "scale_px", "angle_deg", "descriptors"):
        assert torch.isfinite(getattr(found, name)).all()
    assert found.descriptors.shape == (2, 20, 128)
    if spoilt_by is None:
        assert not found.valid[1].any()  # a flat picture


def test_invalid_slots_are_zero_and_valid_ones_of_unit_norm(backend):
    found = sift(tensor(texture(60, 60)), max_keypoints=500, backend=backend)
    assert 0 < found.valid.sum() < 500
    empty = ~found.valid
    assert found.xy_px[empty].abs().max() == found.descriptors[empty].abs().max() == 0
    assert_close(found.descriptors[found.valid].norm(dim=1), torch.ones(int(found.valid.sum())))
    assert (found.angle_deg >= 0).all()
    assert (found.angle_deg < 360).all()


def test_a_batch_is_its_images(backend):
    images = tensor(texture(90, 110, 1), texture(90, 110, 2), np.full((90, 110), 9, np.uint8))
    together = sift(images, max_keypoints=50, backend=backend)
    for i in range(3):
        alone = sift(images[i : i + 1], max_keypoints=50, backend=backend)
        assert torch.equal(alone.valid[0], together.valid[i])
        assert_close(alone.xy_px[0], together.xy_px[i], atol=1e-3, rtol=0)
        assert_close(alone.descriptors[0], together.descriptors[i], atol=1e-3, rtol=0)


def test_the_mask_holds_keypoints_back(backend):
    image = tensor(texture(120, 120))
    mask = torch.zeros_like(image, dtype=torch.bool)
    mask[..., 30:70, 50:100] = True
    xy = valid_xy(sift(image, mask=mask, backend=backend))
    assert 5 < len(xy) < sift(image, backend=backend).valid.sum()
    assert (np.abs(xy - (74.5, 49.5)) <= (25, 20)).all()


def test_spread_reaches_weak_texture(backend):
    strong, weak = texture(120, 60, 1), texture(120, 180, 2)
    image = np.hstack([strong, (weak.astype(np.float32) * 0.15 + 109).astype(np.uint8)])

    def share_in_weak(spread):
        options = {"max_keypoints": 60, "contrast_threshold": 0.005, "backend": backend}
        return (valid_xy(sift(tensor(image), spread=spread, **options))[:, 0] > 60).mean()

    assert share_in_weak(1) < 0.05 < 0.15 < share_in_weak(6)


# What is described.


def test_light_does_not_change_descriptors(backend):
    image = tensor(texture(120, 120))
    plain = sift(image, backend=backend)
    dim = sift(0.6 * image + 0.3, contrast_threshold=0.6 * 0.02, backend=backend)
    pairs = np.array(pairs_of(match(plain, dim)))
    assert len(pairs) > 0.9 * plain.valid.sum()
    gap = (plain.xy_px[0, pairs[:, 0]] - dim.xy_px[0, pairs[:, 1]]).norm(dim=1)
    assert (gap < 0.1).float().mean() > 0.99


def warped(image: np.ndarray, angle: float, scale: float, shift: tuple[float, float]) -> ViewPair:
    height, width = image.shape
    matrix = np.vstack([cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle, scale), [0, 0, 1]])
    matrix[:2, 2] += shift
    flags = {"flags": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_REFLECT}
    other = cv2.warpAffine(image, matrix[:2], (width, height), **flags)
    return ViewPair("texture", image, other, by_homography(np.linalg.inv(matrix)))


@pytest.mark.slow
def test_quality_is_opencvs(backend):
    warps = [(0, 1.0, (3.3, -2.6)), (35, 1.0, (0, 0)), (-80, 1.25, (4, 1)), (160, 0.8, (0, 3)), (10, 0.7, (1, 1))]
    pairs = [warped(texture(180, 180, seed), *warp) for seed in range(4) for warp in warps]

    def quality(name):
        detector = detectors()[name]()
        found = detector.make()
        views = [[detector.keypoints(found(gray, 0.0)) for gray in (pair.first, pair.second)] for pair in pairs]
        return mean([judge(*view, pair) for view, pair in zip(views, pairs, strict=True)])

    ours, theirs = quality(NAMES[backend]), quality("OpenCV SIFT, contrast 0.02")
    assert ours.repeatability > 0.95 * theirs.repeatability
    assert ours.inlier_ratio > 0.98 * theirs.inlier_ratio
    assert ours.correct > 0.85 * theirs.correct  # OpenCV gives a place several orientations


def test_the_backends_find_and_describe_the_same():
    """Orientations and cells are in one order: a descriptor of one matches its own of the other."""
    image = tensor(texture(200, 240, 1))
    for upright in (False, True):
        options = {"upright": upright, "up_deg": 20.0, "max_keypoints": 600}
        one, other = (sift(image, backend=name, **options) for name in ("compiled", "kornia"))
        distance = torch.cdist(one.xy_px[0], other.xy_px[0])
        scales = (one.scale_px[0, :, None] / other.scale_px[0].clamp_min(1e-3)).log2().abs()
        near = (distance < 0.3) & (scales < 0.1) & one.valid[0][:, None] & other.valid[0]
        assert near.any(1).sum() > 0.8 * one.valid.sum()
        first, second = near.nonzero().unbind(1)
        turn = ((one.angle_deg[0, first] - other.angle_deg[0, second] + 180).remainder(360) - 180).abs()
        assert (turn < 5).float().mean() > 0.9
        cosine = (one.descriptors[0, first] * other.descriptors[0, second]).sum(1)
        assert cosine[turn < 5].median() > 0.98


def test_edges_and_low_contrast_are_no_keypoints(backend):
    """A straight edge under noise has extrema along it; the ratio of its curvatures tells them from blobs."""
    step = np.where(np.arange(120) < 60, 60, 190)[None].repeat(120, 0).astype(np.float32)
    noisy = step + np.random.default_rng(0).normal(0, 2, step.shape)
    edge = cv2.GaussianBlur(np.clip(noisy, 0, 255).astype(np.float32), (0, 0), 1.5).astype(np.uint8)
    assert sift(tensor(edge), backend=backend).valid.sum() == 0
    weak = 0.5 + 0.01 * blob(32, 32, 3)  # a difference of Gaussians of about a sixth of its height
    assert not sift(weak, contrast_threshold=0.02, backend=backend).valid.any()
    assert sift(weak, contrast_threshold=0.001, backend=backend).valid.any()


def test_auto_is_compiled_on_the_cpu_and_kornia_elsewhere():
    image = tensor(texture(60, 60))
    assert torch.equal(sift(image).descriptors, sift(image, backend="compiled").descriptors)
    assert not torch.equal(sift(image).descriptors, sift(image, backend="kornia").descriptors)
    cuda = torch.device("cuda")
    assert chosen_backend("auto", cuda) == chosen_backend("kornia", cuda) == "kornia"
    with pytest.raises(OptionError, match="backend: expected auto or kornia for images on cuda, got 'compiled'"):
        chosen_backend("compiled", cuda)


# What is refused.


SMALL = torch.zeros(1, 1, 9, 9)


@pytest.mark.parametrize(
    ("images", "options", "error", "text"),
    [
        (SMALL[0, 0], {}, ShapeError, "images: expected (B, 1, H, W), got (9, 9)"),
        (torch.zeros(1, 3, 9, 9), {}, ShapeError, "images: expected (B, 1, H, W), got (1, 3, 9, 9)"),
        (SMALL.byte(), {}, DtypeError, "images: expected floating point, got torch.uint8"),
        (SMALL, {"max_keypoints": 0}, OptionError, "max_keypoints: expected at least 1, got 0"),
        (SMALL, {"upsample": 3}, OptionError, "upsample: expected 1 or 2, got 3"),
        (SMALL, {"backend": "opencv"}, OptionError, "backend: expected one of auto, compiled, kornia, got"),
        (SMALL, {"spread": 0}, OptionError, "spread: expected 1 or more, got 0"),
        (SMALL, {"contrast_threshold": -1}, OptionError, "contrast_threshold"),
        (SMALL, {"mask": torch.ones(1, 1, 9, 8, dtype=torch.bool)}, ShapeError, "mask: expected"),
        (SMALL, {"mask": torch.ones(1, 1, 9, 9)}, DtypeError, "mask: expected bool"),
    ],
)
def test_wrong_arguments_are_named(images, options, error, text):
    with pytest.raises(error) as caught:
        sift(images, **options)
    assert text in str(caught.value)


def test_a_picture_that_requires_a_gradient_has_the_same_features(backend):
    image = torch.rand(1, 1, 60, 70, generator=torch.Generator().manual_seed(4))
    expected, found = (sift(i, backend=backend) for i in (image, image.clone().requires_grad_()))
    assert torch.equal(found.descriptors, expected.descriptors)
