"""Over hills: the ground below is found under what stands on it, and a fix lies where the truth is."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from engine import Budget, Fix, Frame, MatcherOptions, Navigator, NccOptions, OrthoMap, SceneMatcher
from engine.budget import Deadline
from engine.camera import mount_rotation
from engine.geo import enu_from_body
from engine.kernels.dense import Pose
from engine.matching.pose import AttitudePrior, solve_pose
from engine.matching.unknown_slope import from_level_ground, over_unknown_slope, wide_slope_deg
from tests.support.fixes import px_off
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


def matcher_of(site, camera, refine=True):
    return SceneMatcher(site, camera, "ncc", "cpu", MatcherOptions(ncc=NccOptions(refine=refine)))


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("somewhere", [True, False])
def test_a_fix_over_hills_lies_where_the_truth_is(scene, ground, camera, stated, somewhere):
    """The map's ground lies up to 40 m off the ground below, and the height is above the latter."""
    site, frame, up_m = scene
    frame = frame if stated else replace(frame, roll_deg=None, pitch_deg=None)
    fix = matcher_of(site, camera).locate(frame, None if somewhere else ground.prior(NADIR))
    assert fix.stage == "refined"
    assert px_off(fix, NADIR) < 0.7
    assert fix.up_m == pytest.approx(up_m, abs=0.2)


def test_sift_counts_height_from_the_ground_below(scene, ground, camera):
    site, frame, up_m = scene
    fix = SceneMatcher(site, camera, "sift", "cpu").locate(frame, ground.prior(NADIR))
    assert px_off(fix, NADIR) < 1
    assert fix.up_m == pytest.approx(up_m, abs=0.5)
    assert fix.confidence > 0.9995  # nothing speaks against it; a height that is 17 m off would


def test_a_frame_without_height_takes_it_from_the_last_fix_above_the_ground_there(scene, ground, camera):
    site, frame, up_m = scene
    navigator = Navigator(matcher_of(site, camera), ground.prior(NADIR))
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
    true_m = 50.0 + 150.0 * slope[0] + 140.0 * slope[1]
    assert site.ground_at([150.0, 140.0]) == pytest.approx(true_m, abs=1.0)


def test_where_nothing_is_known_the_ground_is_the_maps():
    heights = np.full((200, 200), 7.0)
    heights[:, 100:] = np.nan
    site = OrthoMap.from_arrays(np.zeros((200, 200), np.uint8), GRID, UTM, surface_m=heights)
    bare = OrthoMap.from_arrays(np.zeros((200, 200), np.uint8), GRID, UTM)
    for where, level in ((site, 7.0), (bare, 0.0)):
        for at in ([40.0, 60.0], [180.0, 60.0], [1e4, -1e4]):
            assert where.ground_at(at) == pytest.approx(level, abs=1e-6)


# A map alone: the refined pose over ground whose slope nobody stated

TRUE = {"roll_deg": 4.0, "pitch_deg": -3.0, "heading_deg": 20.0}


def tangent(degrees):
    return np.tan(np.radians(degrees))


def picture():
    """What a picture of a plane tells: by six numbers, of which each tilt looks like a slope and a way."""
    rows = np.eye(8)[:6]
    rows[0, 4], rows[1, 3] = HEIGHT_M, -HEIGHT_M
    rows[3, 7], rows[4, 6] = 1.0, 1.0
    return rows / np.array([0.05, 0.05, 0.05, 1e-3, 1e-3, 1e-3])[:, None]


def inferred(measured, slope_sigma):
    """Mean, covariance and evidence of the parameters by the textbook, the slope's prior being normal."""
    tilt = tangent(0.37)
    precision = np.diag(np.array([1e4, 1e4, 1.6, tilt, tilt, 3 * tilt, slope_sigma, slope_sigma]) ** -2.0)
    rows = picture()
    covariance = np.linalg.inv(rows.T @ rows + precision)
    spread = rows @ np.linalg.inv(precision) @ rows.T + np.eye(6)
    evidence = np.exp(-0.5 * measured @ np.linalg.solve(spread, measured)) / np.sqrt(np.linalg.det(spread))
    return covariance @ rows.T @ measured, covariance, evidence


