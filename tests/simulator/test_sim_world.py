"""The simulated world: conditions against their definitions, relief and water against geometry, maps as worlds."""

import dataclasses
import itertools

import cv2
import numpy as np
import pytest

from engine import Attitude, OptionError, OrthoMap
from engine.geo import enu_from_body
from scenematch.files.geotiff import write_geotiff
from scenematch.simulator import FlightStyle, SensorNoise, World, build_town, plan_flight, world_from_map
from scenematch.simulator.canvas import ASPHALT, CANOPY, GRASS
from scenematch.simulator.conditions import CONDITIONS, Condition, apply_season, condition_by_name
from scenematch.simulator.light import LIGHTS, illuminate
from scenematch.simulator.raster_world import bare_ground
from scenematch.simulator.render import Atmosphere, Glint, render_frame
from tests.support.patches import CAMERA, EPSG, GSD, ORIGIN, SIZE, TO_CRS, centre_of_bright, patch_world, project
from tests.support.towns import site_of, under_map

TINY = {"width_px": 64, "height_px": 64}
MIDDLING = {"width_px": 700, "height_px": 720}
SMALL = {"width_px": 300, "height_px": 280}
LEVEL = Attitude(0.0, 0.0, 0.0)
PERFECT = SensorNoise(**dict.fromkeys(SensorNoise.__dataclass_fields__, 0.0))


@pytest.fixture(scope="module")
def hilly():
    return build_town(3, **MIDDLING, relief_m=30.0, river=True, condition="overcast")


# ---------------------------------------------------------------------------------------------- conditions


@pytest.mark.parametrize("name", LIGHTS)
def test_a_condition_of_light_alone_is_that_light(name):
    own = Condition(light=LIGHTS[name])
    assert condition_by_name(name) == own
    assert condition_by_name(own) is own


@pytest.mark.slow
def test_the_map_and_the_frames_each_have_their_own_day():
    noon, winter = build_town(5, **SMALL), build_town(5, **SMALL, condition="winter")
    assert winter.ortho.tobytes() == noon.ortho.tobytes()
    assert winter.surface_m.tobytes() == noon.surface_m.tobytes()
    assert np.abs(winter.world.rgb.astype(int) - noon.world.rgb).mean() > 25
    swapped = build_town(5, **SMALL, map_condition="winter")
    assert swapped.world.rgb.tobytes() == noon.world.rgb.tobytes()
    assert np.abs(swapped.ortho.astype(int) - noon.ortho).mean() > 25
    assert swapped.surface_m.sum() < noon.surface_m.sum()  # bare trees


@pytest.mark.slow
def test_every_condition_can_be_seen_and_differs_from_the_others():
    seen = [build_town(5, **TINY, condition=name).world.rgb.astype(np.float32) for name in CONDITIONS]
    for one, other in itertools.combinations(seen, 2):
        assert np.abs(one - other).mean() > 3.0
    for one in seen:
        assert one.std() > 10.0
        assert 15.0 < one.mean() < 190.0


def test_snow_lies_on_lawns_and_bare_trees_are_as_thin_as_told():
    kind = np.full((400, 600), GRASS, np.uint8)
    kind[:, 200:400], kind[:, 400:] = ASPHALT, CANOPY
    albedo = np.full((*kind.shape, 3), 90, np.uint8)
    height = np.where(kind == CANOPY, 6.0, 0.0).astype(np.float32)
    day = Condition(light=LIGHTS["noon"], snow=1.0, leaves=0.3)
    rgb, stands = apply_season(albedo, height, kind, None, day, 0.265, np.random.default_rng(1))
    lawn, street = rgb[:, :200].mean(), rgb[:, 200:400].mean()
    assert lawn > 180.0
    assert street < 110.0
    assert np.mean(stands[:, 400:] > 0) == pytest.approx(0.3, abs=0.06)
    assert albedo.max() == 90  # what came in is left alone
    summer = apply_season(albedo, height, kind, None, CONDITIONS["noon"], 0.265, np.random.default_rng(1))
    assert summer[0] is albedo
    assert summer[1] is height


def test_lamps_and_the_open_sky_light_what_they_can_reach():
    height = np.zeros((200, 200), np.float32)
    height[:, 100:] = 15.0
    white, dark = np.full((200, 200, 3), 100, np.uint8), CONDITIONS["overcast"].light
    lit = illuminate(white, height, 0.5, dark, shade=0.75)[..., 1]
    np.testing.assert_allclose([int(lit[100, 10]), int(lit[100, 190])], 100 * dark.sky_rgb[1], atol=1.0)
    assert lit[100, 97] < 0.75 * lit[100, 10]  # at the foot of the wall
    lamps = np.zeros((200, 200), np.float32)
    lamps[50, 50] = 1.0
    with_lamp, without = (illuminate(white, height, 0.5, dark, lamps=lamp) for lamp in (lamps, None))
    np.testing.assert_array_equal(np.argwhere((with_lamp != without).any(axis=2)), [[50, 50]])


