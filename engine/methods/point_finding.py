"""Points that a frame and a view of the map share, by a learned matcher, with the frame turned upright for it.

Learned keypoints tolerate little rotation and scaling. Where height and heading are known the frame is therefore
rectified to the map's pixels and axes before it is matched; else it is reduced to about the map's pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from engine.align import shrink, view_of
from engine.indexes.keypoints import KeypointMap
from engine.indexes.landmarks import as_picture
from engine.learned import KeypointMatcher, PairMatcher
from engine.methods.query import Query
from engine.methods.views import MapView

Array = NDArray[np.float64]

_RIM_PX = 5  # what lies nearer to the frame's edge in the rectified picture may be the edge
_MAX_STRETCH = 4.0  # area of a rectified frame's box over the frame's own; beyond it the camera looks too far


@dataclass(frozen=True, slots=True)
class MatchPicture:
    """A frame as it is matched.

    Attributes:
        gray: (h, w) about the map's pixels.
        valid: (h, w) bool, where it shows the frame, its rim left out.
        frame_from_picture: (3, 3) homography between pixels.
    """

    gray: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    frame_from_picture: Array

    def to_frame(self, xy_px: Array) -> Array:
        """Pixels (M, 2) of the frame."""
        found = np.column_stack([xy_px, np.ones(len(xy_px))]) @ self.frame_from_picture.T
        return np.asarray(found[:, :2] / found[:, 2:], np.float64)


def upright_picture(query: Query, level: int) -> MatchPicture | None:
    """The whole frame in the pixels and axes of a level by its telemetry.

    None where height or heading is unknown, or a part of the frame sees too far.
    """
    pose = query.telemetry
    if pose.grid_attitude is None or pose.height_agl_m is None:
        return None
    view = view_of(query.camera, pose.grid_attitude, pose.height_agl_m, query.jacobian * 2.0**level)
    if view is None or np.prod(view.footprint_px) > _MAX_STRETCH * view.area_px:
        return None
    height, width = query.gray.shape
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [width - 1, height - 1, 1], [0, height - 1, 1]], np.float64)
    ground = corners @ np.linalg.inv(view.image_from_map).T
    ground = ground[:, :2] / ground[:, 2:]
    low = np.floor(ground.min(axis=0))
    size = np.ceil(ground.max(axis=0)) - low + 1
    shift = np.array([[1.0, 0, low[0]], [0, 1.0, low[1]], [0, 0, 1.0]])
    frame_from_picture, box = view.image_from_map @ shift, (int(size[0]), int(size[1]))
    picture, picture_from_image = shrink(query.gray, float(np.sqrt(view.area_px / query.gray.size)))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    homography = picture_from_image @ frame_from_picture
    warped = cv2.warpPerspective(picture, homography, box, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    inside = cv2.warpPerspective(np.ones_like(query.gray), frame_from_picture, box, flags=flags)
    return MatchPicture(np.asarray(warped, np.uint8), _without_rim(inside), frame_from_picture)


def reduced_picture(query: Query, scale: float) -> MatchPicture:
    """The frame reduced to a scale."""
    height, width = query.gray.shape
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    picture = cv2.resize(query.gray, size, interpolation=cv2.INTER_AREA)
    sx, sy = width / size[0], height / size[1]
    homography = np.array([[sx, 0, sx / 2 - 0.5], [0, sy, sy / 2 - 0.5], [0, 0, 1.0]])
    return MatchPicture(np.asarray(picture, np.uint8), np.ones(picture.shape, np.bool_), homography)


def _without_rim(inside: NDArray[np.uint8]) -> NDArray[np.bool_]:
    rim = np.ones((2 * _RIM_PX + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(inside, rim, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0)


@dataclass(frozen=True, slots=True)
class PointFinder:
    """Matches the frames of a flight with views of one map.

    Attributes:
        matcher: of two pictures.
        keypoints: of the map, where the matcher has any.
        max_keypoints: of a frame.
        max_map_keypoints: of a window.
        max_window_px: upper bound on the pixels of a view.
    """

    matcher: PairMatcher
    keypoints: KeypointMap | None = None
    max_keypoints: int = 512
    max_map_keypoints: int = 2048
    max_window_px: int | None = None

    def too_large(self, view: MapView) -> bool:
        """Whether a view is more than is searched."""
        return self.max_window_px is not None and view.crop.area_px > self.max_window_px

    def find(self, query: Query, view: MapView, scale: float) -> tuple[Array, Array]:
        """What frame and view share.

        Args:
            query: the frame.
            view: of the map.
            scale: to which the frame is reduced where it cannot be rectified.

        Returns:
            (M, 2) pixels of the undistorted frame and (M, 2) pixels of the full map.
        """
        with query.scheduler.stage("rectify"):
            picture = upright_picture(query, view.level) or reduced_picture(query, scale)
        points, places = self.pairs(query, picture.gray, picture.valid, view)
        return picture.to_frame(points), query.site.full_from_level(places, view.level)

    def pairs(
        self, query: Query, gray: NDArray[np.uint8], valid: NDArray[np.bool_], view: MapView
    ) -> tuple[Array, Array]:
        """What a picture and a view share.

        Args:
            query: the frame that the picture was made of.
            gray: (h, w) upright, about in the level's pixels.
            valid: (h, w) bool, where the picture shows the frame.
            view: of the map.

        Returns:
            (M, 2) pixels of the picture and (M, 2) pixels of the view's level.
        """
        picture = as_picture(gray, query.device)
        if self.keypoints is not None and isinstance(self.matcher, KeypointMatcher):
            points, places = self._by_keypoints(query, view, picture, self.matcher, self.keypoints, valid)
        else:
            with query.scheduler.stage("match"), torch.inference_mode():
                crop = as_picture(query.site.gray(view.crop, view.level), query.device)
                points, places = (_points(found) for found in self.matcher(picture, crop))
                shown = _is_valid(points, valid)
                points, places = points[shown], places[shown]
        return points, places + view.corner_px

    def _by_keypoints(
        self,
        query: Query,
        view: MapView,
        picture: torch.Tensor,
        matcher: KeypointMatcher,
        known: KeypointMap,
        valid: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        """Matched pixels of picture and crop, the crop's keypoints looked up."""
        with query.scheduler.stage("frame features"):
            mine = matcher.extract(picture, 4 * self.max_keypoints)
            shown = np.flatnonzero(_is_valid(_points(mine.xy_px), valid))[: self.max_keypoints]
            mine = mine.only(torch.from_numpy(shown).to(mine.xy_px.device))
        with query.scheduler.stage("map features"):
            theirs = known.find(view.crop, view.level, self.max_map_keypoints)
        with query.scheduler.stage("match"):
            size, crop_size = (valid.shape[1], valid.shape[0]), (view.crop.width_px, view.crop.height_px)
            pairs = matcher.match(mine, size, theirs, crop_size)
            points, places = _points(mine.xy_px[pairs[:, 0]]), _points(theirs.xy_px[pairs[:, 1]])
        return points, places


def _points(xy_px: torch.Tensor) -> Array:
    return np.asarray(xy_px.cpu().numpy(), np.float64)


def _is_valid(xy_px: Array, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which points (M, 2) lie where a mask (h, w) holds."""
    x, y = np.clip(np.rint(xy_px), 0, np.array(valid.shape)[::-1] - 1).astype(np.intp).T
    return np.asarray(valid[y, x])
