"""Dense refinement of a fix by correlation: all of the camera's pose, through the surface model."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.align import enhance, shrink
from engine.dense import DenseFit, EnhancedFrame, GaussianPrior, Pose, correlation_at, covariance_of, refine
from engine.geo import attitude_from_rotation, chi_square, enu_from_body
from engine.indexes.samples import BLOCK_PX, SampleMap
from engine.integrity import CONSISTENT_CHI_SQUARE, AssumedErrors
from engine.methods.hypothesis import NccOptions
from engine.methods.query import Query
from engine.pose import AttitudePrior
from engine.values import Attitude, Fix, NoFix, Reason, Window

Array = NDArray[np.float64]

# Refinement begins this many levels above the frame's own: one where the tilt was told; two where it was not, or
# the first try failed.
_COARSER, _COARSER_YET = 1, 2
_TILTS_DEG = (-6.0, -3.0, 0.0, 3.0, 6.0)  # from which it begins there, about both axes
_MIN_CORRELATION_WITHOUT_TILT = (
    0.45  # correlation asked for there: over simulated towns true poses reached 0.53, wrong ones 0.32
)
_MIN_CORRELATION = 0.2  # the same where they were told: over a town in snow true poses reached 0.29
_HEIGHT_SHARE = 2e-4  # of the height that walls, and the ground that they hide, pull it: 3 cm at 150 m
_LAST_STEP, _LAST_STEP_COARSE = 0.2, 0.5  # in standard deviations: a coarser level only has to come near


def improve(query: Query, fix: Fix, samples: SampleMap, options: NccOptions) -> Fix | NoFix:
    """The fix with all of its pose refined, or the fix itself where refinement does not bear it out.

    Where nobody told roll and pitch the picture must tell them, or the fix is refused: how far it is off, nobody
    knows then.

    Args:
        query: the frame, with height and heading.
        fix: by correlation.
        samples: of the map.
        options: of the correlation.
    """
    belief = _belief(query, fix, options.errors)
    with query.watch.stage("dense"):
        fit = _through_levels(query, belief, samples, options, _COARSER) if _has_tilt(query) else None
        fit = fit or _through_levels(query, belief, samples, options, _COARSER_YET)
        pose_covariance = None if fit is None else covariance_of(fit, belief)
    if fit is not None and pose_covariance is not None:
        covariance = pose_covariance[:3, :3] + options.errors.map_m**2 * np.eye(3)
        covariance[2, 2] += (_HEIGHT_SHARE * (fit.pose.center_m[2] - query.site.ground_m)) ** 2
        moved = (fit.pose.center_m - belief.pose.center_m)[:2]
        if chi_square(moved, fix.covariance_m2[:2, :2] + covariance[:2, :2]) <= CONSISTENT_CHI_SQUARE:
            return _improved(query, fix, fit, covariance)
    return fix if _has_tilt(query) else _refused(query, fix)


def _has_tilt(query: Query) -> bool:
    return query.frame.roll_deg is not None and query.frame.pitch_deg is not None


def _through_levels(
    query: Query, belief: GaussianPrior, samples: SampleMap, options: NccOptions, coarser: int
) -> DenseFit | None:
    """Refine on levels coarser than the frame's first, where a few pixels reach farther, then on its own."""
    site, height_m = query.site, query.frame.height_agl_m
    assert height_m is not None  # a fix by correlation had one
    own = query.level_of(height_m)
    told = _has_tilt(query)
    pose, fit, before = belief.pose, None, 0.0
    for level in range(min(own + coarser, site.levels - 1), own - 1, -1):
        window = _footprint(query, belief.pose, height_m, level)
        if window is None:
            fit = None
            continue
        picture, ground = _picture(query, height_m, level, options), samples.find(window, level)
        if level == own:
            before = max(
                correlation_at(picture, ground, belief.pose),
                _MIN_CORRELATION if told else _MIN_CORRELATION_WITHOUT_TILT,
            )
        if not told and fit is None:
            pose = max(_tilted(pose, height_m), key=lambda start: correlation_at(picture, ground, start))
        fit = refine(
            picture, ground, pose, belief, last_step_sigmas=_LAST_STEP if level == own else _LAST_STEP_COARSE
        )
        pose = pose if fit is None else fit.pose
    return fit if fit is not None and fit.converged and fit.correlation >= before else None


