"""Covariance of a fix by correlation, from its peak and the assumed errors of telemetry, map and ground."""

from __future__ import annotations

import math

import numpy as np

from engine.assumed_errors import AssumedErrors
from engine.camera import Camera
from engine.geo import Array, transport_covariance
from engine.values import GridPose, Peak

_MAX_TURNED = math.radians(60.0)
_ASIDE = math.tan(math.radians(2.0))  # of an axis that counts as vertical
# Neighbouring pixels share their noise: a square with this side counts as one.
_CORRELATION_PX = 5.0


def tilt_covariance(cam_from_map: Array, sigma_rad: float) -> Array:
    """Covariance of an unknown tilt.

    Args:
        cam_from_map: (3, 3) rotation of the camera.
        sigma_rad: standard deviation of the tilt about east and about north.

    Returns:
        (3, 3) in rad^2, of a small turn about the camera's axes.
    """
    horizontal = cam_from_map[:, :2]
    return np.asarray(sigma_rad**2 * horizontal @ horizontal.T)


def scale_doubt_m(off_m: float, height_m: float, camera_down: Array, stated_down: Array | None) -> float:
    """Position error to allow for if a measured height is not the telemetry's.

    A focal length that is wrong by some share scales the height and the optical axis's angle off the vertical;
    distortion missing from the calibration also looks like a tilt. Or the telemetry's height is wrong: the picture
    cannot tell.

    Args:
        off_m: how far the heights are apart.
        height_m: as measured.
        camera_down: (3,) optical axis in east, north, up, as measured.
        stated_down: the same by the telemetry; None if that is unknown.

    Returns:
        One standard deviation per axis.
    """
    aside = float(np.hypot(*camera_down[:2])) / max(-float(camera_down[2]), 1e-3) + _ASIDE
    turned = 0.0 if stated_down is None else math.acos(min(1.0, float(stated_down @ camera_down)))
    return math.hypot(off_m * aside, height_m * math.tan(min(turned, _MAX_TURNED)))


def score_sigma(pixels: int) -> float:
    """Standard deviation of the NCC between a patch and ground that it does not show.

    The correlation coefficient of N independent samples about zero has the variance 1/N.
    """
    return 1.0 / math.sqrt(max(1.0, pixels / _CORRELATION_PX**2))


def peak_covariance_px(peak: Peak, pixels: int) -> Array:
    """Covariance of a correlation peak (Cramer-Rao).

    For a picture that is the map plus Gaussian noise, the log-likelihood of a shift is N/2 log(1 - rho^2), whose
    second derivative at the peak is N rho rho'' / (1 - rho^2); its inverse is the covariance. N is that of
    :func:`score_sigma`.

    Args:
        peak: the peak.
        pixels: of the template.

    Returns:
        (2, 2) in square pixels, x before y.
    """
    independent = 1.0 / score_sigma(pixels) ** 2
    rho = min(max(peak.score, 0.05), 0.999)
    information = -peak.curvature * independent * rho / (1.0 - rho * rho)
    # A ridge has no curvature along it: the peak is still known there to a few pixels.
    values, vectors = np.linalg.eigh(information)
    variances = np.clip(1.0 / np.maximum(values, 1e-9), 0.05**2, 5.0**2)
    return np.asarray((vectors * variances) @ vectors.T, dtype=np.float64)


def misalignment_covariance_px2(
    peak: Peak, shape: tuple[int, int], height_m: float, errors: AssumedErrors
) -> Array:
    """Covariance of a peak whose template is rotated or scaled relative to the map.

    An error of heading or height moves every part of the patch by a different amount. If the parts stay within the
    width of the peak, the peak lies at their mean, and nothing is lost; if not, it follows the part with the
    strongest texture, which may be anywhere. The share between the two is u^2 / (u^2 + width^2).

    Args:
        peak: of the patch.
        shape: (rows, columns) of the patch.
        height_m: above the ground.
        errors: assumed errors of height and heading.

    Returns:
        (2, 2) in square pixels.
    """
    share = math.hypot(errors.height_share, errors.height_m / height_m, math.radians(errors.heading_deg))
    apart = share**2 * (shape[0] ** 2 + shape[1] ** 2) / 24.0  # mean over the patch along one axis
    bend = -float(np.trace(peak.curvature)) / 2.0
    width = max(peak.score, 0.05) / max(bend, 1e-9)
    return np.asarray(apart * apart / (apart + width) * np.eye(2), dtype=np.float64)


def ncc_covariance_m2(
    peak_px2: Array, pose: GridPose, camera: Camera, enu_jacobian: Array, errors: AssumedErrors
) -> Array:
    """Covariance of a fix by correlation.

    The nadir is the template's position minus an offset from height and attitude, so their errors move the fix:
    half a degree of tilt is 1.3 m at 150 m.

    Args:
        peak_px2: (2, 2) covariance of the peak in square pixels.
        pose: known height and attitude that aligned the frame.
        camera: its mount gives the direction of the optical axis.
        enu_jacobian: (2, 2) metres east and north per pixel.
        errors: of the telemetry and the map.

    Returns:
        (3, 3) east, north, up in square metres.
    """
    attitude, height = pose.known_attitude, pose.known_height_m
    values = (height, attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg)
    height_sigma = errors.height_sigma_m(height)
    sigmas = (height_sigma, *errors.tilts_deg(pose), errors.heading_deg)
    spread = np.empty((2, 4))  # each column is already scaled by its sigma
    axis = camera.mount[:, 2].tolist()
    for column, sigma in enumerate(sigmas):
        more, less = list(values), list(values)
        more[column] += sigma
        less[column] -= sigma
        (east, north), (other_east, other_north) = _aim_m(axis, *more), _aim_m(axis, *less)
        spread[:, column] = 0.5 * (east - other_east), 0.5 * (north - other_north)
    horizontal = spread @ spread.T + transport_covariance(enu_jacobian, peak_px2) + errors.map_m**2 * np.eye(2)
    covariance = np.diag([0.0, 0.0, height_sigma**2])
    covariance[:2, :2] = horizontal
    return covariance


def _aim_m(
    axis: list[float], height_m: float, roll_deg: float, pitch_deg: float, heading_deg: float
) -> tuple[float, float]:
    """Where the optical axis meets the ground, in metres east and north of the nadir.

    Args:
        axis: forward, right and down in the body.
        height_m: above the ground.
        roll_deg: of the body.
        pitch_deg: likewise.
        heading_deg: likewise.
    """
    forward, right, down = axis
    roll, pitch, heading = math.radians(roll_deg), math.radians(pitch_deg), math.radians(heading_deg)
    sr, sp, sh = math.sin(roll), math.sin(pitch), math.sin(heading)
    cr, cp, ch = math.cos(roll), math.cos(pitch), math.cos(heading)
    ahead = cp * forward + sp * (sr * right + cr * down)  # along the heading, see engine.geo.enu_from_body
    aside = cr * right - sr * down
    below = -sp * forward + cp * (sr * right + cr * down)
    reach_m = height_m / max(below, 1e-3)
    return (sh * ahead + ch * aside) * reach_m, (ch * ahead - sh * aside) * reach_m
