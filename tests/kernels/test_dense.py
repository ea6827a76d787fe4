"""Dense refinement: the pose that a picture was made with is found again, and what cannot be known is said."""

import math
from dataclasses import astuple, replace

import cv2
import numpy as np
import pytest
import torch

from engine import Camera, Fix, MatcherOptions, NccOptions, NoFix, Prior, SceneMatcher, Window
from engine.geo import enu_from_body
from engine.kernels.dense import EnhancedFrame, GaussianPrior, Pose, Samples, correlation_at, covariance_of, refine
from engine.maps.prepared import PreparedMap
from engine.maps.samples import SampleMap
from tests.support.rasters import whole
from tests.support.towns import site_of

NADIR = np.array([315.0, 296.0])
HEIGHT_M = 150.0
SIZE_PX = 300


@pytest.fixture(scope="module")
def camera():
    """Whose pixels are not square, and whose axis is not in the middle."""
    return Camera(SIZE_PX, SIZE_PX, np.array([[259.8, 0.0, 149.5], [0.0, 264.0, 152.0], [0.0, 0.0, 1.0]]))


def waves(u, v):
    """A smooth picture that repeats nowhere within itself, at any place (u, v)."""
    return np.sin(0.12 * u + 0.05 * v) + np.sin(0.14 * v - 0.04 * u + 0.0004 * u * u) + np.cos(0.0006 * u * v)


def make_scene(camera, roofs_m):
    """A camera, points in space on the ground and on roofs, and the smooth picture in which it sees them."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-80, 80, (2500, 2)), rng.choice([0.0, *roofs_m], 2500)])
    body = enu_from_body(3.0, -2.0, 25.0) @ camera.mount
    pose = Pose(body.T, np.array([4.0, -3.0, HEIGHT_M]), np.zeros(2))

    def values(places):
        x = pose.rotation @ (places - pose.center_m).T
        return waves(*(camera.matrix[:2, :2] @ (x[:2] / x[2]) + camera.matrix[:2, 2:]))

    steps = np.array([[0.01, 0.0, 0.0], [0.0, 0.01, 0.0]])
    gradients = np.column_stack([(values(points + step) - values(points - step)) / 0.02 for step in steps])
    columns, rows = np.meshgrid(np.arange(SIZE_PX, dtype=float), np.arange(SIZE_PX, dtype=float))
    levels = waves(columns, rows).astype(np.float32)
    return pose, Samples(points, values(points), gradients, np.ones(len(points))), levels


@pytest.fixture(scope="module")
def scene(camera):
    return make_scene(camera, (6.0, 15.0))


def believed(pose, turn_deg=(0.0, 0.0, 0.0), moved_m=(0.0, 0.0, 0.0), precision=None):
    """A belief that is off by so much, weak by default."""
    turned = cv2.Rodrigues(np.radians(np.array(turn_deg)))[0] @ pose.rotation
    weak = np.diag([0.0, 0.0, 1e-4, 10.0, 10.0, 10.0, 1e8, 1e8]) if precision is None else precision
    return GaussianPrior(Pose(turned, pose.center_m + moved_m, np.zeros(2)), weak)


def fitted(camera, scene, belief, levels=None, **changed):
    """The fit of the samples, some of their values changed, to the scene's picture or another."""
    _, samples, own = scene
    picture = EnhancedFrame(own if levels is None else levels, camera.matrix)
    return refine(picture, replace(samples, **changed), belief.pose, belief)


