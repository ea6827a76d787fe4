"""The simulated flight: geometry against engine.geo and engine.camera, the town, the vehicle, the sensors."""

import itertools

import cv2
import numpy as np
import pytest

from engine.geo import enu_from_body
from engine.values import Attitude
from scenematch.simulator import FlightStyle, SensorNoise, World, plan_flight, render_frame
from scenematch.simulator.light import LIGHTS, sun_visibility
from scenematch.simulator.vehicle import COURSE_STEP_S, fly_waypoints, leg_accelerations
from tests.support.patches import CAMERA, ORIGIN, TO_GRID, patch_world
from tests.support.towns import drawn_town, under_map


def test_buildings_stand_up_and_hide_what_is_behind():
    world = patch_world(760, 600, 20.0)  # 40 m east of the camera: its western wall faces the lens
    image = render_frame(world, CAMERA, ORIGIN, 150.0, Attitude(0.0, 0.0, 0.0))
    wall = (image[..., 0].astype(int) - image[..., 1]) > 12
    assert wall.sum() > 150
    columns = np.flatnonzero(wall.any(axis=0))
    ends = [259.8 * (32.5 - 0.125) / depth + 149.5 for depth in (150.0, 130.0)]
    assert [columns.min(), columns.max()] == pytest.approx(ends, abs=1.5)


def test_supersampling_and_a_rotated_raster_do_not_move_the_picture(sim_town):
    where = tuple(sim_town.pixel_to_crs @ (450.0, 500.0, 1.0))
    attitude = Attitude(3.0, -4.0, 110.0)
    coarse, fine = (render_frame(sim_town.world, CAMERA, where, 150.0, attitude, supersample=n) for n in (1, 3))
    world = sim_town.world
    rasters = (np.ascontiguousarray(raster[::-1, ::-1]) for raster in (world.rgb, world.sides, world.height_m))
    last_y, last_x = np.array(world.height_m.shape) - 1
    turn = np.array([[-1.0, 0.0, last_x], [0.0, -1.0, last_y], [0.0, 0.0, 1.0]])
    flipped = World(*rasters, world.pixel_to_crs @ turn, world.crs_epsg)
    turned = render_frame(flipped, CAMERA, where, 150.0, attitude, supersample=3)
    assert np.abs(turned.astype(int) - fine).mean() < 1.0
    shift, response = cv2.phaseCorrelate(coarse[..., 1].astype(np.float64), fine[..., 1].astype(np.float64))
    assert np.hypot(*shift) < 0.1
    assert response > 0.5


def test_shadows_fall_away_from_the_sun_and_have_the_right_length():
    heights = np.zeros((400, 400), np.float32)
    heights[190:211, 190:211] = 10.0
    for light in LIGHTS.values():
        dark = np.argwhere(sun_visibility(heights, 0.5, light) < 0.5)[:, ::-1] - 200.0
        east, down, up = light.towards_sun
        along = -(dark @ (east, down)) / np.hypot(east, down) * 0.5
        assert along.max() == pytest.approx(10.0 * np.hypot(east, down) / up + 5.0, abs=3.0)
        assert along.min() > -8.0


def test_a_town_has_buildings_ground_and_colour(sim_town):
    assert sim_town.ortho.shape[:2] == sim_town.surface_m.shape == (1000, 900)
    assert sim_town.surface_m.min() == 0.0
    assert 18.0 < sim_town.surface_m.max() < 40.0
    assert 0.1 < np.mean(sim_town.surface_m > 3.0) < 0.5
    assert sim_town.ortho.std(axis=(0, 1)).min() > 25.0
    assert sim_town.world.gsd_m_per_px == pytest.approx(0.265)
    fine = under_map(sim_town, sim_town.world.height_m)
    np.testing.assert_allclose(fine.mean(axis=(1, 3)), sim_town.surface_m, atol=1e-3)


def test_another_seed_gives_another_town(sim_town):
    assert np.abs(sim_town.ortho.astype(int) - drawn_town(7).ortho).mean() > 20


