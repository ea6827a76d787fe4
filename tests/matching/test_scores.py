"""Enhanced grey levels and structure: each is what its line says, respects nodata, finds its place."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from engine import Frame, OptionError
from engine.kernels.scores import enhance, orientation
from engine.matching.structure import by_blocks, slack_px
from engine.runtime.device import CPU
from tests.support.fixes import px_off

NADIR = np.array([310.0, 305.0])
PIXELS = 0.5  # the most that a fix may be off, in map pixels


def noise(shape=(60, 63), seed=0, top=256):
    return np.random.default_rng(seed).integers(0, top, shape).astype(np.uint8)


def binomial(gray):
    """Rows and columns weighted 1-2-1, the border reflected about its pixels."""
    wide = np.pad(gray.astype(float), 1, mode="reflect")
    tall = wide[:-2] + 2 * wide[1:-1] + wide[2:]
    return (tall[:, :-2] + 2 * tall[:, 1:-1] + tall[:, 2:]) / 16


# What is correlated


@pytest.mark.parametrize("masked", [False, True])
def test_a_pixel_is_normalised_by_its_neighbourhood(masked):
    """Of the smoothed picture."""
    gray = noise()
    smooth = binomial(gray)
    enhanced = enhance(gray, radius_px=3, valid=np.ones(gray.shape, bool) if masked else None)
    for y, x in ((10, 10), (20, 33), (50, 44)):
        box = smooth[y - 3 : y + 4, x - 3 : x + 4]
        expected = (smooth[y, x] - box.mean()) / np.sqrt(box.var() + 4.0)
        assert enhanced[y, x] == pytest.approx(expected, abs=0.05)  # smoothed to whole grey levels


def test_a_neighbourhood_without_a_pixel_is_refused():
    with pytest.raises(OptionError, match=r"^radius_px: expected 1 to 180, got 0"):
        enhance(noise(), radius_px=0)


def test_flat_ground_stays_flat_and_finite():
    for level in (0, 17, 255):
        assert np.ptp(enhance(np.full((30, 31), level, np.uint8))) < 0.02
    assert not enhance(np.full((30, 31), 80, np.uint8), valid=np.zeros((30, 31), bool)).any()


# Orientation


def test_an_edge_that_swaps_its_tones_keeps_its_orientation(ground):
    gray = ground.gray[:200, :210]
    np.testing.assert_allclose(orientation(255 - gray), orientation(gray), atol=0.06)  # roundings of grey levels


def test_a_quarter_turn_of_the_picture_is_half_a_turn_of_the_doubled_angle(ground):
    gray = np.ascontiguousarray(ground.gray[:200, :210])
    turned = orientation(np.ascontiguousarray(np.rot90(gray)))
    np.testing.assert_allclose(turned, -np.rot90(orientation(gray), axes=(1, 2)), atol=1e-3)


def test_stripes_have_the_orientation_that_they_run_in():
    columns = (127 + 100 * np.sin(np.arange(80) / 2.0)).astype(np.uint8)
    cosine, sine = orientation(np.tile(columns, (80, 1)))[:, 20:-20, 20:-20]
    assert cosine.min() > 0.3
    assert np.abs(sine).max() < 1e-6


def test_what_is_not_valid_has_no_orientation_and_is_not_seen(ground):
    gray, valid = ground.gray[:120, :130].copy(), np.ones((120, 130), bool)
    valid[:, 70:] = False
    first = orientation(gray, valid=valid)
    gray[:, 75:] = 0
    np.testing.assert_array_equal(orientation(gray, valid=valid), first)
    assert not first[:, ~valid].any()


# Nodata


def test_what_is_not_valid_is_not_seen():
    gray = noise()
    valid = np.ones(gray.shape, bool)
    valid[:, 40:] = False
    valid[5:9, 5:8] = False
    black, white = np.where(valid, gray, 0).astype(np.uint8), np.where(valid, gray, 255).astype(np.uint8)
    first, second = (enhance(g, radius_px=5, valid=valid) for g in (black, white))
    np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-6)  # a few roundings of float32
    assert not first[~valid].any()
    far = np.s_[20:, :33]
    np.testing.assert_allclose(first[far], enhance(gray, radius_px=5)[far], atol=0.2)


# Finding a place


def test_a_frame_that_is_darker_to_one_side_is_found(matchers, ground, camera):
    image = ground.picture(camera, NADIR, 150.0)
    shaded = np.rint(image * np.linspace(0.25, 1.0, image.shape[1])).astype(np.uint8)
    frame = Frame(shaded, 0, 150.0, 0.0, 0.0, 0.0)
    assert px_off(matchers["ncc"].locate(frame, ground.prior(NADIR)), NADIR) < PIXELS


def test_a_frame_whose_tones_are_turned_round_is_found_by_its_structure(matchers, ground, camera):
    inverted = Frame(255 - ground.picture(camera, NADIR, 150.0), 0, 150.0, 0.0, 0.0, 0.0)
    found = matchers["ncc"].locate(inverted, ground.prior(NADIR))
    assert px_off(found, NADIR) < PIXELS
    assert "structure" in found.timings.stages_ms


def test_a_frame_of_which_half_the_tones_are_turned_round_is_found_by_structure(matchers, ground, camera):
    """Fields that were darker than their neighbours are brighter: squares of the picture are inverted."""
    image = ground.picture(camera, NADIR, 150.0).copy()
    rows, columns = (np.arange(n) // 40 for n in image.shape[:2])
    swapped = (rows[:, None] + columns) % 2 == 0
    image[swapped] = 255 - image[swapped]
    result = matchers["ncc"].locate(Frame(image, 0, 150.0, 0.0, 0.0, 0.0), ground.prior(NADIR))
    assert px_off(result, NADIR) < 2.0
    assert "structure" in result.timings.stages_ms


def test_a_block_may_lie_off_its_place_and_the_frame_scores_as_if_it_did_not():
    rng, rows, columns = np.random.default_rng(5), 96, 144
    search = rng.normal(size=(3, rows + 40, columns + 50)).astype(np.float32)
    slack, (y, x), block = slack_px((rows, columns), 3), (17, 23), (rows // 3, columns // 3)
    template = np.empty((3, 1, rows, columns), np.float32)
    for top, left in itertools.product(range(0, rows, block[0]), range(0, columns, block[1])):
        down, right = rng.integers(-slack, slack + 1, 2)
        place = np.s_[:, y + top + down :, x + left + right :]
        template[:, 0, top : top + block[0], left : left + block[1]] = search[place][:, : block[0], : block[1]]
    rigid, giving = by_blocks(search, template, CPU, 3)[:, 0]
    assert giving[y, x] == giving.max() == pytest.approx(1.0, abs=1e-5)
    assert rigid[y, x] < 0.9
    assert (giving >= rigid - 1e-6).all()


@pytest.mark.parametrize("turn_deg", [-4.0, 4.5])
def test_a_compass_that_is_a_few_degrees_off_is_found_out(matchers, ground, camera, turn_deg):
    frame = ground.frame(camera, NADIR, 150.0, heading_deg=40.0)
    rng = np.random.default_rng(3)  # dim and noisy, so that the turned patch does not do by itself
    image = np.clip(0.12 * frame.image + 90 + rng.normal(0, 14, frame.image.shape), 0, 255).astype(np.uint8)
    stated = replace(frame, image=image, heading_deg=40.0 + turn_deg)
    result = matchers["ncc"].locate(stated, ground.prior(NADIR))
    assert px_off(result, NADIR) < 3.0
    assert abs(result.attitude.heading_deg - 40.0) < 1.5