def refined(measured):
    """The pose by a wide prior of the slope, its covariance, and the place (2,) by the picture alone."""
    mean, covariance, _ = inferred(measured, tangent(wide_slope_deg(2.0)))
    free, _, _ = inferred(measured, 1e6)
    return Pose(np.eye(3), mean[:3], mean[6:]), covariance, free[:2]


@pytest.mark.parametrize("slope_deg", [(0.0, 0.3), (0.4, -0.2), (1.5, 1.0)])
def test_exchanging_the_prior_equals_inference_with_each_and_their_mean_by_evidence(slope_deg):
    measured = picture() @ np.concatenate([[0.3, -0.2, 0.5, 0.004, -0.003, 0.01], tangent(np.array(slope_deg))])
    found = over_unknown_slope(*refined(measured), HEIGHT_M, 2.0)
    sigmas = (0.35, 0.7, 1.4, 2.8, 5.6)
    parts = [inferred(measured, tangent(sigma)) for sigma in sigmas]
    means, covariances, evidence = map(np.array, zip(*parts, strict=True))
    weights = evidence / sigmas  # steep ground is rare
    expected = np.average(means, axis=0, weights=weights)
    off = means - expected
    spread = np.average(covariances + off[:, :, None] * off[:, None], axis=0, weights=weights)
    np.testing.assert_allclose(found.pose.center_m, expected[:3], atol=2e-3)
    np.testing.assert_allclose(found.pose.slope, expected[6:], atol=1e-5)
    np.testing.assert_allclose(found.covariance[:2, :2], spread[:2, :2], rtol=1e-3, atol=2e-3)
    assert found.covariance[2, 2] >= spread[2, 2]


@pytest.mark.parametrize("told_off_deg", [0.0, 0.3])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.03, -0.02), (-0.05, 0.08)])
def test_a_slope_that_looks_like_a_tilt_is_told_from_it_by_the_stated_attitude(slope, told_off_deg):
    """Solved as if the ground were level, the camera over the steepest of these is 14 m from where it is."""
    rng = np.random.default_rng(0)
    true = enu_from_body(4.0, -3.0, 20.0) @ mount_rotation()
    points = np.column_stack([rng.uniform(-60.0, 60.0, (200, 2)), np.zeros(200)])
    sloping = points + np.outer(points[:, :2] @ slope, [0.0, 0.0, 1.0])
    center = np.array([8.0, -6.0, HEIGHT_M])
    seen = (sloping - center) @ true
    pixels = seen[:, :2] / seen[:, 2:] * 260.0 + 150.0 + rng.normal(0.0, 0.3, (200, 2))
    told = true.T @ cv2.Rodrigues(np.radians([told_off_deg, 0.0, 0.0]))[0]
    wide = AttitudePrior(told, np.hypot(0.37, wide_slope_deg(2.0)))
    camera_matrix = np.array([[260.0, 0.0, 150.0], [0.0, 260.0, 150.0], [0.0, 0.0, 1.0]])
    solved = solve_pose(points, pixels, camera_matrix, prior=wide)
    level = Pose(solved.rotation, solved.center_m, np.zeros(2))
    attitudes = [(0.99, AttitudePrior(told, 0.37)), (0.01, AttitudePrior(told, 4.0))]
    over = from_level_ground(level, solved.covariance, np.zeros(3), attitudes, 2.0)
    off_m = over.pose.center_m - center
    assert off_m[:2] @ np.linalg.solve(over.covariance[:2, :2], off_m[:2]) < 6.0
    assert np.hypot(*off_m[:2]) < 2.5  # the attitude may also be wrong altogether
    np.testing.assert_allclose(over.pose.slope, slope, atol=0.02)


