"""One frame's correlation surface or matches, recomputed for reports."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from engine.kernels.coarse_to_fine import WIDE_PX
from engine.matching.align import Patch, rectify, view_of
from engine.matching.correlation import MIN_VALID_SHARE, Aligned, Correlator
from engine.matching.pose import PoseStats
from engine.matching.query import Query
from engine.ncc_fft import surface
from engine.runtime.device import on_host, to_device
from engine.values import Window

if TYPE_CHECKING:
    from engine.matching.feature_pose import FeatureMatcher

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class ScoreSurface:
    """A correlation surface.

    Attributes:
        scores: (H, W) in [-1, 1].
        peak_px: (2,) its highest place (x, y).
        corner_px: (2,) map position of the patch's middle at the first score.
        step_px: map pixels from one score to the next.
    """

    scores: NDArray[np.float32]
    peak_px: tuple[int, int]
    corner_px: Array
    step_px: float

    @property
    def score(self) -> float:
        """The highest."""
        return float(self.scores[self.peak_px[1], self.peak_px[0]])


@dataclass(frozen=True, slots=True)
class PointMatches:
    """Points of the frame found on the map.

    Attributes:
        frame_px: (M, 2) in the undistorted frame.
        map_px: (M, 2) in the map.
        agree: (M,) whether each agrees with the pose; all False without a pose.
    """

    frame_px: Array
    map_px: Array
    agree: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Explanation:
    """A frame's match in pictures; None for what could not be made.

    Attributes:
        gray: (H, W) the undistorted frame.
        rectified: (h, w) the frame in the map's pixels and axes.
        outline_px: (4, 2) corners in map pixels of the found frame: of the rectified part for NCC, of the whole
            frame for SIFT.
        surface: of NCC.
        matches: of SIFT.
    """

    gray: Gray
    rectified: Gray | None = None
    outline_px: Array | None = None
    surface: ScoreSurface | None = None
    matches: PointMatches | None = None


def explain_correlation(correlator: Correlator, window: Window) -> Explanation:
    """The surface of a window at the frame's own height and heading, see :meth:`engine.matching.ncc.Ncc.find`."""
    query, site, pose = correlator.query, correlator.query.site, correlator.query.telemetry
    if pose.height_agl_m is None or pose.grid_heading_deg is None:
        return Explanation(query.gray)
    level = query.level_of(pose.height_agl_m)
    while window.area_px >> 2 * level > WIDE_PX and level < site.levels - 1:
        level += 1
    aligned = correlator.align(pose, level)
    if not isinstance(aligned, Aligned):
        return Explanation(query.gray)
    region, (height, width) = correlator.cut(window, level), aligned.template.shape
    if region.window.width_px < width or region.window.height_px < height:
        return Explanation(query.gray, aligned.patch.gray)
    own = to_device(aligned.template[None], query.device)
    scores = on_host(surface(region.search, own, min_overlap=MIN_VALID_SHARE)[0])
    corner = np.array([region.window.x0, region.window.y0], np.float64)
    middle = site.full_from_level(outline_of(corner, aligned.patch.gray).mean(axis=0), level)
    shown = score_surface(scores, middle, 2.0**level)
    outline = site.full_from_level(outline_of(corner + shown.peak_px, aligned.patch.gray), level)
    return Explanation(query.gray, aligned.patch.gray, outline, shown)


def explain_features(matcher: FeatureMatcher, window: Window) -> Explanation:
    """The matches in a window at the frame's own height and heading."""
    query = matcher.query
    patch = rectified_frame(query)
    explanation = Explanation(query.gray, None if patch is None else patch.gray)
    if query.telemetry.height_agl_m is None:
        return explanation
    frame_px, ground_m, stats = matcher.matches_in(window)
    agree = np.zeros(len(frame_px), bool) if stats is None else stats.inliers
    matches = PointMatches(frame_px, query.site.pixel_from_enu(ground_m[:, :2]), agree)
    outline = None if stats is None else _footprint(query, stats, float(np.median(ground_m[agree, 2])))
    return replace(explanation, outline_px=outline, matches=matches)


def score_surface(scores: NDArray[np.float32], corner_px: Array, step_px: float) -> ScoreSurface:
    """The surface of scores (H, W) with its highest place."""
    y, x = np.unravel_index(int(scores.argmax()), scores.shape)
    return ScoreSurface(scores, (int(x), int(y)), corner_px, step_px)


def outline_of(corner_px: Array, patch: Gray) -> Array:
    """(4, 2) corners of a patch (h, w) whose top-left pixel is on ``corner_px`` (2,), along its pixels' edges."""
    height, width = patch.shape
    return corner_px - 0.5 + np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)


def rectified_frame(query: Query) -> Patch | None:
    """The frame in the map's pixels by its telemetry, on the level with the closest resolution."""
    pose = query.telemetry
    if pose.grid_attitude is None or pose.height_agl_m is None:
        return None
    jacobian = query.jacobian * 2.0 ** query.level_of(pose.height_agl_m)
    view = view_of(query.camera, pose.grid_attitude, pose.height_agl_m, jacobian)
    return None if view is None else rectify(query.gray, view)


def _footprint(query: Query, stats: PoseStats, ground_m: float) -> Array | None:
    """(4, 2) where the frame's corners meet level ground, in map pixels; None if one sees the horizon."""
    rays = query.camera.frame_rays[:4] @ stats.rotation
    if (rays[:, 2] >= 0.0).any():
        return None
    reach = (ground_m - stats.center_m[2]) / rays[:, 2:]
    return query.site.pixel_from_enu(stats.center_m[:2] + reach * rays[:, :2])
