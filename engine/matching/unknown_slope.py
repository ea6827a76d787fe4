"""Ground without a surface model: a refined pose over a plane of unknown slope.

A ground slope and a camera tilt look alike, so the picture shows only their sum. Most ground is nearly level, some
is not: the slope's prior is a mixture of normal distributions of several widths. A small sum is then mostly an
attitude error, a large one mostly a slope.

The pose is refined with a wide prior of the slope, or solved over level ground with an attitude that is less
certain by as much. That prior is then replaced by each of the mixture's, as by a measurement of zero slope with
that accuracy (a Kalman update). Evidence weights the results.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from engine.geo import Array
from engine.kernels.dense import Pose
from engine.matching.pose import AttitudePrior

Mixture = tuple[Array, Array, Array]
"""Steps (N, 8) from a pose, their covariances (N, 8, 8), and the logarithms (N,) of their weights."""

# Widths of the mixture in units of the assumed slope, the rarer the steeper: fitted to no flight. Over drawn towns
# with hills of 0 to 30 m the mean normalised squared error of SIFT's positions is 1.0 to 1.8.
_WIDTHS = (0.175, 0.35, 0.7, 1.4, 2.8)
# The refinement without its prior of the slope and the peak rest on the same attitude: over level simulated towns
# 98 % of poses agreed to this share of the height (the peak is as inexact), over hills of 8 to 30 m 19 to 33 %.
_MAX_APART_SHARE = 0.0067


@dataclass(frozen=True, slots=True)
class SlopeFit:
    """A pose over ground of unknown slope.

    Attributes:
        pose: the mean, with the more probable attitude.
        covariance: (8, 8) in the order of :mod:`engine.kernels.dense`'s parameters.
    """

    pose: Pose
    covariance: Array


def _wide(unknown_slope_deg: float) -> float:
    """Standard deviation of the slope for the first refinement: twice the variance of the mixture's widest."""
    return math.sqrt(2.0) * _WIDTHS[-1] * math.radians(unknown_slope_deg)


def wide_slope_deg(unknown_slope_deg: float) -> float:
    """Standard deviation of the slope for the first refinement, as the angle of that slope in degrees."""
    return math.degrees(math.atan(_wide(unknown_slope_deg)))


def over_unknown_slope(
    pose: Pose, covariance: Array, peak_en_m: Array, height_m: float, unknown_slope_deg: float
) -> SlopeFit | None:
    """Replace the wide slope prior of a refined pose by the mixture of likely slopes.

    Args:
        pose: refined, with the prior of :func:`wide_slope_deg` about level ground.
        covariance: (8, 8) of it.
        peak_en_m: (2,) position by the peak alone, in metres east and north.
        height_m: above the ground.
        unknown_slope_deg: standard deviation of slopes of unknown ground, in degrees.

    Returns:
        The pose, or None if the ground is not a plane: the refined position without a slope prior then differs
        from the peak's.
    """
    unbounded = covariance[6:, 6:] - _wide(unknown_slope_deg) ** 2 * np.eye(2)  # with the wide prior removed
    free = -covariance[:2, 6:] @ np.linalg.solve(unbounded, pose.slope)
    apart_m = pose.center_m[:2] + free - peak_en_m
    if math.hypot(*apart_m) > _MAX_APART_SHARE * height_m:
        return None
    over = _mixed(pose, [_by_likely_slopes(pose.slope, covariance, unknown_slope_deg)], height_m)
    over.covariance[:2, :2] += apart_m[:, None] * apart_m  # one of the two is off by this much
    return over


