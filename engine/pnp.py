"""Perspective from N points: initial pose, Gauss-Newton on the inliers, and the covariance.

Whether a pose is accepted is decided in :mod:`engine.pose`.

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

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Start = tuple[Array, Array]  # initial pose: rotation (3, 3) and centre (3,)

_STEPS = 12  # Gauss-Newton steps at most; four or five are usual
_STEP_SIGMAS = 2e-2  # a step this small, in standard deviations of the pose, is the last
_PAIRS = 24  # pairs of matches that give candidate centres where the attitude is known
_SLACK = 3.0  # factor on the tolerance at the start, for the error of a known attitude
_REACH_SIGMAS = 4.0
_FAR_PX = 1e9  # assigned coordinates of points behind the camera
_MIN_EIGENVALUE = 1e-7  # of the correlation matrix; below it some direction is not determined


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
        noise_floor_px: Lower bound on the standard deviation of a pixel.
        min_inliers: Fewest inliers of a pose.
    """

    points: Array
    pixels: Array
    K: Array
    weights: Array
    attitude: Array | None
    precision: Array
    tolerance_px: float
    noise_floor_px: float
    min_inliers: int


@dataclass(frozen=True, slots=True)
class Reprojection:
    """All matches reprojected by a pose.

    Attributes:
        tangents: (3, N) x / z, y / z and 1 / z in the camera.
        projected: (2, N) pixels, far off for points behind the camera.
        squared: (N,) of the reprojection distance.
    """

    tangents: Array
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


def ransac(problem: Problem, max_iterations: int, confidence: float, seed: int) -> Start | None:
    """Return the best pose of minimal samples, by OpenCV's USAC with MSAC scores.

    Args:
        problem: The matches.
        max_iterations: Upper bound on the number of samples.
        confidence: Probability, in (0, 1), at which the search stops early.
        seed: Of the samples.

    Returns:
        Rotation (3, 3) and centre (3,), or None where no sample gives a pose.
    """
    params = cv2.UsacParams()
    params.threshold = problem.tolerance_px
    params.confidence = confidence
    params.maxIterations = max_iterations
    params.randomGeneratorState = seed
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


def refine_from_attitude(problem: Problem, seed: int) -> Fit | None:
    """Return the pose near the known attitude, or None unless more than half of the matches are its inliers.

    Two matches and the attitude determine the centre. A majority needs no further search: no other pose can have
    one.
    """
    if problem.attitude is None:
        return None
    R, count = problem.attitude, problem.pixels.shape[1]
    pairs = np.random.default_rng(seed).integers(0, count, (2, _PAIRS))
    x = R @ problem.points
    rays = np.linalg.inv(problem.K) @ np.concatenate([problem.pixels, np.ones((1, count))])
    # x = c + z ray with ray = (., ., 1): x gives the difference of the depths; x and y give the first depth.
    one, two = pairs
    deeper = x[2, one] - x[2, two]
    offset, across = (x[:, one] - x[:, two] - deeper * rays[:, two])[:2], (rays[:, one] - rays[:, two])[:2]
    depth = np.sum(offset * across, axis=0) / np.maximum(np.sum(across * across, axis=0), 1e-12)
    centers = x[:, one] - depth * rays[:, one]
    seen = x[:, None, :] - centers[:, :, None]
    residual = problem.K[:2, :2] @ (seen[:2] / np.maximum(seen[2], 1e-9)).reshape(2, -1)
    residual = residual.reshape(2, _PAIRS, count) + (problem.K[:2, 2:] - problem.pixels)[:, None, :]
    near = np.sum(residual * residual, axis=0) <= (_SLACK * problem.tolerance_px) ** 2
    best = int(np.argmax(np.count_nonzero(near, axis=1)))
    if 2 * np.count_nonzero(near[best]) <= count:
        return None
    fit = gauss_newton(problem, R, R.T @ centers[:, best], slack=_SLACK)
    return fit if fit is not None and 2 * np.count_nonzero(fit.inliers) > count else None


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
    x = R @ problem.points - (R @ center)[:, None]
    behind = x[2] < 1e-9
    x[2, behind] = 1.0
    near = 1 / x[2]
    projected = problem.K[:2, :2] @ (x[:2] * near) + problem.K[:2, 2:]
    projected[:, behind] = _FAR_PX
    x[:2] *= near
    x[2] = near
    residual = projected - problem.pixels
    residual *= residual
    return Reprojection(x, projected, residual[0] + residual[1])


