"""Align a camera frame with the map: grey, rectify (equations 2 and 3).

For correlation :func:`rectify` rectifies a part of the frame on a plane; for features :func:`orthorectify`
rectifies the whole frame over the ground's relief.

Convention:
    A rectified patch has the map's pixels and axes. Its ``offset_px`` is the position of its top-left pixel
    relative to the camera's nadir, so that nadir = (matched position on the map) - offset.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.camera import SIDE_STEPS, Camera
from engine.geo import Array, inverse_2x2
from engine.kernels.between_nodes import places_between_nodes
from engine.maps.tiles import RIM_PX, WHOLE_LEVEL_PX
from engine.values import Attitude, Frame

# Beyond this angle off the vertical a footprint is stretched more than 4 times and relief occludes the ground.
MAX_RAY_DEG = 75.0
MIN_DOWN = math.cos(math.radians(MAX_RAY_DEG))
MIN_SIDE_PX = 8
"""Least side of a patch, and of a picture that was averaged down."""
# A frame finer than the map by more than this factor is averaged down first, to prevent aliasing.
_MAX_SHRINK = 0.75
_ASPECTS = np.array([1.0, 4 / 3, 3 / 4, 16 / 9, 9 / 16])
FRACTION = 0.7
"""Side of the rectified part over the frame's: it fits into a square frame at any heading, so that the cost of
matching does not depend on the heading."""
# Least size of a patch as a share of that.
MIN_SHRINK = 0.25
_SHRINKS = np.linspace(1.0, MIN_SHRINK, 61)
# Corners (S, A, 4, 2) about the middle of rectangles of area 1 and below, the largest first.
_RECTANGLES = (
    0.5
    * _SHRINKS[:, None, None, None]
    * np.stack([np.sqrt(_ASPECTS), 1.0 / np.sqrt(_ASPECTS)], axis=1)[:, None]
    * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
)


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


@dataclass(frozen=True, slots=True)
class GroundView:
    """Projection of a plane under the camera, in map pixels about the nadir.

    Attributes:
        image_from_map: (3, 3) homography; map pixels relative to the nadir to frame pixels.
        center_px: (2,) ground point at the frame's middle.
        footprint_px: extent (width, height) of the whole frame on the map, the s T of equations 4 and 5.
        area_px: area of the whole frame on the map.
    """

    image_from_map: Array
    center_px: Array
    footprint_px: tuple[float, float]
    area_px: float


def view_of(camera: Camera, attitude: Attitude, height_m: float, enu_jacobian: Array) -> GroundView | None:
    """The camera's view of a level plane ``height_m`` below it.

    Equation 2 (scale) and equation 3 (rotation) are the special case of a level camera: the homography contains
    s = h / (f gsd), psi - psi_m, and the tilt. The Jacobian includes scale and meridian convergence of the map.

    Args:
        camera: pinhole (the frame is undistorted).
        attitude: of the body.
        height_m: above the plane.
        enu_jacobian: (2, 2) metres east and north per map pixel x and y.

    Returns:
        GroundView | None: None if a ray of a corner exceeds :data:`MAX_RAY_DEG`.
    """
    enu_from_camera = camera.enu_from_camera(attitude)
    rays = camera.frame_rays @ enu_from_camera.T
    down = -rays[:, 2] / np.sqrt((rays * rays).sum(axis=1))
    if down.min() < MIN_DOWN:
        return None
    ground_px = rays[:, :2] * (height_m / -rays[:, 2])[:, None] @ inverse_2x2(enu_jacobian).T
    extent = np.ptp(ground_px[:4], axis=0)
    plane = np.zeros((3, 3))  # map pixels about the nadir to east, north, up of the ground below the camera
    plane[:2, :2], plane[2, 2] = enu_jacobian, -height_m
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


def rectify(gray: NDArray[np.uint8], view: GroundView) -> Patch | None:
    """Warp the frame to the map's pixels, and crop to the largest upright rectangle inside a share of it.

    Args:
        gray: (H, W) undistorted.
        view: from :func:`view_of`.

    Returns:
        Patch | None: None if it would be smaller than 8 x 8 map pixels.
    """
    size = _inscribed_size(view, gray.shape)
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
    """Average a picture down if it is much finer than the map.

    Args:
        gray: (H, W).
        scale: size on the ground of the picture's pixel over the map's.

    Returns:
        The picture (h, w), ``gray`` itself if it is not much finer; and the homography (3, 3) from pixels of
        ``gray`` to its pixels.
    """
    if scale >= _MAX_SHRINK:
        return gray, np.eye(3)
    height, width = (max(MIN_SIDE_PX, round(n * scale)) for n in gray.shape)
    sx, sy = width / gray.shape[1], height / gray.shape[0]
    homography = np.array([[sx, 0, sx / 2 - 0.5], [0, sy, sy / 2 - 0.5], [0, 0, 1.0]])
    picture, left = gray, scale
    while left <= _MAX_SHRINK / 2.0:  # as far as halving goes, which OpenCV does fast, edges on edges
        half = (max(MIN_SIDE_PX, picture.shape[1] // 2), max(MIN_SIDE_PX, picture.shape[0] // 2))
        picture, left = np.asarray(cv2.resize(picture, half, interpolation=cv2.INTER_AREA), np.uint8), 2.0 * left
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8), homography


def _inscribed_size(view: GroundView, shape: tuple[int, ...]) -> tuple[int, int] | None:
    """Width and height of the largest upright rectangle about the view's centre inside the frame."""
    side = FRACTION * math.sqrt(view.area_px)
    limit = np.array([shape[1] - 1, shape[0] - 1])
    for shapes in (_RECTANGLES[:1], _RECTANGLES):  # at most headings and tilts the largest fits
        corners = view.center_px + side * shapes  # (S, A, 4, 2)
        image = corners @ view.image_from_map[:, :2].T + view.image_from_map[:, 2]
        depth = image[..., 2:]
        pixels = image[..., :2] / depth
        inside = ((pixels >= 0) & (pixels <= limit) & (depth > 0)).all(axis=(-2, -1)).ravel()
        best = int(inside.argmax())
        if inside[best]:
            width, height = (int(2 * side * n) for n in shapes.reshape(-1, 4, 2)[best, 2])
            return (width, height) if min(width, height) >= MIN_SIDE_PX else None
    return None