@pytest.mark.parametrize("turn_deg", [(0.5, -0.4, 0.6), (-0.6, 0.3, -0.8), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize(("gain", "bias"), [(1.0, 0.0), (0.4, 30.0)])
def test_all_six_degrees_are_found_again_whatever_gain_and_bias(scene, camera, turn_deg, gain, bias):
    pose, samples, levels = scene
    belief = believed(pose, turn_deg, moved_m=(0.8, -0.6, 1.0))
    levels = gain * levels + np.float32(bias)
    fit = fitted(camera, scene, belief, levels)
    assert np.abs(fit.pose.center_m - pose.center_m).max() < 0.1
    assert np.degrees(np.arccos(np.clip((np.sum(fit.pose.rotation * pose.rotation) - 1) / 2, -1, 1))) < 0.05
    assert fit.correlation > 0.99 > correlation_at(EnhancedFrame(levels, camera.matrix), samples, belief.pose)


def test_outliers_do_not_move_the_pose(scene, camera):
    """A fifth of the samples show something else: cars, new roofs."""
    pose, samples, _ = scene
    rng = np.random.default_rng(2)
    wrong = rng.random(len(samples.values)) < 0.2
    values = np.where(wrong, rng.uniform(-3, 3, len(wrong)), samples.values)
    fit = fitted(camera, scene, believed(pose, (0.3, 0.2, -0.4), moved_m=(0.5, 0.5, -0.5)), values=values)
    assert np.abs(fit.pose.center_m - pose.center_m).max() < 0.3


def test_a_slope_nobody_told_of_is_found_where_the_attitude_is_known(scene, camera):
    pose, samples, _ = scene
    points = samples.points_m.copy()
    slope = np.array([0.03, -0.02])
    points[:, 2] -= (points[:, :2] - pose.center_m[:2]) @ slope
    known = np.diag([0.0, 0.0, 1e6, 1e10, 1e10, 1e10, 100.0, 100.0])
    fit = fitted(camera, scene, believed(pose, precision=known), points_m=points)
    np.testing.assert_allclose(fit.pose.slope, slope, atol=3e-3)


def half_a_degree(slope_precision=1e8):
    """The precision of a belief whose attitude is that uncertain, its height by a metre."""
    return np.diag([0.0, 0.0, 1.0, *[np.radians(0.5) ** -2] * 3, slope_precision, slope_precision])


def test_the_covariance_knows_that_tilt_and_slope_look_alike(camera):
    """On flat ground with its slope open the position is known no better than the attitude's own error lets it."""
    scene = make_scene(camera, ())
    pose, _, levels = scene
    noisy = levels + np.random.default_rng(1).normal(0, 0.5, levels.shape).astype(np.float32)
    sigmas = []
    for slope_precision in (1e8, 100.0):
        belief = believed(pose, precision=half_a_degree(slope_precision))
        covariance = covariance_of(fitted(camera, scene, belief, noisy), belief)
        assert np.linalg.eigvalsh(covariance)[0] > 0
        sigmas.append(np.sqrt(np.diag(covariance)[:2]))
    assert (sigmas[0] < 0.3).all()
    assert (sigmas[1] > 0.9 * HEIGHT_M * np.tan(np.radians(0.5))).all()


def test_what_neighbours_share_widens_the_covariance(scene, camera):
    """Grain and patches of the same variance: patches pull many samples at once."""
    pose, _, levels = scene
    belief = believed(pose, precision=half_a_degree())
    sigmas = {}
    for name, radius_px in (("grain", 0.1), ("patches", 12.0)):
        noise = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 1.0, levels.shape), (0, 0), radius_px)
        fit = fitted(camera, scene, belief, (levels + 0.5 * noise / noise.std()).astype(np.float32))
        covariance = covariance_of(fit, belief)
        off = (fit.pose.center_m - pose.center_m)[:2]
        assert off @ np.linalg.solve(covariance[:2, :2], off) < 13.8  # once in a thousand
        sigmas[name] = np.sqrt(np.diag(covariance)[:2])
    assert (sigmas["patches"] > 1.5 * sigmas["grain"]).all()


def test_samples_share_a_cell_within_an_eighth_of_the_picture(scene, camera):
    _, _, points, _, _, weights, _, cells = fitted(camera, scene, believed(scene[0])).projected
    seen = weights > 0
    places, cells = (camera.matrix @ (points / points[2]))[:2, seen], cells[seen]
    assert len(np.unique(cells)) > 40
    for cell in np.unique(cells):
        assert np.ptp(places[:, cells == cell], axis=1).max() <= SIZE_PX / 8


def test_the_map_s_gradients_are_how_its_values_change_on_the_ground(ground):
    site = ground.flat_site
    found = SampleMap(site).find(Window(100, 120, 200, 160), 0)
    picture = PreparedMap(site, torch.device("cpu")).cut(whole(site), 0).search.image
    for axis, step in enumerate(np.eye(2) * site.gsd_m_per_px):
        at = [site.pixel_from_enu(found.points_m[:, :2] + sign * step) for sign in (1, -1)]
        ahead, behind = (cv2.remap(picture, *px.T.astype(np.float32)[:, None], cv2.INTER_LINEAR)[0] for px in at)
        change = (ahead - behind) / (2 * site.gsd_m_per_px)
        np.testing.assert_allclose(found.gradients[:, axis], change, atol=0.02 * np.abs(change).max())


