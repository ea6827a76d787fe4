"""The simulated camera: motion, shutter, lens and exposure against what optics says of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from engine.camera import Camera
from engine.values import Attitude
from scenematch.simulator import ExposureMotion, FlightStyle, Optics, plan_flight, render_frame, take_picture
from scenematch.simulator.flight import DRONE_SENSOR
from scenematch.simulator.optics import Sensor
from tests.support.patches import CAMERA, ORIGIN, TO_CRS, TO_GRID, centre_of_bright, patch_world, project

LEVEL = Attitude(0.0, 0.0, 0.0)
IDEAL = Sensor(
    gamma=1.0, balance_rgb=(1.0, 1.0, 1.0), haze=0.0, vignette=0.0, exposure_sd=0.0, blur_px=0.1, noise_sd=0.0
)
BARREL = Camera(300, 300, CAMERA.matrix, "plumb_bob", np.array([-0.28, 0.09, 0.001, -0.0008, -0.01]))
FISHEYE = Camera(300, 300, CAMERA.matrix, "equidistant", np.array([0.03, -0.012, 0.004, -0.001]))


def snap(world, camera=CAMERA, optics=None, sway=None, attitude=LEVEL, sensor=IDEAL, grid=ORIGIN):
    rng = np.random.default_rng(1)
    return take_picture(world, camera, grid, 150.0, attitude, rng, sensor=sensor, optics=optics, sway=sway)


def spread(image: np.ndarray) -> np.ndarray:
    """Variance in x and y of a bright patch, in square pixels."""
    weight = np.clip(image[..., 1].astype(float) - 40.5, 0.0, None)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([np.average((v - np.average(v, weights=weight)) ** 2, weights=weight) for v in (x, y)])


def test_an_ideal_camera_changes_nothing(sim_town):
    where, attitude = tuple(sim_town.pixel_to_crs @ (350.0, 350.0, 1.0)), Attitude(3.0, -4.0, 110.0)
    seen = render_frame(sim_town.world, CAMERA, where, 150.0, attitude)
    expected = DRONE_SENSOR.develop(seen, np.random.default_rng(1)).tobytes()
    fast = ExposureMotion((8.0, 3.0, 0.0), (5.0, 5.0, 5.0))
    for optics, sway in ((None, None), (Optics(), None), (Optics(), fast), (Optics(exposure_ms=8.0), None)):
        assert snap(sim_town.world, CAMERA, optics, sway, attitude, DRONE_SENSOR, where).tobytes() == expected


def test_motion_blur_is_as_long_as_the_way_flown():
    world = patch_world(600, 600, 0.0)
    sharp, optics = snap(world), Optics(exposure_ms=50.0, exposure_samples=15)
    blurred = snap(world, optics=optics, sway=ExposureMotion((50.0, 0.0, 0.0)))  # 2.5 m east: 4.33 px
    np.testing.assert_allclose(centre_of_bright(blurred), centre_of_bright(sharp), atol=0.05)
    length = 259.81 * 2.5 / 150.0
    np.testing.assert_allclose(spread(blurred) - spread(sharp), (length**2 / 12.0, 0.0), atol=0.3)
    turned = snap(world, optics=optics, sway=ExposureMotion(turn_dps=(0.0, 20.0, 0.0)))  # nose up by 1 degree
    length = 259.81 * np.radians(1.0)
    np.testing.assert_allclose(spread(turned) - spread(sharp), (0.0, length**2 / 12.0), atol=0.35)


@pytest.mark.parametrize("row", [320, 880])
def test_each_row_of_a_rolling_shutter_is_seen_from_where_the_camera_then_is(row):
    world = patch_world(600, row, 0.0)
    position = np.array([ORIGIN[0] + 6.3, ORIGIN[1] - 11.7])
    sway, optics = ExposureMotion((30.0, -20.0, 4.0), (20.0, -10.0, 40.0)), Optics(readout_ms=60.0)
    seen = centre_of_bright(snap(world, CAMERA, optics, sway, Attitude(2.0, -1.0, 5.0), grid=tuple(position)))
    after_s = (seen[1] / 299.0 - 0.5) * 0.06
    way = TO_GRID @ sway.velocity_mps[:2] * after_s  # of the camera until that moment
    then = Attitude(2.0 + 20.0 * after_s, -1.0 - 10.0 * after_s, 5.0 + 40.0 * after_s)
    grid = TO_CRS @ (600, row, 1.0)
    expected = project(CAMERA, grid, 0.0, position + way, 150.0 + 4.0 * after_s, then)
    np.testing.assert_allclose(seen, expected, atol=0.25)
    still = centre_of_bright(snap(world, CAMERA, None, sway, Attitude(2.0, -1.0, 5.0), grid=tuple(position)))
    assert np.abs(still - expected).max() > 0.8


@pytest.mark.parametrize("camera", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_a_patch_lies_where_opencv_projects_it(camera):
    for x, y in ((820, 430), (400, 740)):
        pinhole = project(CAMERA, TO_CRS @ (x, y, 1.0), 0.0, np.array(ORIGIN), 150.0, LEVEL)
        ray = np.linalg.inv(CAMERA.matrix) @ (*pinhole, 1.0)
        zero = np.zeros(3)
        project_points = cv2.fisheye.projectPoints if camera is FISHEYE else cv2.projectPoints
        bent = project_points(ray[None, None], zero, zero, camera.matrix, camera.distortion)[0].ravel()
        seen = centre_of_bright(snap(patch_world(x, y, 0.0), camera))
        np.testing.assert_allclose(seen, bent, atol=0.25)
        assert np.abs(bent - pinhole).max() > 1.0


def test_a_planned_flight_moves_while_its_shutter_is_open(sim_town):
    optics, style = Optics(exposure_ms=30.0, readout_ms=30.0), FlightStyle(height_agl_m=90.0)
    still, blurred = (plan_flight(1, town=sim_town, style=style, rate_hz=0.5, optics=o) for o in (None, optics))
    speed = np.linalg.norm([sway.velocity_mps for sway in blurred.sways], axis=1)
    np.testing.assert_allclose(speed, np.linalg.norm(blurred.truth.velocity_mps, axis=1), atol=1e-6)
    turn = np.array([sway.turn_dps for sway in blurred.sways])
    assert 1.0 < np.abs(turn).max() < 90.0
    assert [row.lat_deg for row in still.truth_rows()] == [row.lat_deg for row in blurred.truth_rows()]
    seen, stated = next(blurred.iter_frames()), next(still.iter_frames())
    assert seen.heading_deg == stated.heading_deg
    assert still.telemetry.heading_deg.tobytes() == blurred.telemetry.heading_deg.tobytes()