def test_haze_is_koschmieders():
    clear = patch_world(600, 600, 0.0)
    air = Atmosphere(visibility_m=700.0, rgb=(180.0, 190.0, 200.0))
    hazy = dataclasses.replace(clear, air=air)
    before, after = (render_frame(w, CAMERA, ORIGIN, 150.0, LEVEL).astype(float) for w in (clear, hazy))
    rays = np.linalg.inv(CAMERA.matrix) @ np.array([[150, 0, 299], [150, 0, 150], [1, 1, 1.0]])
    for (x, y), ray in zip([(150, 150), (0, 0), (299, 150)], rays.T, strict=True):
        left = 0.02 ** (150.0 * np.linalg.norm(ray) / 700.0)  # 2 % of the contrast at the visibility
        expected = before[y, x] * left + np.array(air.rgb) * (1.0 - left)
        np.testing.assert_allclose(after[y, x], expected, atol=1.5)


# -------------------------------------------------------------------------------------------- relief, water


@pytest.mark.slow
def test_hills_carry_the_town_and_its_surface_model(hilly):
    world, ground = hilly.world, hilly.world.ground_m
    assert ground.min() == 0.0
    assert 15.0 < ground.max() <= 30.0
    assert (world.height_m >= ground).all()
    flat = build_town(3, **MIDDLING, river=True, condition="overcast")
    assert flat.world.ground_m is None
    np.testing.assert_allclose(world.height_m - ground, flat.world.height_m, atol=1e-3)
    open_land = (flat.world.height_m == 0.0) & (world.glint.water == 0)
    assert np.percentile(np.hypot(*np.gradient(ground, world.gsd_m_per_px))[open_land], 90) < 0.25
    np.testing.assert_allclose(under_map(hilly, world.height_m).mean(axis=(1, 3)), hilly.surface_m, atol=1e-3)


@pytest.mark.slow
def test_a_river_crosses_the_town_on_the_level(hilly):
    water = hilly.world.glint.water > 0
    _, labels, stats, _ = cv2.connectedComponentsWithStats(water.astype(np.uint8))
    largest = labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    assert np.mean(water) > 0.02
    assert np.ptp(hilly.world.ground_m[largest]) < 0.2
    dry = build_town(3, **SMALL, condition="overcast").world.glint.water
    wet = build_town(3, **SMALL, condition="overcast", river=True).world.glint.water
    assert wet.mean() > dry.mean() + 0.02


def test_the_sun_flashes_where_water_mirrors_it():
    sun = LIGHTS["noon"]
    water = np.full((SIZE, SIZE), 1, np.uint8)
    dark = np.full((SIZE, SIZE, 3), 30, np.uint8)
    sides, heights = np.zeros((SIZE, SIZE, 4), np.uint8), np.zeros((SIZE, SIZE), np.float32)
    world = World(dark, sides, heights, TO_CRS, EPSG, glint=Glint(sun, water))
    attitude = Attitude(3.0, 14.0, 150.0)  # towards the sun
    seen = render_frame(world, CAMERA, ORIGIN, 150.0, attitude).astype(float)
    # The grid is turned by 1.08 degrees against true north.
    east, down, up = sun.towards_sun
    turn = np.radians(1.08)
    east, north = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) @ (east, -down)
    to_camera = np.array([-east, -north, up])  # mirrored at the level
    direction = (enu_from_body(3.0, 14.0, 150.0) @ CAMERA.mount).T @ -to_camera
    pixel = CAMERA.matrix @ direction / direction[2]
    assert 0 < pixel[:2].min() <= pixel[:2].max() < 299
    brightest = cv2.minMaxLoc(cv2.GaussianBlur(seen[..., 1], (0, 0), 4.0))[3]
    np.testing.assert_allclose(brightest, pixel[:2], atol=4.0)
    assert seen.max() > 150
    dry = render_frame(dataclasses.replace(world, glint=Glint(sun, 0 * water)), CAMERA, ORIGIN, 150.0, attitude)
    assert dry.max() == 30


