"""Sigmas of chance and covariance: figures done by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from engine import AssumedErrors, Camera
from engine.matching import covariance as covariances
from engine.matching.covariance import misalignment_covariance_px2, peak_covariance_px, score_sigma
from engine.ncc_fft import find_peak, ncc
from engine.values import GridPose, Peak

CAMERA = Camera.from_fov(300, 300, 60.0)
PIXELS = 2500  # 100 blocks of 5 x 5: one sigma of chance is 0.1


def peak(score=0.8, second=0.2, bend=((-0.02, 0.0), (0.0, -0.02))):
    return Peak(10.0, 12.0, score, second, np.array(bend))


def test_a_score_of_chance_scatters_by_its_sigma():
    """Pictures of 100 blocks of 5 x 5 equal pixels that have nothing to do with each other."""
    first, second = np.random.default_rng(6).normal(size=(2, 1500, 10, 10))
    search, templates = (torch.from_numpy(np.kron(values, np.ones((5, 5)))) for values in (first, second))
    assert score_sigma(PIXELS) == pytest.approx(0.1)
    assert float(ncc(search, templates[:, None]).std()) == pytest.approx(0.1, rel=0.05)
    assert score_sigma(1) == 1.0


def test_what_is_assumed_of_telemetry_is_said_in_one_place():
    errors = AssumedErrors(height_m=3.0, height_share=0.04, tilt_deg=0.5, unknown_tilt_deg=4.0)
    assert errors.height_sigma_m(100.0) == pytest.approx(5.0)
    stated = {(None, None): (4.0, 4.0), (1.0, None): (0.5, 4.0), (None, 1.0): (4.0, 0.5), (0.0, 0.0): (0.5, 0.5)}
    for (roll, pitch), sigmas in stated.items():
        assert errors.tilts_deg(GridPose(100.0, 0.0, roll, pitch)) == sigmas


@given(
    score=st.floats(-1.0, 1.0),
    values=st.tuples(st.floats(-2.0, 0.5), st.floats(-2.0, 0.5)),
    turn=st.floats(0.0, 3.2),
    pixels=st.integers(1, 10**6),
)
def test_the_covariance_of_a_peak_is_positive_definite_and_bounded(score, values, turn, pixels):
    c, s = math.cos(turn), math.sin(turn)
    axes = np.array([[c, -s], [s, c]])
    covariance = peak_covariance_px(peak(score, bend=axes @ np.diag(values) @ axes.T), pixels)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
    low, high = np.linalg.eigvalsh(covariance)
    assert 0.05**2 - 1e-9 <= low <= high <= 5.0**2 + 1e-9


@pytest.mark.parametrize(
    ("score", "bend", "pixels", "variances_px2"),
    [
        # 2500 pixels in blocks of 25 are 100; information 0.02 * 100 * 0.5 / (1 - 0.25) = 1.3333 per square pixel
        (0.5, (-0.02, -0.005), 2500, (0.75, 3.0)),
        (0.8, (-0.02, -0.005), 2500, (0.225, 0.9)),
        (0.9, (-0.1, 0.0), 40_000, (0.05**2, 25.0)),  # along a ridge known to pixels, and not infinitely badly
    ],
)
def test_the_covariance_of_a_peak_by_hand(score, bend, pixels, variances_px2):
    covariance = peak_covariance_px(peak(score, bend=np.diag(bend)), pixels)
    np.testing.assert_allclose(covariance, np.diag(variances_px2), rtol=1e-12)


def test_the_covariance_of_a_peak_is_what_white_noise_does():
    """Cramer-Rao: where every pixel counts, and not one in 5 x 5, the figure is the scatter itself."""
    rng = np.random.default_rng(3)
    picture = gaussian_filter(rng.normal(size=(72, 72)), 2.5)
    picture = torch.from_numpy(picture / picture.std())
    places, claimed = [], []
    for _ in range(150):
        noisy = picture[16:56, 16:56] + 2.0 * torch.from_numpy(rng.normal(size=(40, 40)))
        found = find_peak(ncc(picture[None], noisy[None, None])[0, 0], exclusion_px=6.0)
        places.append((found.x, found.y))
        claimed.append(np.trace(peak_covariance_px(found, 25 * 1600)))
    spread = np.sum((np.array(places) - 16.0) ** 2, axis=1).mean()
    assert 0.6 < np.mean(claimed) / spread < 1.7


def errors_for(frame, **assumed):
    errors = AssumedErrors(**assumed)
    return covariances.ncc_covariance_m2(1e-12 * np.eye(2), frame, CAMERA, 0.5 * np.eye(2), errors)


def test_half_a_degree_of_tilt_is_1_3_metres_at_150():
    covariance = errors_for(GridPose(150.0, 0.0, 0.0, 0.0), tilt_deg=0.5, map_m=0.3)
    # A level camera: the axis meets the ground below, whatever the height and the heading.
    np.testing.assert_allclose(np.diag(covariance)[:2], 1.309**2 + 0.3**2, rtol=1e-3)
    assert covariance[2, 2] == pytest.approx(0.5**2 + 1.5**2)
    np.testing.assert_allclose(covariance - np.diag(np.diag(covariance)), 0.0, atol=1e-9)


def test_a_tilt_that_nobody_measured_is_less_sure():
    level = GridPose(150.0, 0.0, 0.0, 0.0)
    unknown_roll = GridPose(150.0, 0.0, None, 0.0)
    gain = errors_for(unknown_roll) - errors_for(level)
    # Heading north, roll moves the axis east and west.
    assert gain[0, 0] == pytest.approx((150.0 * math.tan(math.radians(4.0))) ** 2 - 1.309**2, rel=1e-2)
    assert gain[1, 1] == pytest.approx(0.0, abs=1e-9)


def test_the_height_of_a_tilted_camera_moves_the_fix_along_the_tilt():
    """Nose up 20 degrees on a heading of 90: the axis meets the ground 54.6 m to the east."""
    frame = GridPose(150.0, 90.0, 0.0, 20.0)
    small = {"heading_deg": 1e-6, "tilt_deg": 1e-6, "map_m": 1e-6}
    covariance = errors_for(frame, height_m=3.0, height_share=1e-9, **small)
    assert math.sqrt(covariance[0, 0]) == pytest.approx(3.0 * math.tan(math.radians(20.0)), rel=1e-6)
    assert covariance[1, 1] < 1e-6
    turned = errors_for(frame, height_m=1e-6, height_share=1e-9, **(small | {"heading_deg": 1.0}))
    assert math.sqrt(turned[1, 1]) == pytest.approx(54.6 * math.radians(1.0), rel=1e-2)
    assert turned[0, 0] < 1e-4


def test_a_turned_patch_pulls_its_peak_only_where_its_parts_come_apart():
    """By hand: what 240 x 320 px move by when turned by 1 degree, against a peak 0.8 / 0.02 = 40 px^2 wide."""
    stated = AssumedErrors(heading_deg=1.0, height_m=1e-9, height_share=1e-9)
    apart = math.radians(1.0) ** 2 * (240**2 + 320**2) / 24.0
    pull = misalignment_covariance_px2(peak(0.8), (240, 320), 150.0, stated)
    np.testing.assert_allclose(pull, apart**2 / (apart + 40.0) * np.eye(2), rtol=1e-9)
    sharp = misalignment_covariance_px2(peak(0.8, bend=((-80.0, 0.0), (0.0, -80.0))), (240, 320), 150.0, stated)
    assert sharp[0, 0] == pytest.approx(apart, rel=0.01)  # the parts cannot agree: anywhere between them
    assert misalignment_covariance_px2(peak(0.8), (24, 32), 150.0, stated)[0, 0] < 1e-3 * pull[0, 0]
