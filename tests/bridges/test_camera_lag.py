"""The delay of a camera: pictures that lag behind the attitude by a known time."""

import math

import cv2
import numpy as np
import pytest

from engine.camera import mount_rotation
from scenematch.bridges.camera_lag import camera_lag, turn_between
from tests.support.refusals import refusal

FOCAL_PX = 200.0


def swing(time_s):
    """Roll and pitch in degrees of a vehicle that is tilted by hand."""
    return 8.0 * np.sin(2.3 * time_s) + 3.0 * np.sin(5.1 * time_s), 6.0 * np.sin(1.7 * time_s + 1.0)


def attitude():
    times_s = np.arange(0.0, 20.0, 0.02)
    return np.column_stack([times_s, *swing(times_s), np.full(times_s.shape, 30.0)])


def pictures(delay_s):
    """Arrival times, and turns as pictures of a far texture show them."""
    texture = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (900, 900), np.uint8), (0, 0), 3.0)
    arrivals, turns, before = np.arange(1.0, 19.0, 0.1), [], None
    for arrival_s in arrivals:
        roll, pitch = swing(arrival_s - delay_s)
        down, right = FOCAL_PX * math.tan(math.radians(pitch)), FOCAL_PX * math.tan(math.radians(roll))
        image = cv2.getRectSubPix(texture, (240, 240), (450.0 + right, 450.0 + down))
        if before is not None:
            turns.append(turn_between(before, image, FOCAL_PX))
        before = image
    return arrivals, np.array(turns)


@pytest.mark.parametrize("delay_s", [0.0, 0.035, 0.18])
def test_the_delay_is_found_to_milliseconds(delay_s):
    found = camera_lag(*pictures(delay_s), attitude(), mount_rotation("nadir"))
    assert found.delay_s == pytest.approx(delay_s, abs=0.006)
    assert found.correlation > 0.95


def test_a_vehicle_at_rest_and_another_camera_are_refused():
    (arrivals, turns), vehicle = pictures(0.1), (attitude(), mount_rotation("nadir"))
    assert "too little movement" in refusal(camera_lag, arrivals, 1e-4 * turns, *vehicle)
    other = np.random.default_rng(2).permutation(turns)
    assert "expected turns as the attitude" in refusal(camera_lag, arrivals, other, *vehicle)
    assert "30 or more" in refusal(camera_lag, arrivals[:5], turns[:4], *vehicle)
