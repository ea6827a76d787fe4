"""The paper's recipe, reproduced literally with OpenCV: the baseline for comparison.

NCC: grey, equalise, scale (eq. 2), rotate (eq. 3), ``TM_CCORR_NORMED`` (eq. 1) in the adaptive window (eq. 4, 5),
whole-pixel peak; tilt is not compensated. SIFT: frame and window at 0.5, features of both computed for every
frame, Lowe's ratio, flat ground, ``solvePnPRansac``. Neither refuses a match that it found.

Give a class of :data:`RECIPES` to :class:`engine.SceneMatcher` as its method.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.geo import attitude_from_rotation
from engine.matching import refusals
from engine.matching.align import FRACTION
from engine.matching.for_reports import (
    Explanation,
    PointMatches,
    outline_of,
    rectified_frame,
    score_surface,
)
from engine.matching.method import Method
from engine.matching.query import Query
from engine.options import PAPER_SCALE, NavigatorOptions
from engine.values import MAX_SIGMA_M, Attitude, Reason, Result, Window

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Scores = NDArray[np.float32]

RATIO = 0.8  # the paper gives none; Lowe's own
REPROJECTION_PX = 4.0
SIGMA_M = 2.4  # the paper states no covariance; this is the RMS error that it reports
_COVARIANCE_M2 = SIGMA_M**2 / 2.0 * np.eye(3)
ACCEPT_ALL = NavigatorOptions(
    gate=1e12,
    risk=1.0 - 1e-12,
    attitude_lag_s=1e-9,
    attitude_jitter_s=1e-9,
    tilt_bias_deg=1e-9,
    heading_bias_deg=1e-9,
)
"""Accept every match, as the paper's recipe does."""


class PaperNcc(Method):
    """The paper's NCC."""

    name = "ncc"

    def locate(self, query: Query) -> Result:
        """The highest peak in the window; needs height and heading."""
        if query.telemetry.height_agl_m is None:
            return query.refuse(Reason.NO_HEIGHT, "the paper's window needs the height above ground", "ncc")
        if query.telemetry.grid_heading_deg is None:
            return query.refuse(Reason.NO_HEADING, "NCC needs the heading", "ncc")
        window = _window(query)
        if window is None:
            return refusals.outside(query, "ncc")
        search = query.site.gray(window)
        with query.scheduler.stage("align"):
            template = template_of(query, window)
        if template is None:
            return query.refuse(Reason.OUTSIDE_MAP, "the frame does not fit the window", "ncc", window=window)
        with query.scheduler.stage("match"):
            _, score, _, (x, y) = cv2.minMaxLoc(surface(template, search))
        nadir = np.array([window.x0 + x, window.y0 + y]) + (template.shape[0] - 1) / 2
        return query.fix("ncc", nadir, _COVARIANCE_M2.copy(), score=float(score), window=window)

    def explain(self, query: Query, window: Window) -> Explanation:
        """The correlation surface of a window."""
        known = query.telemetry.height_agl_m is not None and query.telemetry.grid_heading_deg is not None
        template = template_of(query, window) if known else None
        if template is None:
            return Explanation(query.gray)
        corner = np.array([window.x0, window.y0], np.float64)
        middle = outline_of(corner, template).mean(axis=0)
        scores = score_surface(surface(template, query.site.gray(window)), middle, 1.0)
        return Explanation(query.gray, template, outline_of(corner + scores.peak_px, template), scores)


class PaperSift(Method):
    """The paper's SIFT."""

    name = "sift"

    def locate(self, query: Query) -> Result:
        """The pose of OpenCV's PnP with RANSAC; needs the height for its window."""
        if query.telemetry.height_agl_m is None:
            return query.refuse(Reason.NO_HEIGHT, "the paper's window needs the height above ground", "sift")
        window = _window(query)
        if window is None:
            return refusals.outside(query, "sift")
        search = query.site.gray(window)
        with query.scheduler.stage("match"):
            matched = matches(query.gray, search)
        if matched is None:
            return query.refuse(Reason.TOO_FEW_MATCHES, "no features", "sift", window=window)
        points_px, map_px = matched
        if len(points_px) < 4:
            return query.refuse(Reason.TOO_FEW_MATCHES, f"{len(points_px)} matches", "sift", window=window)
        with query.scheduler.stage("pose"):
            pose = _pose(query, points_px, map_px + np.array([window.x0, window.y0]))
        if isinstance(pose, str):
            return query.refuse(Reason.BAD_POSE, pose, "sift", window=window)
        rotation, center, share = pose
        return query.fix(
            "sift",
            query.site.pixel_from_enu(center[:2]),
            _COVARIANCE_M2.copy(),
            score=share,
            window=window,
            center_m=center,
            grid_attitude=Attitude(*attitude_from_rotation(rotation.T @ query.camera.mount.T)),
        )

    def explain(self, query: Query, window: Window) -> Explanation:
        """The matches in a window."""
        patch, matched = rectified_frame(query), matches(query.gray, query.site.gray(window))
        rectified = None if patch is None else patch.gray
        if matched is None:
            return Explanation(query.gray, rectified)
        agree = np.zeros(len(matched[0]), bool)  # the recipe gives only the pose
        found = PointMatches(matched[0], matched[1] + np.array([window.x0, window.y0], np.float64), agree)
        return Explanation(query.gray, rectified, matches=found)