@pytest.mark.slow
def test_a_flight_over_hills_tells_the_height_above_the_ground_below(hilly):
    style = FlightStyle(height_agl_m=80.0)
    plan = plan_flight(3, town=hilly, frames=60, rate_hz=0.4, noise=PERFECT, style=style)
    truth = plan.truth_rows()
    below = np.array([row.alt_amsl_m - row.height_agl_m - hilly.datum_amsl_m for row in truth])
    assert np.ptp(below) > 8.0  # the flight keeps its height above the sea
    assert truth[0].height_agl_m == pytest.approx(80.0, abs=2.5)
    site = site_of(hilly)
    for k, row in enumerate(truth):
        assert site.surface_at(site.pixel_from_geodetic(row.lat_deg, row.lon_deg)) > below[k] - 0.5
    assert next(plan.iter_frames()).height_agl_m == pytest.approx(truth[0].height_agl_m)


# ------------------------------------------------------------------------------------------ maps as worlds


@pytest.fixture(scope="module")
def rasters(tmp_path_factory):
    """A patch on a box of 20 m on ground at 212 m above the sea, as two files of different grids."""
    folder = tmp_path_factory.mktemp("rasters")
    world = patch_world(700, 480, 20.0)
    write_geotiff(folder / "map.tif", world.rgb, TO_CRS, EPSG)
    coarse = np.array([[2 * GSD, 0.0, TO_CRS[0, 2] + GSD / 2], [0.0, -2 * GSD, TO_CRS[1, 2] - GSD / 2]])
    heights = world.height_m.reshape(SIZE // 2, 2, SIZE // 2, 2).mean(axis=(1, 3)) + 212.0
    write_geotiff(folder / "dsm.tif", heights.astype(np.float32), coarse, EPSG)
    return folder


@pytest.mark.parametrize("attitude", [LEVEL, Attitude(5.0, -4.0, 37.0)])
def test_frames_over_a_map_show_it_where_it_lies(rasters, attitude):
    town = world_from_map(rasters / "map.tif", rasters / "dsm.tif")
    assert town.datum_amsl_m == pytest.approx(212.0)
    assert town.ortho.tobytes() == patch_world(700, 480, 20.0).rgb.tobytes()
    position = np.array([ORIGIN[0] + 6.3, ORIGIN[1] - 11.7])
    seen = render_frame(town.world, CAMERA, tuple(position), 150.0, attitude)
    expected = project(CAMERA, TO_CRS @ (700, 480, 1.0), 20.0, position, 150.0, attitude)
    np.testing.assert_allclose(centre_of_bright(seen), expected, atol=0.25)
    assert town.world.ground_at(tuple(TO_CRS @ (700, 480, 1.0))) == pytest.approx(0.0, abs=0.1)


def test_a_map_without_surface_is_flat_and_a_day_changes_it(rasters):
    flat, snowy = (world_from_map(rasters / "map.tif", condition=day) for day in (None, "haze"))
    assert flat.surface_m.max() == 0.0
    assert flat.world.ground_m is None
    assert flat.world.rgb.tobytes() == flat.ortho.tobytes() == snowy.ortho.tobytes()
    assert snowy.world.air == CONDITIONS["haze"].air
    with pytest.raises(OptionError, match="condition: expected one of"):
        world_from_map(rasters / "map.tif", condition="storm")


def test_a_map_in_degrees_is_flown_over_in_metres(tmp_path):
    rgb = np.random.default_rng(1).integers(0, 255, (300, 200, 3), np.uint8)
    write_geotiff(tmp_path / "map.tif", rgb, [[1e-5, 0, 16.4], [0, -1e-5, 48.2]], 4326)
    town = world_from_map(tmp_path / "map.tif", cache_dir=tmp_path)
    site = OrthoMap.open(tmp_path / "map.tif", cache_dir=tmp_path)
    assert town.crs_epsg == site.crs.to_epsg() == 32633
    assert town.ortho.shape == (site.height_px, site.width_px, 3)
    assert town.gsd_m_per_px == pytest.approx(site.gsd_m_per_px, rel=1e-3)


def test_a_flight_fits_any_map_and_stands_above_its_datum(rasters):
    town, style = world_from_map(rasters / "map.tif", rasters / "dsm.tif"), FlightStyle(height_agl_m=110.0)
    plan = plan_flight(2, town=town, frames=2, noise=PERFECT, style=style)
    truth, frame = plan.truth_rows()[0], next(plan.iter_frames())
    assert truth.alt_amsl_m == pytest.approx(212.0 + truth.height_agl_m, abs=0.1)
    assert frame.image.shape == (300, 300, 3)


def test_bare_ground_is_the_hill_under_the_houses():
    hill = np.broadcast_to(np.linspace(0.0, 30.0, 800, dtype=np.float32), (800, 800))
    surface = hill.copy()
    surface[200:260, 300:360] += 12.0
    ground = bare_ground(surface, 0.5)
    assert (ground <= surface).all()
    inner = np.s_[100:-100, 100:-100]
    np.testing.assert_allclose(ground[inner], hill[inner], atol=1.6)  # it cuts at 40 m: 1.5 m on this slope
