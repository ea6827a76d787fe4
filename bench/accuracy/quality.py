"""How good local features are on two pictures of the same ground, where the true map between them is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.geo import Array

Gray = NDArray[np.uint8]

REPEAT_PX, REPEAT_FACTOR = 1.5, 1.5
CORRECT_PX = 3.0
RATIO = 0.8


@dataclass(frozen=True)
class ViewPair:
    """Two pictures of the same ground.

    Attributes:
        source: what was photographed.
        first, second: (H, W) pictures.
        first_from_second: takes pixels (N, 2) of the second to the same ground in the first.
    """

    source: str
    first: Gray
    second: Gray
    first_from_second: Callable[[Array], Array]

    @cached_property
    def shared(self) -> NDArray[np.bool_]:
        """(H, W) where the first shows ground that the second shows too."""
        rows, columns = self.second.shape
        pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
        moved = self.first_from_second(pixels.astype(np.float64))
        seen = np.zeros(self.first.shape, np.uint8)
        x, y = np.rint(moved[inside(moved, self.first.shape)]).astype(int).T
        seen[y, x] = 1
        return np.asarray(cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)), bool)

    @cached_property
    def _jacobian(self) -> Array:
        """d first / d second over the middle half of the picture: relief within it averages out."""
        rows, columns = self.second.shape
        middle, step = np.array([columns, rows]) / 2.0, np.diag([columns, rows]) / 4.0
        ahead, behind = self.first_from_second(middle + step), self.first_from_second(middle - step)
        return np.asarray((ahead - behind).T / (2.0 * step.diagonal()))

    @property
    def scale(self) -> float:
        """Pixels of the first per pixel of the second."""
        return float(np.sqrt(abs(np.linalg.det(self._jacobian))))

    @property
    def turn_deg(self) -> float:
        """Where the first's x axis points in the second, from +x towards +y."""
        x, y = np.linalg.solve(self._jacobian, [1.0, 0.0])
        return float(np.degrees(np.arctan2(y, x)))


@dataclass(frozen=True)
class Keypoints:
    """Features of one picture: places (N, 2) with centres at integers, scales (N,), and descriptors (N, D).

    Descriptors of float32 are compared by Euclidean distance, those of uint8 bit by bit.
    """

    xy_px: Array
    scale_px: Array
    descriptors: NDArray[np.float32] | Gray


@dataclass(frozen=True)
class Quality:
    """Figures of one pair, or their means.

    Attributes:
        keypoints: found in a picture, the mean of both.
        repeatability: share of the keypoints in the common ground that the other picture has too, at the same
            place within 1.5 px and the same scale within a factor of 1.5.
        matching_score: correct matches over the keypoints in the common ground, of the picture with fewer.
        inlier_ratio: share of the mutual matches with a ratio below 0.8 that are right within 3 px.
        correct: how many those are.
        error_px: median distance of the correct matches from the truth, in pixels of the first picture.
    """

    keypoints: float
    repeatability: float
    matching_score: float
    inlier_ratio: float
    correct: float
    error_px: float


def judge(first: Keypoints, second: Keypoints, pair: ViewPair) -> Quality:
    """Compare the features of both pictures with the truth; distances are in pixels of the first."""
    moved = pair.first_from_second(second.xy_px)
    common = inside(moved, pair.first.shape)
    x, y = np.rint(np.clip(first.xy_px, 0, np.array(pair.first.shape[::-1]) - 1)).astype(int).T
    seen = pair.shared[y, x]
    apart = np.linalg.norm(first.xy_px[seen, None] - moved[None, common], axis=2)
    factor = second.scale_px[None, common] * pair.scale / first.scale_px[seen, None]
    same = (apart <= REPEAT_PX) & (factor <= REPEAT_FACTOR) & (factor * REPEAT_FACTOR >= 1.0)
    repeated, possible = same.any(0).sum() + same.any(1).sum(), sum(same.shape)
    pairs = matches(first, second)
    errors = np.linalg.norm(first.xy_px[pairs[:, 0]] - moved[pairs[:, 1]], axis=1)
    right = errors[errors <= CORRECT_PX]
    return Quality(
        keypoints=(len(first.xy_px) + len(second.xy_px)) / 2.0,
        repeatability=repeated / max(possible, 1),
        matching_score=len(right) / max(min(same.shape), 1),
        inlier_ratio=len(right) / max(len(pairs), 1),
        correct=float(len(right)),
        error_px=float(np.median(right)) if len(right) else np.nan,
    )


def mean(qualities: list[Quality]) -> Quality:
    """The mean of every figure; pairs without a correct match have no error to average."""
    columns = [np.array(column) for column in zip(*map(astuple, qualities), strict=True)]
    known = [column[np.isfinite(column)] for column in columns]
    return Quality(*(float(column.mean()) if column.size else np.nan for column in known))


def matches(first: Keypoints, second: Keypoints) -> NDArray[np.int64]:
    """(M, 2) indices of the mutual nearest neighbours that pass Lowe's ratio test."""
    if min(len(first.xy_px), len(second.xy_px)) < 2:
        return np.zeros((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if first.descriptors.dtype == np.uint8 else cv2.NORM_L2)
    back = [m.trainIdx for m in matcher.match(second.descriptors, first.descriptors)]
    good = [
        (best.queryIdx, best.trainIdx)
        for best, other in matcher.knnMatch(first.descriptors, second.descriptors, k=2)
        if best.distance < RATIO * other.distance and back[best.trainIdx] == best.queryIdx
    ]
    return np.array(good, np.int64).reshape(-1, 2)


def inside(xy_px: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which points (N, 2) have their pixel in a picture of this shape."""
    return np.asarray(((xy_px >= 0) & (xy_px <= np.array(shape[::-1]) - 1)).all(axis=-1))
