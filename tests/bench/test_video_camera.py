"""The camera of a simulated vehicle that shows a recorded video from where the vehicle is."""

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="pymavlink is not installed")

from bench.live.flights.video_camera import SIZE, Footage, ground_from_pixel, recorded_from_shown
from bench.live.standin import State
from tests.bench.test_recorded_flights import video

FRAME, FOCAL_PX = (852, 480), 680.0
TAKEN = State(10.0, -20.0, 170.0, 0.0, 0.0, 104.0, 0.0, 0.0)
MARGIN = np.array([(FRAME[0] - SIZE[0]) / 2.0, (FRAME[1] - SIZE[1]) / 2.0])


def moved(forward_m: float, right_m: float) -> State:
    """The vehicle so far from where the frame was taken."""
    heading = math.radians(TAKEN.heading_deg)
    east_m = forward_m * math.sin(heading) + right_m * math.cos(heading)
    north_m = forward_m * math.cos(heading) - right_m * math.sin(heading)
    return replace(TAKEN, east_m=TAKEN.east_m + east_m, north_m=TAKEN.north_m + north_m)


def test_where_the_frame_was_taken_its_middle_is_shown():
    warp = recorded_from_shown(TAKEN, FRAME, TAKEN, FOCAL_PX)
    assert np.allclose(warp, np.column_stack([np.eye(2), MARGIN]), atol=1e-9)


def test_forward_is_up_and_right_is_right():
    metre_px = FOCAL_PX / TAKEN.height_m
    warp = recorded_from_shown(TAKEN, FRAME, moved(5.0, 3.0), FOCAL_PX)
    assert np.allclose(warp[:, 2] - MARGIN, [3.0 * metre_px, -5.0 * metre_px], atol=1e-9)


def test_a_pixel_is_on_the_same_ground_in_both_pictures():
    vehicle = replace(moved(-4.0, 2.0), height_m=181.0, heading_deg=97.0)
    warp = recorded_from_shown(TAKEN, FRAME, vehicle, FOCAL_PX)
    for pixel in ((0.0, 0.0, 1.0), (639.0, 399.0, 1.0), (100.0, 300.0, 1.0)):
        on_ground = ground_from_pixel(vehicle, SIZE, FOCAL_PX) @ pixel
        recorded = warp @ pixel
        assert np.allclose(ground_from_pixel(TAKEN, FRAME, FOCAL_PX) @ [*recorded, 1.0], on_ground, atol=1e-9)


def test_the_picture_is_of_the_frame_that_was_taken_nearest(tmp_path):
    """Frames of one shade each, 0.36 m apart due north: the shade tells the frame."""
    path = video(tmp_path, "[gb_yaw: 0.0 gb_pitch: -90.0 gb_roll: 0.0]", FRAME, shade=3)
    footage = Footage(path, 64.1, every=5)
    for index in (0, 7, 14):
        shade = footage.picture(footage.states[index]).mean()
        assert shade == pytest.approx(15 * index, abs=4)
    assert footage.hfov_deg == pytest.approx(50.4, abs=0.1)
