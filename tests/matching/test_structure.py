"""Structure: it keeps its orientation where tones change, and finds what grey levels do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from engine import Frame, NoFix, SceneMatcher
from engine.kernels.scores import orientation
from tests.support.fixes import px_off

NADIR = np.array([310.0, 305.0])


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


def test_a_frame_of_which_half_the_tones_are_turned_round_is_found_by_structure(ground, camera):
    """Fields that were darker than their neighbours are brighter: squares of the picture are inverted."""
    image = ground.picture(camera, NADIR, 150.0).copy()
    rows, columns = (np.arange(n) // 40 for n in image.shape[:2])
    swapped = (rows[:, None] + columns) % 2 == 0
    image[swapped] = 255 - image[swapped]
    matcher = SceneMatcher(ground.site, camera, "ncc", "cpu")
    result = matcher.locate(Frame(image, 0, 150.0, 0.0, 0.0, 0.0), ground.prior(NADIR))
    assert px_off(result, NADIR) < 2.0
    assert "structure" in result.timings.stages_ms


# Another heading


@pytest.mark.parametrize("turn_deg", [-4.0, 4.5])
def test_a_compass_that_is_a_few_degrees_off_is_found_out(ground, camera, turn_deg):
    frame = ground.frame(camera, NADIR, 150.0, heading_deg=40.0)
    rng = np.random.default_rng(3)  # dim and noisy, so that the turned patch does not do by itself
    image = np.clip(0.12 * frame.image + 90 + rng.normal(0, 14, frame.image.shape), 0, 255).astype(np.uint8)
    stated = replace(frame, image=image, heading_deg=40.0 + turn_deg)
    result = SceneMatcher(ground.site, camera, "ncc", "cpu").locate(stated, ground.prior(NADIR))
    assert px_off(result, NADIR) < 3.0
    assert abs(result.attitude.heading_deg - 40.0) < 1.5


@pytest.mark.parametrize("heading_deg", [36.0, 40.0, 44.0])
def test_no_heading_makes_another_place_look_right(ground, camera, heading_deg):
    frame = ground.frame(camera, NADIR, 150.0, heading_deg=40.0)
    mirrored = replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]), heading_deg=heading_deg)
    assert isinstance(SceneMatcher(ground.site, camera, "ncc", "cpu").locate(mirrored, ground.prior(NADIR)), NoFix)
