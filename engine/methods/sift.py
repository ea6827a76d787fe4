"""The SIFT method (Fig. 6): half scale, features of frame and window, matches lifted to 3D, PnP with RANSAC."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from engine.align import view_of
from engine.errors import OptionError
from engine.features import Features, match, sift
from engine.geo import attitude_from_rotation, enu_from_body
from engine.integrity import AssumedErrors
from engine.methods.query import Query, level_crop, level_for
from engine.orthomap import OrthoMap
from engine.pose import AttitudePrior, PoseOptions, PoseStats, solve_pose
from engine.types import Attitude, Fix, NoFix, Reason, Window

Array = NDArray[np.float64]

METHOD = "sift"
_CROP_STEP_PX = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class SiftOptions:
    """Settings of the SIFT method.

    Attributes:
        margin: the 1.3 of equations 4 and 5.
        scale: the frame is reduced to this before detection; the paper's 0.5.
        max_keypoints: features taken from the frame; the window's share grows with its area.
        max_map_keypoints: upper limit for the window, also where it is the whole map.
        ratio: best against second-best descriptor distance (Lowe's test).
        min_deviation: standard deviation in grey levels below which a frame has no texture.
        max_tilt_deg: a pose further off the vertical is taken for a wrong one.
        use_attitude: where the frame came with heading, roll and pitch, let them weigh in the pose by their
            assumed errors; a few features alone can hardly tell a tilt from a displacement.
        pose: settings of PnP and RANSAC.
        errors: what is assumed of the telemetry and the map.
    """

    margin: float = 1.3
    scale: float = 0.5
    max_keypoints: int = 300
    max_map_keypoints: int = 6000
    ratio: float = 0.8
    min_deviation: float = 3.0
    max_tilt_deg: float = 45.0
    use_attitude: bool = True
    pose: PoseOptions = field(default_factory=PoseOptions)
    errors: AssumedErrors = field(default_factory=AssumedErrors)

    def __post_init__(self) -> None:
        if not self.margin >= 1.0:
            raise OptionError(f"margin: expected 1 or more, got {self.margin}")
        for name in ("scale", "ratio"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise OptionError(f"{name}: expected above 0 and at most 1, got {getattr(self, name)}")
        if self.max_keypoints < 4:
            raise OptionError(f"max_keypoints: expected 4 or more, got {self.max_keypoints}")


def locate(query: Query, options: SiftOptions) -> Fix | NoFix:
    """One frame to a fix by features; needs neither height nor heading."""
    flat = query.refuse_flat(METHOD, options.min_deviation)
    if flat is not None:
        return flat
    watch = query.watch
    with watch.stage("window"):
        window = _window(query, options)
    if isinstance(window, NoFix):
        return window
    with watch.stage("frame features"):
        frame_features, frame_scale = _frame_features(query, options)
    with watch.stage("map features"):
        map_features, level, corner = _map_features(query, window, options)
    with watch.stage("match"):
        pairs = match(frame_features, map_features, ratio=options.ratio).pairs().cpu().numpy()
        points_px = _full_resolution(_take(frame_features, pairs[:, 0]), frame_scale)
        map_px = query.site.full_from_level(_take(map_features, pairs[:, 1]) + corner, level)
    if len(pairs) < options.pose.min_inliers:
        detail = f"{len(pairs)} matches; {options.pose.min_inliers} are asked for"
        return query.refuse(Reason.TOO_FEW_MATCHES, detail, METHOD, window=window)
    if watch.deadline.remaining_ms < 0:
        return query.refuse(Reason.LATE, "the budget was spent before the pose", METHOD, window=window)
    with watch.stage("pose"):
        points_m = np.c_[query.site.enu_from_pixel(map_px), query.site.surface_at(map_px)]
        prior = _attitude_prior(query, options)
        stats = solve_pose(points_m, points_px, query.camera.matrix, options.pose, prior=prior)
    if stats is None:
        detail = f"no pose explains enough of the {len(pairs)} matches"
        return query.refuse(Reason.BAD_POSE, detail, METHOD, window=window)
    return _fix(query, stats, window, options)


def _window(query: Query, options: SiftOptions) -> Window | NoFix:
    """The adaptive window (eq. 4, 5); the whole map where position or height is unknown."""
    frame, nadir = query.frame, query.prior_px
    if nadir is None or frame.height_agl_m is None:
        return Window(0, 0, query.site.width_px, query.site.height_px)
    attitude = frame.attitude or Attitude(0.0, 0.0, 0.0)
    view = view_of(query.camera, attitude, frame.height_agl_m, query.jacobian)
    if view is None:
        tilt = f"roll {attitude.roll_deg:.1f}, pitch {attitude.pitch_deg:.1f} degrees"
        return query.refuse(Reason.TILTED, f"a corner of the frame looks at the horizon ({tilt})", METHOD)
    width, height = view.footprint_px
    if frame.heading_deg is None:  # at any heading the footprint fits the square of its diagonal
        width = height = math.hypot(width, height)
    window = query.window(nadir + view.center_px, (width, height), (width, height), margin=options.margin)
    return window or query.refuse(Reason.OUTSIDE_MAP, "the window lies outside the map", METHOD)


def _frame_features(query: Query, options: SiftOptions) -> tuple[Features, tuple[float, float]]:
    """Features of the reduced frame, and the scale (x, y) that reduced it."""
    height, width = query.gray.shape
    size = (max(16, round(width * options.scale)), max(16, round(height * options.scale)))
    picture = cv2.resize(query.gray, size, interpolation=cv2.INTER_AREA)
    features = sift(_tensor(picture, query.device), max_keypoints=options.max_keypoints)
    return features, (size[0] / width, size[1] / height)


def _map_features(query: Query, window: Window, options: SiftOptions) -> tuple[Features, int, Array]:
    """Features of the window on the pyramid level like the reduced frame's, the level, and the crop's corner."""
    site = query.site
    level = min(1, site.levels - 1)
    if query.frame.height_agl_m is not None:
        reduced_gsd = query.frame.height_agl_m / (query.camera.focal_px * options.scale)
        level = level_for(site.gsd_m_per_px, reduced_gsd, site.levels)
    crop = level_crop(site, window, level, step_px=_CROP_STEP_PX)
    mask = None
    if not site.fully_valid:
        mask = torch.from_numpy(site.valid(crop, level)).to(query.device)[None, None]
    share = crop.area_px / (query.gray.size * options.scale**2)
    count = int(np.clip(options.max_keypoints * share, options.max_keypoints, options.max_map_keypoints))
    features = sift(_tensor(site.gray(crop, level), query.device), max_keypoints=count, mask=mask)
    return features, level, np.array([crop.x0, crop.y0], dtype=np.float64)


def _tensor(gray: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(gray)).to(device)[None, None].float() / 255.0


def _take(features: Features, index: NDArray[np.int64]) -> Array:
    """Places (M, 2) of the features with these indices."""
    return np.asarray(features.xy_px[0].cpu().numpy()[index], dtype=np.float64)


def _full_resolution(xy_px: Array, scale: tuple[float, float]) -> Array:
    """Places in the reduced picture to places in the frame: edges lie on edges, centres on centres."""
    return np.asarray((xy_px + 0.5) / np.array(scale) - 0.5, dtype=np.float64)


def _map_covariance_m2(site: OrthoMap, height_m: float, errors: AssumedErrors) -> Array:
    """(3, 3) what the map adds: its georeference, and a slope of the ground that PnP takes for a tilt."""
    slope_deg = errors.surface_slope_deg if site.has_surface else errors.unknown_slope_deg
    horizontal = errors.map_m**2 + (height_m * math.radians(slope_deg)) ** 2
    return np.diag([horizontal, horizontal, errors.map_m**2])


def _attitude_prior(query: Query, options: SiftOptions) -> AttitudePrior | None:
    """The frame's own attitude with its assumed error about the camera's axes, or None where it is not known."""
    frame, errors = query.frame, options.errors
    if not options.use_attitude or frame.heading_deg is None or frame.roll_deg is None or frame.pitch_deg is None:
        return None
    enu_from_camera = enu_from_body(frame.roll_deg, frame.pitch_deg, frame.heading_deg) @ query.camera.mount
    return AttitudePrior(enu_from_camera.T, (errors.tilt_deg, errors.tilt_deg, errors.heading_deg))


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
