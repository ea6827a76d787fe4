"""Camera pose from matched points: options in, statistics out, or None if the matches do not support a pose.

:mod:`engine.matching.pnp` finds inliers, even among wrong matches alone, and refines the pose on them. Here an
a-contrario test bounds the expected number of poses with as many inliers by chance.

Convention:
    ``cam_from_map``: x_cam = R (X - C), camera axes x right, y down, z forward; map axes in metres, z up.
    Pixels are those of a pinhole camera, distortion already taken out.

References:
    Moisan and Stival, A probabilistic criterion to detect rigid point matches between two images, IJCV 2004,
    https://doi.org/10.1023/B:VISI.0000013094.38752.54 (a-contrario test).
    Schweighofer and Pinz, Robust pose estimation from a planar target, PAMI 2006,
    https://doi.org/10.1109/TPAMI.2006.252 (the two poses of a planar target).
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from engine.geo import Array, chi_square_of
from engine.matching import pnp
from engine.matching.pnp import MIN_INLIERS, SLACK, Fit, Mask, Problem, Reprojection
from engine.matching.votes import chance_of_agreeing
from engine.options import PoseOptions
from engine.values import SIGNIFICANCE

_SAME_POSE_DEG = 1.5
_CLOSER = (1.0, 2.0, 4.0)  # factors on the tolerance, tried in turn; without the prior a pose starts from the last
_CLOSE_SHARE, _CLOSE_INLIERS = 0.15, 12  # fewest inliers, as a share of those within the widest tolerance
# By how many times the inliers it must have more. Under right attitudes 134 frames of four flights had up to 1.07
# times as many and one 1.16, under angles in radians, swapped or of the wrong sign each wrong pose but one 1.09.
_CONTESTED = 1.1
# And by how much the two must differ: features over a surface model of another year measured tilts wrong by 2.3.
_CONTESTED_TILT_DEG, _CONTESTED_TURN_DEG = 3.0, 10.0
_IDENTITY = np.eye(3)


@dataclass(frozen=True, slots=True)
class AttitudePrior:
    """Prior of the attitude, such as telemetry.

    Attributes:
        rotation: (3, 3) of cam_from_map.
        sigma_deg: Standard deviation of the angle about each axis: one number, or (x, y, z).
        axes: (3, 3) rotation from the camera to the axes of ``sigma_deg``, such as a mount for those of the body;
            the default is the camera's own.
    """

    rotation: Array
    sigma_deg: float | tuple[float, float, float]
    axes: Array = field(default_factory=lambda: np.eye(3))

    @property
    def precision(self) -> Array:
        """(3, 3) inverse covariance in 1/rad^2 of the angles about the camera's axes."""
        return np.asarray(self.axes.T * (np.deg2rad(self.sigma_deg) ** -2.0 * np.ones(3)) @ self.axes)


@dataclass(frozen=True, slots=True)
class PoseStart:
    """An initial pose, in place of RANSAC's.

    Attributes:
        rotation: (3, 3) of cam_from_map.
        center_m: (3,) the camera's centre in the map's axes.
        tolerance_px: the pose should reproject right matches to within this.
    """

    rotation: Array
    center_m: Array
    tolerance_px: float


