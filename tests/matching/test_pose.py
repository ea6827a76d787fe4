"""Truths about the pose: recovered where it is there, within its covariance, and refused where it is not."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2, norm

from engine.matching.pose import AttitudePrior, PoseStart, PoseStats, solve_pose
from engine.options import PoseOptions
from tests.support.poses import CAMERA, GROUNDS, SIZE_PX, WRONG, Scene, any_scene, attitude, measured, scene

K, SIZE = CAMERA.matrix, SIZE_PX
CHI2_3_SIGMA = chi2.ppf(norm.cdf(3) - norm.cdf(-3), 3)  # three degrees of freedom, 99.73 %


def solved(s: Scene, options: PoseOptions | None = None, **other: object) -> PoseStats:
    result = solve_pose(s.points_m, s.points_px, K, options, **other)
    assert result is not None
    return result


def reordered(s: Scene, order: np.ndarray) -> Scene:
    return replace(s, points_m=s.points_m[order], points_px=s.points_px[order], wrong=s.wrong[order])


NARROW = np.array([[9000.0, 0, 149.5], [0, 9000.0, 149.5], [0, 0, 1]])


def tilted(deg: float) -> np.ndarray:
    return cv2.Rodrigues(np.deg2rad([deg, 0, 0]))[0] @ np.diag([1.0, -1, -1])


def narrow_view(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a plane, their pixels in a narrow view that is tilted by 8 degrees, and noise for them."""
    points = np.c_[rng.uniform(-2, 2, (60, 2)), np.zeros(60)]
    x = (points + tilted(8.0)[2] * 150) @ tilted(8.0).T
    return points, (x @ NARROW.T)[:, :2] / x[:, 2:], rng.normal(0, 0.7, (60, 2))


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return np.degrees(np.linalg.norm(cv2.Rodrigues(a @ b.T)[0]))


# Recovered.


@pytest.mark.parametrize("relief_m", [0.0, 60.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 5.0, 25.0])
def test_exact_points_give_the_exact_pose(relief_m, tilt_deg):
    rng = np.random.default_rng(1)
    for _ in range(10):
        s = scene(rng, relief_m=relief_m, tilt_deg=tilt_deg)
        pose = solved(s)
        np.testing.assert_allclose(pose.center_m, s.center_m, atol=1e-5)
        assert angle_deg(pose.rotation, s.rotation) < 1e-5
        assert pose.inliers.all()


def test_large_coordinates_change_nothing():
    offset = np.array([500_000.0, 3_600_000.0, 200.0])
    near = scene(np.random.default_rng(3), noise_px=0.5, wrong=0.3)
    far = replace(near, points_m=near.points_m + offset)
    a, b = solved(near), solved(far)
    np.testing.assert_allclose(b.center_m - offset, a.center_m, atol=1e-5)
    np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-4, atol=1e-12)
    assert (a.inliers == b.inliers).all()


def test_units_scale():
    """A world twice as large, seen from twice as far, gives the same picture."""
    s = scene(np.random.default_rng(4), noise_px=0.5)
    once, twice = solved(s), solved(replace(s, points_m=2 * s.points_m))
    np.testing.assert_allclose(twice.center_m, 2 * once.center_m, rtol=1e-4)
    np.testing.assert_allclose(twice.covariance_center_m2, 4 * once.covariance_center_m2, rtol=1e-3)
    assert (twice.inliers == once.inliers).all()


@pytest.mark.parametrize("relief_m", [0.0, 40.0])
@pytest.mark.parametrize("wrong", [0.3, 0.5, 0.7])
def test_wrong_matches_are_left_out(wrong, relief_m):
    rng = np.random.default_rng(5)
    for _ in range(15):
        s = scene(rng, 120, noise_px=0.5, wrong=wrong, relief_m=relief_m)
        pose = solved(s)
        assert np.linalg.norm(pose.center_m - s.center_m) < 3
        assert pose.inliers[~s.wrong].mean() > 0.95
        assert pose.inliers[s.wrong].mean() < 0.1


