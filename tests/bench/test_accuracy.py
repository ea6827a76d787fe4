"""The figures of the benchmarks are what they say: perfect features score 1, noise does not, and truth is true."""

import cv2
import numpy as np
import pytest

from bench.accuracy import quality, years
from bench.accuracy.audit import Trial, fit
from bench.accuracy.flights import attitude_rms_deg, moved_to_middle
from bench.accuracy.quality import Keypoints, ViewPair, judge
from bench.accuracy.recall import DETECTORS, WARPS, measured, warped
from bench.accuracy.trials import ground_quad_px, picture
from bench.inputs.map_views import map_pairs
from bench.inputs.views import by_homography, warped_pairs
from bench.pages.integrity import auc, calibration_error, false_positives
from bench.speed.detectors import detectors
from engine import Camera
from engine.values import Attitude, Truth
from tests.support.fixes import a_fix

CAMERA = Camera.from_fov(300, 300, 60.0)
NORTH = Attitude(0.0, 0.0, 0.0)  # level
SIZE = 200
TURN = np.array([[0.0, -1.0, SIZE - 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # a quarter: (x, y) to (last - y, x)


def pair_by(homography, size=SIZE):
    blank = np.zeros((size, size), np.uint8)
    return ViewPair("test", blank, blank, by_homography(np.asarray(homography, float)))


def keypoints(xy_px, scale_px=2.0, seed=0):
    words = np.random.default_rng(seed).normal(size=(len(xy_px), 32)).astype(np.float32)
    return Keypoints(np.asarray(xy_px, float), np.full(len(xy_px), scale_px), words)


@pytest.fixture
def places():
    """Points at least 8 px apart."""
    grid = np.stack(np.meshgrid(np.arange(8, SIZE - 8, 10), np.arange(8, SIZE - 8, 10)), axis=-1).reshape(-1, 2)
    return grid + np.random.default_rng(1).uniform(-1, 1, grid.shape)


def test_the_same_features_in_a_turned_picture_are_perfect(places):
    turned = by_homography(np.linalg.inv(TURN))(places)
    figures = judge(keypoints(places), keypoints(turned), pair_by(TURN))
    assert figures.repeatability == figures.matching_score == figures.inlier_ratio == 1.0
    assert figures.correct == figures.keypoints == len(places)
    assert figures.error_px < 1e-9


def test_the_turn_and_the_scale_of_a_pair_are_those_of_its_map():
    pair = pair_by(TURN)
    assert pair.scale == pytest.approx(1.0)
    # The first's x axis points up in the second: (x, y) of the second goes to (last - y, x).
    assert pair.turn_deg == pytest.approx(-90.0)
    assert pair_by(np.diag([2.0, 2.0, 1.0])).scale == pytest.approx(2.0)


@pytest.mark.parametrize(("off_px", "repeated", "right"), [(1.4, 1.0, 1.0), (2.0, 0.0, 1.0), (3.1, 0.0, 0.0)])
def test_a_shifted_keypoint_counts_up_to_the_tolerances(places, off_px, repeated, right):
    figures = judge(keypoints(places), keypoints(places + np.array([off_px, 0.0])), pair_by(np.eye(3)))
    assert (figures.repeatability, figures.inlier_ratio) == (repeated, right)


@pytest.mark.parametrize("zoom", [1.0, 2.0])
@pytest.mark.parametrize(("factor", "repeated"), [(1.4, 1.0), (1.6, 0.0), (1 / 1.4, 1.0), (1 / 1.6, 0.0)])
def test_a_keypoint_of_another_scale_on_the_ground_is_not_repeated(places, factor, repeated, zoom):
    """Where the first picture shows the ground larger, keypoints of the same ground are larger in it."""
    first, second = keypoints(places, scale_px=2.0 * zoom), keypoints(places / zoom, scale_px=2.0 * factor)
    assert judge(first, second, pair_by(np.diag([zoom, zoom, 1.0]))).repeatability == repeated


def test_keypoints_outside_the_common_ground_do_not_count_against_repeatability(places):
    pair = pair_by([[1, 0, SIZE / 2], [0, 1, 0], [0, 0, 1]])  # the left half of the second is the first's right
    inside = places[places[:, 0] >= SIZE / 2]
    assert len(inside) < len(places)
    assert judge(keypoints(places), keypoints(inside - [SIZE / 2, 0.0]), pair).repeatability == 1.0


def test_words_that_say_nothing_find_next_to_nothing(places):
    figures = judge(keypoints(places, seed=1), keypoints(places, seed=2), pair_by(np.eye(3)))
    assert figures.repeatability == 1.0
    assert figures.matching_score < 0.02


def correlation(pair):
    """Of the second picture with the first laid on it by the pair's map."""
    rows, columns = pair.second.shape
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    moved = pair.first_from_second(pixels.astype(float))
    inside = quality.inside(moved, pair.first.shape).reshape(rows, columns)
    x, y = moved.astype(np.float32).reshape(rows, columns, 2).transpose(2, 0, 1)
    laid = cv2.remap(pair.first, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR)
    assert inside.mean() > 0.3
    return np.corrcoef(laid[inside], pair.second[inside])[0, 1]


@pytest.mark.slow
@pytest.mark.parametrize("size", [(150, 150), (300, 300)])
@pytest.mark.parametrize(("pairs", "count", "least"), [(warped_pairs, 5, 0.85), (map_pairs, 4, 0.8)])
def test_pairs_show_the_same_ground_where_their_map_says(pairs, count, least, size):
    assert min(correlation(pair) for pair in pairs(size, count)) > least


@pytest.mark.slow
def test_every_detector_finds_a_blob_where_it_is():
    """OpenCV's and kornia's own biases are below half a pixel; x for y, or a corner for a centre, is more."""
    v, u = np.mgrid[:160, :160]
    x, y, sigma = 80.0, 70.0, 4.0
    bright = 40 + 150 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2))
    for name, create in detectors().items():
        if name in ("OpenCV ORB", "OpenCV AKAZE"):
            continue  # they look for corners
        detector = create()
        found = detector.keypoints(detector.make()(bright.astype(np.uint8), 0.0))
        nearest = np.argmin(np.linalg.norm(found.xy_px - (x, y), axis=1))
        assert np.abs(found.xy_px[nearest] - (x, y)).max() < 0.7, name
        assert 0.6 < found.scale_px[nearest] / sigma < 1.6, name


def fix_with(attitude, up_m=100.0):
    return a_fix(5.0, -3.0, timestamp_ns=0, up_m=up_m, attitude=attitude)


def test_the_attitudes_error_is_the_angle_between_the_attitudes():
    truth = [Truth(timestamp_ns=0, lat_deg=0.0, lon_deg=0.0, roll_deg=2.0, pitch_deg=0.0, heading_deg=359.0)]
    assert attitude_rms_deg([fix_with(Attitude(2.0, 0.0, 2.0))], truth) == pytest.approx(3.0)
    assert attitude_rms_deg([fix_with(Attitude(6.0, 0.0, 359.0))], truth) == pytest.approx(4.0)
    assert attitude_rms_deg([], truth) is None


def test_a_fix_moves_to_where_its_axis_meets_the_ground(ground):
    level = moved_to_middle(fix_with(Attitude(0.0, 0.0, 30.0)), ground.site, CAMERA)
    assert (level.east_m, level.north_m) == pytest.approx((5.0, -3.0))
    # Heading north with the nose up it looks ahead.
    nose_up = moved_to_middle(fix_with(Attitude(0.0, 10.0, 0.0)), ground.site, CAMERA)
    assert (nose_up.east_m, nose_up.north_m) == pytest.approx((5.0, -3.0 + 100.0 * np.tan(np.radians(10.0))))


# ---------------------------------------------------------------------------------------------------------- recall


@pytest.mark.parametrize("name", list(DETECTORS))
def test_matches_are_judged_by_the_warp(name):
    noise = np.random.default_rng(0).normal(0.0, 1.0, (160, 200))
    gray = np.clip(128.0 + 200.0 * cv2.GaussianBlur(noise, (0, 0), 2.0), 0, 255).astype(np.uint8)
    found, _ = measured(DETECTORS[name], 100, [warped("noise", gray, *warp) for warp in WARPS])
    assert all(quality.correct > 20 for quality in found)
    assert all(quality.inlier_ratio > 0.9 for quality in found)
    assert all(quality.error_px < 0.5 for quality in found)


# ------------------------------------------------------------------------------------------------------ statistics


def test_scores_are_ranked():
    """Right ones 3 and 1, wrong ones 2 and 0: of four pairs three are in order; 1 is kept, so 2 passes."""
    score, right = np.array([3.0, 1.0, 2.0, 0.0]), np.array([True, True, False, False])
    assert auc(score, right) == 0.75
    assert auc(np.ones(4), right) == 0.5
    assert np.isnan(auc(np.ones(2), right[[0, 1]]))
    assert false_positives(score, right, kept=1.0) == 0.5
    assert calibration_error(np.array([0.75] * 4), np.array([True, True, True, False])) == 0.0
    assert calibration_error(np.array([1.0] * 4), right) == 0.5


def test_the_fit_finds_the_weights_that_drew_the_outcomes():
    rng = np.random.default_rng(0)
    weights, features = np.array([-1.0, 0.5, 0.0, 2.0]), rng.normal(size=(20_000, 3))
    chance = 1.0 / (1.0 + np.exp(-weights[0] - features @ weights[1:]))
    right = rng.random(len(chance)) < chance
    found = [Trial(60.0, 0.5, row, bool(one), False) for row, one in zip(features, right, strict=True)]
    assert fit(found) == pytest.approx(weights, abs=0.1)


# -------------------------------------------------------------------------------------------------- pairs of years


@pytest.mark.usefixtures("shared")
def test_every_place_is_in_one_half():
    fit, report = (set(years.places(half)) for half in years.HALVES)
    assert not fit & report
    assert len(fit | report) == 38
    assert abs(len(fit) - len(report)) <= 4


@pytest.mark.usefixtures("shared")
def test_a_shift_back_is_the_shift_forth_turned_round():
    first, second = years.YEARS[:2]
    for place in years.places("fit"):
        np.testing.assert_array_equal(years.shift(place, first, second), -years.shift(place, second, first))


def test_a_level_frame_that_looks_north_shows_the_map_under_its_place(ground):
    place_m = ground.site.enu_from_pixel(np.array([310.0, 305.0]))
    quad_px = ground_quad_px(ground.site, CAMERA, place_m, 100.0, NORTH)
    np.testing.assert_allclose(quad_px.mean(axis=0), [310.0, 305.0], atol=1e-3)
    image = picture(ground.gray, ground.site, CAMERA, place_m, 100.0, NORTH)
    scale = (quad_px[1, 0] - quad_px[0, 0]) / (CAMERA.width_px - 1)
    x, y = np.round(quad_px[0] + 150 * scale).astype(int)
    near = ground.gray[y - 1 : y + 2, x - 1 : x + 2]
    assert near.min() <= image[150, 150] <= near.max()
