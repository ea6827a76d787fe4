"""Dense refinement: the camera's pose for which a picture and the map, seen through the surface, agree best.

Gauss-Newton on grey levels: samples of the map with their places in space are projected into the picture, and what
the picture shows there is compared with what the map shows, up to gain and bias. What telemetry knows of attitude
and height, and a slope of the ground that nobody knows, enter as a Gaussian belief.

Convention:
    ``cam_from_map``: x_cam = R (X - C). Parameters are, in this order, the centre C in metres east, north and up,
    a small rotation about the camera's axes in radians, and the ground's slope to the east and to the north.

References:
    Evangelidis and Psarakis, Parametric image alignment using enhanced correlation coefficient maximization,
    PAMI 2008, https://doi.org/10.1109/TPAMI.2008.113 (gain and bias).
    Benhimane and Malis, Real-time image-based tracking of planes using efficient second-order minimization,
    IROS 2004, https://doi.org/10.1109/IROS.2004.1389474 (gradients of both pictures).
    Beaton and Tukey, The fitting of power series, Technometrics 1974,
    https://doi.org/10.1080/00401706.1974.10489171 (biweight).
    Liang and Zeger, Longitudinal data analysis using generalized linear models, Biometrika 1986,
    https://doi.org/10.1093/biomet/73.1.13 (scatter from cell to cell).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import ShapeError

Array = NDArray[np.float64]
Image = NDArray[np.float32]

MIN_SAMPLES = 60
_STEPS = 12  # Gauss-Newton steps at most; three or four are usual
_EDGE_PX = 2.0  # along the picture's edge nothing is sampled
# What the samples pull is summed over so many cells of the picture, squared: how the sums scatter says how far
# neighbours share what the map does not show.
_CELLS = 8
_EXCESS = 1.6  # variance besides, at which the errors over six simulated towns at noon fill the covariance


@dataclass(frozen=True, slots=True)
class Samples:
    """Points of the map.

    Attributes:
        points_m: (N, 3) east, north and up.
        values: (N,) what the map shows there, enhanced as the picture is.
        gradients: (N, 2) of the values, per metre to the east and to the north.
        weights: (N,) 0 to 1, how far place and value are to be relied on.
    """

    points_m: Array
    values: Array
    gradients: Array
    weights: Array

    def __post_init__(self) -> None:
        count = len(self.points_m)
        shapes = {"points_m": (count, 3), "values": (count,), "gradients": (count, 2), "weights": (count,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(f"{name}: expected {shape}, got {getattr(self, name).shape}")


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the camera is and looks, and how the ground leans.

    Attributes:
        rotation: (3, 3) of cam_from_map.
        center_m: (3,) east, north, up.
        slope: (2,) rise of the ground per metre to the east and to the north, besides the samples' heights.
    """

    rotation: Array
    center_m: Array
    slope: Array


@dataclass(frozen=True, slots=True)
class GaussianPrior:
    """What is known before the pictures are compared.

    Attributes:
        pose: the mean; the slope turns the ground about the point below its centre.
        precision: (8, 8) inverse covariance of the parameters, 0 where nothing is known.
    """

    pose: Pose
    precision: Array


@dataclass(frozen=True, slots=True)
class EnhancedFrame:
    """What the camera saw: (H, W) grey levels, enhanced as the map is, and the (3, 3) pinhole that they obey."""

    levels: Image
    matrix: Array


@dataclass(frozen=True, slots=True)
class _Projection:
    """All samples as a pose sees them.

    Attributes:
        differences: (N,) of picture and map.
        places: (3, N) of the samples in the camera.
        offsets_m: (2, N) of the samples from the slope's pivot.
        rotation: (3, 3) of the pose.
        shown: (3, N) derivatives of the differences by the places, as the picture's gradients show them.
        expected: (3, N) the same, as the map's gradients let expect them.
        weights: (N,) robust ones, 0 where the picture does not show the sample.
        cells: (N,) which cell of the picture shows it.
        correlation: of picture and map at the samples that the picture shows.
    """

    differences: Array
    places: Array
    offsets_m: Array
    rotation: Array
    shown: Array
    expected: Array
    weights: Array
    cells: NDArray[np.intp]
    correlation: float

    @property
    def variance(self) -> float:
        """Of the differences."""
        return max(float(self.weights @ self.differences**2 / self.weights.sum()), 1e-12)

    def derivatives(self, by_places: Array) -> Array:
        """(8, N) of the differences by the parameters, from those by the places (3, N)."""
        from engine.kernels import dense_loops

        return np.asarray(dense_loops.derivatives(by_places, self.places, self.offsets_m, self.rotation))


@dataclass(frozen=True, slots=True)
class DenseFit:
    """A refined pose.

    Attributes:
        pose: where picture and map agree best.
        correlation: of picture and map at the samples, before the last step.
        settled: whether the last step was a small one.
        look: what was seen before the last step.
    """

    pose: Pose
    correlation: float
    settled: bool
    look: _Projection