def test_unusable_matches_are_ignored():
    s = scene(np.random.default_rng(7), 40)
    s.points_m[3] = np.nan
    s.points_px[5, 0] = np.inf
    weights = np.ones(40)
    weights[8] = 0
    s.points_m[11] = 2.0 * s.center_m - s.points_m[11]  # behind the camera, on the same line of sight
    pose = solved(s, weights=weights)
    assert np.flatnonzero(~pose.inliers).tolist() == [3, 5, 8, 11]
    np.testing.assert_allclose(pose.center_m, s.center_m, atol=1e-5)


def test_weights_follow_the_better_points():
    rng = np.random.default_rng(8)
    errors: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(40):
        s = scene(rng, 60)
        sigma = np.where(np.arange(60) < 20, 0.05, 0.9)
        s.points_px += rng.normal(size=(60, 2)) * sigma[:, None]
        for weighted, values in errors.items():
            pose = solved(s, weights=0.25 / sigma**2 if weighted else None)
            values.append(float(np.sum((pose.center_m - s.center_m) ** 2)))
    assert np.mean(errors[True]) < 0.2 * np.mean(errors[False])


# Its covariance.


@pytest.mark.parametrize("cases", [100, pytest.param(250, marks=pytest.mark.slow)])
@pytest.mark.parametrize("with_prior", [False, True])
@pytest.mark.parametrize("ground", GROUNDS)
def test_errors_lie_within_three_sigma_whatever_the_ground(ground, with_prior, cases):
    """60 to 300 m up, 15 to 300 matches, noise of 0.3 to 1 px, up to 60 % wrong."""
    rng, within_axes, nees, nees_turn = np.random.default_rng([3, GROUNDS.index(ground), with_prior]), [], [], []
    for _ in range(cases):
        s = any_scene(rng, ground)
        pose = solve_pose(s.points_m, s.points_px, K, prior=measured(rng, s.rotation) if with_prior else None)
        if pose is None:
            continue
        np.testing.assert_allclose(pose.covariance, pose.covariance.T, rtol=1e-6, atol=1e-15)
        assert np.linalg.eigvalsh(pose.covariance).min() > 0
        error, turn = pose.center_m - s.center_m, cv2.Rodrigues(s.rotation @ pose.rotation.T)[0][:, 0]
        within_axes.append(np.abs(error) < 3 * np.sqrt(np.diag(pose.covariance_center_m2)))
        nees.append(error @ np.linalg.solve(pose.covariance_center_m2, error))
        nees_turn.append(turn @ np.linalg.solve(pose.covariance[3:, 3:], turn))
        assert nees[-1] < CHI2_3_SIGMA or np.linalg.norm(error) < 10
    assert len(nees) >= 0.96 * cases
    assert np.mean(np.array(nees) < CHI2_3_SIGMA) >= 0.98
    assert np.mean(within_axes, axis=0).min() >= 0.98
    assert np.mean(np.array(nees_turn) < CHI2_3_SIGMA) >= 0.97
    if ground != "distorted":  # there a pixel's noise grows with the lens's stretch, which no one tells the pose
        assert 2.4 < np.mean(nees) < 3.6
        assert 2.4 < np.mean(nees_turn) < 3.6


def test_where_the_search_began_does_not_show():
    """The attitude of the telemetry and three random matches lead to one pose."""
    rng = np.random.default_rng(22)
    for _ in range(20):
        s = scene(rng, 120, noise_px=0.8, wrong=0.3, relief_m=10)
        prior = AttitudePrior(s.rotation, sigma_deg=1.0)
        orders = [rng.permutation(len(s.points_m)) for _ in range(3)]
        poses = [solved(reordered(s, order), prior=prior) for order in orders]
        free = solved(s, prior=AttitudePrior(scene(rng).rotation, sigma_deg=1e4))  # says nothing: RANSAC decides
        weak = solved(s)
        for pose in poses[1:]:
            sigma = np.sqrt(np.diag(pose.covariance_center_m2))
            assert (np.abs(pose.center_m - poses[0].center_m) < 0.05 * sigma).all()
        sigma = np.sqrt(np.diag(free.covariance_center_m2))
        assert (np.abs(free.center_m - weak.center_m) < 0.05 * sigma).all()


