"""The SIFT method (Fig. 6): half scale, features of frame and map, matches lifted to 3D, PnP with RANSAC."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from engine.confidence import PoseFeatures, prior_agreement, probability
from engine.errors import OptionError
from engine.features import match, sift
from engine.geo import attitude_from_rotation, enu_from_body
from engine.indexes.landmarks import LandmarkMap, Landmarks, as_picture
from engine.integrity import AssumedErrors, judge_confidence
from engine.learned import PairMatcher
from engine.methods.query import Query
from engine.methods.views import MIN_HEIGHT_M, MapView, TelemetryHypothesis, turn_deg, view_in, views_of
from engine.orthomap import OrthoMap
from engine.pose import AttitudePrior, PoseOptions, PoseStats, solve_pose
from engine.values import Attitude, Fix, NoFix, Reason, Window

Array = NDArray[np.float64]

METHOD = "sift"
MAP_FEATURES = ("prepared", "per_frame")
_USUAL_SCALE = 0.5  # for which the tolerance of the pose is meant; features of a coarser picture are blunter
_FOUND_HEADING_DEG = 30.0  # belief in a heading that the matches gave themselves: none to speak of
_ROUGH_REACH_PX = 1.5  # pixels of the map off a landmark where heights are asked for
_BLUNT_PX = 1.6  # scale at which a keypoint's place is half as sure, in variance, as a small one's


@dataclass(frozen=True, slots=True, kw_only=True)
class SiftOptions:
    """Settings of the SIFT method.

    Attributes:
        margin: the 1.3 of equations 4 and 5.
        scale: the frame is reduced to this before detection; the paper's 0.5.
        max_keypoints: features taken from the frame; the map's are as dense.
        map_features: "prepared" once for the map, or found "per_frame" in the window, as the paper does.
        max_map_keypoints: upper limit for a window that is described per frame.
        ratio: best against second-best descriptor distance (Lowe's test).
        upright: where the heading is known, turn the descriptors by it and not by each keypoint's gradients.
        max_turn_deg: where the heading is known and descriptors are not upright, how far the angles of a match may
            contradict it; None does not ask.
        max_scale_factor: where the height is known, by which factor the scales of a match may contradict it; None
            does not ask.
        second_look: where nothing is found, look again without the heading and with heights up to
            ``height_factor`` off.
        height_factor: see above; 1 trusts the height also then.
        max_height_m: where the height is unknown, it is at most this.
        matcher: takes the place of features: it is given the reduced frame and the crop of the map, and what it
            matches is lifted and solved for the pose as features are.
        min_deviation: standard deviation in grey levels below which a frame has no texture.
        max_tilt_deg: a pose further off the vertical is taken for a wrong one.
        use_attitude: let what is known of heading, roll and pitch weigh in the pose by its assumed errors; a few
            features alone can hardly tell a tilt from a displacement.
        min_confidence: probability of :func:`engine.confidence.probability` below which a pose is not believed.
        pose: settings of PnP and RANSAC.
        errors: what is assumed of the telemetry and the map.
    """

    margin: float = 1.3
    scale: float = 0.5
    max_keypoints: int = 300
    map_features: str = "prepared"
    max_map_keypoints: int = 6000
    ratio: float = 0.8
    upright: bool = True
    max_turn_deg: float | None = 30.0
    max_scale_factor: float | None = 1.5
    second_look: bool = True
    height_factor: float = 2.0
    max_height_m: float = 500.0
    matcher: PairMatcher | None = None
    min_deviation: float = 3.0
    max_tilt_deg: float = 45.0
    use_attitude: bool = True
    min_confidence: float = 0.97
    pose: PoseOptions = field(default_factory=PoseOptions)
    errors: AssumedErrors = field(default_factory=AssumedErrors)

    def __post_init__(self) -> None:
        for name in ("margin", "height_factor", "max_height_m", "min_deviation"):
            if math.isinf(getattr(self, name)):
                raise OptionError(f"{name}: expected a finite number, got {getattr(self, name)}")
        for name in ("margin", "height_factor"):
            if not getattr(self, name) >= 1.0:
                raise OptionError(f"{name}: expected 1 or more, got {getattr(self, name)}")
        if not self.min_deviation >= 0.0:
            raise OptionError(f"min_deviation: expected 0 or more, got {self.min_deviation}")
        if not 0.0 <= self.min_confidence < 1.0:
            raise OptionError(f"min_confidence: expected 0 or more and below 1, got {self.min_confidence}")
        for name in ("scale", "ratio"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise OptionError(f"{name}: expected above 0 and at most 1, got {getattr(self, name)}")
        for name, least in (
            ("max_turn_deg", 0.0), ("max_scale_factor", 1.0), ("max_height_m", MIN_HEIGHT_M), ("max_tilt_deg", 0.0)
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not value > least:
                raise OptionError(f"{name}: expected above {least:g}, got {value}")
        if self.map_features not in MAP_FEATURES:
            raise OptionError(
                f"map_features: expected one of {', '.join(MAP_FEATURES)}, got {self.map_features!r}"
            )
        for name in ("max_keypoints", "max_map_keypoints"):
            if not getattr(self, name) >= 4:
                raise OptionError(f"{name}: expected 4 or more, got {getattr(self, name)}")


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
class PoseCandidate:
    """A pose that is not judged yet.

    Attributes:
        fix: what it means, with the probability that it is right.
        evidence: what speaks for it.
    """

    fix: Fix
    evidence: PoseFeatures


def locate(query: Query, landmarks: LandmarkMap, options: SiftOptions) -> Fix | NoFix:
    """One frame to a fix by features; needs neither height nor heading."""
    found = find(query, landmarks, options)
    return found if isinstance(found, NoFix) else judge(query, found, options)


def find(query: Query, landmarks: LandmarkMap, options: SiftOptions) -> PoseCandidate | NoFix:
    """The pose of one frame with its evidence, or a refusal where there is none. As :func:`locate`."""
    flat = query.refuse_flat(METHOD, options.min_deviation)
    if flat is not None:
        return flat
    height_m, factor = query.frame.height_agl_m, options.height_factor
    unknown = (MIN_HEIGHT_M, options.max_height_m)
    told = TelemetryHypothesis(unknown if height_m is None else (height_m, height_m), turn_deg(query))
    first = _look(query, landmarks, told, options)
    if isinstance(first, PoseCandidate):
        if not doubtful(first, options):
            return first
    elif first.reason not in (Reason.TOO_FEW_MATCHES, Reason.BAD_POSE):
        return first
    doubted = TelemetryHypothesis(unknown if height_m is None else (height_m / factor, height_m * factor), None)
    deadline = query.watch.deadline
    if not options.second_look or doubted == told or deadline.remaining_ms < deadline.elapsed_ms:
        return first
    second = _look(query, landmarks, doubted, options)
    return second if isinstance(second, PoseCandidate) and not doubtful(second, options) else first


def doubtful(found: PoseCandidate, options: SiftOptions) -> bool:
    """Whether a pose is not probable enough."""
    return judge_confidence(found.evidence, options.min_confidence) is not None


def judge(query: Query, found: PoseCandidate, options: SiftOptions) -> Fix | NoFix:
    """The fix where its pose is believed, else a refusal."""
    refusal = judge_confidence(found.evidence, options.min_confidence)
    if refusal is None:
        return found.fix
    return query.refuse(*refusal, METHOD, score=found.fix.score, window=found.fix.window)


def _look(
    query: Query, landmarks: LandmarkMap, belief: TelemetryHypothesis, options: SiftOptions
) -> PoseCandidate | NoFix:
    """Match, lift and solve, with what is believed of the telemetry."""
    watch = query.watch
    with watch.stage("window"):
        views = views_of(query, belief, METHOD, margin=options.margin, scale=options.scale)
    if isinstance(views, NoFix):
        return views
    if options.matcher is not None:
        matched = _by_matcher(query, views, options.matcher, options)
    else:
        matched = _by_features(query, views, landmarks, belief, options)
    matched.sort(key=lambda found: len(found.points_px), reverse=True)
    count, window = len(matched[0].points_px), matched[0].view.window
    if count < options.pose.min_inliers:
        detail = f"{count} matches; {options.pose.min_inliers} are asked for"
        return query.refuse(Reason.TOO_FEW_MATCHES, detail, METHOD, window=window)
    if watch.deadline.remaining_ms < 0:
        return query.refuse(Reason.LATE, "the budget was spent before the pose", METHOD, window=window)
    for found in matched:
        with watch.stage("pose"):
            stats = _pose(query, found, belief, options)
        if stats is not None:
            fix = _fix(query, stats, found.view.window, options)
            return fix if isinstance(fix, NoFix) else _weighed(query, fix, stats, belief, options)
    return query.refuse(Reason.BAD_POSE, f"no pose explains enough of the {count} matches", METHOD, window=window)


def matches_in(
    query: Query, landmarks: LandmarkMap, window: Window, options: SiftOptions
) -> tuple[Array, Array, PoseStats | None]:
    """What is matched in a window at the frame's own height and heading, and the pose of it: for reports.

    Returns:
        Points (M, 2) in pixels of the undistorted frame, their places (M, 3) on the ground in metres, and the pose
        with its inliers, or None where there are too few or they do not carry one.
    """
    height_m = query.frame.height_agl_m
    assert height_m is not None  # without one there is no single view
    belief = TelemetryHypothesis((height_m, height_m), turn_deg(query))
    views = [view_in(query, window, height_m, options.scale)]
    if options.matcher is not None:
        found = _by_matcher(query, views, options.matcher, options)[0]
    else:
        found = _by_features(query, views, landmarks, belief, options)[0]
    enough = len(found.points_px) >= options.pose.min_inliers
    return found.points_px, found.points_m, _pose(query, found, belief, options) if enough else None


def _by_features(
    query: Query, views: list[MapView], landmarks: LandmarkMap, belief: TelemetryHypothesis, options: SiftOptions
) -> list[_Matched]:
    """Features of the frame among those of the map, view by view."""
    turn = belief.turn_deg
    upright = options.upright and turn is not None
    with query.watch.stage("frame features"):
        reduced = _reduced(query, options.scale)
        features = sift(reduced.picture, max_keypoints=options.max_keypoints, upright=upright, up_deg=turn or 0.0)
    matched = []
    for view in views:
        with query.watch.stage("map features"):
            known = _map_features(query, view, landmarks, upright, options)
        with query.watch.stage("match"):
            found = match(
                features,
                known.features,
                ratio=options.ratio,
                rotation_deg=-(turn or 0.0),
                max_angle_diff_deg=None if upright or turn is None else options.max_turn_deg,
                scale=1.0 / view.pixel_ratio,
                max_scale_factor=None if belief.height_m is None else options.max_scale_factor,
            )
            pairs = found.pairs().cpu().numpy()
            points_px = reduced.full(features.xy_px[0].cpu().numpy()[pairs[:, 0]])
            scale_px = features.scale_px[0].cpu().numpy()[pairs[:, 0]].astype(np.float64)
            weights = 1.0 / (1.0 + (scale_px / _BLUNT_PX) ** 2)
            points_m = known.points_m[pairs[:, 1]]
            matched.append(_Matched(view, points_px, points_m, weights * _roughness_weights(query.site, points_m)))
    return matched


def _by_matcher(query: Query, views: list[MapView], matcher: PairMatcher, options: SiftOptions) -> list[_Matched]:
    """What the user's own matcher finds, view by view."""
    reduced = _reduced(query, options.scale)
    matched = []
    for view in views:
        with query.watch.stage("match"), torch.inference_mode():
            crop = as_picture(query.site.gray(view.crop, view.level), query.device)
            points, places = (found.cpu().numpy() for found in matcher(reduced.picture, crop))
            map_px = query.site.full_from_level(places + view.corner_px, view.level)
            ground_m = _lifted(query.site, map_px)
            matched.append(
                _Matched(view, reduced.full(points), ground_m, _roughness_weights(query.site, ground_m))
            )
    return matched


def _reduced(query: Query, scale: float) -> _Reduced:
    height, width = query.gray.shape
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    picture = cv2.resize(query.gray, size, interpolation=cv2.INTER_AREA)
    return _Reduced(as_picture(np.asarray(picture, np.uint8), query.device), np.array(size) / [width, height])


def _map_features(
    query: Query, view: MapView, landmarks: LandmarkMap, upright: bool, options: SiftOptions
) -> Landmarks:
    """Landmarks of a view, as dense as the features of the reduced frame; denser where its pixels are coarser."""
    reduced_px = query.gray.size * options.scale**2
    if options.map_features == "prepared":
        per_px = options.max_keypoints / reduced_px * max(1.0, view.pixel_ratio) ** 2
        return landmarks.find(view.crop, view.level, upright=upright, per_px=per_px)
    site, crop = query.site, view.crop
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


def _lifted(site: OrthoMap, map_px: Array) -> Array:
    """(N, 3) east, north and the height of the surface at pixels of the map."""
    return np.column_stack([site.enu_from_pixel(map_px), site.surface_at(map_px)])


def _roughness_weights(site: OrthoMap, points_m: Array) -> Array:
    """Weights (N,) of landmarks: where the surface is rough, what they show may stand higher or lower."""
    return site.roughness_weight_at(site.pixel_from_enu(points_m[:, :2]), _ROUGH_REACH_PX)


def _map_covariance_m2(site: OrthoMap, height_m: float, errors: AssumedErrors) -> Array:
    """(3, 3) what the map adds: its georeference, and a slope of the ground that PnP takes for a tilt."""
    slope_deg = errors.surface_slope_deg if site.has_surface else errors.unknown_slope_deg
    horizontal = errors.map_m**2 + (height_m * math.radians(slope_deg)) ** 2
    return np.diag([horizontal, horizontal, errors.map_m**2])


def _pose(query: Query, found: _Matched, belief: TelemetryHypothesis, options: SiftOptions) -> PoseStats | None:
    """The pose that the matches agree on and the attitude allows.

    Few matches can hardly tell a tilt from a displacement. What is known of the tilt weighs in also where the
    heading is not: that is then taken from the matches themselves.
    """
    tolerance_px = options.pose.reprojection_px * max(1.0, _USUAL_SCALE / options.scale)
    pose = replace(options.pose, reprojection_px=tolerance_px)
    solve = partial(solve_pose, found.points_m, found.points_px, query.camera.matrix, pose, weights=found.weights)
    if not options.use_attitude:
        return solve()
    heading_deg, sigma_deg = query.frame.heading_deg, options.errors.heading_deg
    if heading_deg is None or belief.turn_deg is None:
        free = solve()
        if free is None:
            return None
        heading_deg = attitude_from_rotation(free.rotation.T @ query.camera.mount.T)[2]
        sigma_deg = _FOUND_HEADING_DEG
    return solve(prior=_attitude_prior(query, heading_deg, sigma_deg, options.errors))


def _attitude_prior(query: Query, heading_deg: float, sigma_deg: float, errors: AssumedErrors) -> AttitudePrior:
    """The frame's attitude with its assumed errors about the body's axes; what is not told is level."""
    frame, mount = query.frame, query.camera.mount
    enu_from_camera = enu_from_body(frame.roll_deg or 0.0, frame.pitch_deg or 0.0, heading_deg) @ mount
    return AttitudePrior(enu_from_camera.T, (*errors.tilts_deg(frame), sigma_deg), axes=mount)


def _weighed(
    query: Query, fix: Fix, stats: PoseStats, belief: TelemetryHypothesis, options: SiftOptions
) -> PoseCandidate:
    """A pose with what speaks for it; telemetry that is doubted is not asked."""
    errors, height_m = options.errors, query.frame.height_agl_m
    height_chi_square = None
    if height_m is not None and belief.height_m == height_m:
        assert fix.up_m is not None
        variance = errors.height_sigma_m(height_m) ** 2 + float(fix.covariance_m2[2, 2])
        ground_m = query.site.ground_at(query.site.pixel_from_enu([fix.east_m, fix.north_m]))
        height_chi_square = (fix.up_m - ground_m - height_m) ** 2 / variance
    prior_chi_square = None
    if query.prior is not None and query.prior_px is not None:
        prior_chi_square = prior_agreement(
            fix, query.site.enu_from_pixel(query.prior_px), query.prior.sigma_m
        ).prior_chi_square
    evidence = PoseFeatures(stats.log10_nfa, prior_chi_square, height_chi_square)
    return PoseCandidate(replace(fix, confidence=probability(evidence)), evidence)


def _fix(query: Query, stats: PoseStats, window: Window, options: SiftOptions) -> Fix | NoFix:
    """The camera's centre as a fix; refused where a drone over this map cannot be there."""
    site = query.site
    roll, pitch, heading = attitude_from_rotation(stats.rotation.T @ query.camera.mount.T)
    east, north, up = (float(v) for v in stats.center_m)
    nadir = site.pixel_from_enu(np.array([east, north]))
    share = float(stats.inliers.mean())
    tilt = math.degrees(math.acos(float(np.clip(-stats.rotation[2, 2], -1.0, 1.0))))
    if tilt > options.max_tilt_deg or up <= float(site.surface_at(nadir)):
        detail = f"the pose is {tilt:.0f} degrees off the vertical at a height of {up:.0f} m"
        return query.refuse(Reason.BAD_POSE, detail, METHOD, score=share, window=window)
    lat, lon = site.geodetic_from_pixel(nadir)
    covariance = stats.covariance_center_m2 + _map_covariance_m2(site, up, options.errors)
    if query.frame.roll_deg is None or query.frame.pitch_deg is None:
        covariance *= max(1.0, _USUAL_SCALE / options.scale) ** 2  # blunt features err together, as a tilt would
    return Fix(
        timestamp_ns=query.frame.timestamp_ns,
        lat_deg=float(lat),
        lon_deg=float(lon),
        east_m=east,
        north_m=north,
        up_m=up,
        covariance_m2=covariance,
        attitude=Attitude(roll, pitch, heading),
        score=share,
        method=METHOD,
        window=window,
        timings=query.watch.timings,
        map_xy_px=(float(nadir[0]), float(nadir[1])),
    )