def correlation_at(picture: EnhancedFrame, samples: Samples, pose: Pose) -> float:
    """Weighted correlation of picture and map at the samples that a pose sees; 0 where it sees too few.

    The pose is taken as it is, on ground without a further slope.
    """
    offset_m = np.ascontiguousarray((samples.points_m - pose.center_m).T)
    look = _look(picture, samples, offset_m, pose, pose)
    return 0.0 if look is None else look.correlation


def refine(
    picture: EnhancedFrame, samples: Samples, start: Pose, belief: GaussianPrior, *, last_step_sigmas: float = 0.2
) -> DenseFit | None:
    """Gauss-Newton from a start whose picture is a few pixels off at most.

    Args:
        picture: what the camera saw.
        samples: of the map.
        start: where to begin.
        belief: what is known besides.
        last_step_sigmas: a step this small, in standard deviations of the pose, is the last.

    Returns:
        The pose, or None where too few samples are seen or they leave it undetermined.
    """
    offset_m = np.ascontiguousarray((samples.points_m - belief.pose.center_m).T)
    pose = start
    for left in reversed(range(_STEPS)):
        look = _look(picture, samples, offset_m, pose, belief.pose)
        solved = None if look is None else _step(look, pose, belief)
        if look is None or solved is None:
            return None
        step, sigmas_squared = solved
        pose = _moved(pose, step)
        settled = sigmas_squared < last_step_sigmas**2
        if settled or not left:
            return DenseFit(pose, look.correlation, settled, look)
    return None


def covariance_of(fit: DenseFit, belief: GaussianPrior) -> Array | None:
    """(8, 8) of a refined pose, or None where picture and map leave it undetermined.

    The scatter of what the samples pull, over the squared pull of what both pictures show. Parts of the picture
    that the map does not show have gradients too, which say nothing of the pose: of the picture's information
    counts the share that its gradients have in common with the map's.
    """
    look = fit.look
    shown, expected = look.derivatives(look.shown), look.derivatives(look.expected)
    weighted = shown * look.weights
    information = weighted @ shown.T
    alone = _inverse(information / look.variance + belief.precision)
    if alone is None:
        return None

    def size(matrix: Array) -> float:
        """In the measure of what the samples tell of each parameter besides the belief."""
        return float(np.sum(alone * matrix))

    in_common, of_map = size(weighted @ expected.T), size((expected * look.weights) @ expected.T)
    pulls = 0.5 * (shown + expected) * (look.weights * look.differences)
    by_cell = np.array([np.bincount(look.cells, pull, _CELLS**2) for pull in pulls], np.float64)
    scatter = size(by_cell @ by_cell.T) / size(information)
    if in_common <= 0.0 or scatter <= 0.0:
        return None
    share = min(1.0, in_common**2 / (size(information) * of_map))
    return _inverse(information * (share / (_EXCESS * scatter)) + belief.precision)


def _step(look: _Projection, pose: Pose, belief: GaussianPrior) -> tuple[Array, float] | None:
    """The Gauss-Newton step (8,), and in standard deviations, squared."""
    # The mean of both gradients finds its way from farther than that of the picture alone.
    derivatives = look.derivatives(0.5 * (look.shown + look.expected))
    weighted = derivatives * (look.weights / (_EXCESS * look.variance))
    inverse = _inverse(weighted @ derivatives.T + belief.precision)
    if inverse is None:
        return None
    gradient = -weighted @ look.differences - belief.precision @ _away(pose, belief.pose)
    step = inverse @ gradient
    return step, float(step @ gradient)


def _inverse(matrix: Array) -> Array | None:
    found, inverse = cv2.invert(matrix, flags=cv2.DECOMP_CHOLESKY)
    return np.asarray(inverse, np.float64) if found else None


def _moved(pose: Pose, step: Array) -> Pose:
    turned = cv2.Rodrigues(step[3:6])[0] @ pose.rotation
    return Pose(turned, pose.center_m + step[:3], pose.slope + step[6:])


def _away(pose: Pose, other: Pose) -> Array:
    """The parameters (8,) that lead from another pose to this one."""
    turn = cv2.Rodrigues(pose.rotation @ other.rotation.T)[0][:, 0]
    return np.concatenate([pose.center_m - other.center_m, turn, pose.slope - other.slope])


def _look(
    picture: EnhancedFrame, samples: Samples, offset_m: Array, pose: Pose, pivot: Pose
) -> _Projection | None:
    """Project the samples, which lie (3, N) metres from the slope's pivot, and compare what is seen there."""
    from engine.kernels import dense_loops  # numba takes a while to import

    rotation = np.ascontiguousarray(pose.rotation)  # of one layout, for which the loops are compiled
    levels, places, shown, expected, weights, cells, count = dense_loops.seen(
        picture.levels, picture.matrix, rotation, pose.center_m, pose.slope,
        offset_m, pivot.center_m, samples.gradients, samples.weights, _EDGE_PX, _CELLS,
    )  # fmt: skip
    if count < MIN_SAMPLES:
        return None
    differences, weights, correlation, gain = dense_loops.compare(levels, samples.values, weights)
    expected *= gain
    return _Projection(differences, places, offset_m[:2], rotation, shown, expected, weights, cells, correlation)
