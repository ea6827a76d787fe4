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
from engine.geo import wrap_heading_deg
from engine.maps.landmarks import MIN_CONTRAST, LandmarkMap, Landmarks, as_picture
from engine.maps.samples import ROUGH_REACH_PX
from engine.matching.align import Orthophoto, orthorectify
from engine.matching.pose import PoseStart
from engine.matching.query import Query
from engine.matching.relief import ground_relief
from engine.matching.views import MapView, TelemetryHypothesis, map_px_per_pixel, slant_m
from engine.matching.votes import Vote, rotation, vote
from engine.options import PAPER_SCALE, SiftOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device, Picture, as_float, on_host, to_device
from engine.values import Attitude

if TYPE_CHECKING:  # it loads torch
    from engine.matching.point_finding import PointFinder

Array = NDArray[np.float64]

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


def match_views(
    query: Query,
    landmarks: LandmarkMap | None,
    options: SiftOptions,
    views: list[MapView],
    hypothesis: TelemetryHypothesis,
    finder: PointFinder | None = None,
) -> list[Matched]:
    """Find the frame's points in each view.

    Args:
        query: the frame.
        landmarks: of the map; None if a finder takes their place.
        options: settings.
        views: the parts of the map to search.
        hypothesis: what is assumed about the telemetry.
        finder: finds the points instead of features; None takes ``options.matcher`` if there is one.
    """
    if finder is None and options.matcher is not None:
        from engine.matching.point_finding import PointFinder

        finder = PointFinder(options.matcher)
    source = finder or landmarks
    assert source is not None  # only a finder needs no landmarks
    height_m, attitude = hypothesis.height_m, query.telemetry.grid_attitude
    if height_m is not None and hypothesis.x_axis_deg is not None and attitude is not None:
        found = [_by_orthophoto(query, source, options, view, attitude, height_m) for view in views]
        if None not in found:
            return [matched for matched in found if matched is not None]
    if isinstance(source, LandmarkMap):
        return _by_frame(query, source, options, views, hypothesis)
    return _by_reduced(query, source, options, views)


# ----------------------------------------------------------------------------------- by the orthophoto


def _by_orthophoto(
    query: Query,
    source: LandmarkMap | PointFinder,
    options: SiftOptions,
    view: MapView,
    attitude: Attitude,
    height_m: float,
) -> Matched | None:
    """Draw the whole frame on a view's level, match its features, and let the matches vote."""
    with query.scheduler.stage("rectify"):
        jacobian = query.jacobian * 2.0**view.level
        relief = ground_relief(query.site, query.prior_px, view.level)
        photo = orthorectify(query.gray, query.camera, attitude, height_m, jacobian, relief)
    if photo is None:
        return None
    if isinstance(source, LandmarkMap):
        photo_px, map_px = _feature_pairs(query, source, photo, view, options)
    else:
        photo_px, map_px = source.find(query, as_picture(photo.gray, query.device), photo.valid, view)
    ground_m = lifted(query.site, query.site.full_from_level(map_px, view.level))
    weights = _weights(query.site, ground_m)
    per_px = 2.0**view.level / map_px_per_pixel(query, height_m)  # frame pixels per pixel of the level
    matched = Matched(view, photo.to_frame(photo_px), ground_m, weights, options.tolerance_px * max(per_px, 1.0))
    with query.scheduler.stage("vote"):
        return _voted(query, options, matched, photo, photo_px, map_px, attitude, height_m)


def _feature_pairs(
    query: Query, landmarks: LandmarkMap, photo: Orthophoto, view: MapView, options: SiftOptions
) -> tuple[Array, Array]:
    """Matched features: (M, 2) pixels of the orthophoto, and (M, 2) of the level."""
    with query.scheduler.stage("frame features"):
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
    with query.scheduler.stage("map features"):
        per_px = _MAP_DENSITY * keypoints / max(shown_px, 1)
        known = landmarks.find(view.crop, view.level, upright=True, per_px=per_px)
    with query.scheduler.stage("match"):
        found = match(features, known.features, ratio=_VOTE_RATIO, max_scale_factor=_MAX_SCALE_FACTOR)
        photo_px, index = _matched(features, found)
        return photo_px.astype(np.float64), known.xy_px[index].astype(np.float64)