@pytest.mark.parametrize(
    ("off_m", "height_m", "is_confirmed"),
    [(0.9, HEIGHT_M, True), (1.1, HEIGHT_M, False), (1.1, 2.0 * HEIGHT_M, True)],
)
def test_a_pose_that_is_not_the_peak_s_is_not_confirmed(off_m, height_m, is_confirmed):
    pose, covariance, place = refined(picture() @ np.full(8, 1e-3))
    found = over_unknown_slope(pose, covariance, place + np.array([off_m, 0.0]), height_m, 2.0)
    assert (found is not None) == is_confirmed


@pytest.fixture(scope="module")
def site(ground):
    return ground.map_of(georeference_sigma_m=0.1)


@pytest.fixture(scope="module")
def level_fixes(ground, site, camera):
    """Over level ground, by telemetry whose tilt is off as assumed: fix and (2,) error, by peak and refined."""
    frame = ground.frame(camera, NADIR, HEIGHT_M, **TRUE)
    by_peak, refined = [], []
    for rows, refine in ((by_peak, False), (refined, True)):
        matcher = matcher_of(site, camera, refine)
        for roll_deg, pitch_deg in [(0.5, -0.3), (-0.4, 0.4), (0.2, 0.5), (-0.5, -0.2)]:
            tilt = {"roll_deg": TRUE["roll_deg"] + roll_deg, "pitch_deg": TRUE["pitch_deg"] + pitch_deg}
            fix = matcher.locate(replace(frame, **tilt), ground.prior(NADIR))
            rows.append((fix, ground.off_m(fix, NADIR)))
    return by_peak, refined


def test_over_level_ground_a_map_alone_gives_less_than_the_peak_s_error(level_fixes):
    peaks, refined = (np.array([np.hypot(*off) for _, off in rows]) for rows in level_fixes)
    assert (refined < peaks).all()
    assert np.sqrt(np.mean(refined**2)) < 0.75 * np.sqrt(np.mean(peaks**2))


def test_the_refined_fix_states_a_smaller_error_and_keeps_to_it(level_fixes):
    stated = [np.mean([np.trace(fix.relative_covariance_m2) for fix, _ in rows]) for rows in level_fixes]
    assert 0.3 * stated[0] < stated[1] < stated[0]
    for fix, off in level_fixes[1]:
        assert fix.stage == "refined"
        assert off @ np.linalg.solve(fix.relative_covariance_m2, off) < 9.0
        assert abs(fix.up_m - HEIGHT_M) < 3.0 * np.sqrt(fix.covariance_m2[2, 2])


@pytest.mark.parametrize("shape", [plane, hill])
def test_over_slopes_the_peak_s_fix_stands(ground, site, camera, shape):
    frame, _ = seen(ground, camera, shape)
    peak, fix = (matcher_of(site, camera, refine).locate(frame, ground.prior(NADIR)) for refine in (False, True))
    assert px_off(fix, NADIR) < px_off(peak, NADIR) + 1.0


def test_drawn_over_the_relief_a_frame_matches_steep_ground_better_than_on_a_plane(ground, camera):
    """On a plane the hill's side is displaced; the efforts of a refused peak draw the frame over it."""
    site, (frame, _) = site_on(ground, hill), seen(ground, camera, hill)
    matcher = matcher_of(site, camera)
    true = replace(frame, **ATTITUDE, height_agl_m=HEIGHT_M)
    query = matcher._query(true, ground.prior(NADIR), Deadline(Budget()))
    correlator = matcher._method._correlator(query)
    scores, size = {}, None
    for over_relief in (False, True):
        aligned = correlator.align(query.telemetry, 0, None, size)
        size = aligned.template.shape
        peak = correlator.search(aligned, correlator.window(aligned))
        scores[over_relief] = peak.score
        assert np.hypot(*(correlator.nadir_px(peak, aligned) - NADIR)) < (2.0 if over_relief else 10.0)
        assert [patch.shape for patch in correlator.nowhere(aligned)] == [aligned.patch.gray.shape] * 2
    assert scores[True] > scores[False] + 0.1
