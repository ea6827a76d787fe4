"""From a camera frame to a template aligned with the map: grey, enhance, rectify (equations 2 and 3).

Convention:
    A rectified patch has the map's pixels and axes. Its ``offset_px`` is the position of its top-left pixel
    relative to the camera's nadir, so that nadir = (matched position on the map) - offset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import OptionError
from engine.geo import enu_from_body
from engine.values import Attitude, Frame

Array = NDArray[np.float64]
FloatImage = NDArray[np.float32]

# Beyond this angle off the vertical a footprint is stretched more than 4 times and relief occludes the ground.
MAX_RAY_DEG = 75.0
# A frame that is finer than the map by more than this factor is averaged down first, to prevent aliasing.
_MAX_SHRINK = 0.75
_ASPECTS = np.array([1.0, 4 / 3, 3 / 4, 16 / 9, 9 / 16])
# Least size of a patch as a share of the requested fraction.
MIN_SHRINK = 0.25
_SHRINKS = np.linspace(1.0, MIN_SHRINK, 61)
# Corners (S, A, 4, 2) about the middle of rectangles of area 1 and below, the largest first.
_RECTANGLES = (
    0.5
    * _SHRINKS[:, None, None, None]
    * np.stack([np.sqrt(_ASPECTS), 1.0 / np.sqrt(_ASPECTS)], axis=1)[:, None]
    * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
)
SCORES = ("grey", "local", "gradient", "mixed")
_MIDDLE_GREY = 127.5
# Added to the local variance, in squared grey levels, so that sensor noise on flat ground is not amplified.
_NOISE_VARIANCE = 4.0


def to_gray(frame: Frame) -> NDArray[np.uint8]:
    """The frame's picture in grey, on the CPU; colours by ITU-R BT.601 luma.

    Args:
        frame: its image is (H, W) or (H, W, 3), on any device.

    Returns:
        (H, W) uint8.
    """
    image = frame.image if isinstance(frame.image, np.ndarray) else frame.image.cpu().numpy()
    if image.ndim == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    return np.ascontiguousarray(image)


def check_score(score: str) -> None:
    """Raise OptionError where no score has this name."""
    if score not in SCORES:
        raise OptionError(f"score: expected one of {', '.join(SCORES)}, got {score!r}")


def enhance(
    gray: NDArray[np.uint8], *, radius_px: int = 8, score: str = "local", valid: NDArray[np.bool_] | None = None
) -> FloatImage:
    """The paper's "enhance" step: what of the grey levels is correlated, the same for frame and map.

    The picture is first smoothed by the binomial 1-2-1, since aliasing of sampled edges biases correlation peaks
    towards whole pixels. ``docs/scores.md`` compares the scores.

    - "local": each pixel less its neighbourhood's mean, over its standard deviation, which is robust to shadows,
      haze and exposure.
    - "gradient": the same of the gradient's magnitude, which is invariant to the sign of a contrast.
    - "mixed": the sum of both.
    - "grey": the smoothed grey levels less middle grey.

    Args:
        gray: (H, W).
        radius_px: neighbourhoods are boxes of 2 radius_px + 1 pixels; 0 is without normalisation.
        score: one of :data:`SCORES`.
        valid: (H, W) bool; pixels where it is False are ignored and 0 in the result.

    Returns:
        (H, W) float32.

    Raises:
        OptionError: the radius is negative, or no score has this name.
    """
    if radius_px < 0:
        raise OptionError(f"radius_px: expected 0 or more, got {radius_px}")
    check_score(score)
    weight = None if valid is None else valid.astype(np.float32)
    smooth = _smoothed(gray, weight)
    if score == "grey":
        return _masked(smooth.astype(np.float32) - _MIDDLE_GREY, weight)
    if score == "local":
        return _normalised(smooth, radius_px, weight)
    # No gradient is taken across the border of the valid area.
    inner = None if weight is None else cv2.erode(weight, np.ones((3, 3), np.uint8))
    gradient = _normalised(_gradient_magnitude(smooth), radius_px, inner)
    return gradient if score == "gradient" else gradient + _normalised(smooth, radius_px, weight)


def _smoothed(gray: NDArray[np.uint8], weight: FloatImage | None) -> NDArray[np.uint8] | FloatImage:
    """The picture smoothed by 1-2-1: in uint8, which is faster, or in float32 where there is a mask."""
    if weight is None:
        return np.asarray(cv2.GaussianBlur(gray, (3, 3), 0))
    share = np.maximum(cv2.GaussianBlur(weight, (3, 3), 0), 1e-6)
    return np.asarray(cv2.GaussianBlur(gray * weight, (3, 3), 0) / share)


def _gradient_magnitude(picture: NDArray[np.uint8] | FloatImage) -> FloatImage:
    """Grey levels per pixel, by central differences."""
    across = cv2.Sobel(picture, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    down = cv2.Sobel(picture, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    return np.asarray(cv2.magnitude(across, down))


def _normalised(picture: NDArray[np.uint8] | FloatImage, radius_px: int, weight: FloatImage | None) -> FloatImage:
    """Each pixel less the mean of its neighbourhood, over its standard deviation, weighted."""
    if radius_px == 0:
        return _masked(picture.astype(np.float32), weight)
    box = (2 * radius_px + 1, 2 * radius_px + 1)
    if weight is None:
        mean = cv2.boxFilter(picture, cv2.CV_32F, box)
        square = cv2.sqrBoxFilter(picture, cv2.CV_32F, box)
    else:
        share = np.maximum(cv2.blur(weight, box), 1e-6)
        mean = cv2.blur(picture * weight, box) / share
        square = cv2.blur(picture * picture * weight, box) / share
    # In place: on a patch of 228 x 228 pixels an allocation takes longer than the arithmetic.
    square -= mean * mean
    np.maximum(square, 0.0, out=square)
    square += _NOISE_VARIANCE
    normal = np.subtract(picture.astype(np.float32, copy=False), mean, out=mean)
    normal /= np.sqrt(square, out=square)
    return _masked(normal, weight)


def _masked(picture: FloatImage, weight: FloatImage | None) -> FloatImage:
    return np.asarray(picture if weight is None else picture * weight, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class GroundView:
    """Projection of a plane under the camera, in map pixels about the nadir.

    Attributes:
        image_from_map: (3, 3) homography; map pixels relative to the nadir to frame pixels.
        center_px: (2,) ground point in the frame's middle.
        footprint_px: extent (width, height) of the whole frame on the map, the s T of equations 4 and 5.
        area_px: area of the whole frame on the map.
    """

    image_from_map: Array
    center_px: Array
    footprint_px: tuple[float, float]
    area_px: float


def view_of(
    camera: Camera, attitude: Attitude, height_m: float, enu_jacobian: Array, slope_m_per_px: Array | None = None
) -> GroundView | None:
    """The camera's view of a plane ``height_m`` below it, level or sloped.

    Equation 2 (scale) and equation 3 (rotation) are the special case of a level camera: the homography contains
    s = h / (f gsd), psi - psi_m, and the tilt. The Jacobian includes scale and meridian convergence of the map.

    Args:
        camera: pinhole (the frame is undistorted).
        attitude: of the body.
        height_m: above the plane, along the vertical.
        enu_jacobian: (2, 2) metres east and north per map pixel x and y.
        slope_m_per_px: (2,) rise of the plane per map pixel x and y; None is level.

    Returns:
        GroundView | None: None where a ray of a corner exceeds :data:`MAX_RAY_DEG` or does not meet the plane.
    """
    enu_from_camera = enu_from_body(attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg) @ camera.mount
    rays = camera.frame_rays @ enu_from_camera.T
    down = -rays[:, 2] / np.linalg.norm(rays, axis=1)
    if down.min() < np.cos(np.radians(MAX_RAY_DEG)):
        return None
    slope = np.zeros(2) if slope_m_per_px is None else slope_m_per_px
    approach = (
        rays[:, :2] @ np.linalg.solve(enu_jacobian.T, slope) - rays[:, 2]
    )  # of each ray, along the plane's normal
    if approach.min() <= 0.0:
        return None
    ground_m = rays[:, :2] * (height_m / approach)[:, None]
    ground_px = np.linalg.solve(enu_jacobian, ground_m.T).T
    extent = np.ptp(ground_px[:4], axis=0)
    plane = np.zeros((3, 3))  # map pixels about the nadir to east, north, up of the ground below the camera
    plane[:2, :2], plane[2, :2], plane[2, 2] = enu_jacobian, slope, -height_m
    return GroundView(
        camera.matrix @ enu_from_camera.T @ plane,
        ground_px[4],
        (float(extent[0]), float(extent[1])),
        float(cv2.contourArea(ground_px[:4].astype(np.float32))),
    )


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectified part of a frame.

    Attributes:
        gray: (h, w) uint8, in the map's pixels.
        offset_px: (2,) of its top-left pixel from the nadir, in map pixels.
    """

    gray: NDArray[np.uint8]
    offset_px: Array


