"""Ground without a surface model: a refined pose over a plane of unknown slope.

A ground slope and a camera tilt look alike, so the picture shows only their sum. Most ground is nearly level, some
is not: the slope's prior is a mixture of normal distributions of several widths. A small sum is then mostly an
attitude error, a large one mostly a slope.

The pose is refined with a wide prior of the slope. Afterwards that prior is replaced by each of the mixture's, as
by a measurement of zero slope with that accuracy (a Kalman update). Evidence weights the results.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.kernels.dense import Pose

Array = NDArray[np.float64]

# Widths of the mixture in units of the assumed slope, all equally probable: fitted to no flight, but to draws of
# both errors. With slopes of any one width from 0 to 4 degrees the mean normalised squared error is 1.1 to 2.2.
_WIDTHS = (0.175, 0.35, 0.7, 1.4)
# The refinement without its prior of the slope and the peak rest on the same attitude: over level simulated towns
# 98 % of poses agreed to this share of the height (the peak is as inexact), over hills of 8 to 30 m 19 to 33 %.
_MAX_APART_SHARE = 0.0067


@dataclass(frozen=True, slots=True)
class SlopeFit:
    """A pose over ground of unknown slope.

    Attributes:
        pose: the mean.
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
    wide = _wide(unknown_slope_deg)
    unbounded = covariance[6:, 6:] - wide**2 * np.eye(2)  # with the wide prior removed
    free = -covariance[:2, 6:] @ np.linalg.solve(unbounded, pose.slope)
    apart_m = pose.center_m[:2] + free - peak_en_m
    if math.hypot(*apart_m) > _MAX_APART_SHARE * height_m:
        return None
    steps, covariances, log_weights = [], [], []
    for width in _WIDTHS:
        sigma = width * math.radians(unknown_slope_deg)
        variance = 1.0 / (sigma**-2 - wide**-2)  # of the measurement that turns the wide prior into this one
        total = covariance[6:, 6:] + variance * np.eye(2)
        gain = np.linalg.solve(total, covariance[6:]).T
        steps.append(-gain @ pose.slope)
        covariances.append(covariance - gain @ covariance[6:])
        chi_square = float(pose.slope @ np.linalg.solve(total, pose.slope))
        log_weights.append(math.log(variance / sigma**2) - 0.5 * (math.log(np.linalg.det(total)) + chi_square))
    weights = np.exp(np.array(log_weights) - max(log_weights))
    weights /= weights.sum()
    over = _mixed(pose, np.array(steps), np.array(covariances), weights, height_m)
    over.covariance[:2, :2] += apart_m[:, None] * apart_m  # one of the two is off by this much
    return over


def _mixed(pose: Pose, steps: Array, covariances: Array, weights: Array, height_m: float) -> SlopeFit:
    """Mean and covariance of a mixture of steps (K, 8) from a pose, with covariances (K, 8, 8)."""
    step = weights @ steps
    between = steps - step
    covariance = np.einsum("k,kij->ij", weights, covariances) + (weights[:, None] * between).T @ between
    slope = pose.slope + step[6:]
    # Sloping ground is seldom a plane: as far away as the camera is high it rises or falls by about as much.
    relief_m2 = height_m**2 * 0.5 * float(slope @ slope + np.trace(covariance[6:, 6:]))
    covariance[2, 2] += relief_m2
    rotation = cv2.Rodrigues(step[3:6])[0] @ pose.rotation
    return SlopeFit(Pose(rotation, pose.center_m + step[:3], slope), covariance)