RECIPES: Mapping[str, type[Method]] = {kind.name: kind for kind in (PaperNcc, PaperSift)}
"""The methods by name."""


def _window(query: Query) -> Window | None:
    scale = _scale(query)
    extent = (scale * query.camera.width_px, scale * query.camera.height_px)
    center = np.zeros(2) if query.prior_px is None else query.prior_px
    return query.window(center, extent, (1.0, 1.0))


def _scale(query: Query) -> float:
    """Map pixels per pixel of the frame (eq. 2)."""
    return query.telemetry.known_height_m / (query.camera.focal_px * query.site.gsd_m_per_px)


def template_of(query: Query, window: Window) -> Gray | None:
    """The frame equalised, scaled (eq. 2) and turned (eq. 3), square; None if it does not fit the window."""
    height, width = query.gray.shape
    scale, jacobian = _scale(query), query.jacobian
    side = int(FRACTION * scale * min(height, width))
    if side < 8 or window.width_px < side or window.height_px < side:
        return None
    up_deg = float(np.degrees(np.arctan2(-jacobian[0, 1], -jacobian[1, 1])))
    alpha_deg = query.telemetry.known_attitude.heading_deg - up_deg
    # getRotationMatrix2D turns anticlockwise; the frame's top points alpha clockwise of the map's top.
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -alpha_deg, scale)
    turn[:, 2] += (side - 1) / 2 - np.array([(width - 1) / 2, (height - 1) / 2])
    return np.asarray(cv2.warpAffine(cv2.equalizeHist(query.gray), turn, (side, side)), np.uint8)


def surface(template: Gray, search: Gray) -> Scores:
    """NCC by equation 1, at each place of the template's top-left pixel."""
    return np.asarray(cv2.matchTemplate(cv2.equalizeHist(search), template, cv2.TM_CCORR_NORMED), np.float32)


def matches(gray: Gray, search: Gray) -> tuple[Array, Array] | None:
    """Points (M, 2) of the frame and of the window that SIFT matches at half scale; None without features."""
    detector = cv2.SIFT_create()
    halves = [
        cv2.resize(p, None, fx=PAPER_SCALE, fy=PAPER_SCALE, interpolation=cv2.INTER_AREA) for p in (gray, search)
    ]
    (frame_points, frame_words), (map_points, map_words) = (
        detector.detectAndCompute(half, None) for half in halves
    )
    if frame_words is None or map_words is None or len(map_points) < 2:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(frame_words, map_words, k=2)
    good = [best for best, second in pairs if best.distance < RATIO * second.distance]
    found = ([frame_points[m.queryIdx].pt for m in good], [map_points[m.trainIdx].pt for m in good])
    frame_px, map_px = ((np.array(points).reshape(-1, 2) + 0.5) / PAPER_SCALE - 0.5 for points in found)
    return frame_px, map_px


def _pose(query: Query, points_px: Array, map_px: Array) -> tuple[Array, Array, float] | str:
    """Rotation (3, 3), centre (3,) and share of inliers by OpenCV, or why there is none."""
    points_m = np.c_[query.site.enu_from_pixel(map_px), np.zeros(len(points_px))]
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points_m, points_px, query.camera.matrix, None, reprojectionError=REPROJECTION_PX
    )
    if not found or inliers is None:
        return "PnP found no pose"
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    center = np.asarray(-rotation.T @ np.asarray(shift, dtype=np.float64).ravel())
    if not (np.abs(center) < MAX_SIGMA_M).all():  # PnP reports success on NaN and at any distance
        return "PnP found no finite pose"
    return rotation, center, len(inliers) / len(points_px)