def test_no_pose_from_samples_that_are_not_seen(scene, camera):
    pose, samples, levels = scene
    assert fitted(camera, scene, believed(pose, moved_m=(1000.0, 0.0, 0.0))) is None
    nothing = np.zeros(len(samples.weights))
    assert fitted(camera, scene, believed(pose), weights=nothing) is None
    assert correlation_at(EnhancedFrame(levels, camera.matrix), replace(samples, weights=nothing), pose) == 0.0


# ------------------------------------------------------------------------------------------------ as part of NCC


def located(site, camera, frame, prior, **options):
    matcher = SceneMatcher(site, camera, "ncc", "cpu", MatcherOptions(ncc=NccOptions(**options)))
    return matcher.locate(frame, prior)


def test_telemetry_that_is_wrong_is_corrected(ground, camera):
    """Each error of the telemetry alone moves the fix of the peak by a metre; the picture knows better."""
    true = ground.frame(camera, NADIR, heading_deg=25.0, roll_deg=3.0, pitch_deg=-2.0)
    stated = replace(true, roll_deg=3.5, pitch_deg=-2.4, heading_deg=26.0, height_agl_m=152.0)
    peak = located(ground.flat_site, camera, stated, ground.prior(NADIR), refine=False)
    fix = located(ground.flat_site, camera, stated, ground.prior(NADIR))
    assert (peak.stage, peak.up_m, fix.stage, fix.method) == ("fine", None, "refined", "ncc")
    assert np.hypot(*ground.off_m(peak, NADIR)) > 1.0
    assert np.hypot(*ground.off_m(fix, NADIR)) < 0.15
    assert fix.up_m == pytest.approx(HEIGHT_M, abs=0.3)
    assert astuple(fix.attitude) == pytest.approx((3.0, -2.0, 25.0), abs=0.06)
    assert fix.sigma_m < peak.sigma_m


def test_without_a_surface_model_the_covariance_stays_as_wide_as_the_tilt_is_doubtful(ground, camera):
    true = ground.frame(camera, NADIR, heading_deg=25.0, roll_deg=3.0, pitch_deg=-2.0)
    fix = located(ground.site, camera, replace(true, roll_deg=3.4, pitch_deg=-2.3), ground.prior(NADIR))
    assert fix.sigma_m > 0.7 * HEIGHT_M * np.tan(np.radians(0.5))
    assert ground.chi_square(fix, NADIR) < 9.0


@pytest.mark.parametrize("roll_deg", [0.0, 3.0, -5.0])
def test_without_attitude_the_tilt_is_measured(ground, camera, roll_deg):
    frame = ground.frame(camera, NADIR, heading_deg=25.0, roll_deg=roll_deg)
    untold = replace(frame, roll_deg=None, pitch_deg=None)
    fix = located(ground.flat_site, camera, untold, ground.prior(NADIR, sigma_m=15))
    assert ground.chi_square(fix, NADIR) < 9.0
    assert fix.attitude.roll_deg == pytest.approx(roll_deg, abs=0.2)


def fixes_over(flight, site, method="ncc", frames=slice(None)):
    """The answers to frames of a flight by priors some metres off, each with the truth and its place (2,)."""
    matcher = SceneMatcher(site, flight.camera, method, "cpu")
    for frame, truth in zip(flight.frames[frames], flight.truth[frames], strict=True):
        place = site.frame.enu_from_geodetic(truth.lat_deg, truth.lon_deg)
        prior = Prior(east_m=place[0] + 3.0, north_m=place[1] - 2.0, sigma_m=5.0)
        yield matcher.locate(frame, prior), truth, place


