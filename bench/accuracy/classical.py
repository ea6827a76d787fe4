"""The plain classical recipe: a rectified frame, upright RootSIFT without a cap, and a vote for the translation.

As a user of OpenCV would write it, with heading, height and, roughly, tilt known. Of the engine it has only the
projection of the frame. It always answers, and states no accuracy.

Convention:
    Pixels are the map's, centres at integers. A vote is a match whose shift, map minus rectified frame, puts the
    camera's nadir within a tolerance of the place that is voted for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from engine import Camera, Frame, OrthoMap
from engine.geo import Array
from engine.matching.align import shrink, to_gray, view_of
from engine.values import Window

Gray = NDArray[np.uint8]
Descriptors = NDArray[np.float32]

CONTRAST, RATIO = 0.01, 0.9
TOLERANCE_SHARE = 0.03
"""Votes agree within this share of the height."""
_EDGE_PX = 6  # features closer to the outline or to nodata are of the outline
_MAX_SIDE_PX = 4000
_BLOCK = 20_000_000  # products of descriptors held at once


@dataclass(frozen=True)
class Features:
    """Positions (N, 2) and RootSIFT descriptors (N, 128) of one picture."""

    xy_px: Array
    descriptors: Descriptors


class ClassicalRecipe:
    """The recipe on one map by one camera.

    Args:
        site: the map; its surface is not used.
        camera: of the frames.
    """

    def __init__(self, site: OrthoMap, camera: Camera) -> None:
        self.site, self.camera = site, camera
        self._sift = cv2.SIFT_create(nfeatures=0, contrastThreshold=CONTRAST)

    @cached_property
    def _map(self) -> Features:
        """Features of the whole map, once."""
        window = Window(0, 0, self.site.width_px, self.site.height_px)
        return self._describe(self.site.gray(window), self.site.valid(window))

    def prepare(self) -> None:
        """Describe the map, so that no frame pays for it."""
        _ = self._map

    def rectified(self, frame: Frame) -> Features | None:
        """Features of the frame on the map's grid, about the nadir; None if it cannot be projected.

        Args:
            frame: with heading and height; without roll and pitch it is taken as level.
        """
        attitude, height_m = frame.attitude, frame.height_agl_m
        if attitude is None or height_m is None:
            return None
        jacobian = self.site.enu_jacobian(np.array([self.site.width_px, self.site.height_px]) / 2.0)
        view = view_of(self.camera, attitude, height_m, jacobian)
        if view is None or max(view.footprint_px) > _MAX_SIDE_PX:
            return None
        gray = self.camera.undistort(to_gray(frame))
        picture, picture_from_image = shrink(gray, math.sqrt(view.area_px / gray.size))
        corners = cv2.perspectiveTransform(_outline(gray.shape), np.linalg.inv(view.image_from_map))[0]
        low, size = np.floor(corners.min(0)), np.ceil(np.ptp(corners, axis=0)).astype(int) + 1
        shift = np.array([[1.0, 0, low[0]], [0, 1.0, low[1]], [0, 0, 1.0]])
        warp = picture_from_image @ view.image_from_map @ shift
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        patch = cv2.warpPerspective(picture, warp, tuple(map(int, size)), flags=flags)
        inside = np.zeros(patch.shape, np.uint8)
        cv2.fillConvexPoly(inside, np.rint(corners - low).astype(np.int32), 1)
        found = self._describe(patch, inside.astype(bool))
        return Features(found.xy_px + low, found.descriptors)

    def elect(self, frame: Features, centre_px: Array, half_px: float, tolerance_px: float) -> Array | None:
        """The nadir (2,) that most matches are for, the mean of those that agree; None without a match.

        Args:
            frame: from :meth:`rectified`.
            centre_px: (2,) where the nadir is expected.
            half_px: half the side of the square of possible nadirs.
            tolerance_px: distance within which votes agree.
        """
        low, high = frame.xy_px.min(0, initial=0.0) - half_px, frame.xy_px.max(0, initial=0.0) + half_px
        relative = self._map.xy_px - centre_px
        seen = ((relative >= low) & (relative <= high)).all(1)
        if not len(frame.xy_px) or seen.sum() < 2:
            return None
        own, on_map = _matches(frame.descriptors, self._map.descriptors[seen])
        nadirs = self._map.xy_px[seen][on_map] - frame.xy_px[own]
        return _fullest(nadirs[(np.abs(nadirs - centre_px) <= half_px).all(1)], tolerance_px)

    def _describe(self, gray: Gray, valid: NDArray[np.bool_]) -> Features:
        """Upright RootSIFT: every angle 0, one keypoint a place and scale."""
        mask = cv2.erode(np.pad(valid.astype(np.uint8), 1), np.ones((2 * _EDGE_PX + 1,) * 2))[1:-1, 1:-1]
        found = {(point.pt, point.size): point for point in self._sift.detect(gray, mask)}
        for point in found.values():
            point.angle = 0.0
        points, descriptors = self._sift.compute(gray, list(found.values()))
        if not points:
            return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
        share = descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9)
        return Features(np.array([point.pt for point in points]), np.sqrt(share).astype(np.float32))


def _matches(first: Descriptors, second: Descriptors) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the nearest neighbours that pass the ratio test; as BFMatcher, ten times as fast."""
    nearest, passed = np.zeros(len(first), np.int64), np.zeros(len(first), np.bool_)
    for rows in np.array_split(np.arange(len(first)), len(first) * len(second) // _BLOCK + 1):
        likeness = first[rows] @ second.T
        nearest[rows] = likeness.argmax(1)
        best = likeness[np.arange(len(rows)), nearest[rows]]
        likeness[np.arange(len(rows)), nearest[rows]] = -1.0
        # Of unit vectors: |a - b|^2 = 2 - 2 a.b.
        passed[rows] = 1.0 - best < RATIO**2 * (1.0 - likeness.max(1))
    return np.flatnonzero(passed), nearest[passed]


def _outline(shape: tuple[int, ...]) -> Array:
    """(1, 4, 2) corners of a picture."""
    width, height = shape[1] - 0.5, shape[0] - 0.5
    return np.array([[[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]]])


def _fullest(points: Array, radius: float) -> Array | None:
    """The mean of the most points (N, 2) within a radius of any one of them."""
    if not len(points):
        return None
    near = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)) <= radius
    return np.asarray(points[near[near.sum(1).argmax()]].mean(0))