def from_level_ground(
    pose: Pose,
    covariance: Array,
    ground_m: Array,
    attitudes: Sequence[tuple[float, AttitudePrior]],
    unknown_slope_deg: float,
) -> SlopeFit:
    """Divide the tilt of a pose between the camera and the ground.

    Args:
        pose: solved as if the ground were level, with a prior of roll and pitch that is less certain than the
            first of ``attitudes`` by :func:`wide_slope_deg`.
        covariance: (6, 6) of centre and rotation.
        ground_m: (3,) the middle of what was matched.
        attitudes: priors of the attitude itself, with their probabilities.
        unknown_slope_deg: standard deviation of slopes of unknown ground, in degrees.
    """
    R, wide_rad2, mixed = pose.rotation, _wide(unknown_slope_deg) ** 2 * np.eye(2), []
    turns = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])  # of the ground, by its slopes to the east and north
    moves = np.vstack([np.cross(turns.T, pose.center_m - ground_m).T, -R @ turns])  # (6, 2) of the pose with it
    for probability, attitude in attitudes:
        total = (R.T @ np.linalg.inv(attitude.precision) @ R)[:2, :2] + wide_rad2
        tilt = (R.T @ cv2.Rodrigues(R @ attitude.rotation.T)[0][:, 0])[:2]  # the ground's and the attitude's
        gain = wide_rad2 @ turns[:2].T @ np.linalg.inv(total)
        by_pose, left = np.hstack([np.zeros((2, 3)), gain @ R.T[:2]]), wide_rad2 - gain @ turns[:2] @ wide_rad2
        known, unknown = np.vstack([np.eye(6) + moves @ by_pose, by_pose]), np.vstack([moves, np.eye(2)])
        slope, both = gain @ tilt, known @ covariance @ known.T + unknown @ left @ unknown.T
        log_weight = math.log(probability) + _log_normal(tilt, total)
        steps, covariances, log_weights = _by_likely_slopes(slope, both, unknown_slope_deg)
        mixed.append((unknown @ slope + steps, covariances, log_weight + log_weights))
    return _mixed(pose, mixed, float(pose.center_m[2] - ground_m[2]))


def _by_likely_slopes(slope: Array, covariance: Array, unknown_slope_deg: float) -> Mixture:
    """The steps that put each of the mixture's priors in place of the wide one."""
    sigma = np.array(_WIDTHS) * math.radians(unknown_slope_deg)
    variance = 1.0 / (sigma**-2 - _wide(unknown_slope_deg) ** -2)  # of the measurements that turn that into them
    totals = covariance[6:, 6:] + variance[:, None, None] * np.eye(2)
    gains = covariance[:, 6:] @ np.linalg.inv(totals)
    log_weights = np.log(variance / sigma**2 / _WIDTHS) + _log_normal(slope, totals)
    return -gains @ slope, covariance - gains @ covariance[6:], log_weights


def _log_normal(values: Array, covariances: Array) -> Array:
    """Logarithms of normal densities about 0 with covariances (..., 2, 2), up to a constant."""
    return np.asarray(-0.5 * (np.log(np.linalg.det(covariances)) + np.linalg.inv(covariances) @ values @ values))


def _mixed(pose: Pose, kinds: Sequence[Mixture], height_m: float) -> SlopeFit:
    """A mixture of steps from a pose: the mean of the most probable kind, the covariance of all about that."""
    steps, covariances, log_weights = (np.stack(each) for each in zip(*kinds, strict=True))  # (kinds, widths, ...)
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    best = weights.sum(axis=1).argmax()
    step = weights[best] @ steps[best] / weights[best].sum()
    between = steps - step
    covariance = np.einsum("kn,knij->ij", weights, covariances)
    covariance += np.einsum("kn,kni,knj->ij", weights, between, between)
    slope = pose.slope + step[6:]
    # Sloping ground is seldom a plane: as far away as the camera is high it rises or falls by about as much.
    relief_m2 = height_m**2 * 0.5 * float(slope @ slope + np.trace(covariance[6:, 6:]))
    covariance[2, 2] += relief_m2
    rotation = cv2.Rodrigues(step[3:6])[0] @ pose.rotation
    return SlopeFit(Pose(rotation, pose.center_m + step[:3], slope), covariance)