def rectify(gray: NDArray[np.uint8], camera: Camera, view: GroundView, *, fraction: float = 0.7) -> Patch | None:
    """Warp the frame to the map's pixels, and crop to the largest upright rectangle inside it.

    Args:
        gray: (H, W) undistorted.
        camera: its pinhole.
        view: from :func:`view_of`.
        fraction: upper bound on the rectangle's side over the frame's; at 0.7 it fits into a square frame at any
            heading, so that the cost of matching does not depend on the heading.

    Returns:
        Patch | None: None where it is smaller than 8 x 8 map pixels.
    """
    size = _inscribed_size(view, gray.shape, fraction)
    if size is None:
        return None
    width, height = size
    offset = np.round(view.center_px - (np.array([width, height]) - 1) / 2.0)
    shift = np.array([[1.0, 0, offset[0]], [0, 1.0, offset[1]], [0, 0, 1.0]])
    scale = float(np.sqrt(view.area_px / (gray.shape[0] * gray.shape[1])))
    picture, picture_from_image = shrink(gray, scale)
    patch = cv2.warpPerspective(
        picture,
        picture_from_image @ view.image_from_map @ shift,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return Patch(np.asarray(patch, dtype=np.uint8), offset)


def shrink(gray: NDArray[np.uint8], scale: float) -> tuple[NDArray[np.uint8], Array]:
    """Average a picture down where it is much finer than the map.

    Args:
        gray: (H, W).
        scale: pixel of the picture over pixel of the map, on the ground.

    Returns:
        The picture (h, w), ``gray`` itself where it is not much finer; and the homography (3, 3) from pixels of
        ``gray`` to its pixels.
    """
    if scale >= _MAX_SHRINK:
        return gray, np.eye(3)
    height, width = (max(8, round(n * scale)) for n in gray.shape)
    sx, sy = width / gray.shape[1], height / gray.shape[0]
    homography = np.array([[sx, 0, sx / 2 - 0.5], [0, sy, sy / 2 - 0.5], [0, 0, 1.0]])
    return np.asarray(cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA), np.uint8), homography


def _inscribed_size(view: GroundView, shape: tuple[int, ...], fraction: float) -> tuple[int, int] | None:
    """Width and height of the largest upright rectangle about the view's centre inside the frame."""
    side = fraction * math.sqrt(view.area_px)
    limit = np.array([shape[1] - 1, shape[0] - 1])
    for shapes in (_RECTANGLES[:1], _RECTANGLES):  # for most headings and tilts the largest fits
        corners = view.center_px + side * shapes  # (S, A, 4, 2)
        image = corners @ view.image_from_map[:, :2].T + view.image_from_map[:, 2]
        depth = image[..., 2:]
        pixels = image[..., :2] / depth
        inside = ((pixels >= 0) & (pixels <= limit) & (depth > 0)).all(axis=(-2, -1)).ravel()
        best = int(inside.argmax())
        if inside[best]:
            width, height = (int(2 * side * n) for n in shapes.reshape(-1, 4, 2)[best, 2])
            break
    else:
        return None
    return (width, height) if min(width, height) >= 8 else None