@dataclass(frozen=True, slots=True)
class PoseStats:
    """A pose with its uncertainty.

    Attributes:
        rotation: (3, 3) R of x_cam = R (X_map - center).
        center_m: (3,) the camera's centre in the map's axes.
        covariance: (6, 6) of the centre (m) and of a small rotation about the camera's axes (rad).
        inliers: (N,) bool.
        log10_nfa: log10 of the number of false alarms; the lower, the more significant.
        log10_tried: log10 of the number of poses among which it is the best.
    """

    rotation: Array
    center_m: Array
    covariance: Array
    inliers: Mask
    log10_nfa: float
    log10_tried: float

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
    start: PoseStart | None = None,
) -> PoseStats | None:
    """Estimate the pose with the most inliers.

    Args:
        points_m: (N, 3) map points in metres; they may be coplanar and far from the origin.
        points_px: (N, 2) undistorted pixels (x, y).
        camera_matrix: (3, 3) pinhole intrinsics.
        options: Tolerances; the defaults suit frames of a few hundred pixels.
        weights: (N,) relative inverse variances of the image points; None is 1 for all.
        prior: Attitude for the refinement, which separates tilt from displacement at a small field of view; it is
            dropped if markedly more matches agree without it.
        start: Start of the refinement; None searches for an initial pose.

    Returns:
        None if the matches are few, collinear, behind the camera, ambiguous or, without a start, as many as chance
        gives.
    """
    options = options or PoseOptions()
    weights = np.ones(len(points_m)) if weights is None else weights
    known = np.flatnonzero(np.isfinite(points_m).all(1) & np.isfinite(points_px).all(1) & (weights > 0))
    if len(known) < MIN_INLIERS or _spread(points_px[known].T) < options.min_spread_px:
        return None
    origin = points_m[known].mean(0)
    problem = Problem(
        points=(points_m[known] - origin).T,
        pixels=points_px[known].T,
        K=camera_matrix,
        weights=weights[known],
        attitude=None if prior is None else prior.rotation,
        precision=np.zeros((3, 3)) if prior is None else prior.precision,
        tolerance_px=options.reprojection_px,
    )
    fit = _fit(problem) if start is None else _fit_from(problem, start, origin)
    if fit is not None and prior is not None:
        problem, fit = _without_wrong_prior(problem, fit)
    if fit is None or not _supported(problem, fit, options):
        return None
    other = _other_pose(problem, fit, options)
    if other is not None and start is None:
        return None
    (log10_nfa, log10_tried), covariance = _false_alarms(problem, fit, options), pnp.match_covariance(problem, fit)
    is_chance = start is None and log10_nfa >= 0.0  # the votes for a start are the evidence for its place
    if is_chance or covariance is None:
        return None
    if other is not None:  # the place is known but not the tilt: either pose may be right
        apart = np.append(other.center - fit.center, np.zeros(3))
        covariance = covariance + 0.5 * apart[:, None] * apart
    inliers = np.zeros(len(points_m), bool)
    inliers[known[fit.inliers]] = True
    return PoseStats(fit.rotation, fit.center + origin, covariance, inliers, log10_nfa, log10_tried)


def _spread(points: Array) -> float:
    """Return the smallest standard deviation of points (2, N) over all directions."""
    x, y = points - points.mean(axis=1, keepdims=True)
    xx, xy, yy = float(x @ x), float(x @ y), float(y @ y)
    smaller = 0.5 * (xx + yy - math.hypot(xx - yy, 2 * xy))
    return math.sqrt(max(smaller, 0.0) / points.shape[1])


def _fit(problem: Problem) -> Fit | None:
    start = pnp.ransac(problem)
    return None if start is None else pnp.gauss_newton(problem, *start)


def _fit_from(problem: Problem, start: PoseStart, origin: Array) -> Fit | None:
    """The fit near an initial pose, to all matches within its tolerance or to the fewer that agree more closely.

    If most agree only roughly, as over changed ground, the closer ones alone would be chance.
    """
    wide = replace(problem, tolerance_px=max(start.tolerance_px, problem.tolerance_px))
    near = pnp.gauss_newton(wide, start.rotation, start.center_m - origin)
    if near is None:
        return None
    enough = max(_CLOSE_SHARE * np.count_nonzero(near.inliers), _CLOSE_INLIERS)
    for factor in _CLOSER:
        closer = replace(problem, tolerance_px=min(factor * problem.tolerance_px, wide.tolerance_px))
        close = pnp.gauss_newton(closer, near.rotation, near.center, slack=SLACK)
        if close is not None and np.count_nonzero(close.inliers) >= enough:
            return close
    return near