def gauss_newton(
    problem: Problem, R: Array, center: Array, *, steps: int = _STEPS, slack: float = 1.0
) -> Fit | None:
    """Iterate Gauss-Newton with Tukey's biweight; each step updates the inliers and their variance.

    Args:
        problem: The matches.
        R: (3, 3) initial rotation.
        center: (3,) initial centre.
        steps: Upper bound on the number of steps.
        slack: Factor on the tolerance in the first step.

    Returns:
        The pose, or None where there are too few inliers or they do not determine it.
    """
    square = problem.tolerance_px**2
    reach = slack**2 * square
    view, variance, freedom = reproject(problem, R, center), reach / 9, math.inf
    inliers = view.squared <= reach
    for _ in range(steps):
        if (count := np.count_nonzero(inliers)) < problem.min_inliers:
            return None
        gain, noise = _biweight_factors(0.5 * reach / variance)
        scale = noise * _student(freedom) * variance
        normal, gradient = _normal_equations(problem, view, np.maximum(1 - view.squared / reach, 0) ** 2, scale)
        covariance = _inverse(problem, normal)
        if covariance is None:
            return None
        gradient[3:] -= problem.precision @ turn_from_attitude(problem, R)
        delta = covariance @ gradient
        center = center + R.T @ delta[:3]
        R = cv2.Rodrigues(delta[3:])[0] @ R
        view = reproject(problem, R, center)
        # The trace is the number of parameters that the matches determine; the prior determines the rest.
        freedom = 2 * count - float(np.vdot(covariance, normal))
        variance = _variance_px2(float((problem.weights * inliers) @ view.squared) / freedom, problem)
        inliers, reach = view.squared <= square, max(square, _REACH_SIGMAS**2 * variance)
        if float(delta @ gradient) < _STEP_SIGMAS**2:
            break
    return Fit(R, center, view, inliers, gain * normal, variance)


def _normal_equations(
    problem: Problem, view: Reprojection, agreement: Array, variance: float
) -> tuple[Array, Array]:
    """Return J^T W J (6, 6) and -J^T W r (6,), W over the variance, for a step of the centre and of the rotation.

    In the camera's axes, with x = R (X - C), R <- exp([w]) R and C <- C + R^T c:  dx = -c + w x x,  and the pixel
    is K x / z.
    """
    u, v, near = view.tangents
    J = np.zeros((6, 2, len(u)))
    J[0, 0] = J[1, 1] = -near
    J[2, 0], J[2, 1] = u * near, v * near
    J[4, 1] = u * v
    J[3, 0], J[3, 1] = -J[4, 1], -1 - v * v
    J[4, 0] = 1 + u * u
    J[5, 0], J[5, 1] = -v, u
    J = problem.K[:2, :2] @ J
    weighted, flat = (J * (problem.weights * agreement)).reshape(6, -1), J.reshape(6, -1)
    return weighted @ flat.T / variance, weighted @ (problem.pixels - view.projected).ravel() / variance


def _inverse(problem: Problem, information: Array) -> Array | None:
    """Return the covariance (6, 6) by matches and known attitude, or None where they do not determine the pose."""
    total = information.copy()
    total[3:, 3:] += problem.precision
    found, covariance = cv2.invert(total, flags=cv2.DECOMP_CHOLESKY)
    return np.asarray(covariance) if found else None


def _biweight_factors(u: float) -> tuple[float, float]:
    """Return the efficiency factors of the biweight w = (1 - r^2 / T^2)^2 for normal noise s, u = T^2 / (2 s^2).

    The first factor turns the sum of w J^T J into the derivative that the sum of w J^T r is expected to have, the
    second s^2 into the variance that makes it the inverse covariance (Huber's sandwich): with q = r^2 / (2 s^2),
    which is exponential, they are  E[w q] / E[w]  and  E[w^2 q] / E[w q].
    """
    u = min(u, 500.0)
    moments, tail = [1 - math.exp(-u)], math.exp(-u)  # of q up to u: g_n = n g_(n-1) - u^n e^-u
    for n in range(1, 6):
        tail *= u
        moments.append(n * moments[-1] - tail)
    g = [moment / u**n for n, moment in enumerate(moments)]
    weight = g[0] - 2 * g[1] + g[2]
    sensitivity = u * (g[1] - 2 * g[2] + g[3])
    noise = u * (g[1] - 4 * g[2] + 6 * g[3] - 4 * g[4] + g[5])
    return sensitivity / weight, noise / sensitivity


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


def _variance_px2(mean: float, problem: Problem) -> float:
    """Return the variance s^2 at which distances r, truncated at T, have this mean square per axis.

    E[r^2 | r < T] = 2 s^2 (1 - u / (e^u - 1)),  u = T^2 / (2 s^2).
    """
    mean = max(mean, problem.noise_floor_px**2)
    half = 0.5 * problem.tolerance_px**2
    variance = min(mean, half)
    for _ in range(5):
        u = min(half / variance, 50.0)
        variance = min(mean / (1 - u / math.expm1(u)), half)
    return variance


def _student(freedom: float) -> float:
    """Return the variance of Student's t over a normal's, since the variance is itself estimated."""
    return 1.0 if math.isinf(freedom) else freedom / max(freedom - 2, 1.0)


def match_covariance(problem: Problem, fit: Fit) -> Array | None:
    """Return the covariance of a pose.

    Args:
        problem: The matches.
        fit: The refined pose.

    Returns:
        (6, 6) of the centre in the map's axes (m) and of the rotation about the camera's (rad), or None where some
        direction is not determined.
    """
    covariance = _inverse(problem, fit.information)
    if covariance is None:
        return None
    sigma = np.sqrt(np.diag(covariance))
    if np.linalg.eigvalsh(covariance / np.outer(sigma, sigma))[0] < _MIN_EIGENVALUE:
        return None
    to_map = np.eye(6)
    to_map[:3, :3] = fit.rotation.T
    return np.asarray(to_map @ covariance @ to_map.T)
