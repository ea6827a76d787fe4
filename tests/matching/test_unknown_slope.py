"""A map alone: the refined pose over ground whose slope nobody stated."""

from dataclasses import replace

import numpy as np
import pytest

from engine import MatcherOptions, SceneMatcher
from engine.kernels.dense import Pose
from engine.matching.unknown_slope import over_unknown_slope, wide_slope_deg
from engine.options import NccOptions
from tests.matching.test_relief import hill, off_m, plane, seen

HEIGHT_M = 150.0
NADIR = np.array([310.0, 305.0])
TRUE = {"roll_deg": 4.0, "pitch_deg": -3.0, "heading_deg": 20.0}
OFF_DEG = [(0.5, -0.3), (-0.4, 0.4), (0.2, 0.5), (-0.5, -0.2)]


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


@pytest.mark.parametrize("slope_deg", [(0.0, 0.3), (0.4, -0.2), (1.5, 1.0)])
def test_exchanging_the_prior_equals_inference_with_each_and_their_mean_by_evidence(slope_deg):
    measured = picture() @ np.concatenate([[0.3, -0.2, 0.5, 0.004, -0.003, 0.01], tangent(np.array(slope_deg))])
    mean, covariance, _ = inferred(measured, tangent(wide_slope_deg(2.0)))
    pose = Pose(np.eye(3), mean[:3], mean[6:])
    free, _, _ = inferred(measured, 1e6)
    found = over_unknown_slope(pose, covariance, free[:2], HEIGHT_M, 2.0)
    parts = [inferred(measured, tangent(sigma)) for sigma in (0.35, 0.7, 1.4, 2.8)]
    weights = np.array([part[2] for part in parts])
    weights /= weights.sum()
    expected = sum(weight * part[0] for weight, part in zip(weights, parts, strict=True))
    spread = sum(
        weight * (part[1] + np.outer(part[0] - expected, part[0] - expected))
        for weight, part in zip(weights, parts, strict=True)
    )
    np.testing.assert_allclose(found.pose.center_m, expected[:3], atol=2e-3)
    np.testing.assert_allclose(found.pose.slope, expected[6:], atol=1e-5)
    np.testing.assert_allclose(found.covariance[:2, :2], spread[:2, :2], rtol=1e-3, atol=2e-3)
    assert found.covariance[2, 2] >= spread[2, 2]


def test_a_pose_that_is_not_the_peak_s_is_not_confirmed():
    measured = picture() @ np.full(8, 1e-3)
    mean, covariance, _ = inferred(measured, tangent(wide_slope_deg(2.0)))
    pose = Pose(np.eye(3), mean[:3], mean[6:])
    free, _, _ = inferred(measured, 1e6)
    assert over_unknown_slope(pose, covariance, free[:2] + np.array([0.9, 0.0]), HEIGHT_M, 2.0) is not None
    assert over_unknown_slope(pose, covariance, free[:2] + np.array([1.1, 0.0]), HEIGHT_M, 2.0) is None
    assert over_unknown_slope(pose, covariance, free[:2] + np.array([1.1, 0.0]), 2.0 * HEIGHT_M, 2.0) is not None


@pytest.fixture(scope="module")
def site(ground):
    return ground.map_of(georeference_sigma_m=0.1)


def matcher_of(site, camera, refine):
    return SceneMatcher(site, camera, "ncc", "cpu", MatcherOptions(ncc=NccOptions(refine=refine)))


@pytest.fixture(scope="module")
def level_fixes(ground, site, camera):
    """Over level ground, by telemetry whose tilt is off as assumed: fix and (2,) error, by peak and refined."""
    frame = ground.frame(camera, NADIR, HEIGHT_M, **TRUE)
    by_peak, refined = [], []
    for rows, refine in ((by_peak, False), (refined, True)):
        matcher = matcher_of(site, camera, refine)
        for roll_deg, pitch_deg in OFF_DEG:
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
    prior = ground.prior(np.array([315.0, 296.0]))
    peak, fix = (matcher_of(site, camera, refine).locate(frame, prior) for refine in (False, True))
    assert off_m(ground, fix) < off_m(ground, peak) + 0.5