@pytest.mark.parametrize(("sigma_deg", "wrong"), [(0.4, 0.0), (4.0, 0.0), (20.0, 0.5)])
@pytest.mark.parametrize("off_deg", [-35.0, -20.0, -8.0, 8.0, 20.0, 35.0])
def test_about_a_wrong_attitude_the_pose_is_right_or_there_is_none(sigma_deg, wrong, off_deg):
    """About a wrong tilt a part of the matches agree still, at a place as far off; those of all outvote it."""
    rng, found = np.random.default_rng(5), 0
    for _ in range(10):
        s = scene(rng, 100, noise_px=0.5, wrong=wrong, relief_m=20.0)
        turn = cv2.Rodrigues(np.deg2rad([off_deg, 0.0, 0.0]))[0]
        pose = solve_pose(s.points_m, s.points_px, K, prior=AttitudePrior(turn @ s.rotation, sigma_deg))
        if pose is not None:
            found += 1
            assert np.linalg.norm(pose.center_m - s.center_m) < 3.0
    assert found >= (1 if sigma_deg < 1.0 and abs(off_deg) < 10.0 else 9 if sigma_deg > 1.0 else 0)


def test_a_prior_on_attitude_separates_tilt_from_displacement():
    rng = np.random.default_rng(11)
    plain, helped = [], []
    for _ in range(80):
        s = scene(rng, 40, noise_px=0.8)
        prior = AttitudePrior(cv2.Rodrigues(np.deg2rad(rng.normal(0, 0.1, 3)))[0] @ s.rotation, sigma_deg=0.1)
        for squared, pose in ((plain, solved(s)), (helped, solved(s, prior=prior))):
            squared.append(np.sum((pose.center_m - s.center_m)[:2] ** 2))
    assert np.mean(helped) < 0.5 * np.mean(plain)


# Refused.


