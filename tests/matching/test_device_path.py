"""What crosses between the host and a GPU, counted on a pretended device; and that its answers are the CPU's."""

import math

import numpy as np
import pytest
import torch

import engine.runtime.device
from bench.inputs.scenes import flight, town_gray
from engine import MatcherOptions, OptionError, SceneMatcher, SiftOptions
from engine.features import match, sift
from engine.ncc_fft import match_template, ncc, prepare, surface
from engine.runtime.device import on_host, to_device
from tests.support.pretended import DEVICE, Pretended, pretended_device
from tests.support.tensors import assert_close

CPU = torch.device("cpu")
SUMMIT = 28  # numbers that a peak is made of
SIZES = pytest.mark.parametrize(
    ("size", "model"), [((150, 131), (63, 50)), ((425, 425), (228, 228)), ((64, 63), (63, 63))]
)


def picture(height, width, seed):
    rough = torch.randn(1, 1, height, width, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.avg_pool2d(rough, 5, stride=1, padding=2)[0, 0] * 4.0


def cut(image, size, seed):
    """A noisy part of a picture."""
    rng = torch.Generator().manual_seed(seed)
    y, x = ((n - m) // 3 for n, m in zip(image.shape, size, strict=True))
    return image[y : y + size[0], x : x + size[1]] + 0.05 * torch.randn(*size, generator=rng)


def assert_same_peak(found, expected):
    assert (found.x, found.y) == pytest.approx((expected.x, expected.y), abs=1e-4)
    assert (found.score, found.second_score) == pytest.approx((expected.score, expected.second_score), abs=1e-6)
    np.testing.assert_allclose(found.curvature, expected.curvature, atol=1e-5)


# ------------------------------------------------------------------------- the pretended device itself


def test_the_pretended_device_counts_what_would_wait_and_refuses_what_lies_elsewhere():
    """Copies are counted by the tests below, which ask for some."""
    with pretended_device() as crossings:
        there = torch.arange(12.0).view(3, 4).to(DEVICE)
        assert isinstance(there, Pretended)
        assert float(there.sum()) == 66.0
        assert there[there > 3.0].shape == (8,)
        assert len(there.nonzero()) == 11
        assert len(crossings.waits) == 3
        crossings.uploads.clear()
        assert there[torch.tensor([2, 0])].shape == (2, 4)  # an index of the host's is uploaded
        assert crossings.uploads == [2]
        with pytest.raises(RuntimeError, match="expected all tensors on one device"):
            there + torch.ones(3, 4)


def test_arrays_cross_once_and_come_back_as_they_were():
    rng = np.random.default_rng(0)
    arrays = [rng.random((5, 3)).astype(np.float32), rng.random(3).astype(np.float16), rng.integers(0, 9, (3, 2))]
    arrays += [rng.random(7) > 0.5, np.zeros((0, 2), np.int64), rng.random((4, 4))[:, ::2]]
    for device in (CPU, DEVICE):
        with pretended_device() as crossings:
            pictures = [to_device(array, device) for array in arrays]
            back = [on_host(picture) for picture in pictures]
            assert len(crossings.uploads) == len(crossings.downloads) == (device != CPU) * len(arrays)
        for one, other in zip(arrays, back, strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)


# ------------------------------------------------------------------------- NCC


@SIZES
def test_nodata_lowers_no_score_on_a_device_either(size, model):
    image, valid = picture(*size, 1), np.ones(size, np.bool_)
    valid[:, : size[1] // 12] = False
    image[torch.from_numpy(~valid)] = 0.0
    templates = cut(image, model, 2)[None]
    expected = surface(prepare(image, valid=valid), templates, min_overlap=0.9)
    with pretended_device():
        found = surface(prepare(image.to(DEVICE), valid=valid), templates.to(DEVICE), min_overlap=0.9).cpu()
    assert_close(found, expected, atol=2e-6, rtol=0)


@SIZES
def test_a_match_uploads_a_template_and_downloads_28_numbers(size, model):
    image = picture(*size, 1)
    template = cut(image, model, 2)
    expected = match_template(prepare(image), template, exclusion_px=5.0, exhaustive=True)
    with pretended_device() as crossings:
        search = prepare(image.to(DEVICE))
        crossings.uploads.clear()
        found = match_template(search, template.to(DEVICE), exclusion_px=5.0)
    assert (crossings.uploads, crossings.downloads, crossings.waits) == ([template.numel()], [SUMMIT], [])
    assert_same_peak(found, expected)


@pytest.mark.parametrize("zero_mean", [True, False])
def test_the_surface_waits_for_the_check_of_its_arguments_alone(zero_mean):
    windows = torch.stack([picture(70, 81, i) for i in range(2)]) + 3.0
    templates = torch.stack([torch.stack([cut(w, (20, 31), i) for i in range(3)]) for w in windows])
    expected = ncc(windows, templates, zero_mean=zero_mean)
    with pretended_device() as crossings:
        found = ncc(*(tensor.to(DEVICE) for tensor in (windows, templates)), zero_mean=zero_mean)
        assert (crossings.downloads, crossings.waits) == ([2], [])
        back = found.cpu()
    assert_close(back, expected, atol=2e-6, rtol=0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["search", "templates"])
def test_values_that_are_not_finite_are_refused_on_a_device(name, bad):
    tensors = {"search": picture(30, 31, 0)[None], "templates": picture(8, 9, 1)[None, None]}
    tensors[name].view(-1)[5] = bad
    with pretended_device(), pytest.raises(OptionError, match=f"^{name}: expected finite values"):
        ncc(*(tensor.to(DEVICE) for tensor in tensors.values()))


# ------------------------------------------------------------------------- SIFT


def scenes():
    parts = [town_gray(1)[y : y + 150, 100:270] for y in (100, 300)]
    return torch.from_numpy(np.stack(parts))[:, None].float() / 255.0


OPTIONS = {
    "usual": {},
    "upright": {"upright": True, "up_deg": 30.0},
    "not doubled": {"upsample": 1, "contrast_threshold": 0.005, "max_keypoints": 900},
    "strongest": {"spread": 1, "max_keypoints": 20},
    "more slots than keypoints": {"max_keypoints": 4000},
}


@pytest.mark.parametrize(
    "name", ["usual", *(pytest.param(name, marks=pytest.mark.slow) for name in OPTIONS if name != "usual")]
)
@pytest.mark.parametrize("masked", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_features_stay_on_the_device_and_are_the_cpus(name, masked):
    pictures = scenes()
    mask = torch.ones_like(pictures, dtype=torch.bool)
    mask[:, :, :40] = False
    with pretended_device():
        there, allowed = (to_device(given.numpy(), DEVICE) for given in (pictures, mask))
    expected = sift(pictures, mask=mask if masked else None, backend="kornia", **OPTIONS[name])
    with pretended_device() as crossings:
        found = sift(there, mask=allowed if masked else None, **OPTIONS[name])
        assert crossings.downloads == []
        found = [on_host(part) for part in (found.valid, found.xy_px, found.scale_px, found.descriptors)]
    assert_same_features(found, expected)


def assert_same_features(found, expected):
    """Nearly all of them, in both pictures."""
    valid, xy, scale, descriptors = found
    own = expected.valid.numpy()
    assert abs(int(valid.sum()) - int(own.sum())) <= 0.01 * own.sum()
    assert not xy[~valid].any()
    assert not descriptors[~valid].any()
    for b in range(2):
        mine, theirs = xy[b][valid[b]], expected.xy_px[b].numpy()[own[b]]
        apart = np.hypot(*(mine[:, None] - theirs[None]).transpose(2, 0, 1))
        apart += np.abs(scale[b][valid[b]][:, None] - expected.scale_px[b].numpy()[own[b]][None])
        nearest = apart.argmin(1)
        same = apart.min(1) < 0.01
        assert same.mean() >= 0.98
        difference = np.abs(descriptors[b][valid[b]] - expected.descriptors[b].numpy()[own[b]][nearest]).max(1)
        assert (difference[same] < 1e-3).mean() >= 0.98


@pytest.mark.parametrize("size", [(5, 5), (9, 40), (12, 12), (33, 121)])
def test_a_picture_of_any_size_has_features_on_a_device(size):
    image = picture(*size, 3)[None, None].clamp(0.0, 1.0)
    expected = sift(image, max_keypoints=20, backend="kornia")
    with pretended_device():
        found = sift(image.to(DEVICE), max_keypoints=20)
        valid, angles = on_host(found.valid), on_host(found.angle_deg)
    np.testing.assert_array_equal(valid, expected.valid.numpy())
    assert np.isfinite(angles).all()


def test_matches_are_the_cpus():
    """And so are the features without a mask."""
    expected = match(*(sift(scene[None], backend="kornia") for scene in scenes()), max_scale_factor=2.0)
    with pretended_device() as crossings:
        there = [sift(scene[None].to(DEVICE)) for scene in scenes()]
        crossings.waits.clear()
        found = match(*there, max_scale_factor=2.0)
        assert (crossings.downloads, crossings.waits) == ([], [])
        index, valid = on_host(found.train_index), on_host(found.valid)
    agreeing = (index == expected.train_index.numpy()) & (valid == expected.valid.numpy())
    assert agreeing.mean() >= 0.95


# ------------------------------------------------------------------------- whole frames


def apart_m(one, other):
    return math.hypot(one.east_m - other.east_m, one.north_m - other.north_m)


# Copies to the host per frame once the map is prepared: the peak; and of pairs pixels, scales, which count, whose.
DOWNLOADS = {("ncc", "auto"): 1, ("sift", "kornia"): 3, ("sift", "auto"): 0, ("auto", "kornia"): 4}
METRES = {"ncc": 1e-6, "sift": 1e-2, "auto": 1e-5}  # of auto it may be SIFT's, refined


@pytest.mark.parametrize(
    ("method", "backend"),
    [case if case[0] != "auto" else pytest.param(*case, marks=pytest.mark.slow) for case in DOWNLOADS],
)
def test_a_frame_crosses_once_and_its_fix_is_the_cpus(method, backend, monkeypatch):
    scene = flight(1)
    monkeypatch.setattr("engine.matching.ladder.is_beyond_doubt", lambda *_: False)  # auto asks both methods
    options = MatcherOptions(sift=SiftOptions(backend=backend))
    matcher = SceneMatcher(scene.site, scene.camera, method, "cpu", options)
    expected = [matcher.locate(*pair) for pair in zip(scene.frames, scene.priors, strict=True)]
    monkeypatch.setattr(engine.runtime.device, "resolve", lambda name: DEVICE)
    with pretended_device() as crossings:
        matcher = SceneMatcher(scene.site, scene.camera, method, options=options)
        for frame, prior in zip(scene.frames, scene.priors, strict=True):
            matcher.locate(frame, prior)  # regions, landmarks and plans are made
        for frame, prior, fix in zip(scene.frames, scene.priors, expected, strict=True):
            crossings.uploads.clear()
            crossings.downloads.clear()
            crossings.waits.clear()
            found = matcher.locate(frame, prior)
            assert len(crossings.downloads) == DOWNLOADS[method, backend]
            if backend == "auto":  # NCC's template goes up; kornia counts its extrema, and the host waits for it
                assert len(crossings.uploads) == DOWNLOADS[method, backend]
                assert crossings.waits == []
            assert apart_m(found, fix) < METRES[method]


# ------------------------------------------------------------------------- a real one, where there is one

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


@needs_cuda
@pytest.mark.parametrize("zero_mean", [True, False])
def test_a_gpu_makes_the_surfaces_of_float64(zero_mean):
    windows = torch.stack([picture(170, 181, i) for i in range(2)]) + 3.0
    templates = torch.stack([torch.stack([cut(w, (60, 71), i) for i in range(3)]) for w in windows])
    expected = ncc(windows.double(), templates.double(), zero_mean=zero_mean)
    found = ncc(windows.cuda(), templates.cuda(), zero_mean=zero_mean)
    assert_close(found.cpu().double(), expected, atol=2e-5, rtol=0)


@needs_cuda
@pytest.mark.parametrize("method", ["ncc", "sift", "auto"])
def test_a_gpu_fixes_a_flight_as_the_cpu_does_and_its_memory_does_not_grow(method):
    scene = flight(8)
    options = MatcherOptions(sift=SiftOptions(backend="kornia"))
    matchers = [SceneMatcher(scene.site, scene.camera, method, device, options) for device in ("cuda", "cpu")]
    for frame, prior in zip(scene.frames, scene.priors, strict=True):
        found, expected = (matcher.locate(frame, prior) for matcher in matchers)
        assert apart_m(found, expected) < 0.05
    held = torch.cuda.memory_allocated()
    for frame, prior in list(zip(scene.frames, scene.priors, strict=True)) * 3:
        matchers[0].locate(frame, prior)
    assert torch.cuda.memory_allocated() <= held
