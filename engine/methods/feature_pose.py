"""One frame matched with the map by features: matches lifted to 3D, and the pose that they agree on by PnP."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from engine.confidence import PoseFeatures, prior_agreement, probability
from engine.covariance import AssumedErrors
from engine.features import match, sift
from engine.geo import attitude_from_rotation
from engine.indexes.landmarks import LandmarkMap, Landmarks, as_picture
from engine.learned import PairMatcher
from engine.methods.options import MIN_HEIGHT_M, SiftOptions
from engine.methods.query import Query
from engine.methods.views import MapView, TelemetryHypothesis, view_in, views_of, x_axis_deg
from engine.orthomap import OrthoMap
from engine.pose import PoseStats, solve_pose
from engine.values import Attitude, Fix, NoFix, Reason, Window

Array = NDArray[np.float64]

METHOD = "sift"
_NOMINAL_SCALE = 0.5  # to which the tolerance of the pose refers; features of a coarser picture are less accurate
_MATCHED_HEADING_SIGMA_DEG = 30.0  # of a heading that only the matches gave: next to no information
_ROUGHNESS_REACH_PX = 1.5  # pixels of the map about a landmark within which its surface's roughness counts
_BLUNT_PX = 1.6  # scale at which a keypoint's position has twice the variance of a small one's


@dataclass(frozen=True, slots=True)
class PoseCandidate:
    """A pose that is not accepted yet.

    Attributes:
        fix: what it means, with its confidence.
        features: of the confidence model.
    """

    fix: Fix
    features: PoseFeatures

    @property
    def confidence(self) -> float:
        """Probability that the place is right."""
        assert self.fix.confidence is not None  # each pose has one
        return self.fix.confidence


@dataclass(frozen=True, slots=True)
class _Matched:
    """Points of the frame found again in a view.

    Attributes:
        view: where.
        points_px: (M, 2) pixels of the frame.
        points_m: (M, 3) metres on the ground.
        weights: (M,) relative inverse variances of the pixels.
    """

    view: MapView
    points_px: Array
    points_m: Array
    weights: Array


@dataclass(frozen=True, slots=True)
class _Reduced:
    """The frame reduced as the paper does, (1, 1, H, W) in [0, 1], and the scale (x, y) that reduced it."""

    picture: torch.Tensor
    scale: Array

    def full(self, xy_px: Array) -> Array:
        """Places in the frame: edges lie on edges, centres on centres."""
        return np.asarray((xy_px + 0.5) / self.scale - 0.5, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class FeatureMatcher:
    """One frame with the landmarks that it is matched with.

    Attributes:
        query: the frame.
        landmarks: of the map.
        options: settings.
    """

    query: Query
    landmarks: LandmarkMap
    options: SiftOptions

    def find(self) -> PoseCandidate | NoFix:
        """The pose of the frame, or a refusal where there is none."""
        query, options = self.query, self.options
        flat = query.refuse_flat(METHOD, options.min_deviation)
        if flat is not None:
            return flat
        height_m, factor = query.telemetry.height_agl_m, options.height_factor
        unknown = (MIN_HEIGHT_M, options.max_height_m)
        known = TelemetryHypothesis(unknown if height_m is None else (height_m, height_m), x_axis_deg(query))
        first = self._find_with(known)
        if isinstance(first, PoseCandidate):
            if not self.is_doubtful(first):
                return first
        elif first.reason not in (Reason.TOO_FEW_MATCHES, Reason.BAD_POSE):
            return first
        wide = TelemetryHypothesis(unknown if height_m is None else (height_m / factor, height_m * factor), None)
        deadline = query.scheduler.deadline
        if not options.second_look or wide == known or deadline.remaining_ms < deadline.elapsed_ms:
            return first
        second = self._find_with(wide)
        return second if isinstance(second, PoseCandidate) and not self.is_doubtful(second) else first

    def is_doubtful(self, found: PoseCandidate) -> bool:
        """Whether a pose is not probable enough."""
        return found.confidence < self.options.min_confidence

    def matches_in(self, window: Window) -> tuple[Array, Array, PoseStats | None]:
        """What is matched in a window at the frame's own height and heading, and the pose of it: for reports.

        Returns:
            Points (M, 2) in pixels of the undistorted frame, their places (M, 3) on the ground in metres, and the
            pose with its inliers, or None where there are too few or they do not determine one.
        """
        height_m = self.query.telemetry.height_agl_m
        assert height_m is not None  # without one there is no single view
        hypothesis = TelemetryHypothesis((height_m, height_m), x_axis_deg(self.query))
        found = self._match_views([view_in(self.query, window, height_m, self.options.scale)], hypothesis)[0]
        enough = len(found.points_px) >= self.options.pose.min_inliers
        return found.points_px, found.points_m, self._pose(found, hypothesis) if enough else None

    def _find_with(self, hypothesis: TelemetryHypothesis) -> PoseCandidate | NoFix:
        """Match, lift and solve, with what is assumed of the telemetry."""
        query, options, scheduler = self.query, self.options, self.query.scheduler
        with scheduler.stage("window"):
            views = views_of(query, hypothesis, METHOD, margin=options.margin, scale=options.scale)
        if isinstance(views, NoFix):
            return views
        matched = self._match_views(views, hypothesis)
        matched.sort(key=lambda found: len(found.points_px), reverse=True)
        count, window = len(matched[0].points_px), matched[0].view.window
        if count < options.pose.min_inliers:
            detail = f"{count} matches; {options.pose.min_inliers} are asked for"
            return query.refuse(Reason.TOO_FEW_MATCHES, detail, METHOD, window=window)
        if scheduler.deadline.remaining_ms < 0:
            return query.refuse(Reason.LATE, "the budget was spent before the pose", METHOD, window=window)
        for found in matched:
            with scheduler.stage("pose"):
                stats = self._pose(found, hypothesis)
            if stats is not None:
                fix = self._fix(stats, found.view.window)
                return fix if isinstance(fix, NoFix) else self._with_confidence(fix, stats, hypothesis)
        detail = f"no pose explains enough of the {count} matches"
        return query.refuse(Reason.BAD_POSE, detail, METHOD, window=window)

    # -------------------------------------------------------------------------------------------- matching

    def _match_views(self, views: list[MapView], hypothesis: TelemetryHypothesis) -> list[_Matched]:
        if self.options.matcher is not None:
            return self._by_pair_matcher(views, self.options.matcher)
        return self._by_features(views, hypothesis)

    def _by_features(self, views: list[MapView], hypothesis: TelemetryHypothesis) -> list[_Matched]:
        """Features of the frame among those of the map, view by view."""
        query, options, turn = self.query, self.options, hypothesis.x_axis_deg
        upright = options.upright and turn is not None
        with query.scheduler.stage("frame features"):
            reduced = self._reduce()
            features = sift(
                reduced.picture, max_keypoints=options.max_keypoints, upright=upright, up_deg=turn or 0.0
            )
        matched = []
        for view in views:
            with query.scheduler.stage("map features"):
                known = self._map_features(view, upright)
            with query.scheduler.stage("match"):
                found = match(
                    features,
                    known.features,
                    ratio=options.ratio,
                    rotation_deg=-(turn or 0.0),
                    max_angle_diff_deg=None if upright or turn is None else options.max_turn_deg,
                    scale=1.0 / view.pixel_ratio,
                    max_scale_factor=None if hypothesis.height_m is None else options.max_scale_factor,
                )
                pairs = found.pairs().cpu().numpy()
                points_px = reduced.full(features.xy_px[0].cpu().numpy()[pairs[:, 0]])
                scale_px = features.scale_px[0].cpu().numpy()[pairs[:, 0]].astype(np.float64)
                weights = 1.0 / (1.0 + (scale_px / _BLUNT_PX) ** 2)
                points_m = known.points_m[pairs[:, 1]]
                weights = weights * _roughness_weights(query.site, points_m)
                matched.append(_Matched(view, points_px, points_m, weights))
        return matched

    def _by_pair_matcher(self, views: list[MapView], matcher: PairMatcher) -> list[_Matched]:
        """What the user's own matcher finds, view by view."""
        query, reduced = self.query, self._reduce()
        matched = []
        for view in views:
            with query.scheduler.stage("match"), torch.inference_mode():
                crop = as_picture(query.site.gray(view.crop, view.level), query.device)
                points, places = (found.cpu().numpy() for found in matcher(reduced.picture, crop))
                map_px = query.site.full_from_level(places + view.corner_px, view.level)
                ground_m = _lifted(query.site, map_px)
                weights = _roughness_weights(query.site, ground_m)
                matched.append(_Matched(view, reduced.full(points), ground_m, weights))
        return matched

    def _reduce(self) -> _Reduced:
        query, scale = self.query, self.options.scale
        height, width = query.gray.shape
        size = (max(16, round(width * scale)), max(16, round(height * scale)))
        picture = cv2.resize(query.gray, size, interpolation=cv2.INTER_AREA)
        tensor = as_picture(np.asarray(picture, np.uint8), query.device)
        return _Reduced(tensor, np.array(size) / [width, height])

    def _map_features(self, view: MapView, upright: bool) -> Landmarks:
        """Landmarks of a view, as dense as the features of the reduced frame; denser where pixels are coarser."""
        query, options, site, crop = self.query, self.options, self.query.site, view.crop
        reduced_px = query.gray.size * options.scale**2
        if options.map_features == "prepared":
            per_px = options.max_keypoints / reduced_px * max(1.0, view.pixel_ratio) ** 2
            return self.landmarks.find(crop, view.level, upright=upright, per_px=per_px)
        count = np.clip(
            options.max_keypoints * crop.area_px / reduced_px, options.max_keypoints, options.max_map_keypoints
        )
        mask = None
        if not site.fully_valid:
            mask = torch.from_numpy(site.valid(crop, view.level)).to(query.device)[None, None]
        picture = as_picture(site.gray(crop, view.level), query.device)
        features = sift(picture, max_keypoints=int(count), upright=upright, mask=mask)
        map_px = site.full_from_level(features.xy_px[0].cpu().numpy() + view.corner_px, view.level)
        return Landmarks(features, _lifted(site, map_px))

    # ------------------------------------------------------------------------------------------------ pose

    def _pose(self, found: _Matched, hypothesis: TelemetryHypothesis) -> PoseStats | None:
        """The pose that the matches agree on and the attitude allows.

        Few matches hardly separate a tilt from a displacement. What is known of the tilt counts also where the
        heading is not: that is then taken from the matches themselves.
        """
        query, options = self.query, self.options
        tolerance_px = options.pose.reprojection_px * max(1.0, _NOMINAL_SCALE / options.scale)
        pose = replace(options.pose, reprojection_px=tolerance_px)
        matrix = query.camera.matrix
        solve = partial(solve_pose, found.points_m, found.points_px, matrix, pose, weights=found.weights)
        if not options.use_attitude:
            return solve()
        heading_deg, sigma_deg = query.telemetry.grid_heading_deg, options.errors.heading_deg
        if heading_deg is None or hypothesis.x_axis_deg is None:
            free = solve()
            if free is None:
                return None
            heading_deg = attitude_from_rotation(free.rotation.T @ query.camera.mount.T)[2]
            sigma_deg = _MATCHED_HEADING_SIGMA_DEG
        return solve(prior=query.attitude_prior(heading_deg, sigma_deg, options.errors))

    def _fix(self, stats: PoseStats, window: Window) -> Fix | NoFix:
        """The camera's centre as a fix; refused where a drone over this map cannot be there."""
        query, site, options = self.query, self.query.site, self.options
        up = float(stats.center_m[2])
        nadir = site.pixel_from_enu(stats.center_m[:2])
        share = float(stats.inliers.mean())
        tilt = math.degrees(math.acos(float(np.clip(-stats.rotation[2, 2], -1.0, 1.0))))
        if tilt > options.max_tilt_deg or up <= float(site.surface_at(nadir)):
            detail = f"the pose is {tilt:.0f} degrees off the vertical at a height of {up:.0f} m"
            return query.refuse(Reason.BAD_POSE, detail, METHOD, score=share, window=window)
        covariance = stats.covariance_center_m2 + _map_covariance_m2(site, up, options.errors)
        if not query.telemetry.has_tilt:  # features of a coarse picture err together, as a tilt would
            covariance *= max(1.0, _NOMINAL_SCALE / options.scale) ** 2
        return query.fix(
            METHOD,
            nadir,
            covariance,
            score=share,
            window=window,
            east_north_m=stats.center_m[:2],
            up_m=up,
            grid_attitude=Attitude(*attitude_from_rotation(stats.rotation.T @ query.camera.mount.T)),
            map_sigma_m=options.errors.map_m,
        )

    def _with_confidence(self, fix: Fix, stats: PoseStats, hypothesis: TelemetryHypothesis) -> PoseCandidate:
        """The candidate of a fix; a height that is doubted in this hypothesis does not count."""
        query, errors, height_m = self.query, self.options.errors, self.query.telemetry.height_agl_m
        height_chi_square = None
        if height_m is not None and hypothesis.height_m == height_m:
            assert fix.up_m is not None
            # Above ground both count: an error of the map moves the ground with the camera.
            variance = errors.height_sigma_m(height_m) ** 2 + float(fix.covariance_m2[2, 2]) - errors.map_m**2
            ground_m = query.site.ground_at(query.site.pixel_from_enu([fix.east_m, fix.north_m]))
            height_chi_square = (fix.up_m - ground_m - height_m) ** 2 / variance
        prior_chi_square = None
        if query.prior is not None and query.prior_px is not None:
            prior_m = query.site.enu_from_pixel(query.prior_px)
            prior_chi_square = prior_agreement(fix, prior_m, query.prior.sigma_m).prior_chi_square
        features = PoseFeatures(stats.log10_nfa, prior_chi_square, height_chi_square)
        return PoseCandidate(replace(fix, confidence=probability(features)), features)


def _lifted(site: OrthoMap, map_px: Array) -> Array:
    """(N, 3) east, north and the height of the surface at pixels of the map."""
    return np.column_stack([site.enu_from_pixel(map_px), site.surface_at(map_px)])


def _roughness_weights(site: OrthoMap, points_m: Array) -> Array:
    """Weights (N,) of landmarks: where the surface is rough, what they show may stand higher or lower."""
    return site.roughness_weight_at(site.pixel_from_enu(points_m[:, :2]), _ROUGHNESS_REACH_PX)


def _map_covariance_m2(site: OrthoMap, height_m: float, errors: AssumedErrors) -> Array:
    """(3, 3) of the map: its georeferencing accuracy, and a slope of the ground that PnP takes for a tilt."""
    slope_deg = errors.surface_slope_deg if site.has_surface else errors.unknown_slope_deg
    horizontal = errors.map_m**2 + (height_m * math.radians(slope_deg)) ** 2
    return np.diag([horizontal, horizontal, errors.map_m**2])