# ----------------------------------------------------------------------------------------- the whole frame

MAX_FIELD_DEG = 70.0
"""Ground farther off the vertical than this angle is ignored: it is far away and foreshortened."""
SIDE_STEP_PX = 16
"""Least side of an orthorectified frame, and its step: a flight uses few sizes, and lays out none in the air."""
MAX_PICTURE_PX = WHOLE_LEVEL_PX
"""Most pixels of one; if it would need more, the height is out of proportion to the map."""
_RIM = np.ones((2 * RIM_PX + 1,) * 2, np.uint8)

Relief = Callable[[Array], Array]
"""Heights (...,) in metres above the ground below the camera, at offsets (..., 2) from the nadir in map pixels."""


@dataclass(frozen=True, slots=True)
class Orthophoto:
    """The whole frame in the map's pixels and axes, by an assumed pose.

    Attributes:
        gray: (h, w) uint8; the edge is repeated where the frame shows nothing.
        valid: (h, w) bool, True where the frame shows the ground, without its rim.
        offset_px: (2,) of its top-left pixel from the assumed nadir, in map pixels.
        frame_px: x and y, (h, w) float32 each, of each pixel's source in the frame.
    """

    gray: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    offset_px: Array
    frame_px: tuple[NDArray[np.float32], NDArray[np.float32]]

    def to_frame(self, xy_px: Array) -> Array:
        """Places in the frame, bilinear.

        Args:
            xy_px: (N, 2) pixels of the orthophoto.

        Returns:
            (N, 2) pixels of the frame.
        """
        if not len(xy_px):
            return np.zeros((0, 2))
        at = xy_px.astype(np.float32)
        x, y = (cv2.remap(plane, at[:, 0], at[:, 1], cv2.INTER_LINEAR) for plane in self.frame_px)
        return np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)


