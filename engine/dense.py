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
    Beaton and Tukey, The fitting of power series, Technometrics 1974,
    https://doi.org/10.1080/00401706.1974.10489171 (biweight).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import ShapeError

Array = NDArray[np.float64]
Image = NDArray[np.float32]

PARAMETERS = 8
LEAST_SAMPLES = 60
_STEPS = 12  # Gauss-Newton steps at most; three or four are usual
_BIWEIGHT = 4.685  # of the residuals' deviation: where Tukey's biweight gives a sample no weight
_MAD = 1.4826  # deviation of normal noise over its median absolute value
_THINNED = 3  # every so many differences tell their median
_EDGE_PX = 2.0  # along the picture's edge nothing is sampled
# Neighbouring samples share what the map does not show: so many count as one.
_SHARED = 2.0


@dataclass(frozen=True, slots=True)
class Samples:
    """Points of the map.

    Attributes:
        points_m: (N, 3) east, north and up.
        values: (N,) what the map shows there, enhanced as the picture is.
        weights: (N,) 0 to 1, how far place and value are to be relied on.
    """

    points_m: Array
    values: Array
    weights: Array

    def __post_init__(self) -> None:
        count = len(self.points_m)
        for name, shape in (("points_m", (count, 3)), ("values", (count,)), ("weights", (count,))):
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
class Belief:
    """What is known before the pictures are compared.

    Attributes:
        pose: the mean; the slope turns the ground about the point below its centre.
        precision: (8, 8) inverse covariance of the parameters, 0 where nothing is known.
    """

    pose: Pose
    precision: Array


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture to sample: (H, W, 3) its levels and their gradients to the right and down, and its pinhole."""

    levels: Image
    matrix: Array


@dataclass(frozen=True, slots=True)
class DenseFit:
    """A refined pose.

    Attributes:
        pose: where picture and map agree best.
        covariance: (8, 8) of the parameters.
        correlation: of picture and map at the samples, before the last step.
        settled: whether the last step was a small one.
    """

    pose: Pose
    covariance: Array
    correlation: float
    settled: bool


@dataclass(frozen=True, slots=True)
class _Look:
    """All samples as a pose sees them.

    Attributes:
        differences: (N,) of picture and map.
        derivatives: (8, N) of the differences.
        weights: (N,) robust ones, 0 where the picture does not show the sample.
        correlation: of picture and map at the samples that the picture shows.
    """

    differences: Array
    derivatives: Array
    weights: Array
    correlation: float


def picture_of(levels: Image, matrix: Array) -> Picture:
    """A picture (H, W) with its gradients by central differences.

    Args:
        levels: enhanced as the map is.
        matrix: (3, 3) pinhole that it obeys.
    """
    across = cv2.Sobel(levels, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    down = cv2.Sobel(levels, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    return Picture(np.asarray(cv2.merge([levels, across, down]), np.float32), matrix)


def correlation_at(picture: Picture, samples: Samples, pose: Pose) -> float:
    """Weighted correlation of picture and map at the samples that a pose sees; 0 where it sees too few.

    The pose is taken as it is, on ground without a further slope.
    """
    offset_m = np.ascontiguousarray((samples.points_m - pose.center_m).T)
    look = _look(picture, samples, offset_m, pose, pose)
    return 0.0 if look is None else look.correlation


def refine(
    picture: Picture, samples: Samples, start: Pose, belief: Belief, *, last_step_sigmas: float = 0.2
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
    pose, fit = start, None
    for _ in range(_STEPS):
        look = _look(picture, samples, offset_m, pose, belief.pose)
        solved = None if look is None else _step(look, pose, belief)
        if look is None or solved is None:
            return None
        step, covariance, sigmas_squared = solved
        pose = _moved(pose, step)
        fit = DenseFit(pose, covariance, look.correlation, sigmas_squared < last_step_sigmas**2)
        if fit.settled:
            break
    return fit


def _step(look: _Look, pose: Pose, belief: Belief) -> tuple[Array, Array, float] | None:
    """The Gauss-Newton step (8,), the covariance (8, 8), and the step in standard deviations, squared."""
    weighted = look.derivatives * look.weights
    variance = float(look.weights @ look.differences**2 / look.weights.sum())
    scale = 1.0 / (_SHARED * max(variance, 1e-12))
    information = scale * (weighted @ look.derivatives.T) + belief.precision
    gradient = -scale * (weighted @ look.differences) - belief.precision @ _away(pose, belief.pose)
    found, covariance = cv2.invert(information, flags=cv2.DECOMP_CHOLESKY)
    if not found:
        return None
    step = covariance @ gradient
    return step, np.asarray(covariance, np.float64), float(step @ gradient)


def _moved(pose: Pose, step: Array) -> Pose:
    turned = cv2.Rodrigues(step[3:6])[0] @ pose.rotation
    return Pose(turned, pose.center_m + step[:3], pose.slope + step[6:])


def _away(pose: Pose, other: Pose) -> Array:
    """The parameters (8,) that lead from another pose to this one."""
    turn = cv2.Rodrigues(pose.rotation @ other.rotation.T)[0][:, 0]
    return np.concatenate([pose.center_m - other.center_m, turn, pose.slope - other.slope])


def _look(picture: Picture, samples: Samples, offset_m: Array, pose: Pose, pivot: Pose) -> _Look | None:
    """Project the samples, which lie (3, N) metres from the slope's pivot, and compare what is seen there."""
    away = offset_m + (pivot.center_m - pose.center_m)[:, None]
    away[2] += pose.slope @ offset_m[:2]
    x = pose.rotation @ away
    near = 1.0 / np.maximum(x[2], 1e-6)
    focal, middle = picture.matrix[:2, :2], picture.matrix[:2, 2:]
    tangents = x[:2] * near
    at = focal @ tangents + middle
    low, (height, width) = _EDGE_PX, picture.levels.shape[:2]
    high = np.array([[width], [height]]) - 1.0 - _EDGE_PX
    seen = ((at > low) & (at < high)).all(axis=0) & (x[2] > 0)
    weights = samples.weights * seen
    if np.count_nonzero(weights) < LEAST_SAMPLES:
        return None
    places = np.clip(at, -1e4, 1e4).astype(np.float32)[:, None]
    level, across, down = cv2.remap(picture.levels, *places, cv2.INTER_LINEAR)[0].T.astype(np.float64)
    differences, weights, correlation = _compare(level, samples.values, weights)
    pull = np.empty_like(x)  # d level / d x
    pull[:2] = focal.T @ np.stack([across, down]) * near
    pull[2] = -(pull[0] * tangents[0] + pull[1] * tangents[1])
    derivatives = np.empty((PARAMETERS, len(level)))
    derivatives[:3] = -pose.rotation.T @ pull
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):  # x cross pull
        derivatives[3 + i] = x[j] * pull[k] - x[k] * pull[j]
    derivatives[6:] = -derivatives[2] * offset_m[:2]
    return _Look(differences, derivatives, weights, correlation)


def _compare(level: Array, value: Array, weights: Array) -> tuple[Array, Array, float]:
    """Differences between picture and map up to gain and bias, robust weights, and the correlation."""
    differences, correlation = _up_to_gain(level, value, weights)
    agreement = _biweight(differences, weights)
    differences, _ = _up_to_gain(level, value, agreement)  # what does not belong there sets no gain
    return differences, _biweight(differences, weights), correlation


def _up_to_gain(level: Array, value: Array, weights: Array) -> tuple[Array, float]:
    total = weights.sum()
    level = level - weights @ level / total
    value = value - weights @ value / total
    weighted = weights * value
    both, own, other = float(weighted @ level), float(weights @ (level * level)), float(weighted @ value)
    return level - both / max(other, 1e-12) * value, both / max(math.sqrt(own * other), 1e-12)


def _biweight(differences: Array, weights: Array) -> Array:
    typical = float(np.median(np.abs(differences[weights > 0][::_THINNED])))
    agreement = np.maximum(1.0 - (differences / (_BIWEIGHT * _MAD * max(typical, 1e-6))) ** 2, 0.0)
    return weights * agreement * agreement