def test_a_flight_is_complete_and_repeatable(sim_flight, sim_town):
    assert len(sim_flight.frames) == len(sim_flight.truth) == 24
    assert [f.timestamp_ns for f in sim_flight.frames] == [t.timestamp_ns for t in sim_flight.truth]
    assert sim_flight.frames[0].timestamp_ns == 1_000_000_000
    assert all(a.timestamp_ns < b.timestamp_ns for a, b in itertools.pairwise(sim_flight.frames))
    frame, truth = sim_flight.frames[3], sim_flight.truth[3]
    assert frame.image.shape == (300, 300, 3)
    assert abs(frame.height_agl_m - truth.height_agl_m) < 5.0
    assert truth.alt_amsl_m - truth.height_agl_m == pytest.approx(155.0)
    again = next(plan_flight(1, town=sim_town, frames=3).iter_frames())
    assert again.image.tobytes() == sim_flight.frames[0].image.tobytes()
    assert again.heading_deg == sim_flight.frames[0].heading_deg
    assert plan_flight(2, town=sim_town, frames=3).telemetry.heading_deg[0] != sim_flight.frames[0].heading_deg


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_whole_flight_is_the_papers(sim_town, seed):
    plan = plan_flight(seed, town=sim_town)
    motion = plan.truth
    assert 140 <= len(plan) <= 165
    assert 6.0 <= np.hypot(motion.roll_deg, motion.pitch_deg).max() <= 7.5
    speed = np.hypot(motion.velocity_mps[:, 0], motion.velocity_mps[:, 1])
    assert speed[0] < 0.5
    assert 6.5 < speed[speed > 0.5].mean() < 7.6
    assert np.abs(motion.position_m[:, 2] - 150.0).max() < 2.5
    assert np.sum(np.abs((np.diff(motion.heading_deg) + 180.0) % 360.0 - 180.0)) > 250.0
    edges = np.array([-0.5, 299.5])
    corners = np.vstack([*(axis.ravel() for axis in np.meshgrid(edges, edges)), np.ones(4)])
    rays = np.linalg.inv(CAMERA.matrix) @ corners
    for k in range(len(plan)):
        rotation = enu_from_body(motion.roll_deg[k], motion.pitch_deg[k], motion.heading_deg[k])
        ground = rotation @ CAMERA.mount @ rays
        place, height_m = motion.position_m[k, :2], motion.position_m[k, 2]
        reach = TO_GRID @ (place[:, None] - ground[:2] / ground[2] * height_m)
        # The map ends 238.5 m to the east and west, 265 m to the north and south.
        assert (np.abs(reach).max(axis=1) < (238.5 - 15.0, 265.0 - 15.0)).all()


def test_a_leg_ends_where_it_should_and_at_rest():
    style = FlightStyle()
    for length in (3.0, 40.0, 250.0):
        push = leg_accelerations(length, style)
        speed = np.cumsum(push) * COURSE_STEP_S
        assert abs(speed[-1]) < 0.02
        assert speed.max() <= style.cruise_mps + 0.02
        assert np.sum(speed) * COURSE_STEP_S == pytest.approx(length, abs=0.3)
        assert np.abs(np.diff(push)).max() <= style.acceleration_mps2 / style.ramp_s * COURSE_STEP_S * 2.001


def test_the_nose_dips_to_speed_up_and_points_along_the_leg():
    motion = fly_waypoints(np.array([[0.0, 0.0], [200.0, 0.0]]), FlightStyle(), np.random.default_rng(3))
    speeding, braking = motion.at(np.array([8.0])), motion.at(np.array([motion.time_s[-1] - 8.0]))
    assert -7.2 < speeding.pitch_deg[0] < -4.0
    assert 4.0 < braking.pitch_deg[0] < 7.2
    assert speeding.heading_deg[0] == pytest.approx(90.0, abs=2.0)
    np.testing.assert_allclose(motion.position_m[-1, :2], (200.0, 0.0), atol=1.5)
    steps_m = np.diff(motion.position_m, axis=0)[100:-1]
    np.testing.assert_allclose(steps_m / COURSE_STEP_S, motion.velocity_mps[100:-2], atol=0.05)


def test_telemetry_errs_as_documented(sim_town):
    plan = plan_flight(1, town=sim_town, rate_hz=8.0)
    truth, stated = plan.truth, plan.telemetry
    heading = (stated.heading_deg - truth.heading_deg + 180.0) % 360.0 - 180.0
    assert heading.mean() == pytest.approx(0.4, abs=0.08)
    assert heading.std() == pytest.approx(0.7, rel=0.1)
    assert (stated.roll_deg - truth.roll_deg).std() == pytest.approx(0.35, rel=0.1)
    assert (stated.pitch_deg - truth.pitch_deg).std() == pytest.approx(0.35, rel=0.1)
    assert (stated.velocity_mps - truth.velocity_mps)[:, :2].std() == pytest.approx(0.2, rel=0.1)
    height = stated.position_m[:, 2] - truth.position_m[:, 2]
    assert np.diff(height).std() == pytest.approx(0.7 * np.sqrt(2), rel=0.1)
    assert 0.6 < height.std() < 1.3
    perfect = dict.fromkeys(SensorNoise.__dataclass_fields__, 0.0)
    exact = plan_flight(1, town=sim_town, frames=20, noise=SensorNoise(**perfect))
    np.testing.assert_array_equal(exact.telemetry.position_m, exact.truth.position_m)
    np.testing.assert_allclose(exact.telemetry.heading_deg, exact.truth.heading_deg)
