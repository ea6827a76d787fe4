"""Perspective from N points: where to start, Gauss-Newton on the matches that agree, and the covariance.

Whether a pose is to be believed is not asked here: :mod:`engine.pose` does.

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
Pose = tuple[Array, Array]  # rotation (3, 3) and centre (3,)

_STEPS = 12  # Gauss-Newton steps at most; four or five are usual
_STEP_SIGMAS = 2e-2  # a step this small, in standard deviations of the pose, is the last
_PAIRS = 24  # pairs of matches that vote for a centre where the attitude is known
_SLACK = 3.0  # by which a known attitude's error may widen the tolerance at the start
_REACH_SIGMAS = 4.0
_FAR_PX = 1e9  # where points behind the camera are said to be
_MIN_EIGENVALUE = 1e-7  # of the correlation matrix; below it some direction is not determined


@dataclass(frozen=True, slots=True)
class Problem:
    """Matches, what is known of the attitude, and what counts as agreement.

    Attributes:
        points: (3, N) map points in metres, about their mean.
        pixels: (2, N) undistorted.
        K: (3, 3) pinhole intrinsics.
        weights: (N,) relative inverse variances of the pixels.
        attitude: (3, 3) rotation known from elsewhere, or None.
        precision: (3, 3) inverse covariance of its angles about the camera's axes in 1/rad^2, 0 without one.
        tolerance_px: A match agrees if it reprojects at most this far off.
        noise_floor_px: Lower bound on the standard deviation of a pixel.
        min_inliers: Fewest matches that carry a pose.
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
    """All matches as a pose sees them.

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
        view: What it sees.
        inliers: (N,) bool, the matches that agree.
        information: (6, 6) inverse covariance that the matches give, for the centre in the camera's axes.
        variance_px2: Of a pixel's x and y.
    """

    rotation: Array
    center: Array
    view: Reprojection
    inliers: Mask
    information: Array
    variance_px2: float


# ----------------------------------------------------------------------------------------------- where to start


def ransac(problem: Problem, max_iterations: int, confidence: float, seed: int) -> Pose | None:
    """Return the best pose that three matches fix, or None where there is none."""
    params = cv2.UsacParams()
    params.threshold = problem.tolerance_px
    params.confidence = confidence
    params.maxIterations = max_iterations
    params.randomGeneratorState = seed
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_NULL  # the refinement below does it better
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
    """Return the pose near the known attitude, or None unless more than half of the matches agree with it.

    Two matches and the attitude fix the centre. A majority needs no further search: no other pose can have one.
    """
    if problem.attitude is None:
        return None
    R, count = problem.attitude, problem.pixels.shape[1]
    pairs = np.random.default_rng(seed).integers(0, count, (2, _PAIRS))
    x = R @ problem.points
    rays = np.linalg.inv(problem.K) @ np.concatenate([problem.pixels, np.ones((1, count))])
    # x = c + z ray with ray = (., ., 1): the depths differ by what x says; x and y give the first.
    one, two = pairs
    deeper = x[2, one] - x[2, two]
    apart, across = (x[:, one] - x[:, two] - deeper * rays[:, two])[:2], (rays[:, one] - rays[:, two])[:2]
    depth = np.sum(apart * across, axis=0) / np.maximum(np.sum(across * across, axis=0), 1e-12)
    centers = x[:, one] - depth * rays[:, one]
    seen = x[:, None, :] - centers[:, :, None]
    residual = problem.K[:2, :2] @ (seen[:2] / np.maximum(seen[2], 1e-9)).reshape(2, -1)
    residual = residual.reshape(2, _PAIRS, count) + (problem.K[:2, 2:] - problem.pixels)[:, None, :]
    near = np.sum(residual * residual, axis=0) <= (_SLACK * problem.tolerance_px) ** 2
    best = int(np.argmax(np.count_nonzero(near, axis=1)))
    if 2 * np.count_nonzero(near[best]) <= count:
        return None
    fit = refine(problem, R, R.T @ centers[:, best], slack=_SLACK)
    return fit if fit is not None and 2 * np.count_nonzero(fit.inliers) > count else None


# ----------------------------------------------------------------------------------------------------- refinement


