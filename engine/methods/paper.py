"""The paper's own recipe, literally, with OpenCV: the baseline that the engine is compared with.

NCC: grey, equalise, scale (eq. 2), rotate (eq. 3), ``TM_CCORR_NORMED`` (eq. 1) in the adaptive window (eq. 4, 5),
whole-pixel peak; tilt is not compensated. SIFT: frame and window at 0.5, features of both computed for every
frame, Lowe's ratio, flat ground, ``solvePnPRansac``. Neither refuses a match that it found.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.geo import attitude_from_rotation
from engine.methods.query import Query
from engine.values import Attitude, Fix, NoFix, Reason, Window

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Surface = NDArray[np.float32]

MARGIN = 1.3
SCALE = 0.5
RATIO = 0.8  # the paper gives none; Lowe's own
FRACTION = 0.7  # of the rotated frame, so that no empty corner is matched
REPROJECTION_PX = 4.0
_FAR_M = 1e6
SIGMA_M = 2.4  # the paper states no covariance; this is the RMS error that it reports


def locate(query: Query, method: str) -> Fix | NoFix:
    """One frame to a fix by the paper's NCC or SIFT."""
    height = query.frame.height_agl_m
    if height is None:
        return query.refuse(Reason.NO_HEIGHT, "the paper's window needs the height above ground", method)
    heading = query.frame.heading_deg
    if method == "ncc" and heading is None:
        return query.refuse(Reason.NO_HEADING, "NCC needs the heading", method)
    scale = _scale(query)
    extent = (scale * query.camera.width_px, scale * query.camera.height_px)
    nadir = query.prior_px
    center = np.zeros(2) if nadir is None else nadir
    window = query.window(center, extent, (1.0, 1.0), margin=MARGIN)
    if window is None:
        return query.refuse_outside(method)
    return (_locate_sift if method == "sift" else _locate_ncc)(query, window, query.site.gray(window))


def _scale(query: Query) -> float:
    """Map pixels per pixel of the frame (eq. 2)."""
    assert query.frame.height_agl_m is not None  # refused before
    return query.frame.height_agl_m / (query.camera.focal_px * query.site.gsd_m_per_px)


def template_of(query: Query, window: Window) -> Gray | None:
    """The frame equalised, scaled (eq. 2) and turned (eq. 3), square; None where it does not fit the window."""
    assert query.frame.heading_deg is not None  # refused before
    height, width = query.gray.shape
    scale, jacobian = _scale(query), query.jacobian
    side = int(FRACTION * scale * min(height, width))
    if side < 8 or window.width_px < side or window.height_px < side:
        return None
    alpha_deg = query.frame.heading_deg - float(np.degrees(np.arctan2(-jacobian[0, 1], -jacobian[1, 1])))
    # getRotationMatrix2D turns anticlockwise; the frame's top points alpha clockwise of the map's top.
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -alpha_deg, scale)
    turn[:, 2] += (side - 1) / 2 - np.array([(width - 1) / 2, (height - 1) / 2])
    return np.asarray(cv2.warpAffine(cv2.equalizeHist(query.gray), turn, (side, side)), np.uint8)


def surface(template: Gray, search: Gray) -> Surface:
    """NCC as equation 1 has it, at each place of the template's top-left pixel."""
    return np.asarray(cv2.matchTemplate(cv2.equalizeHist(search), template, cv2.TM_CCORR_NORMED), np.float32)


def _locate_ncc(query: Query, window: Window, search: Gray) -> Fix | NoFix:
    with query.watch.stage("align"):
        template = template_of(query, window)
    if template is None:
        return query.refuse(Reason.OUTSIDE_MAP, "the frame does not fit the window", "ncc", window=window)
    with query.watch.stage("match"):
        _, score, _, (x, y) = cv2.minMaxLoc(surface(template, search))
    nadir = np.array([window.x0 + x, window.y0 + y]) + (template.shape[0] - 1) / 2
    return _fix(query, window, nadir, query.site.enu_from_pixel(nadir), None, None, score, "ncc")


def matches(gray: Gray, search: Gray) -> tuple[Array, Array] | None:
    """Points (M, 2) of the frame and of the window that SIFT matches at half scale; None without features."""
    detector = cv2.SIFT_create()
    halves = [cv2.resize(p, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_AREA) for p in (gray, search)]
    (frame_points, frame_words), (map_points, map_words) = (
        detector.detectAndCompute(half, None) for half in halves
    )
    if frame_words is None or map_words is None or len(map_points) < 2:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(frame_words, map_words, k=2)
    good = [best for best, second in pairs if best.distance < RATIO * second.distance]
    found = ([frame_points[m.queryIdx].pt for m in good], [map_points[m.trainIdx].pt for m in good])
    frame_px, map_px = ((np.array(points).reshape(-1, 2) + 0.5) / SCALE - 0.5 for points in found)
    return frame_px, map_px


def _locate_sift(query: Query, window: Window, search: Gray) -> Fix | NoFix:
    with query.watch.stage("match"):
        matched = matches(query.gray, search)
    if matched is None:
        return query.refuse(Reason.TOO_FEW_MATCHES, "no features", "sift", window=window)
    points_px, map_px = matched
    if len(points_px) < 4:
        return query.refuse(Reason.TOO_FEW_MATCHES, f"{len(points_px)} matches", "sift", window=window)
    with query.watch.stage("pose"):
        places_px = map_px + np.array([window.x0, window.y0])
        points_m = np.c_[query.site.enu_from_pixel(places_px), np.zeros(len(points_px))]
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points_m, points_px, query.camera.matrix, None, reprojectionError=REPROJECTION_PX
        )
    if not found or inliers is None:
        return query.refuse(Reason.BAD_POSE, "PnP found no pose", "sift", window=window)
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    center = -rotation.T @ np.asarray(shift, dtype=np.float64).ravel()
    if not (np.abs(center) < _FAR_M).all():  # PnP reports success on NaN and on the ends of the universe
        return query.refuse(Reason.BAD_POSE, "PnP found no finite pose", "sift", window=window)
    attitude = Attitude(*attitude_from_rotation(rotation.T @ query.camera.mount.T))
    nadir = query.site.pixel_from_enu(center[:2])
    share = len(inliers) / len(points_px)
    return _fix(query, window, nadir, center[:2], float(center[2]), attitude, share, "sift")


def _fix(
    query: Query,
    window: Window,
    nadir_px: Array,
    enu_m: Array,
    up_m: float | None,
    attitude: Attitude | None,
    score: float,
    method: str,
) -> Fix:
    lat, lon = query.site.geodetic_from_pixel(nadir_px)
    return Fix(
        timestamp_ns=query.frame.timestamp_ns,
        lat_deg=float(lat),
        lon_deg=float(lon),
        east_m=float(enu_m[0]),
        north_m=float(enu_m[1]),
        up_m=up_m,
        covariance_m2=SIGMA_M**2 / 2.0 * np.eye(3),
        attitude=attitude,
        score=float(score),
        method=method,
        window=window,
        timings=query.watch.timings,
        map_xy_px=(float(nadir_px[0]), float(nadir_px[1])),
    )
