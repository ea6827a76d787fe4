"""Camera pose from matched points: options in, statistics out, or None where the matches do not carry a pose.

OpenCV's RANSAC finds the matches that agree, Gauss-Newton refines on them, and an a-contrario test asks whether
chance could have made as many agree: RANSAC alone finds a pose in any set of wrong matches.

Convention:
    ``cam_from_map``: x_cam = R X_map + t, camera axes x right, y down, z forward; map axes in metres, z up.
    Pixels are those of a pinhole camera, distortion already taken out.

References:
    Moisan and Stival, A probabilistic criterion to detect rigid point matches between two images, IJCV 2004,
    https://doi.org/10.1023/B:VISI.0000013094.38752.54 (a-contrario test).
    Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 2014,
    https://doi.org/10.1007/s11263-014-0725-5 (the two poses that a plane allows).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import DtypeError, OptionError, ShapeError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SAMPLE = 3  # matches that fix a pose, up to ...
_POSES_PER_SAMPLE = 4
_ROUNDS = 4  # alternations of refinement and selection
_STEPS = 4  # Gauss-Newton steps in each
_PAIRED = 300  # projections that are compared with all image points for the chance of agreement
_SAME_POSE_DEG = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseOptions:
    """What counts as agreement, and how long to search for it.

    Attributes:
        reprojection_px: A match agrees with a pose if it reprojects at most this far off.
        max_iterations: Samples that RANSAC draws at most.
        confidence: Probability, in (0, 1), at which RANSAC stops early.
        min_inliers: Fewest distinct matches that may carry a pose.
        max_log10_nfa: Upper bound on log10 of the number of false alarms, the expected number of poses that as
            many matches support by chance.
        min_spread_px: Smallest standard deviation of the inliers in the image, in the direction where they
            spread least; below it they are nearly on a line.
        min_cost_gap: Chi-square by which the pose must beat the other one that a plane allows.
        noise_floor_px: Lower bound on the standard deviation taken for an image point's x and y.
        seed: Of RANSAC's samples; equal inputs and seeds give equal poses.
    """

    reprojection_px: float = 3.0
    max_iterations: int = 1000
    confidence: float = 0.999
    min_inliers: int = 6
    max_log10_nfa: float = -6.0
    min_spread_px: float = 6.0
    min_cost_gap: float = 9.0
    noise_floor_px: float = 0.05
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("reprojection_px", "min_spread_px", "min_cost_gap", "noise_floor_px"):
            if not 0 < getattr(self, name) < math.inf:
                raise OptionError(f"{name}: expected a positive number, got {getattr(self, name)}")
        if not 0 < self.confidence < 1:
            raise OptionError(f"confidence: expected a number in (0, 1), got {self.confidence}")
        if self.max_iterations < 1:
            raise OptionError(f"max_iterations: expected at least 1, got {self.max_iterations}")
        if self.min_inliers < 4:
            raise OptionError(f"min_inliers: expected at least 4, got {self.min_inliers}")
        if math.isnan(self.max_log10_nfa):
            raise OptionError("max_log10_nfa: expected a number, got nan")
        if self.seed < 0:
            raise OptionError(f"seed: expected at least 0, got {self.seed}")


@dataclass(frozen=True, slots=True)
class AttitudePrior:
    """Attitude known from elsewhere, such as telemetry.

    Attributes:
        rotation: (3, 3) of cam_from_map.
        sigma_deg: Standard deviation of the angle about each camera axis: one number, or (x, y, z).
    """

    rotation: Array
    sigma_deg: float | tuple[float, float, float]

    def __post_init__(self) -> None:
        if np.shape(self.rotation) != (3, 3):
            raise ShapeError(f"rotation: expected (3, 3), got {np.shape(self.rotation)}")
        if np.shape(self.sigma_deg) not in ((), (3,)) or not np.all(np.asarray(self.sigma_deg) > 0):
            raise OptionError(f"sigma_deg: expected one or three positive numbers, got {self.sigma_deg}")


@dataclass(frozen=True, slots=True)
class PoseStats:
    """A pose and how far it can be trusted.

    Attributes:
        rotation: (3, 3) R of x_cam = R X_map + t.
        translation: (3,) t in metres.
        center_m: (3,) the camera's centre in the map's axes, -R^T t.
        covariance: (6, 6) of the centre (m) and of a small rotation about the camera's axes (rad).
        inliers: (N,) bool, the matches that agree.
        rms_px: Root mean square of the inliers' reprojection distances.
        sigma_px: Standard deviation estimated for an image point's x and y.
        log10_nfa: log10 of the number of false alarms; the lower, the surer.
    """

    rotation: Array
    translation: Array
    center_m: Array
    covariance: Array
    inliers: Mask
    rms_px: float
    sigma_px: float
    log10_nfa: float

    @property
    def covariance_center_m2(self) -> Array:
        """(3, 3) covariance of ``center_m``."""
        return self.covariance[:3, :3]


def solve_pose(
    points_m: Array,
    points_px: Array,
    camera_matrix: Array,
    options: PoseOptions | None = None,
    *,
    weights: Array | None = None,
    prior: AttitudePrior | None = None,
) -> PoseStats | None:
    """Estimate the pose that most matches agree on.

    Args:
        points_m: (N, 3) map points in metres; they may lie in one plane and far from the origin.
        points_px: (N, 2) undistorted pixels (x, y).
        camera_matrix: (3, 3) pinhole intrinsics.
        options: Thresholds; the defaults suit frames of a few hundred pixels.
        weights: (N,) relative inverse variances of the image points; None is 1 for all.
        prior: Attitude that the refinement takes into account; at a small field of view it separates a tilt
            from a displacement.

    Returns:
        The pose, or None where the matches are too few, on a line, repeated, behind the camera, ambiguous
        between the two poses of a plane, or not more consistent than chance would make them.
    """
    options = options or PoseOptions()
    points_m, points_px, K, weights = _checked(points_m, points_px, camera_matrix, weights)
    finite = np.isfinite(points_m).all(1) & np.isfinite(points_px).all(1) & (weights > 0)
    known = np.flatnonzero(finite)
    if len(known) < options.min_inliers or _spread(points_px[known]) < options.min_spread_px:
        return None
    origin = points_m[known].mean(0)
    matches = _Matches(points_m[known] - origin, points_px[known], K, weights[known], prior)
    start = _ransac(matches, options)
    if start is None:
        return None
    fit = _refine(matches, start, options)
    if fit is None or not _supported(matches, fit, options) or _ambiguous(matches, fit, options):
        return None
    log10_nfa = _log10_nfa(matches, fit, options)
    if log10_nfa > options.max_log10_nfa:
        return None
    inliers = np.zeros(len(finite), bool)
    inliers[known[fit.inliers]] = True
    center = fit.center + origin
    return PoseStats(
        rotation=fit.rotation,
        translation=-fit.rotation @ center,
        center_m=center,
        covariance=fit.covariance,
        inliers=inliers,
        rms_px=float(np.sqrt(np.mean(np.sum(fit.residual[fit.inliers] ** 2, axis=1)))),
        sigma_px=fit.sigma_px,
        log10_nfa=log10_nfa,
    )


@dataclass(frozen=True, slots=True)
class _Matches:
    points: Array  # (N, 3) about their mean
    pixels: Array
    K: Array
    weights: Array
    prior: AttitudePrior | None


@dataclass(frozen=True, slots=True)
class _Fit:
    rotation: Array
    center: Array
    inliers: Mask
    residual: Array  # (N, 2) of all matches
    sigma_px: float
    covariance: Array
    cost: float


def _checked(points_m: Array, points_px: Array, camera_matrix: Array, weights: Array | None) -> tuple[Array, ...]:
    count = len(points_m)
    weights = np.ones(count) if weights is None else weights
    expected = {"points_m": (count, 3), "points_px": (count, 2), "camera_matrix": (3, 3), "weights": (count,)}
    out = []
    for (name, shape), values in zip(expected.items(), (points_m, points_px, camera_matrix, weights), strict=True):
        array = np.asarray(values)
        if array.shape != shape:
            raise ShapeError(f"{name}: expected {shape}, got {array.shape}")
        if array.dtype.kind not in "fiu":
            raise DtypeError(f"{name}: expected real numbers, got {array.dtype}")
        out.append(array.astype(np.float64))
    return tuple(out)


def _spread(points: Array) -> float:
    """Return the smallest standard deviation of points (N, 2) over all directions."""
    return math.sqrt(max(float(np.linalg.eigvalsh(np.cov(points.T, bias=True))[0]), 0.0))


def _ransac(matches: _Matches, options: PoseOptions) -> tuple[Array, Array] | None:
    """Return rotation and centre of the best pose from three matches."""
    params = cv2.UsacParams()
    params.threshold = options.reprojection_px
    params.confidence = options.confidence
    params.maxIterations = options.max_iterations
    params.randomGeneratorState = options.seed
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_NULL  # the refinement below does it better
    try:
        found, _, rotvec, t, inliers = cv2.solvePnPRansac(
            matches.points, matches.pixels, matches.K, None, params=params
        )
    except cv2.error:  # every sample was degenerate
        return None
    if not found or inliers is None or not (np.isfinite(rotvec).all() and np.isfinite(t).all()):
        return None
    R = cv2.Rodrigues(rotvec)[0]
    return R, -R.T @ t[:, 0]


def _residual(matches: _Matches, R: Array, center: Array) -> tuple[Array, Array]:
    """Return (N, 2) projection less pixel, infinite behind the camera, and (N, 3) points in the camera."""
    x = (matches.points - center) @ R.T
    ahead = x[:, 2] > 1e-9
    depth = np.where(ahead, x[:, 2], 1.0)
    projected = (x / depth[:, None]) @ matches.K[:2].T
    return np.where(ahead[:, None], projected - matches.pixels, np.inf), x


def _inliers(residual: Array, options: PoseOptions) -> Mask:
    return np.asarray(np.einsum("ij,ij->i", residual, residual) <= options.reprojection_px**2)


def _refine(
    matches: _Matches, start: tuple[Array, Array], options: PoseOptions, rounds: int = _ROUNDS
) -> _Fit | None:
    """Alternate between the pose of the inliers and the inliers of the pose."""
    R, center = start
    residual, x = _residual(matches, R, center)
    inliers = _inliers(residual, options)
    sigma = options.reprojection_px / 3
    for _ in range(rounds):
        if inliers.sum() < options.min_inliers:
            return None
        for _ in range(_STEPS):
            step = _gauss_newton_step(matches, R, residual, x, inliers, sigma)
            if step is None:
                return None
            delta, _covariance = step
            center = center + delta[:3]
            R = cv2.Rodrigues(delta[3:])[0] @ R
            residual, x = _residual(matches, R, center)
            if not np.isfinite(residual[inliers]).all():
                return None
            if float(np.abs(delta) @ (1, 1, 1, 100, 100, 100)) < 1e-6:
                break
        sigma = _sigma_px(matches, residual, inliers, options)
        previous, inliers = inliers, _inliers(residual, options)
        if np.array_equal(previous, inliers):
            break
    if inliers.sum() < options.min_inliers:
        return None
    step = _gauss_newton_step(matches, R, residual, x, inliers, sigma)
    if step is None:
        return None
    cost = _cost(matches, R, center, options, sigma)
    return _Fit(R, center, inliers, residual, sigma, step[1], cost)


def _sigma_px(matches: _Matches, residual: Array, inliers: Mask, options: PoseOptions) -> float:
    """Return the deviation s whose distances r, cut off at T, have the inliers' mean square.

    E[r^2 | r < T] = 2 s^2 (1 - u / (e^u - 1)),  u = T^2 / (2 s^2).
    """
    squared = float(matches.weights[inliers] @ np.einsum("ij,ij->i", residual[inliers], residual[inliers]))
    mean = max(squared / (2 * inliers.sum() - 6), options.noise_floor_px**2)
    half, variance = 0.5 * options.reprojection_px**2, mean
    for _ in range(5):
        u = min(half / variance, 50.0)
        variance = min(mean / (1 - u / math.expm1(u)), half)
    return math.sqrt(variance)


def _prior_residual(prior: AttitudePrior | None, R: Array) -> Array:
    """Return the rotation from the prior's attitude to R, about the camera's axes, in sigmas."""
    if prior is None:
        return np.zeros(3)
    turn: Array = cv2.Rodrigues(R @ prior.rotation.T)[0][:, 0]
    return turn / np.deg2rad(prior.sigma_deg)


def _gauss_newton_step(
    matches: _Matches, R: Array, residual: Array, x: Array, inliers: Mask, sigma: float
) -> tuple[Array, Array] | None:
    """Return the step (centre, rotation) and the covariance (6, 6), or None where the pose is undetermined.

    With x = R (X - C), R <- exp([w]) R and C <- C + c:  dx = -R c - [x] w,  and the pixel is K x / z.
    """
    X, Y, Z = x[inliers].T
    zero = np.zeros_like(Z)
    to_pixel = np.stack([1 / Z, zero, -X / Z**2, zero, 1 / Z, -Y / Z**2], axis=1).reshape(-1, 2, 3)
    to_pixel = matches.K[:2, :2] @ to_pixel
    turn = np.stack([zero, Z, -Y, -Z, zero, X, Y, -X, zero], axis=1).reshape(-1, 3, 3)
    root = np.repeat(np.sqrt(matches.weights[inliers]), 2) / sigma
    J = np.concatenate([-to_pixel @ R, to_pixel @ turn], axis=2).reshape(-1, 6) * root[:, None]
    normal, right = J.T @ J, -J.T @ (residual[inliers].ravel() * root)
    if matches.prior is not None:
        precision = 1 / np.deg2rad(np.broadcast_to(matches.prior.sigma_deg, 3))
        normal[3:, 3:] += np.diag(precision**2)
        right[3:] -= precision * _prior_residual(matches.prior, R)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(scale, scale)
    if not np.isfinite(scaled).all() or np.linalg.eigvalsh(scaled)[0] < 1e-10:
        return None
    covariance = np.linalg.inv(scaled) / np.outer(scale, scale)
    return covariance @ right, covariance


def _supported(matches: _Matches, fit: _Fit, options: PoseOptions) -> bool:
    """Ask for enough distinct inliers, not on a line, and seen from above."""
    return (
        _distinct(matches, fit.inliers) >= options.min_inliers
        and _spread(matches.pixels[fit.inliers]) >= options.min_spread_px
        and float(fit.center[2]) > float(np.median(matches.points[fit.inliers, 2]))
    )


def _distinct(matches: _Matches, chosen: Mask) -> int:
    """Return how many pixels, whole numbers of x and y, the chosen matches occupy."""
    pixels = np.round(matches.pixels[chosen]).astype(np.int64)
    return len(np.unique(pixels[:, 0] * (1 << 32) + pixels[:, 1]))


def _log10_nfa(matches: _Matches, fit: _Fit, options: PoseOptions) -> float:
    """Return log10 of the expected number of poses that as many of N matches support by chance.

    NFA = (N - 3) C(N, k) C(k, 3) 4 p^(k - 3), k the inliers. p is the chance that a wrong match agrees: the
    share of all pairings of a map point with an image point, also of other matches, that agree with the pose.
    This counts the crowding of the points, which a uniform density would not.
    """
    total, k = len(matches.pixels), _distinct(matches, fit.inliers)
    if k <= _SAMPLE:
        return math.inf
    square = options.reprojection_px**2
    own = np.arange(0, total, -(-total // _PAIRED))
    dx, dy = ((fit.residual + matches.pixels)[own, axis, None] - matches.pixels[:, axis] for axis in (0, 1))
    near = dx * dx + dy * dy <= square
    agree = int(near.sum()) - int(near[np.arange(len(own)), own].sum())
    extent = np.ptp(matches.pixels, axis=0) + 1
    uniform = math.pi * square / float(extent[0] * extent[1])
    p = min(max(agree / (len(own) * (total - 1)), uniform), 1.0)
    counts = (
        _log10_choose(total, k) + _log10_choose(k, _SAMPLE) + math.log10((total - _SAMPLE) * _POSES_PER_SAMPLE)
    )
    return counts + (k - _SAMPLE) * math.log10(p)


def _log10_choose(n: int, k: int) -> float:
    return (math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)) / math.log(10)


def _ambiguous(matches: _Matches, fit: _Fit, options: PoseOptions) -> bool:
    """Ask whether the other of the two poses that a plane allows explains the inliers nearly as well."""
    points, pixels = matches.points[fit.inliers], matches.pixels[fit.inliers]
    try:
        _, rotvecs, ts, _ = cv2.solvePnPGeneric(points, pixels, matches.K, None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # the points are in no plane: one pose
        return False
    for rotvec, t in zip(rotvecs, ts, strict=True):
        R = cv2.Rodrigues(rotvec)[0]
        center = -R.T @ t[:, 0]
        if _same(R, fit.rotation) or _cost(matches, R, center, options, fit.sigma_px) > 4 * fit.cost + 100:
            continue  # too far off for a refinement to make up
        other = _refine(matches, (R, center), options, rounds=1)
        if other is None or _same(other.rotation, fit.rotation):
            continue
        cost = _cost(matches, other.rotation, other.center, options, fit.sigma_px)
        if cost < fit.cost + options.min_cost_gap:
            return True
    return False


def _same(R: Array, other: Array) -> bool:
    return bool(np.trace(R @ other.T) > 1 + 2 * math.cos(math.radians(_SAME_POSE_DEG)))


def _cost(matches: _Matches, R: Array, center: Array, options: PoseOptions, sigma: float) -> float:
    """Return chi-square of all matches, each bounded at the threshold, and of the prior."""
    residual, _ = _residual(matches, R, center)
    squared = np.minimum(np.einsum("ij,ij->i", residual, residual), options.reprojection_px**2)
    return float(matches.weights @ squared) / sigma**2 + float(np.sum(_prior_residual(matches.prior, R) ** 2))