def look(problem: Problem, R: Array, center: Array) -> Reprojection:
    """Return all matches as the pose sees them."""
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


def refine(problem: Problem, R: Array, center: Array, *, steps: int = _STEPS, slack: float = 1.0) -> Fit | None:
    """Iterate Gauss-Newton with Tukey's biweight; each step finds anew which matches agree, and their variance.

    Args:
        problem: The matches.
        R: (3, 3) where to start.
        center: (3,) where to start.
        steps: At most this many.
        slack: Multiple of the tolerance within which the first step takes matches.

    Returns:
        The pose, or None where too few matches agree or they leave it undetermined.
    """
    square = problem.tolerance_px**2
    reach = slack**2 * square
    view, variance, freedom = look(problem, R, center), reach / 9, math.inf
    inliers = view.squared <= reach
    for _ in range(steps):
        count = np.count_nonzero(inliers)
        if count < problem.min_inliers:
            return None
        gain, noise = _biweight_factors(0.5 * reach / variance)
        scale = noise * _student(freedom) * variance
        normal, gradient = _normal_equations(problem, view, np.maximum(1 - view.squared / reach, 0) ** 2)
        normal, gradient = normal / scale, gradient / scale
        covariance = _inverse(problem, normal)
        if covariance is None:
            return None
        gradient[3:] -= problem.precision @ turn_from_attitude(problem, R)
        delta = covariance @ gradient
        center = center + R.T @ delta[:3]
        R = cv2.Rodrigues(delta[3:])[0] @ R
        view = look(problem, R, center)
        # What the prior knows need not be taken from the matches: the trace is the parameters that were.
        freedom = 2 * count - float(np.vdot(covariance, normal))
        variance = _variance_px2(float((problem.weights * inliers) @ view.squared) / freedom, problem)
        inliers, reach = view.squared <= square, max(square, _REACH_SIGMAS**2 * variance)
        if float(delta @ gradient) < _STEP_SIGMAS**2:
            break
    return Fit(R, center, view, inliers, gain * normal, variance)


def _normal_equations(problem: Problem, view: Reprojection, agreement: Array) -> tuple[Array, Array]:
    """Return J^T W J (6, 6) and -J^T W r (6,) for a step of the centre, in the camera's axes, and of the rotation.

    With x = R (X - C), R <- exp([w]) R and C <- C + R^T c:  dx = -c + w x x,  and the pixel is K x / z.
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
    return weighted @ flat.T, weighted @ (problem.pixels - view.projected).ravel()


def _inverse(problem: Problem, information: Array) -> Array | None:
    """Return the covariance (6, 6) of matches and known attitude, or None where they leave the pose open."""
    total = information.copy()
    total[3:, 3:] += problem.precision
    found, covariance = cv2.invert(total, flags=cv2.DECOMP_CHOLESKY)
    return np.asarray(covariance) if found else None


def _biweight_factors(u: float) -> tuple[float, float]:
    """Return what the biweight w = (1 - r^2 / T^2)^2 does to normal noise s, u = T^2 / (2 s^2).

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
    pull = u * (g[1] - 2 * g[2] + g[3])
    noise = u * (g[1] - 4 * g[2] + 6 * g[3] - 4 * g[4] + g[5])
    return pull / weight, noise / pull


def turn_from_attitude(problem: Problem, R: Array) -> Array:
    """Return the rotation (3,) in radians from the known attitude to R, about the camera's axes; 0 without one."""
    if problem.attitude is None:
        return np.zeros(3)
    turn: Array = cv2.Rodrigues(R @ problem.attitude.T)[0][:, 0]
    return turn


def _variance_px2(mean: float, problem: Problem) -> float:
    """Return the variance s^2 at which distances r, cut off at T, have this mean square per axis.

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
    """Return the variance of Student's t over a normal's: the price of a variance that is itself estimated."""
    return 1.0 if math.isinf(freedom) else freedom / max(freedom - 2, 1.0)


def covariance_of(problem: Problem, fit: Fit) -> Array | None:
    """Return the covariance (6, 6) of the centre in the map's axes and of the rotation about the camera's.

    None where the matches leave some direction open.
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