def _tilted(pose: Pose, height_m: float) -> list[Pose]:
    """The pose and others tilted against it that look at the same middle, where correlation found it."""

    def reach_m(rotation: Array) -> Array:
        return np.asarray(rotation[2] * (height_m / -rotation[2, 2]))

    out = [pose]
    for x_deg, y_deg in itertools.product(_TILTS_DEG, _TILTS_DEG):
        rotation = cv2.Rodrigues(np.radians([x_deg, y_deg, 0.0]))[0] @ pose.rotation
        out.append(Pose(rotation, pose.center_m + reach_m(pose.rotation) - reach_m(rotation), pose.slope))
    return out


def _belief(query: Query, fix: Fix, errors: AssumedErrors) -> GaussianPrior:
    """What the telemetry says, with the position that correlation found as a start of which nothing is known."""
    frame, height_m = query.frame, query.frame.height_agl_m
    attitude = frame.attitude
    assert attitude is not None
    assert height_m is not None
    mount = query.camera.mount
    rotation = (enu_from_body(attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg) @ mount).T
    precision = np.zeros((8, 8))
    precision[2, 2] = errors.height_sigma_m(height_m) ** -2.0
    known = AttitudePrior(rotation, (*errors.tilts_deg(frame), errors.heading_deg), axes=mount)
    precision[3:6, 3:6] = known.precision
    precision[[6, 7], [6, 7]] = math.tan(math.radians(errors.surface_slope_deg)) ** -2.0
    ground_m = query.site.ground_at(query.site.pixel_from_enu([fix.east_m, fix.north_m]))
    center = np.array([fix.east_m, fix.north_m, ground_m + height_m])
    return GaussianPrior(Pose(rotation, center, np.zeros(2)), precision)


def _footprint(query: Query, pose: Pose, height_m: float, level: int) -> Window | None:
    """The part of a level that the frame shows, or None where that is less than a few blocks."""
    rays = query.camera.frame_rays[:4] @ pose.rotation
    ground_m = pose.center_m[:2] + rays[:, :2] * (height_m / -rays[:, 2:])
    corners = query.site.level_from_full(query.site.pixel_from_enu(ground_m), level)
    height, width = query.site.level_shape(level)
    low = np.clip(np.floor(corners.min(axis=0)), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)) + 1, 0, [width, height]).astype(int)
    if (high - low).min() < 4 * BLOCK_PX:
        return None
    return Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))


def _picture(query: Query, height_m: float, level: int, options: NccOptions) -> EnhancedFrame:
    """The frame at the resolution of a level, enhanced as the map is."""
    scale = height_m / query.camera.focal_px / (query.site.gsd_m_per_px * 2.0**level)
    gray, smaller = shrink(query.gray, scale)
    scale /= math.sqrt(smaller[0, 0] * smaller[1, 1])
    radius_px = max(1, round(options.enhance_radius_px / scale)) if options.enhance_radius_px else 0
    return EnhancedFrame(enhance(gray, radius_px=radius_px, score=options.score), smaller @ query.camera.matrix)


def _refused(query: Query, fix: Fix) -> NoFix:
    detail = "roll and pitch are unknown, and the picture does not tell them"
    return query.refuse(Reason.BAD_POSE, detail, fix.method, score=fix.score, window=fix.window)


def _improved(query: Query, fix: Fix, fit: DenseFit, covariance_m2: Array) -> Fix:
    site = query.site
    east, north, up = (float(v) for v in fit.pose.center_m)
    nadir = site.pixel_from_enu(np.array([east, north]))
    lat, lon = site.geodetic_from_pixel(nadir)
    return replace(
        fix,
        lat_deg=float(lat),
        lon_deg=float(lon),
        east_m=east,
        north_m=north,
        up_m=up,
        covariance_m2=covariance_m2,
        attitude=Attitude(*attitude_from_rotation(fit.pose.rotation.T @ query.camera.mount.T)),
        timings=query.watch.timings,
        map_xy_px=(float(nadir[0]), float(nadir[1])),
        stage="refined",
    )
