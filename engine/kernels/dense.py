"""Dense refinement: find the camera pose at which an image and the map on its surface model agree best.

Gauss-Newton on grey levels: 3D samples of the map are projected into the picture, whose levels there are compared
with the map's, up to gain and bias. Attitude and height of the telemetry, and an unknown slope of the ground,
enter as a Gaussian prior.

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
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of the map.

    Attributes:
        points_m: (N, 3) east, north and up.
        values: (N,) levels of the map there, enhanced as the picture is.
        gradients: (N, 2) of the values, per metre to the east and to the north.
        weights: (N,) 0 to 1, reliability of position and value.
    """

    points_m: Array
    values: Array
    gradients: Array
    weights: Array


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of the camera, and slope of the ground.

    Attributes:
        rotation: (3, 3) of cam_from_map.
        center_m: (3,) east, north, up.
        slope: (2,) rise of the ground per metre to the east and to the north, in addition to the samples' heights.
    """

    rotation: Array
    center_m: Array
    slope: Array


@dataclass(frozen=True, slots=True)
class GaussianPrior:
    """Gaussian prior of the parameters.

    Attributes:
        pose: the mean; the slope pivots at the point below its centre.
        precision: (8, 8) inverse covariance of the parameters, 0 where nothing is known.
    """

    pose: Pose
    precision: Array


@dataclass(frozen=True, slots=True)
class EnhancedFrame:
    """The camera's picture.

    Attributes:
        levels: (H, W) grey levels, enhanced as the map is.
        matrix: (3, 3) pinhole intrinsics.
    """

    levels: NDArray[np.float32]
    matrix: Array


@dataclass(frozen=True, slots=True)
class DenseFit:
    """A refined pose, and the samples as they were projected before the last step.

    Attributes:
        pose: at which picture and map agree best.
        converged: whether the last step was small.
        first_correlation: of picture and map at the samples, at the pose to begin with.
        correlation: the same, at those that are visible from the pose before the last step.
        projected: what :func:`engine.kernels.gauss_newton.information` takes.
    """

    pose: Pose
    converged: bool
    first_correlation: float
    correlation: float
    projected: tuple[NDArray[Any], ...]


def correlation_at(picture: EnhancedFrame, samples: Samples, pose: Pose) -> float:
    """Weighted correlation of picture and map at the samples that are visible from a pose.

    Args:
        picture: of the camera.
        samples: of the map.
        pose: its slope pivots at the point below its own centre.

    Returns:
        In [-1, 1]; 0 where fewer than :data:`engine.kernels.dense_loops.MIN_SAMPLES` are visible.
    """
    from engine.kernels import dense_loops  # numba takes a while to import

    offset_m = np.ascontiguousarray((samples.points_m - pose.center_m).T)
    levels, _, _, _, weights, _, count = dense_loops.project(
        picture.levels, picture.matrix, np.ascontiguousarray(pose.rotation), pose.center_m, pose.slope,
        offset_m, pose.center_m, samples.gradients, samples.weights,
    )  # fmt: skip
    if count < dense_loops.MIN_SAMPLES:
        return 0.0
    return float(dense_loops.compare_levels(levels, samples.values, weights)[2])


def refine(picture: EnhancedFrame, samples: Samples, start: Pose, prior: GaussianPrior) -> DenseFit | None:
    """Gauss-Newton from a start with a reprojection error of at most a few pixels.

    Args:
        picture: of the camera.
        samples: of the map.
        start: initial pose.
        prior: of the parameters.

    Returns:
        The pose, or None if too few samples are visible or the pose is not determined.
    """
    from engine.kernels.gauss_newton import gauss_newton  # numba takes a while to import

    offset_m = np.ascontiguousarray((samples.points_m - prior.pose.center_m).T)
    # The loops are compiled for one memory layout of the matrices.
    first, mean = ((np.ascontiguousarray(p.rotation), p.center_m, p.slope) for p in (start, prior.pose))
    found, converged, at_first, correlation, *pose, projected = gauss_newton(
        picture.levels, picture.matrix, first, mean, prior.precision,
        offset_m, samples.values, samples.gradients, samples.weights,
    )  # fmt: skip
    return DenseFit(Pose(*pose), converged, at_first, correlation, projected) if found else None


def covariance_of(fit: DenseFit, prior: GaussianPrior) -> Array | None:
    """Covariance of a refined pose.

    The information of the samples is divided by the scatter of their score vectors from cell to cell (Liang and
    Zeger). Parts of the picture that are not on the map have gradients without information on the pose: only the
    share of the information that the picture's gradients have in common with the map's counts.

    Args:
        fit: from :func:`refine`.
        prior: the one that it was refined with.

    Returns:
        (8, 8) in the order of the parameters, or None if the pose is not determined.
    """
    from engine.kernels import gauss_newton

    own, common, of_map, by_cell = gauss_newton.information(*fit.projected)
    *_, weights, differences, _ = fit.projected
    variance = max(float(weights @ differences**2 / weights.sum()), 1e-12)
    reference = _inverse(own / variance + prior.precision)
    if reference is None:
        return None

    def size(matrix: Array) -> float:
        """Trace in units of the covariance of samples and prior."""
        return float(np.sum(reference * matrix))

    in_common, of_picture = size(common), size(own)
    if in_common <= 0.0 or of_picture <= 0.0:
        return None
    scatter = size(by_cell @ by_cell.T) / of_picture
    if scatter <= 0.0:
        return None
    share = min(1.0, in_common**2 / (of_picture * size(of_map)))
    return _inverse(own * (share / (gauss_newton.EXCESS * scatter)) + prior.precision)


def _inverse(matrix: Array) -> Array | None:
    found, inverse = cv2.invert(matrix, flags=cv2.DECOMP_CHOLESKY)
    return np.asarray(inverse, np.float64) if found else None
