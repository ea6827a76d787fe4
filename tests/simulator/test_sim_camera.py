"""The simulated camera: lens, exposure and obliquity against what optics and geometry say."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from engine import Attitude, Camera
from scenematch.runs.simulation import WorldSettings
from scenematch.simulator import Town, World, plan_flight, render_frame
from scenematch.simulator.flight import DRONE_SENSOR, paper_camera
from scenematch.simulator.optics import Sensor, through_lens
from scenematch.simulator.rays import FAR_DEG
from scenematch.simulator.render import SKY_RGB
from tests.support import patches
from tests.support.patches import CAMERA, ORIGIN, TO_CRS, centre_of_bright, patch_world, project

LEVEL = Attitude(0.0, 0.0, 0.0)
IDEAL = Sensor(
    gamma=1.0, balance_rgb=(1.0, 1.0, 1.0), haze=0.0, vignette=0.0, exposure_sd=0.0, blur_px=0.1, noise_sd=0.0
)
BARREL = Camera(300, 300, CAMERA.matrix, "plumb_bob", np.array([-0.28, 0.09, 0.001, -0.0008, -0.01]))
FISHEYE = Camera(300, 300, CAMERA.matrix, "equidistant", np.array([0.03, -0.012, 0.004, -0.001]))


def snap(world, camera=CAMERA, moments=(), attitude=LEVEL, sensor=IDEAL, grid=ORIGIN):
    return sensor.develop(through_lens(world, camera, grid, 150.0, attitude, moments), np.random.default_rng(1))


def test_an_ideal_camera_changes_nothing(sim_town):
    where, attitude = tuple(sim_town.pixel_to_crs @ (350.0, 350.0, 1.0)), Attitude(3.0, -4.0, 110.0)
    seen = render_frame(sim_town.world, CAMERA, where, 150.0, attitude)
    expected = DRONE_SENSOR.develop(seen, np.random.default_rng(1)).tobytes()
    assert snap(sim_town.world, CAMERA, (), attitude, DRONE_SENSOR, where).tobytes() == expected


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


# ------------------------------------------------------------------------------------------------- oblique cameras


def off_by(metres_north: float, metres_east: float = 0.0) -> np.ndarray:
    """Grid position so far from the world's middle."""
    return np.array([ORIGIN[0] + metres_east, ORIGIN[1] + metres_north])


def centre_near(seen: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Of the bright patch about a place; the sky is bright too."""
    x, y = np.rint(place).astype(int)
    return centre_of_bright(seen[y - 15 : y + 16, x - 15 : x + 16]) + np.array([x - 15, y - 15])


@pytest.mark.parametrize("attitude", [LEVEL, Attitude(5.0, -4.0, 37.0), Attitude(-6.5, 3.0, 251.0)])
@pytest.mark.parametrize(
    ("pitch", "slope"),
    [(-90.0, 0.08), (-90.0, -0.15), (-60.0, 0.15), (-45.0, 0.0), (-45.0, -0.15), (-30.0, 0.08)],
)
def test_a_patch_on_a_hillside_appears_where_geo_and_camera_put_it(pitch, slope, attitude):
    flat, (x, y) = patch_world(600, 600, 0.0), (600, 600)
    ground = (45.0 + slope * patches.GSD * (np.arange(patches.SIZE) - x)).astype(np.float32)
    ground = np.ascontiguousarray(np.broadcast_to(np.maximum(ground, 0.0), (patches.SIZE, patches.SIZE)))
    world = World(flat.rgb, flat.sides, ground, TO_CRS, patches.EPSG, ground_m=ground)
    camera, grid = paper_camera(pitch), TO_CRS @ (x, y, 1.0)
    ahead = 80.0 / np.tan(np.radians(-pitch))  # the patch lies in the frame, and not below the vehicle
    turn = np.radians(attitude.heading_deg)
    position = off_by(15.0 - ahead * np.cos(turn), -20.0 - ahead * np.sin(turn))
    seen = render_frame(world, camera, tuple(position), 125.0, attitude, supersample=1)
    expected = project(camera, grid, 45.0, position, 125.0, attitude)
    np.testing.assert_allclose(centre_near(seen, expected), expected, atol=0.25)
    assert world.ground_at(tuple(grid)) == pytest.approx(45.0)


def test_a_house_hides_what_is_behind_it():
    world, camera = patch_world(600, 600, 20.0), paper_camera(-30.0)
    behind = replace(world, rgb=world.rgb.copy())
    behind.rgb[500:560, 590:610] = (250, 0, 0)  # north of the box, 2 to 17 m behind its wall of 20 m
    for side, hidden in ((-100.0, True), (100.0, False)):
        heading = 0.0 if side < 0 else 180.0
        seen = render_frame(behind, camera, tuple(off_by(side)), 60.0, Attitude(0.0, 0.0, heading))
        red = ((seen[..., 0] > 150) & (seen[..., 2] < 60)).sum()
        assert (red < 60) == hidden, red


def test_beyond_the_far_field_there_is_only_sky():
    camera = paper_camera(-20.0)  # 70 degrees off the vertical: the horizon is in the picture
    seen = render_frame(patch_world(600, 600, 0.0), camera, ORIGIN, 100.0, LEVEL, supersample=1)
    rows = np.arange(camera.height_px)
    angle = 70.0 - np.degrees(np.arctan((rows - 149.5) / camera.focal_px))  # of the middle column
    sky = (np.abs(seen[:, 150] - np.array(SKY_RGB)) <= 1.0).all(axis=1)
    np.testing.assert_array_equal(sky[angle > FAR_DEG + 0.5], True)
    np.testing.assert_array_equal(sky[angle < FAR_DEG - 0.5], False)


def test_a_world_continues_mirrored():
    world, camera = patch_world(600, 60, 0.0), paper_camera(-45.0)
    beyond = TO_CRS @ (600, -61, 1.0)  # as far beyond the northern edge as the patch is from it
    position = beyond - (0.0, 100.0)
    seen = render_frame(world, camera, tuple(position), 100.0, LEVEL, supersample=1)
    expected = project(camera, beyond, 0.0, position, 100.0, LEVEL)
    np.testing.assert_allclose(centre_near(seen, expected), expected, atol=0.25)


@pytest.mark.parametrize("pitch", [-60.0, -45.0])
def test_a_flight_keeps_what_it_looks_at_on_the_map_and_its_truth_is_the_vehicles(pitch):
    blank, half = np.zeros((700, 700), np.float32), 350.0
    to_crs = np.array([[1.0, 0.0, ORIGIN[0] - half], [0.0, -1.0, ORIGIN[1] + half]])
    town = Town(np.zeros((700, 700, 3), np.uint8), blank, to_crs, patches.EPSG, 1.0, patch_world(600, 600, 0.0))
    plan = plan_flight(3, town=town, camera=paper_camera(pitch), rate_hz=0.3)
    heading = np.radians(plan.truth.heading_deg)
    ahead = 150.0 / np.tan(np.radians(-pitch)) * np.column_stack([np.sin(heading), np.cos(heading)])
    assert np.abs(plan.truth.position_m[:, :2] + ahead).max() < half
    east, north = plan.origin.enu_from_geodetic(plan.truth_rows()[5].lat_deg, plan.truth_rows()[5].lon_deg)
    np.testing.assert_allclose((east, north), plan.truth.position_m[5, :2], atol=0.01)


def test_a_simulation_has_the_camera_of_its_pitch():
    assert WorldSettings(camera_pitch_deg=-45.0).camera().mount.tolist() == paper_camera(-45.0).mount.tolist()