def _without_wrong_prior(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """The fit, or the one without the prior if so many more matches agree with it that the prior is wrong.

    With an attitude ten degrees off, part of the frame still agrees, at a correspondingly wrong place.
    """
    free = replace(problem, attitude=None, precision=np.zeros((3, 3)))
    wide = replace(free, tolerance_px=_CLOSER[-1] * problem.tolerance_px)
    near = pnp.gauss_newton(wide, fit.rotation, fit.center)
    close = None if near is None else pnp.gauss_newton(free, near.rotation, near.center, slack=SLACK)
    if close is None or np.count_nonzero(close.inliers) < _CONTESTED * np.count_nonzero(fit.inliers):
        return problem, fit
    x, y, z = np.degrees(pnp.turn_from_attitude(problem, close.rotation)).tolist()
    is_other = math.hypot(x, y) > _CONTESTED_TILT_DEG or abs(z) > _CONTESTED_TURN_DEG
    return (free, close) if is_other else (problem, fit)


def _supported(problem: Problem, fit: Fit, options: PoseOptions) -> bool:
    """Whether there are enough inliers, not collinear, below the camera."""
    if np.count_nonzero(fit.inliers) < MIN_INLIERS:
        return False
    above = float(fit.center[2] - problem.points[2, fit.inliers].mean())
    return above > 0 and _spread(problem.pixels[:, fit.inliers]) >= options.min_spread_px


def _false_alarms(problem: Problem, fit: Fit, options: PoseOptions) -> tuple[float, float]:
    """Return log10 of the expected number of poses with as many inliers of N matches by chance, and of all poses.

    NFA = (N - 3) C(N, k) C(k, 3) 4 p^(k - 3), k the distinct inliers (Moisan and Stival). p is the probability
    that a wrong match is an inlier. Three matches determine up to four poses.
    """
    from engine.kernels import clusters  # numba takes a while to import

    total, agreeing_px = problem.pixels.shape[1], np.ascontiguousarray(problem.pixels[:, fit.inliers].T)
    k = int(clusters.count_apart(agreeing_px, options.distinct_px))
    if k < MIN_INLIERS:
        return math.inf, 0.0
    area_px2 = float((np.ptp(problem.pixels, axis=1) + 1).prod())
    p = chance_of_agreeing(fit.view.projected, problem.pixels, fit.inliers, options.reprojection_px, area_px2)
    distinct = total * k / np.count_nonzero(fit.inliers)  # among as many fewer in all
    tried = _log10_choose(k, 3) + math.log10(4 * (total - 3))
    return tried + _log10_choose(distinct, k) + (k - 3) * math.log10(p), tried


def _log10_choose(n: float, k: int) -> float:
    return (math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)) / math.log(10)


def _other_pose(problem: Problem, fit: Fit, options: PoseOptions) -> Fit | None:
    """The other of the two poses of a plane, if it explains the matches nearly as well."""
    R, center = _mirrored(problem.points[:, fit.inliers], fit)
    if _same(R, fit.rotation):
        return None
    cost = _cost(problem, fit.rotation, fit.view, fit.variance_px2, options)
    if _cost(problem, R, pnp.reproject(problem, R, center), fit.variance_px2, options) > 2 * cost + 50:
        return None  # too far off for a refinement to compensate
    other = pnp.gauss_newton(problem, R, center)
    if other is None or _same(other.rotation, fit.rotation):
        return None
    other_cost = _cost(problem, other.rotation, other.view, fit.variance_px2, options)
    return other if other_cost < cost + chi_square_of(SIGNIFICANCE, 1) else None


def _mirrored(points: Array, fit: Fit) -> tuple[Array, Array]:
    """Return the other pose from which a plane through the points looks the same under weak perspective.

    Depth mirrored along the line of sight v, and the plane in its normal n:  R' = (1 - 2 v v^T) R (1 - 2 n n^T).
    """
    middle = points.mean(axis=1)
    centred = points - middle[:, None]
    n = np.linalg.eigh(centred @ centred.T)[1][:, 0]
    seen = fit.rotation @ (middle - fit.center)
    v = seen / np.linalg.norm(seen)
    mirror, plane = _IDENTITY - 2 * v[:, None] * v, _IDENTITY - 2 * n[:, None] * n
    R = mirror @ fit.rotation @ plane
    return R, middle - R.T @ seen


def _same(R: Array, other: Array) -> bool:
    return float(np.sum(R * other)) > 1 + 2 * math.cos(math.radians(_SAME_POSE_DEG))


def _cost(problem: Problem, R: Array, view: Reprojection, variance: float, options: PoseOptions) -> float:
    """Return chi-square of all matches, each bounded at the threshold, and of the prior."""
    cost = float(problem.weights @ np.minimum(view.squared, options.reprojection_px**2)) / variance
    turn = pnp.turn_from_attitude(problem, R)
    return cost + float(turn @ problem.precision @ turn)