def ground_bounds_px(camera: Camera, attitude: Attitude, height_m: float, enu_jacobian: Array) -> Array | None:
    """Bounding box of the ground that a frame shows, on a level plane, up to :data:`MAX_FIELD_DEG`.

    Args:
        camera: pinhole (the frame is undistorted).
        attitude: of the body.
        height_m: above the plane.
        enu_jacobian: (2, 2) metres east and north per map pixel x and y.

    Returns:
        (2, 2) lower and upper corner in map pixels from the nadir; None if the frame's middle is beyond that
        angle.
    """
    rays = camera.border_rays @ camera.enu_from_camera(attitude).T
    reach = np.hypot(rays[:, 0], rays[:, 1])
    limit = math.tan(math.radians(MAX_FIELD_DEG))
    if rays[-1, 2] >= 0.0 or reach[-1] > -rays[-1, 2] * limit * (1.0 - 1e-9):
        return None
    far = reach > -rays[:, 2] * limit
    along = rays[:, :2] / np.where(far, reach / limit, -rays[:, 2])[:, None]
    ground_px = height_m * along @ inverse_2x2(enu_jacobian).T
    return np.stack([np.floor(ground_px.min(axis=0)), np.ceil(ground_px.max(axis=0))])


def orthorectify(
    gray: NDArray[np.uint8],
    camera: Camera,
    attitude: Attitude,
    height_m: float,
    enu_jacobian: Array,
    relief: Relief | None = None,
) -> Orthophoto | None:
    """Draw the whole frame as the map would show it.

    Args:
        gray: (H, W) undistorted.
        camera: its pinhole.
        attitude: assumed attitude of the body.
        height_m: assumed height above the ground below the camera.
        enu_jacobian: (2, 2) metres east and north per map pixel x and y.
        relief: of the ground; None means level.

    Returns:
        Orthophoto | None: None if it would be too small or too large, or the frame's middle is beyond
        :data:`MAX_FIELD_DEG`.
    """
    bounds = ground_bounds_px(camera, attitude, height_m, enu_jacobian)
    if bounds is None or (bounds[1] - bounds[0]).min() < SIDE_STEP_PX:
        return None
    sides = np.ceil((bounds[1] - bounds[0] + 1.0) / SIDE_STEP_PX) * SIDE_STEP_PX
    if sides.prod() > MAX_PICTURE_PX:
        return None
    corner = np.floor(bounds.mean(axis=0) - (sides - 1.0) / 2.0)
    enu_from_camera = camera.enu_from_camera(attitude)
    sides_px = np.linspace(corner, corner + sides - 1.0, SIDE_STEPS + 1)
    nodes = np.stack(np.meshgrid(*sides_px.T), axis=-1)  # bilinear in between
    up_m = np.full(nodes.shape[:2], -height_m) if relief is None else relief(nodes) - height_m
    ground_m = np.concatenate([nodes @ enu_jacobian.T, up_m[..., None]], axis=-1)
    size = (int(sides[1]), int(sides[0]))
    x_px, y_px, inside = places_between_nodes(_projected(ground_m, camera, enu_from_camera), gray.shape, size)
    slant_m = height_m / max(-enu_from_camera[2, 2], 1e-3)
    scale = slant_m / camera.focal_px / math.sqrt(abs(float(np.linalg.det(enu_jacobian))))
    valid = cv2.erode(inside.view(np.uint8), _RIM, borderType=cv2.BORDER_CONSTANT, borderValue=0).view(np.bool_)
    return Orthophoto(_drawn(gray, scale, x_px, y_px), valid, corner, (x_px, y_px))


def _projected(ground_m: Array, camera: Camera, enu_from_camera: Array) -> NDArray[np.float32]:
    """Places (..., 2) in the frame of ground (..., 3) about the camera, and 1 where it can show it, else 0."""
    seen = ground_m @ enu_from_camera
    ahead = seen[..., 2] > 0.0
    steep = -ground_m[..., 2] >= np.linalg.norm(seen, axis=-1) * math.cos(math.radians(MAX_FIELD_DEG + 1.0))
    projected = seen @ camera.matrix.T / np.where(ahead, seen[..., 2], 1.0)[..., None]
    projected[..., 2] = ahead & steep
    return np.asarray(projected, np.float32)


def _drawn(
    gray: NDArray[np.uint8], scale: float, x_px: NDArray[np.float32], y_px: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """The frame sampled at (h, w) places, averaged down first if it is much finer than the map."""
    picture, picture_from_image = shrink(gray, scale)
    if picture is not gray:
        (sx, _, left), (_, sy, top) = picture_from_image[:2].astype(np.float32)
        x_px, y_px = x_px * sx + left, y_px * sy + top
    return np.asarray(cv2.remap(picture, x_px, y_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