@pytest.mark.parametrize("sets", [15, pytest.param(170, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", WRONG)
def test_wrong_matches_never_give_a_pose(kind, sets):
    """Every other set comes with telemetry."""
    rng = np.random.default_rng([13, list(WRONG).index(kind)])
    for number in range(sets):
        points, pixels = WRONG[kind](rng)
        prior = measured(rng, attitude(rng, rng.uniform(0, 10))) if number % 2 else None
        assert solve_pose(points, pixels, K, prior=prior) is None


def test_many_matches_on_one_spot_count_once():
    """Twelve points of one small thing agree with each other, whatever they show; spread out they carry a pose."""
    rng = np.random.default_rng(21)
    s = scene(rng, 100, wrong=1.0)
    spots = rng.uniform(20, SIZE - 20, (12, 2)), rng.uniform(130, 146, (12, 2))
    for pixels, carried in zip(spots, (True, False), strict=True):
        rays = np.c_[pixels, np.ones(12)] @ np.linalg.inv(K).T @ s.rotation
        points = s.center_m + rays * (-s.center_m[2] / rays[:, 2])[:, None]
        assert (solve_pose(np.r_[s.points_m, points], np.r_[s.points_px, pixels], K) is not None) == carried


@pytest.mark.parametrize("found", [*map(range, (0, 1, 3)), 12 * [0, 1, 2, 3, 4], 30 * [0]], ids=len)
def test_too_few_are_refused_however_often_they_are_found(found):
    s, slots = scene(np.random.default_rng(14), 5), np.array(found, int)
    assert solve_pose(s.points_m[slots], s.points_px[slots], K) is None


@pytest.mark.parametrize("count", [4, 5])
def test_four_or_five_matches_determine_a_pose_and_prove_little(count):
    """As many agree in more than one of 10,000 sets of wrong matches: too little evidence for a fix."""
    assert solved(scene(np.random.default_rng(14), count)).log10_nfa > -4.0


def test_fewer_wrong_matches_are_surer():
    rng = np.random.default_rng(15)
    nfa = [solved(scene(rng, 100, wrong=w, noise_px=0.3)).log10_nfa for w in (0.0, 0.3, 0.6)]
    assert nfa == sorted(nfa)
    assert nfa[0] < -100


def test_points_on_a_line_are_refused():
    rng = np.random.default_rng(16)
    along = rng.uniform(-60, 60, 40)
    points = np.c_[along, 0.5 * along, np.zeros(40)]
    x = (points - [0, 0, 150]) @ scene(rng, tilt_deg=0).rotation.T
    for noise in (0.0, 0.5):
        pixels = (x @ K.T)[:, :2] / x[:, 2:] + rng.normal(0, noise, (40, 2))
        assert solve_pose(points, pixels, K) is None


def test_points_in_one_place_of_the_map_are_refused():
    assert solve_pose(np.zeros((50, 3)), scene(np.random.default_rng(18), 50).points_px, K) is None


def test_a_camera_below_the_ground_is_refused():
    s = scene(np.random.default_rng(19), 50)
    mirrored = s.points_px * (-1, 1) + (SIZE - 1, 0)  # a mirrored picture of a plane is one from below
    assert solve_pose(s.points_m, mirrored, K) is None


def test_the_narrow_view_of_a_plane_is_ambiguous():
    """Nearly parallel rays leave two tilts: a pose is given only when the points tell them apart."""
    points, pixels, noise = narrow_view(np.random.default_rng(20))
    assert solve_pose(points, pixels + noise, NARROW) is None
    assert angle_deg(solve_pose(points, pixels, NARROW).rotation, tilted(8.0)) < 0.1


def test_a_little_relief_does_not_hide_the_ambiguity():
    """A narrow view of ground that is nearly flat leaves two tilts as well, and a wrong one is never given."""
    rng = np.random.default_rng(24)
    refused = 0
    for _ in range(60):
        focal_px = rng.uniform(4000, 12000)
        narrow = np.array([[focal_px, 0, 149.5], [0, focal_px, 149.5], [0, 0, 1]])
        s = scene(rng, 30, noise_px=0.7, relief_m=0.02, tilt_deg=rng.uniform(6, 28), matrix=narrow)
        pose = solve_pose(s.points_m, s.points_px, narrow)
        if pose is None:
            refused += 1
            continue
        turn = cv2.Rodrigues(s.rotation @ pose.rotation.T)[0][:, 0]
        assert turn @ np.linalg.solve(pose.covariance[3:, 3:], turn) < 25
    assert 0 < refused < 60


# From a start


def test_from_a_near_start_one_match_in_six_is_enough_and_from_a_far_one_nothing_is_found():
    s = scene(np.random.default_rng(41), 180, noise_px=0.5, wrong=5 / 6, relief_m=5.0)
    turned = cv2.Rodrigues(np.deg2rad([1.0, -2.0, 1.5]))[0] @ s.rotation
    prior = AttitudePrior(turned, 4.0)
    near = PoseStart(turned, s.center_m + np.array([4.0, -3.0, 2.0]), 20.0)
    found = solve_pose(s.points_m, s.points_px, K, start=near, prior=prior)
    assert np.linalg.norm(found.center_m - s.center_m) < 2.0
    assert np.count_nonzero(found.inliers & s.wrong) <= 3
    far = PoseStart(turned, s.center_m + np.array([90.0, 90.0, 0.0]), 20.0)
    assert solve_pose(s.points_m, s.points_px, K, start=far, prior=prior) is None


def test_where_both_poses_of_a_plane_fit_the_covariance_covers_both_from_a_start():
    """Where the place is known by a vote an unknown tilt makes it vague; it is no reason to refuse."""
    points, pixels, noise = narrow_view(np.random.default_rng(20))
    for wrong_or_right in (tilted(8.0), tilted(-8.0)):
        start = PoseStart(wrong_or_right, -wrong_or_right[2] * 150, 20.0)
        found = solve_pose(points, pixels + noise, NARROW, start=start)
        error = found.center_m + tilted(8.0)[2] * 150
        assert error @ np.linalg.solve(found.covariance_center_m2, error) < chi2.ppf(0.999, 3)