def _matched(features: Features, found: Matches) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Accepted pairs: (M, 2) feature pixels, (M,) indices on the map."""
    xy_px, valid, index = map(on_host, (features.xy_px[0], found.valid[0], found.train_index[0]))
    return xy_px[valid], index[valid]


def _voted(
    query: Query,
    options: SiftOptions,
    matched: Matched,
    photo: Orthophoto,
    photo_px: Array,
    map_px: Array,
    attitude: Attitude,
    height_m: float,
) -> Matched:
    """The matches with the pose that most of them vote for."""
    site, level = query.site, matched.view.level
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


# ------------------------------------------------------------------------------------- by the frame itself


@dataclass(frozen=True, slots=True)
class _Reduced:
    """The frame reduced as in the paper, (1, 1, H, W) in [0, 1], and the scale (x, y) of the reduction."""

    picture: Picture
    scale: Array

    def full(self, xy_px: Array | NDArray[np.float32]) -> Array:
        """Places in the full frame: edges map to edges, centres to centres."""
        return np.asarray((xy_px + 0.5) / self.scale - 0.5, dtype=np.float64)


def _by_frame(
    query: Query,
    landmarks: LandmarkMap,
    options: SiftOptions,
    views: list[MapView],
    hypothesis: TelemetryHypothesis,
) -> list[Matched]:
    """Match features of the reduced frame with those of the map, view by view."""
    turn = hypothesis.x_axis_deg
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
            known = _map_features(query, landmarks, options, view, upright)
        with query.scheduler.stage("match"):
            found = match(
                features,
                known.features,
                scale=1.0 / view.pixel_ratio,
                max_scale_factor=None if hypothesis.height_m is None else _MAX_SCALE_FACTOR,
            )
            xy_px, index = _matched(features, found)
            points_px, points_m = reduced.full(xy_px), known.points_m[index]
            weights = _weights(query.site, points_m)
            matched.append(Matched(view, points_px, points_m, weights, _frame_tolerance_px(options)))
    return matched


def _by_reduced(query: Query, finder: PointFinder, options: SiftOptions, views: list[MapView]) -> list[Matched]:
    """Points that an image matcher finds with the reduced frame, view by view."""
    reduced, matched = _reduce(query, options.scale, query.device), []
    valid = np.ones(reduced.picture.shape[2:], np.bool_)
    for view in views:
        points_px, map_px = finder.find(query, reduced.picture, valid, view)
        ground_m = lifted(query.site, query.site.full_from_level(map_px, view.level))
        weights = _weights(query.site, ground_m)
        matched.append(Matched(view, reduced.full(points_px), ground_m, weights, _frame_tolerance_px(options)))
    return matched


def _frame_tolerance_px(options: SiftOptions) -> float:
    """The pose's tolerance; features of a coarser picture than the paper's are less accurate."""
    return options.pose.reprojection_px * max(1.0, PAPER_SCALE / options.scale)


def _reduce(query: Query, scale: float, device: Device) -> _Reduced:
    height, width = query.gray.shape
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    picture = cv2.resize(query.gray, size, interpolation=cv2.INTER_AREA)
    shrunk = as_picture(np.asarray(picture, np.uint8), device)
    return _Reduced(shrunk, np.array(size) / [width, height])


def _map_features(
    query: Query, landmarks: LandmarkMap, options: SiftOptions, view: MapView, upright: bool
) -> Landmarks:
    """Landmarks of a view, as dense as the features of the reduced frame; denser where pixels are coarser."""
    reduced_px = query.gray.size * options.scale**2
    per_px = options.max_keypoints / reduced_px * max(1.0, view.pixel_ratio) ** 2
    return landmarks.find(view.crop, view.level, upright=upright, per_px=per_px)


def lifted(site: OrthoMap, map_px: Array) -> Array:
    """(N, 3) east, north and the height of the surface at pixels (N, 2) of the map."""
    return np.column_stack([site.enu_from_pixel(map_px), site.surface_at(map_px)])


def _weights(site: OrthoMap, points_m: Array) -> Array:
    """Weights (N,) of matches: on a rough surface heights vary."""
    return site.roughness_weight_at(site.pixel_from_enu(points_m[:, :2]), ROUGH_REACH_PX)
