"""Over hills: the ground below is found under what stands on it, and a fix lies where the truth is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from engine import Fix, Frame, MatcherOptions, Navigator, OrthoMap, SceneMatcher
from engine.matching.align import view_of
from engine.options import NccOptions
from engine.values import Attitude
from tests.support.ground import pixels_of, rays_of

NADIR = np.array([315.0, 296.0])
HEIGHT_M = 150.0
ATTITUDE = {"roll_deg": 3.0, "pitch_deg": -2.0, "heading_deg": 25.0}
UTM = "EPSG:32633"
GRID = np.array([[0.5, 0.0, 500_000.0], [0.0, -0.5, 5_300_000.0]])


def plane(east_m, north_m):
    """A slope of 12 degrees, 400 m above the sea at the map's middle."""
    return 400.0 + 0.18 * east_m - 0.11 * north_m


def hill(east_m, north_m):
    """A hill of 40 m beside the flight, which stands at its foot."""
    return 40.0 * np.exp(-((east_m - 60.0) ** 2 + (north_m - 20.0) ** 2) / (2.0 * 55.0**2))


def seen(ground, camera, shape):
    """The frame from above :data:`NADIR`, its rays followed down to the ground, and how high it hangs.

    The telemetry is off by 0.5, 0.4 and 1 degree, and by 2 m of height above the ground below.
    """
    down = rays_of(camera, pixels_of(camera.height_px, camera.width_px), **ATTITUDE)
    nadir = ground.enu_from_pixel(NADIR)
    up = shape(*nadir) + HEIGHT_M
    hits = np.broadcast_to(nadir, (*down.shape[:2], 2))
    for _ in range(40):  # the slope is below 1, so this contracts
        sink_m = up - shape(hits[..., 0], hits[..., 1])
        hits = nadir + down[..., :2] * (sink_m[..., None] / -down[..., 2:])
    stated = {name: angle + off for (name, angle), off in zip(ATTITUDE.items(), (0.5, -0.4, 1.0), strict=True)}
    return Frame(ground.seen_at(hits), timestamp_ns=0, height_agl_m=HEIGHT_M + 2.0, **stated), up


def site_on(ground, shape):
    enu = ground.enu_from_pixel(pixels_of(*ground.size))
    return ground.map_of(surface_m=shape(enu[..., 0], enu[..., 1]))


@pytest.fixture(scope="module", params=[plane, hill], ids=["plane", "hill"])
def scene(request, ground, camera):
    return site_on(ground, request.param), *seen(ground, camera, request.param)


def off_m(ground, fix):
    return float(np.hypot(*ground.off_m(fix, NADIR)))


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("somewhere", [True, False])
def test_a_fix_over_hills_lies_where_the_truth_is(scene, ground, camera, stated, somewhere):
    """The map's ground lies up to 40 m off the ground below, and the height is above the latter."""
    site, frame, up_m = scene
    frame = frame if stated else replace(frame, roll_deg=None, pitch_deg=None)
    prior = None if somewhere else ground.prior(NADIR)
    fix = SceneMatcher(site, camera, "ncc", "cpu").locate(frame, prior)
    assert fix.stage == "refined"
    assert off_m(ground, fix) < 0.35
    assert fix.up_m == pytest.approx(up_m, abs=0.2)


def test_the_frame_is_laid_on_the_slope_below_it(scene, ground, camera, monkeypatch):
    """Correlation alone: aligned with its slope the frame fits the map better than on level ground."""
    site, frame, _ = scene
    matcher = SceneMatcher(site, camera, "ncc", "cpu", MatcherOptions(ncc=NccOptions(refine=False)))
    fix = matcher.locate(frame, ground.prior(NADIR))
    monkeypatch.setattr("engine.matching.correlation.Correlator._slope", lambda *_: np.zeros(2))
    level = matcher.locate(frame, ground.prior(NADIR))
    assert fix.score > level.score + 0.1
    assert off_m(ground, fix) < 3.0


def test_sift_counts_height_from_the_ground_below(scene, ground, camera):
    site, frame, up_m = scene
    fix = SceneMatcher(site, camera, "sift", "cpu").locate(frame, ground.prior(NADIR))
    assert off_m(ground, fix) < 0.5
    assert fix.up_m == pytest.approx(up_m, abs=0.5)
    assert fix.confidence > 0.9995  # nothing speaks against it; a height that is 17 m off would


def test_a_frame_without_height_takes_it_from_the_last_fix_above_the_ground_there(scene, ground, camera):
    site, frame, up_m = scene
    navigator = Navigator(SceneMatcher(site, camera, "ncc", "cpu"), ground.prior(NADIR))
    assert isinstance(navigator.update(frame), Fix)
    fix = navigator.update(replace(frame, height_agl_m=None, timestamp_ns=10**9))
    assert fix.up_m == pytest.approx(up_m, abs=0.2)


@pytest.mark.parametrize("seed", range(4))
def test_the_ground_is_found_below_roofs_on_a_slope(seed):
    """Houses of 5 to 15 m over two fifths of a slope leave it where it is."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(300.0), np.arange(300.0))
    slope = rng.uniform(-0.15, 0.15, 2)  # metres up per pixel of 0.5 m
    houses = (rng.random((15, 15)) < 0.4) * rng.uniform(5, 15, (15, 15))
    heights = 50.0 + x * slope[0] + y * slope[1] + np.kron(houses, np.ones((20, 20)))
    site = OrthoMap.from_arrays(np.zeros((300, 300), np.uint8), GRID, UTM, surface_m=heights)
    level_m, found = site.ground_plane([150.0, 140.0], 50.0)
    true_m = 50.0 + 150.0 * slope[0] + 140.0 * slope[1]
    assert level_m == pytest.approx(true_m, abs=0.5)
    np.testing.assert_allclose(found, slope, atol=0.01)
    assert site.ground_at([150.0, 140.0]) == pytest.approx(true_m, abs=1.0)


def test_where_nothing_is_known_the_ground_is_the_maps():
    heights = np.full((200, 200), 7.0)
    heights[:, 100:] = np.nan
    site = OrthoMap.from_arrays(np.zeros((200, 200), np.uint8), GRID, UTM, surface_m=heights)
    bare = OrthoMap.from_arrays(np.zeros((200, 200), np.uint8), GRID, UTM)
    for where, level in ((site, 7.0), (bare, 0.0)):
        for at in ([40.0, 60.0], [180.0, 60.0], [1e4, -1e4]):
            found_m, slope = where.ground_plane(at, 20.0)
            assert found_m == pytest.approx(level, abs=1e-6)
            np.testing.assert_allclose(slope, 0.0, atol=1e-6)


def test_a_slope_that_a_corner_looks_along_has_no_view(camera):
    """Its outermost rays fall by 1 m in 0.58 m to the side: along a slope of 60 degrees."""
    level, jacobian = Attitude(0.0, 0.0, 0.0), np.diag([0.5, -0.5])
    assert view_of(camera, level, HEIGHT_M, jacobian, np.array([0.8, 0.0])) is not None
    assert view_of(camera, level, HEIGHT_M, jacobian, np.array([0.9, 0.0])) is None
