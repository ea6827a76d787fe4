"""Find points that an image of the frame and a view of the map share, with an image matcher."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.learned.matchers import KeypointMatcher
from engine.learned.pairs import PairMatcher
from engine.maps.keypoints import KeypointMap
from engine.maps.landmarks import as_picture
from engine.maps.tiles import RIM_PX
from engine.matching.query import Query
from engine.matching.views import MapView
from engine.options import LearnedOptions
from engine.runtime.device import Picture, as_tensor
from engine.runtime.tensors import torch

Array = NDArray[np.float64]

_WIDER = 4  # times as many keypoints: of a picture with its empty margins, and of a window


@dataclass(frozen=True, slots=True)
class PointFinder:
    """Matches the frames of a flight with views of one map.

    Attributes:
        matcher: matches two pictures.
        keypoints: of the map, if the matcher uses any.
        options: limits of keypoints and windows; None, without keypoints, has none.
    """

    matcher: PairMatcher
    keypoints: KeypointMap | None = None
    options: LearnedOptions | None = None

    def too_large(self, view: MapView) -> bool:
        """Whether a view is too large to search."""
        return self.options is not None and view.crop.area_px > self.options.max_window_px

    def find(self, query: Query, picture: Picture, valid: NDArray[np.bool_], view: MapView) -> tuple[Array, Array]:
        """The points that a picture and a view share.

        Args:
            query: the frame that the picture was made from.
            picture: (1, 1, h, w), roughly in the level's pixels, upright if the heading is known.
            valid: (h, w) bool, True where the picture shows the frame.
            view: of the map.

        Returns:
            (M, 2) pixels of the picture and (M, 2) pixels of the view's level.
        """
        picture = _plain_outside(as_tensor(picture), valid)
        if self.keypoints is not None:
            points, places = self._by_keypoints(query, picture, valid, view, self.keypoints)
        else:
            with query.scheduler.stage("match"), torch.inference_mode():
                crop = as_tensor(as_picture(query.site.gray(view.crop, view.level), query.device))
                points, places = (_points(found) for found in self.matcher(picture, crop))
                shown = _is_valid(points, valid)
                points, places = points[shown], places[shown]
        known = np.isfinite(places).all(axis=1)  # a user's matcher may return NaN
        return points[known], places[known] + view.corner_px

    def _by_keypoints(
        self, query: Query, picture: torch.Tensor, valid: NDArray[np.bool_], view: MapView, known: KeypointMap
    ) -> tuple[Array, Array]:
        """Matched pixels of picture and crop; the crop's keypoints are looked up."""
        matcher, options = self.matcher, self.options
        assert isinstance(matcher, KeypointMatcher)  # or the map had no keypoints
        assert options is not None  # whoever has keypoints has limits
        with query.scheduler.stage("frame features"):
            mine = matcher.extract(picture, _WIDER * options.max_keypoints)
            shown = np.flatnonzero(_is_valid(_points(mine.xy_px), valid))[: options.max_keypoints]
            mine = mine.only(torch.from_numpy(shown).to(mine.xy_px.device))
        with query.scheduler.stage("map features"):
            theirs = known.find(view.crop, view.level, _WIDER * options.max_keypoints)
        with query.scheduler.stage("match"):
            size, crop_size = (valid.shape[1], valid.shape[0]), (view.crop.width_px, view.crop.height_px)
            pairs = matcher.match(mine, size, theirs, crop_size)
            points, places = _points(mine.xy_px[pairs[:, 0]]), _points(theirs.xy_px[pairs[:, 1]])
        return points, places


def _plain_outside(picture: torch.Tensor, valid: NDArray[np.bool_]) -> torch.Tensor:
    """The picture, filled with its mean where it shows nothing: networks see the lines of a repeated edge."""
    side = 2 * RIM_PX + 1
    shown = cv2.dilate(valid.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    if shown.all() or not shown.any():
        return picture
    mask = torch.from_numpy(shown).to(picture.device)[None, None]
    return torch.where(mask, picture, picture[mask].mean())


def _points(xy_px: torch.Tensor) -> Array:
    return np.asarray(xy_px.cpu().numpy(), np.float64)


def _is_valid(xy_px: Array, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which points (M, 2) lie where a mask (h, w) is True; non-finite points do not."""
    known = np.asarray(np.isfinite(xy_px).all(axis=1))
    places = np.rint(np.where(known[:, None], xy_px, 0.0))
    x, y = np.clip(places, 0, np.array(valid.shape)[::-1] - 1).astype(np.intp).T
    return np.asarray(known & valid[y, x])
