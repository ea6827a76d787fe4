"""The simulated flight: geometry against engine.geo and engine.camera, the town, the vehicle, the sensors."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from pyproj import Proj

from engine.camera import Camera
from engine.errors import OptionError, ShapeError
from engine.geo import enu_from_body
from engine.values import Attitude
from scenematch.simulator import (
    FlightStyle,
    SensorNoise,
    World,
    build_town,
    plan_flight,
    render_frame,
)
from scenematch.simulator.light import LIGHTS, sun_visibility
from scenematch.simulator.render import grid_from_enu, transformer
from scenematch.simulator.vehicle import COURSE_STEP_S, fly_waypoints, leg_accelerations
from tests.support.patches import CAMERA, EPSG, ORIGIN, TO_CRS, centre_of_bright, patch_world, project
from tests.support.towns import drawn_town


@pytest.fixture(scope="module")
def town():
    return drawn_town(1)


@pytest.fixture(scope="module")
def flight(town):
    return plan_flight(1, town=town, frames=12).draw()


@pytest.mark.parametrize("height", [0.0, 12.3, 25.0])
@pytest.mark.parametrize(
    "attitude",
    [
        Attitude(0.0, 0.0, 0.0),
        Attitude(0.0, 0.0, 90.0),
        Attitude(6.0, 0.0, 0.0),
        Attitude(0.0, -6.0, 0.0),
        Attitude(5.0, -4.0, 37.0),
        Attitude(-6.5, 3.0, 251.0),
    ],
)
def test_a_patch_appears_where_geo_and_camera_put_it(attitude, height):
    x, y = 700, 480
    world = patch_world(x, y, height)
    position = np.array([ORIGIN[0] + 6.3, ORIGIN[1] - 11.7])
    grid = TO_CRS @ (x, y, 1.0)
    seen = render_frame(world, CAMERA, tuple(position), 150.0, attitude)
    expected = project(CAMERA, grid, height, position, 150.0, attitude)
    # The centroid of a square in perspective lies near its centre's picture: half a per cent of its size.
    np.testing.assert_allclose(centre_of_bright(seen), expected, atol=0.2)


def test_the_picture_moves_as_a_pilot_expects():
    world = patch_world(600, 600, 0.0)
    level = centre_of_bright(render_frame(world, CAMERA, ORIGIN, 150.0, Attitude(0.0, 0.0, 0.0)))
    north = render_frame(world, CAMERA, (ORIGIN[0], ORIGIN[1] - 30.0), 150.0, Attitude(0.0, 0.0, 0.0))
    assert centre_of_bright(north)[1] < level[1] - 40  # a place ahead lies in the upper half
    nose_up = centre_of_bright(render_frame(world, CAMERA, ORIGIN, 150.0, Attitude(0.0, 5.0, 0.0)))
    assert nose_up[1] == pytest.approx(level[1] + 259.8 * np.tan(np.radians(5.0)), abs=0.3)
    right_down = centre_of_bright(render_frame(world, CAMERA, ORIGIN, 150.0, Attitude(5.0, 0.0, 0.0)))
    assert right_down[0] == pytest.approx(level[0] + 259.8 * np.tan(np.radians(5.0)), abs=0.3)


def test_buildings_stand_up_and_hide_what_is_behind():
    world = patch_world(760, 600, 20.0)  # 40 m east of the camera: its western wall faces the lens
    image = render_frame(world, CAMERA, ORIGIN, 150.0, Attitude(0.0, 0.0, 0.0))
    wall = (image[..., 0].astype(int) - image[..., 1]) > 12
    assert wall.sum() > 150
    columns = np.flatnonzero(wall.any(axis=0))
    near, far = (259.8 * (32.5 - 0.125) / depth + 149.5 for depth in (150.0, 130.0))
    assert columns.min() == pytest.approx(near, abs=1.5)
    assert columns.max() == pytest.approx(far, abs=1.5)


def test_supersampling_and_a_rotated_raster_do_not_move_the_picture(town):
    where = tuple(town.pixel_to_crs @ (450.0, 500.0, 1.0))
    attitude = Attitude(3.0, -4.0, 110.0)
    coarse, fine = (render_frame(town.world, CAMERA, where, 150.0, attitude, supersample=n) for n in (1, 3))
    half = town.world
    flipped = World(
        np.ascontiguousarray(half.rgb[::-1, ::-1]),
        np.ascontiguousarray(half.sides[::-1, ::-1]),
        np.ascontiguousarray(half.height_m[::-1, ::-1]),
        half.pixel_to_crs
        @ np.array([[-1, 0, half.rgb.shape[1] - 1], [0, -1, half.rgb.shape[0] - 1], [0, 0, 1.0]]),
        half.crs_epsg,
    )
    turned = render_frame(flipped, CAMERA, where, 150.0, attitude, supersample=3)
    assert np.abs(turned.astype(int) - fine).mean() < 1.0
    shift, response = cv2.phaseCorrelate(coarse[..., 1].astype(np.float64), fine[..., 1].astype(np.float64))
    assert np.hypot(*shift) < 0.1
    assert response > 0.5


def test_the_grid_is_turned_by_the_projections_convergence():
    factors = Proj(EPSG).get_factors(16.45, 48.25)
    jacobian = grid_from_enu(EPSG, ORIGIN)
    assert factors.meridian_convergence == pytest.approx(1.08, abs=0.02)
    # East of the central meridian true north leans to the left of grid north.
    north = jacobian @ (0.0, 1.0)
    assert np.degrees(np.arctan2(-north[0], north[1])) == pytest.approx(factors.meridian_convergence, abs=1e-4)
    assert np.sqrt(np.linalg.det(jacobian)) == pytest.approx(factors.meridional_scale, abs=1e-7)


def test_shadows_fall_away_from_the_sun_and_have_the_right_length():
    heights = np.zeros((400, 400), np.float32)
    heights[190:211, 190:211] = 10.0
    for light in LIGHTS.values():
        dark = np.argwhere(sun_visibility(heights, 0.5, light) < 0.5)[:, ::-1] - 200.0
        east, down, up = light.towards_sun
        along = -(dark @ (east, down)) / np.hypot(east, down) * 0.5
        length = 10.0 * np.hypot(east, down) / up
        assert along.max() == pytest.approx(length + 5.0, abs=3.0)
        assert along.min() > -8.0


def test_worlds_and_views_are_checked(town):
    world = patch_world(600, 600, 30.0)
    with pytest.raises(ShapeError, match="world: expected"):
        World(world.rgb[1:], world.sides, world.height_m, TO_CRS, EPSG)
    with pytest.raises(ShapeError, match="pixel_to_crs"):
        World(world.rgb, world.sides, world.height_m, TO_CRS[:, :2], EPSG)
    level = Attitude(0.0, 0.0, 0.0)
    with pytest.raises(OptionError, match="height_agl_m: expected above the highest"):
        render_frame(world, CAMERA, ORIGIN, 25.0, level)
    with pytest.raises(OptionError, match="attitude"):
        render_frame(world, CAMERA, ORIGIN, 150.0, Attitude(0.0, 76.0, 0.0))
    bent = Camera(300, 300, CAMERA.matrix, distortion=np.array([0.1, 0, 0, 0, 0]))
    with pytest.raises(OptionError, match="camera: expected a pinhole"):
        render_frame(world, bent, ORIGIN, 150.0, level)
    flat = World(world.rgb, world.sides, np.zeros_like(world.height_m), TO_CRS, EPSG)
    assert render_frame(flat, CAMERA, ORIGIN, 150.0, level).shape == (300, 300, 3)


def test_a_town_has_buildings_ground_and_colour(town):
    assert town.ortho.shape == (1000, 900, 3)
    assert town.ortho.dtype == np.uint8
    assert town.surface_m.shape == (1000, 900)
    assert town.surface_m.dtype == np.float32
    assert town.surface_m.min() == 0.0
    assert 18.0 < town.surface_m.max() < 40.0
    assert 0.1 < np.mean(town.surface_m > 3.0) < 0.5
    assert town.ortho.std(axis=(0, 1)).min() > 25.0
    assert town.world.gsd_m_per_px == pytest.approx(0.265)
    # Both rasters lie over each other: the middle of the map's first pixel is the corner of four fine ones.
    corner = np.linalg.inv(town.world.pixel_to_crs[:, :2]) @ (
        town.pixel_to_crs[:, 2] - town.world.pixel_to_crs[:, 2]
    )
    np.testing.assert_allclose(corner % 1.0, 0.5, atol=1e-5)
    x, y = np.floor(corner).astype(int)
    fine = town.world.height_m[y : y + 2000, x : x + 1800]
    np.testing.assert_allclose(fine.reshape(1000, 2, 900, 2).mean(axis=(1, 3)), town.surface_m, atol=1e-3)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_another_another_town():
    small = {"width_px": 300, "height_px": 280}
    one, again, other = (build_town(seed, **small) for seed in (5, 5, 6))
    for name in ("ortho", "surface_m"):
        assert getattr(one, name).tobytes() == getattr(again, name).tobytes()
    assert one.world.rgb.tobytes() == again.world.rgb.tobytes()
    assert np.abs(one.ortho.astype(int) - other.ortho).mean() > 20
    evening = build_town(5, **small, condition="evening")
    assert evening.ortho.tobytes() == one.ortho.tobytes()
    assert evening.world.rgb.mean() < 0.75 * one.world.rgb.mean()
    with pytest.raises(OptionError, match="condition: expected one of noon, evening"):
        build_town(condition="night")
    with pytest.raises(OptionError, match="town: expected 16 px"):
        build_town(width_px=8)


def test_frames_match_the_map_where_they_were_taken_and_nowhere_near(flight):
    town = flight.town
    frame, truth = flight.frames[0], flight.truth[0]
    x, y = transformer(town.crs_epsg).transform(truth.lon_deg, truth.lat_deg)
    nadir = np.linalg.inv(town.pixel_to_crs[:, :2]) @ (np.array([x, y]) - town.pixel_to_crs[:, 2])
    scale = truth.height_agl_m / CAMERA.focal_px / town.gsd_m_per_px
    convergence = Proj(town.crs_epsg).get_factors(truth.lon_deg, truth.lat_deg).meridian_convergence
    turn = np.radians(truth.heading_deg - convergence)
    forward, right = np.array([np.sin(turn), -np.cos(turn)]), np.array([np.cos(turn), np.sin(turn)])
    linear = scale * np.column_stack([right, -forward])
    # The level part of the picture's middle, brought to the map; the little tilt of the hover is left out.
    to_map = np.column_stack([linear, nadir - linear @ (149.5, 149.5)])
    grey = cv2.cvtColor(np.asarray(frame.image), cv2.COLOR_RGB2GRAY)
    aligned = cv2.warpAffine(grey, to_map, (900, 1000), borderValue=0)
    x0, y0 = np.rint(nadir).astype(int) - 100
    template = aligned[y0 : y0 + 200, x0 : x0 + 200]
    scores = cv2.matchTemplate(cv2.cvtColor(town.ortho, cv2.COLOR_RGB2GRAY), template, cv2.TM_CCOEFF_NORMED)
    _, best, _, place = cv2.minMaxLoc(scores)
    assert best > 0.5
    np.testing.assert_allclose(place, (x0, y0), atol=6.0)
    scores[place[1] - 20 : place[1] + 21, place[0] - 20 : place[0] + 21] = -1.0
    assert scores.max() < best - 0.2


def test_a_flight_is_complete_and_repeatable(flight, town):
    assert len(flight.frames) == len(flight.truth) == 12
    assert [f.timestamp_ns for f in flight.frames] == [t.timestamp_ns for t in flight.truth]
    assert flight.frames[0].timestamp_ns == 1_000_000_000
    assert all(a.timestamp_ns < b.timestamp_ns for a, b in itertools.pairwise(flight.frames))
    frame, truth = flight.frames[3], flight.truth[3]
    assert frame.image.shape == (300, 300, 3)
    assert abs(frame.height_agl_m - truth.height_agl_m) < 5.0
    assert truth.alt_amsl_m - truth.height_agl_m == pytest.approx(155.0)
    again = next(plan_flight(1, town=town, frames=3).iter_frames())
    assert again.image.tobytes() == flight.frames[0].image.tobytes()
    assert again.heading_deg == flight.frames[0].heading_deg
    other = plan_flight(2, town=town, frames=3)
    assert other.telemetry.heading_deg[0] != flight.frames[0].heading_deg


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_whole_flight_is_the_papers(town, seed):
    plan = plan_flight(seed, town=town)
    motion = plan.truth
    assert 140 <= len(plan) <= 165
    tilt = np.hypot(motion.roll_deg, motion.pitch_deg)
    assert 6.0 <= tilt.max() <= 7.5
    speed = np.hypot(motion.velocity_mps[:, 0], motion.velocity_mps[:, 1])
    assert speed[0] < 0.5
    assert 6.5 < speed[speed > 0.5].mean() < 7.6
    assert np.abs(motion.position_m[:, 2] - 150.0).max() < 2.5
    turns = np.abs((np.diff(motion.heading_deg) + 180.0) % 360.0 - 180.0)
    assert np.sum(turns) > 250.0
    east, north = np.array([-1.0, 1.0]) * 238.5, np.array([-1.0, 1.0]) * 265.0
    edges = np.array([-0.5, 299.5])
    corners = np.vstack([*(axis.ravel() for axis in np.meshgrid(edges, edges)), np.ones(4)])
    rays = np.linalg.inv(CAMERA.matrix) @ corners
    for k in range(len(plan)):
        rotation = enu_from_body(motion.roll_deg[k], motion.pitch_deg[k], motion.heading_deg[k] - 1.08)
        ground = rotation @ CAMERA.mount @ rays
        turn = np.radians(1.08)
        place = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ motion.position_m[k, :2]
        reach = place[:, None] - ground[:2] / ground[2] * motion.position_m[k, 2]
        assert reach[0].min() > east[0] + 15.0
        assert reach[0].max() < east[1] - 15.0
        assert reach[1].min() > north[0] + 15.0
        assert reach[1].max() < north[1] - 15.0


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
    np.testing.assert_allclose(
        np.diff(motion.position_m, axis=0)[100:-1] / COURSE_STEP_S, motion.velocity_mps[100:-2], atol=0.05
    )


def test_telemetry_errs_as_documented(town):
    plan = plan_flight(1, town=town, rate_hz=8.0)
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
    exact = plan_flight(1, town=town, frames=20, noise=SensorNoise(**perfect))
    np.testing.assert_array_equal(exact.telemetry.position_m, exact.truth.position_m)
    np.testing.assert_allclose(exact.telemetry.heading_deg, exact.truth.heading_deg)


def test_options_are_refused_by_name(town):
    with pytest.raises(OptionError, match="tilt_sd_deg: expected 0 or more, got -1"):
        SensorNoise(tilt_sd_deg=-1.0)
    with pytest.raises(OptionError, match="height_sd_m"):
        SensorNoise(height_sd_m=float("nan"))
    with pytest.raises(OptionError, match="cruise_mps: expected a number above 0"):
        FlightStyle(cruise_mps=0.0)
    with pytest.raises(OptionError, match="peak_tilt_deg"):
        FlightStyle(acceleration_mps2=2.0)
    with pytest.raises(OptionError, match="frames"):
        plan_flight(town=town, frames=0)
    with pytest.raises(OptionError, match="seed: expected 0 or more, got -1"):
        build_town(-1)
    with pytest.raises(OptionError, match="rate_hz"):
        plan_flight(town=town, rate_hz=0.0)
    with pytest.raises(OptionError, match="town: expected a map larger"):
        plan_flight(town=town, style=FlightStyle(height_agl_m=400.0))
