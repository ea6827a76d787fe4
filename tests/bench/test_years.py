"""Pairs of years: no place is on both sides, and shifts are those of the map against the frame."""

import numpy as np
import pytest

from bench.accuracy.trials import ground_quad_px, picture
from bench.accuracy.years import HALVES, YEARS, places, shift
from engine import Camera


@pytest.mark.usefixtures("shared")
def test_every_place_is_in_one_half():
    fit, report = (set(places(half)) for half in HALVES)
    assert not fit & report
    assert len(fit | report) == 38
    assert abs(len(fit) - len(report)) <= 4


@pytest.mark.usefixtures("shared")
def test_a_shift_back_is_the_shift_forth_turned_round():
    for place in places("fit"):
        np.testing.assert_array_equal(shift(place, *YEARS[:2]), -shift(place, *YEARS[1::-1]))


def test_a_level_frame_that_looks_north_shows_the_map_under_its_place(ground):
    camera = Camera.from_fov(300, 300, 60.0)
    place_m = ground.site.enu_from_pixel(np.array([310.0, 305.0]))
    quad_px = ground_quad_px(ground.site, camera, place_m, 100.0, 0.0)
    np.testing.assert_allclose(quad_px.mean(axis=0), [310.0, 305.0], atol=1e-3)
    image = picture(ground.gray, ground.site, camera, place_m, 100.0, 0.0)
    scale = (quad_px[1, 0] - quad_px[0, 0]) / (camera.width_px - 1)
    x, y = np.round(quad_px[0] + 150 * scale).astype(int)
    near = ground.gray[y - 1 : y + 2, x - 1 : x + 2]
    assert near.min() <= image[150, 150] <= near.max()
