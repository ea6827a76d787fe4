"""Find points of the frame on the map, by features of the orthophoto or of the reduced frame.

If height and heading are known, the whole frame is orthorectified (:func:`engine.matching.align.orthorectify`):
its features are upright and at the map's scale, and their matches vote for one translation. Otherwise features of
the frame itself are matched at any angle and scale, and RANSAC finds those that agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.features import Features, Matches, match, sift
from engine.geo import Array, wrap_heading_deg
from engine.maps.landmarks import MIN_CONTRAST, LandmarkMap, as_picture
from engine.maps.samples import ROUGH_REACH_PX
from engine.matching.align import Orthophoto, orthorectify
from engine.matching.pose import PoseStart
from engine.matching.query import Query
from engine.matching.relief import ground_relief
from engine.matching.views import MapView, TelemetryHypothesis, map_px_per_pixel, slant_m
from engine.matching.votes import Vote, rotation, vote
from engine.options import PAPER_SCALE, SiftOptions
from engine.runtime.device import Device, Picture, as_float, on_host, to_device
from engine.values import Attitude

if TYPE_CHECKING:  # it loads torch
    from engine.matching.point_finding import PointFinder


MAX_KEYPOINTS = 1000
"""Of the largest orthophoto."""
VOTE_SHARE = 0.03
"""Of the distance to the ground, within which matches agree on a translation."""
_MAP_DENSITY = 1.5  # landmarks per pixel over the frame's keypoints per pixel
_VOTE_RATIO = 0.9  # of Lowe's test where matches vote: a vote tolerates many wrong ones
_MAX_SCALE_FACTOR = 1.5  # by which the scales of a match may contradict a known height


@dataclass(frozen=True, slots=True)
class Matched:
    """Points of the frame found in a view.

    Attributes:
        view: the part of the map.
        points_px: (M, 2) pixels of the frame.
        points_m: (M, 3) metres on the ground.
        weights: (M,) relative inverse variances of the pixels.
        tolerance_px: largest reprojection distance in the frame at which a match agrees with a pose.
        start: the pose with the most votes; None if there was no vote.
        vote: the winning translation; None if there was no vote.
    """

    view: MapView
    points_px: Array
    points_m: Array
    weights: Array
    tolerance_px: float
    start: PoseStart | None = None
    vote: Vote | None = None


@dataclass(frozen=True, slots=True)
class PointSearch:
    """Finds points of one frame on the map.

    Attributes:
        query: the frame.
        source: landmarks of the map, or what finds the points instead of features.
        options: settings.
    """

    query: Query
    source: LandmarkMap | PointFinder
    options: SiftOptions

    def find(self, views: list[MapView], hypothesis: TelemetryHypothesis) -> list[Matched]:
        """Find the frame's points in each view.

        Args:
            views: the parts of the map to search; one if the height is known.
            hypothesis: what is assumed about the telemetry.
        """
        height_m, attitude = hypothesis.height_m, self.query.telemetry.grid_attitude
        if height_m is not None and hypothesis.x_axis_deg is not None and attitude is not None:
            found = self._by_orthophoto(views[0], attitude, height_m)
            if found is not None:
                return [found]
        if isinstance(self.source, LandmarkMap):
            return self._by_frame(self.source, views, hypothesis)
        return self._by_reduced(self.source, views)

    # ------------------------------------------------------------------------------- by the orthophoto

    def _by_orthophoto(self, view: MapView, attitude: Attitude, height_m: float) -> Matched | None:
        """Draw the whole frame on a view's level, match its features, and let the matches vote."""
        query, options, source = self.query, self.options, self.source
        with query.scheduler.stage("rectify"):
            jacobian = query.jacobian * 2.0**view.level
            relief = ground_relief(query.site, query.prior_px, view.level)
            photo = orthorectify(query.gray, query.camera, attitude, height_m, jacobian, relief)
        if photo is None:
            return None
        if isinstance(source, LandmarkMap):
            photo_px, map_px = self._feature_pairs(source, photo, view)
        else:
            photo_px, map_px = source.find(query, as_picture(photo.gray, query.device), photo.valid, view)
        per_px = 2.0**view.level / map_px_per_pixel(query, height_m)  # frame pixels per pixel of the level
        tolerance_px = options.tolerance_px * max(per_px, 1.0)
        matched = self._matched(view, photo.to_frame(photo_px), self._lifted(map_px, view), tolerance_px)
        with query.scheduler.stage("vote"):
            return self._voted(matched, photo, photo_px, map_px, attitude, height_m)

    def _feature_pairs(self, landmarks: LandmarkMap, photo: Orthophoto, view: MapView) -> tuple[Array, Array]:
        """Matched features: (M, 2) pixels of the orthophoto, and (M, 2) of the level."""
        options, scheduler = self.options, self.query.scheduler
        with scheduler.stage("frame features"):
            shown_px = int(np.count_nonzero(photo.valid))
            keypoints = max(options.max_keypoints, min(round(shown_px * options.keypoints_per_px), MAX_KEYPOINTS))
            gray, valid = (to_device(picture, landmarks.device) for picture in (photo.gray, photo.valid))
            features = sift(
                as_float(gray, "float32")[None, None] / 255.0,
                max_keypoints=keypoints,
                backend=options.backend,
                upright=True,
                mask=valid[None, None],
                upsample=options.upsample if keypoints < MAX_KEYPOINTS else 1,  # enough without the smallest
                contrast_threshold=MIN_CONTRAST,
            )
        with scheduler.stage("map features"):
            per_px = _MAP_DENSITY * keypoints / max(shown_px, 1)
            known = landmarks.find(view.crop, view.level, upright=True, per_px=per_px)
        with scheduler.stage("match"):
            found = match(features, known.features, ratio=_VOTE_RATIO, max_scale_factor=_MAX_SCALE_FACTOR)
            photo_px, index = _pairs(features, found)
            return photo_px.astype(np.float64), known.xy_px[index].astype(np.float64)

    def _voted(
        self,
        matched: Matched,
        photo: Orthophoto,
        photo_px: Array,
        map_px: Array,
        attitude: Attitude,
        height_m: float,
    ) -> Matched:
        """The matches with the pose that most of them vote for."""
        query, options, site, level = self.query, self.options, self.query.site, matched.view.level
        share_px = VOTE_SHARE * slant_m(query, height_m) / (site.gsd_m_per_px * 2.0**level)
        radius_px = max(share_px, 2.0 * options.tolerance_px)
        middle = (np.array(photo.gray.shape[::-1]) - 1.0) / 2.0
        # Matches so near to each other that they agree wherever they are: of one object, right or wrong together.
        distinct_px = max(options.pose.distinct_px, 1.5 * radius_px)
        found = vote(photo_px - middle, map_px, radius_px, distinct_px)
        if found is None:
            return matched
        nadir = rotation(found.turn_deg) @ (-photo.offset_px - middle) + found.shift_px
        nadir_px = site.full_from_level(nadir, level)
        turned = replace(attitude, heading_deg=wrap_heading_deg(attitude.heading_deg + found.turn_deg))
        up_m = site.ground_at(nadir_px) + height_m
        start = PoseStart(
            query.camera.enu_from_camera(turned).T,
            np.array([*site.enu_from_pixel(nadir_px), up_m]),
            radius_px / options.tolerance_px * matched.tolerance_px,
        )
        return replace(matched, start=start, vote=found)

    # --------------------------------------------------------------------------------- by the frame itself

    def _by_frame(
        self, landmarks: LandmarkMap, views: list[MapView], hypothesis: TelemetryHypothesis
    ) -> list[Matched]:
        """Match features of the reduced frame with those of the map, view by view."""
        query, options, turn = self.query, self.options, hypothesis.x_axis_deg
        upright = turn is not None
        with query.scheduler.stage("frame features"):
            reduced = _reduce(query, options.scale, landmarks.device)
            features = sift(
                reduced.picture,
                max_keypoints=options.max_keypoints,
                backend=options.backend,
                upright=upright,
                up_deg=turn or 0.0,
            )
        matched = []
        for view in views:
            with query.scheduler.stage("map features"):
                # As dense as the features of the reduced frame; denser where pixels are coarser.
                per_reduced_px = options.max_keypoints / (query.gray.size * options.scale**2)
                per_px = per_reduced_px * max(1.0, view.pixel_ratio) ** 2
                known = landmarks.find(view.crop, view.level, upright=upright, per_px=per_px)
            with query.scheduler.stage("match"):
                found = match(
                    features,
                    known.features,
                    scale=1.0 / view.pixel_ratio,
                    max_scale_factor=None if hypothesis.height_m is None else _MAX_SCALE_FACTOR,
                )
                xy_px, index = _pairs(features, found)
                full_px, tolerance_px = reduced.full(xy_px), self._reduced_tolerance_px
                matched.append(self._matched(view, full_px, known.points_m[index], tolerance_px))
        return matched

    def _by_reduced(self, finder: PointFinder, views: list[MapView]) -> list[Matched]:
        """Points that an image matcher finds with the reduced frame, view by view."""
        reduced, matched = _reduce(self.query, self.options.scale, self.query.device), []
        valid = np.ones(reduced.picture.shape[2:], np.bool_)
        for view in views:
            points_px, map_px = finder.find(self.query, reduced.picture, valid, view)
            full_px, ground_m = reduced.full(points_px), self._lifted(map_px, view)
            matched.append(self._matched(view, full_px, ground_m, self._reduced_tolerance_px))
        return matched

    @property
    def _reduced_tolerance_px(self) -> float:
        """The pose's tolerance; features of a coarser picture than the paper's are less accurate."""
        return self.options.pose.reprojection_px * max(1.0, PAPER_SCALE / self.options.scale)

    def _lifted(self, map_px: Array, view: MapView) -> Array:
        """(N, 3) east, north and the height of the surface at pixels (N, 2) of a view's level."""
        site = self.query.site
        return site.surface_points(site.full_from_level(map_px, view.level))

    def _matched(self, view: MapView, points_px: Array, points_m: Array, tolerance_px: float) -> Matched:
        """The matches, weighted: on a rough surface heights vary."""
        site = self.query.site
        weights = site.roughness_weight_at(site.pixel_from_enu(points_m[:, :2]), ROUGH_REACH_PX)
        return Matched(view, points_px, points_m, weights, tolerance_px)


@dataclass(frozen=True, slots=True)
class _Reduced:
    """The frame reduced as in the paper, (1, 1, H, W) in [0, 1], and the scale (x, y) of the reduction."""

    picture: Picture
    scale: Array

    def full(self, xy_px: Array | NDArray[np.float32]) -> Array:
        """Places in the full frame: edges map to edges, centres to centres."""
        return np.asarray((xy_px + 0.5) / self.scale - 0.5, dtype=np.float64)


def _reduce(query: Query, scale: float, device: Device) -> _Reduced:
    height, width = query.gray.shape
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    picture = cv2.resize(query.gray, size, interpolation=cv2.INTER_AREA)
    shrunk = as_picture(np.asarray(picture, np.uint8), device)
    return _Reduced(shrunk, np.array(size) / [width, height])


def _pairs(features: Features, found: Matches) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Accepted pairs: (M, 2) feature pixels, (M,) indices on the map."""
    xy_px, valid, index = map(on_host, (features.xy_px[0], found.valid[0], found.train_index[0]))
    return xy_px[valid], index[valid]
