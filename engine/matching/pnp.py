"""Perspective from N points: initial pose, Gauss-Newton on the inliers, and the covariance.

Whether a pose is accepted is decided in :mod:`engine.matching.pose`.

Convention:
    ``cam_from_map``: x_cam = R (X - C), camera axes x right, y down, z forward. Matches are columns.

References:
    Beaton and Tukey, The fitting of power series, Technometrics 1974,
    https://doi.org/10.1080/00401706.1974.10489171 (biweight).
    Huber, Robust estimation of a location parameter, Annals of Mathematical Statistics 1964,
    https://doi.org/10.1214/aoms/1177703732 (the variance of such an estimate).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.values import SIGNIFICANCE

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Start = tuple[Array, Array]  # initial pose: rotation (3, 3) and centre (3,)

MIN_INLIERS = 4
"""Fewest distinct inliers of a pose: three determine it."""
_MAX_SAMPLES = 1000  # that RANSAC draws
SLACK = 2.0
"""Factor on the tolerance at the start, for the error of a known attitude or of a pose that fits roughly."""
# Of the correlation matrix; below it half of the digits are lost, and some direction is not determined.
_MIN_EIGENVALUE = math.sqrt(np.finfo(np.float64).eps)


@dataclass(frozen=True, slots=True)
class Problem:
    """Matches, prior of the attitude, and inlier tolerance.

    Attributes:
        points: (3, N) map points in metres, about their mean.
        pixels: (2, N) undistorted.
        K: (3, 3) pinhole intrinsics.
        weights: (N,) relative inverse variances of the pixels.
        attitude: (3, 3) rotation of the prior, or None.
        precision: (3, 3) inverse covariance of its angles about the camera's axes in 1/rad^2, 0 without one.
        tolerance_px: A match agrees if it reprojects at most this far off.
    """

    points: Array
    pixels: Array
    K: Array
    weights: Array
    attitude: Array | None
    precision: Array
    tolerance_px: float


@dataclass(frozen=True, slots=True)
class Reprojection:
    """All matches reprojected by a pose.

    Attributes:
        projected: (2, N) pixels, far off for points behind the camera.
        squared: (N,) of the reprojection distance.
    """

    projected: Array
    squared: Array


@dataclass(frozen=True, slots=True)
class Fit:
    """A refined pose.

    Attributes:
        rotation: (3, 3).
        center: (3,) in the problem's metres.
        view: All matches reprojected.
        inliers: (N,) bool.
        information: (6, 6) inverse covariance from the matches alone, for the centre in the camera's axes.
        variance_px2: Of a pixel's x and y.
    """

    rotation: Array
    center: Array
    view: Reprojection
    inliers: Mask
    information: Array
    variance_px2: float


# ------------------------------------------------------------------------------------------------- initial pose


def ransac(problem: Problem) -> Start | None:
    """Return the best pose of minimal samples, by OpenCV's USAC with MSAC scores.

    Args:
        problem: The matches; equal ones give equal poses.

    Returns:
        Rotation (3, 3) and centre (3,), or None if no sample gives a pose.
    """
    params = cv2.UsacParams()
    params.threshold = problem.tolerance_px
    params.confidence = 1.0 - SIGNIFICANCE
    params.maxIterations = _MAX_SAMPLES
    params.randomGeneratorState = 0
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_NULL  # Gauss-Newton below refines instead
    points, pixels = np.ascontiguousarray(problem.points.T), np.ascontiguousarray(problem.pixels.T)
    try:
        found, _, rotvec, t, inliers = cv2.solvePnPRansac(points, pixels, problem.K, None, params=params)
    except cv2.error:  # every sample was degenerate
        return None
    if not found or inliers is None or not (np.isfinite(rotvec).all() and np.isfinite(t).all()):
        return None
    R = cv2.Rodrigues(rotvec)[0]
    return R, -R.T @ t[:, 0]


# ----------------------------------------------------------------------------------------------------- refinement


def reproject(problem: Problem, R: Array, center: Array) -> Reprojection:
    """Reproject all matches.

    Args:
        problem: The matches.
        R: (3, 3) rotation of cam_from_map.
        center: (3,) of the camera, in the problem's metres.

    Returns:
        Pixels and squared distances; points behind the camera are far off.
    """
    from engine.kernels import pose_fit  # numba takes a while to import

    rotation = np.ascontiguousarray(R)  # the loops are compiled for one memory layout
    return Reprojection(*pose_fit.reproject(problem.points, problem.pixels, problem.K, rotation, center)[1:])


def gauss_newton(problem: Problem, R: Array, center: Array, *, slack: float = 1.0) -> Fit | None:
    """Iterate Gauss-Newton with Tukey's biweight; each step updates the inliers and their variance.

    Args:
        problem: The matches.
        R: (3, 3) initial rotation.
        center: (3,) initial centre.
        slack: Factor on the tolerance in the first step.

    Returns:
        The pose, or None if there are too few inliers or they do not determine it.
    """
    from engine.kernels.pose_fit import fit_pose  # numba takes a while to import

    rotation = np.ascontiguousarray(R)  # the loops are compiled for one memory layout
    attitude = rotation if problem.attitude is None else np.ascontiguousarray(problem.attitude)
    found, rotation, center, _, projected, squared, inliers, information, variance = fit_pose(
        problem.points, problem.pixels, problem.K, problem.weights, attitude, problem.precision,
        problem.tolerance_px, MIN_INLIERS, rotation, center, slack,
    )  # fmt: skip
    if not found:
        return None
    return Fit(rotation, center, Reprojection(projected, squared), inliers, information, variance)


def turn_from_attitude(problem: Problem, R: Array) -> Array:
    """Return the rotation from the known attitude to another.

    Args:
        problem: With or without a known attitude.
        R: (3, 3) of cam_from_map.

    Returns:
        (3,) radians about the camera's axes; 0 without a known attitude.
    """
    if problem.attitude is None:
        return np.zeros(3)
    turn: Array = cv2.Rodrigues(R @ problem.attitude.T)[0][:, 0]
    return turn


def match_covariance(problem: Problem, fit: Fit) -> Array | None:
    """Return the covariance of a pose.

    Args:
        problem: The matches.
        fit: The refined pose.

    Returns:
        (6, 6) of the centre in the map's axes (m) and of the rotation about the camera's (rad), or None if some
        direction is not determined.
    """
    information = fit.information.copy()
    information[3:, 3:] += problem.precision
    found, covariance = cv2.invert(information, flags=cv2.DECOMP_CHOLESKY)
    if not found:
        return None
    sigma = np.sqrt(np.diag(covariance))
    if np.linalg.eigvalsh(covariance / np.outer(sigma, sigma))[0] < _MIN_EIGENVALUE:
        return None
    to_map = np.eye(6)
    to_map[:3, :3] = fit.rotation.T
    return np.asarray(to_map @ covariance @ to_map.T)