def test_errors_are_as_large_as_the_covariance_says(sim_flight, sim_site):
    """Over a flight with houses and noisy telemetry."""
    errors, squared = [], []
    for fix, truth, place in fixes_over(sim_flight, sim_site, frames=slice(4, None)):
        assert fix.stage == "refined"
        off = np.array([fix.east_m, fix.north_m, fix.up_m - sim_site.ground_m]) - [*place, truth.height_agl_m]
        errors.append(off)
        squared.append(off @ np.linalg.solve(fix.covariance_m2, off))
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 0.4
    assert max(squared) < 16.3  # three degrees of freedom, once in a thousand


def test_on_a_map_that_says_it_is_exact_the_errors_fill_the_covariance(sim_flight):
    """Mean NEES of two dimensions: 2 where it is consistent. On a map that says nothing it is far below."""

    def nees(**said):
        squared = []
        for fix, _, place in fixes_over(sim_flight, site_of(sim_flight.town, **said)):
            off = np.array([fix.east_m, fix.north_m]) - place
            squared.append(off @ np.linalg.solve(fix.covariance_m2[:2, :2], off))
        return np.mean(squared)

    exact = nees(georeference_sigma_m=1e-3, slope_sigma_deg=1e-3)
    assert 0.7 < exact < 3.3
    assert nees() < 0.5 * exact


def with_noise(frame, part):
    """A frame of which a part shows nothing."""
    image = frame.image.copy()
    image[part] = np.random.default_rng(0).integers(0, 255, image[part].shape)
    return replace(frame, image=image)


def test_a_picture_of_another_place_keeps_its_fix_or_none(ground, camera):
    """Refinement never makes a fix of what is no fix: the other half of the picture is noise."""
    frame = with_noise(ground.frame(camera, NADIR, heading_deg=25.0), np.s_[:, 150:])
    assert ground.chi_square(located(ground.flat_site, camera, frame, ground.prior(NADIR)), NADIR) < 9.0


def test_a_tilt_that_nobody_tells_is_refused_and_not_guessed(ground, camera):
    """Half of the picture is noise on top of a tilt of 10 degrees: the peak's place is 26 m off."""
    frame = with_noise(ground.frame(camera, NADIR, heading_deg=25.0, roll_deg=10.0), np.s_[150:])
    untold = replace(frame, roll_deg=None, pitch_deg=None)
    result = located(ground.flat_site, camera, untold, ground.prior(NADIR, sigma_m=25))
    assert isinstance(result, NoFix) or ground.chi_square(result, NADIR) < 9.0


def test_rough_ground_counts_less(ground):
    heights = np.zeros(ground.gray.shape, np.float32)
    heights[200:260, 200:260] = 12.0
    site = ground.map_of(surface_m=heights)
    samples = SampleMap(site).find(Window(160, 160, 140, 140), 0)
    x, y = site.pixel_from_enu(samples.points_m[:, :2]).T
    wall = (np.minimum(abs(x - 199.5), abs(x - 259.5)) < 1.0) & (y > 203) & (y < 256)
    level = (np.abs(x - 230) > 34) | (np.abs(y - 230) > 34)
    assert wall.any()
    assert samples.weights[wall].max() < 0.1
    np.testing.assert_allclose(samples.weights[level], 1.0)


@pytest.mark.parametrize(("method", "has_surface"), [("ncc", True), ("ncc", False), ("sift", True)])
def test_attitudes_are_as_wrong_as_their_covariance_says(sim_flight, method, has_surface):
    """Normalised squared errors of three angles: 3 in the mean where consistent, less where cautious."""
    squared = []
    site = site_of(sim_flight.town, surface=has_surface)
    for fix, truth, _ in fixes_over(sim_flight, site, method, slice(None, None, 2)):
        if not isinstance(fix, Fix) or fix.attitude_covariance_deg2 is None:
            continue  # a peak that was not refined has no whole pose
        off = [fix.attitude.roll_deg - truth.roll_deg, fix.attitude.pitch_deg - truth.pitch_deg,
               math.remainder(fix.attitude.heading_deg - truth.heading_deg, 360.0)]  # fmt: skip
        squared.append(off @ np.linalg.solve(fix.attitude_covariance_deg2, off))
        assert fix.attitude_sigma_deg == pytest.approx(np.sqrt(np.diag(fix.attitude_covariance_deg2)))
    assert len(squared) > 8
    assert 0.3 < np.mean(squared) < 6.0
    assert max(squared) < 21.1  # three degrees of freedom, once in ten thousand
