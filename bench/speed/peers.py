"""The same work written with other people's libraries, as their users would write it."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from bench.accuracy.quality import Array, Gray, Keypoints, matches
from engine import Budget, Camera, Fix, Frame, NoFix, OrthoMap, Prior
from engine.assumed_errors import AssumedErrors
from engine.budget import Deadline
from engine.geo import attitude_from_rotation
from engine.matching.align import to_gray, view_of
from engine.matching.pnp import MIN_INLIERS
from engine.matching.pose import AttitudePrior, PoseStats, solve_pose
from engine.matching.query import Query
from engine.options import SiftOptions
from engine.runtime.scheduler import Scheduler
from engine.values import RISK, Attitude, GridPose, Reason, Window
from engine.window import level_crop, level_for

Image = NDArray[np.float32]

MAX_MAP_KEYPOINTS = 6000  # of a window that is described per frame
MAX_TILT_DEG = 45.0  # of a right pose


def opencv_peak(window: Image, template: Image) -> tuple[int, int, float]:
    """The place (x, y) and score of the highest peak by OpenCV."""
    scores = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    _, score, _, (x, y) = cv2.minMaxLoc(scores)
    return x, y, score


def skimage_peak(window: Image, template: Image) -> tuple[int, int, float]:
    """The same by scikit-image."""
    from skimage.feature import match_template

    scores = match_template(window, template)
    y, x = np.unravel_index(int(scores.argmax()), scores.shape)
    return int(x), int(y), float(scores[y, x])


def scipy_peak(window: Image, template: Image) -> tuple[int, int, float]:
    """The same by SciPy's fftconvolve, the recipe that answers on the web give."""
    from scipy.signal import fftconvolve

    w, t = window.astype(np.float64), template.astype(np.float64)
    t = t - t.mean()
    ones = np.ones(t.shape)
    products = fftconvolve(w, t[::-1, ::-1], mode="valid")
    total = fftconvolve(w, ones, mode="valid")
    square = fftconvolve(w * w, ones, mode="valid")
    energy = np.maximum(square - total * total / t.size, 1e-9)
    scores = products / np.sqrt(energy * np.sum(t * t))
    y, x = np.unravel_index(int(scores.argmax()), scores.shape)
    return int(x), int(y), float(scores[y, x])


class OpenCvStep:
    """The NCC step on one frame with OpenCV: what a good user of it would write.

    Grey, rectify by height, heading, roll and pitch with one ``warpPerspective``, local normalisation of frame and
    window, ``matchTemplate``, and a parabola through the peak. With ``prepared`` the normalised map is kept.
    """

    def __init__(self, site: OrthoMap, camera: Camera, *, prepared: bool, radius_px: int = 8) -> None:
        self._site, self._camera, self._radius_px = site, camera, radius_px
        self._gray = site.gray(Window(0, 0, site.width_px, site.height_px))
        self._map = self._enhance(self._gray) if prepared else None
        self._jacobian = site.enu_jacobian(np.array([site.width_px, site.height_px]) / 2.0)

    def _enhance(self, gray: NDArray[np.uint8]) -> Image:
        box = (2 * self._radius_px + 1,) * 2
        smooth = cv2.GaussianBlur(gray, (3, 3), 0)
        mean = cv2.boxFilter(smooth, cv2.CV_32F, box)
        square = cv2.sqrBoxFilter(smooth, cv2.CV_32F, box)
        return np.asarray((smooth - mean) / np.sqrt(np.maximum(square - mean * mean, 0.0) + 4.0), np.float32)

    def __call__(self, frame: Frame, prior: Prior) -> tuple[float, float]:
        """East and north in metres."""
        camera, jacobian = self._camera, self._jacobian
        assert isinstance(frame.image, np.ndarray)
        assert frame.height_agl_m is not None
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        attitude = Attitude(frame.roll_deg or 0.0, frame.pitch_deg or 0.0, frame.heading_deg or 0.0)
        turn = camera.enu_from_camera(attitude)
        ray = turn @ np.linalg.inv(camera.matrix) @ np.array([149.5, 149.5, 1.0])
        aim = np.linalg.solve(jacobian, ray[:2] * frame.height_agl_m / -ray[2])
        scale = frame.height_agl_m / (camera.focal_px * self._site.gsd_m_per_px)
        side = int(0.7 * scale * camera.width_px)
        offset = np.round(aim - (side - 1) / 2)
        plane = np.zeros((3, 3))
        plane[:2, :2], plane[2, 2] = jacobian, -frame.height_agl_m
        shift = np.array([[1, 0, offset[0]], [0, 1, offset[1]], [0, 0, 1.0]])
        homography = camera.matrix @ turn.T @ plane @ shift
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        template = self._enhance(cv2.warpPerspective(gray, homography, (side, side), flags=flags))
        nadir = self._site.pixel_from_enu(np.array([prior.east_m, prior.north_m]))
        half = (1.3 * scale * camera.width_px + 7.0 * 0.2 / self._site.gsd_m_per_px) / 2
        x0, y0 = (max(0, int(v - half)) for v in nadir + aim)
        x1, y1 = (int(v + half) for v in nadir + aim)
        cut = np.s_[y0:y1, x0:x1]
        window = self._enhance(self._gray[cut]) if self._map is None else self._map[cut]
        scores = cv2.matchTemplate(np.ascontiguousarray(window), template, cv2.TM_CCOEFF_NORMED)
        _, _, _, (x, y) = cv2.minMaxLoc(scores)
        place = np.array([x0 + x, y0 + y], dtype=float)
        if 0 < x < scores.shape[1] - 1 and 0 < y < scores.shape[0] - 1:
            place += [_parabola(scores[y, x - 1 : x + 2]), _parabola(scores[y - 1 : y + 2, x])]
        east, north = self._site.enu_from_pixel(place - offset)
        return float(east), float(north)


def _parabola(three: Image) -> float:
    low, middle, high = (float(v) for v in three)
    return 0.5 * (low - high) / (low - 2.0 * middle + high)


class OpenCvFeatures:
    """The SIFT method with OpenCV's features: what a good user of both libraries would write.

    Windows, half scale, ratio and mutual test, surface model, and PnP are the engine's; keypoints, descriptors
    and the brute-force matcher are OpenCV's. With ``prepared`` each level of the map is described once, else the
    window in every frame. It is a matcher for a Navigator.
    """

    def __init__(self, site: OrthoMap, camera: Camera, *, prepared: bool) -> None:
        self.site, self._camera, self._options = site, camera, SiftOptions()
        self._levels: dict[int, Keypoints] | None = {} if prepared else None
        self._pinhole = replace(camera, distortion_model="plumb_bob", distortion=np.zeros(5))

    def locate(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """Where the camera was."""
        device, options, site = torch.device("cpu"), self._options, self.site
        scheduler = Scheduler(Deadline(budget or Budget()), device)
        gray = self._camera.undistort(to_gray(frame))
        assumed = AssumedErrors().on_map(site)
        query = Query(frame, gray, self._pinhole, site, prior, device, scheduler, RISK, assumed)
        window = self._window(query)
        if window is None:
            return query.refuse(Reason.OUTSIDE_MAP, "no window", "sift")
        half = cv2.resize(gray, None, fx=options.scale, fy=options.scale, interpolation=cv2.INTER_AREA)
        seen = _opencv_features(half, options.max_keypoints)
        known, level, corner = self._map_features(query, window)
        pairs = matches(seen, known)
        if len(pairs) < MIN_INLIERS:
            return query.refuse(Reason.TOO_FEW_MATCHES, f"{len(pairs)} matches", "sift", window=window)
        points_px = (seen.xy_px[pairs[:, 0]] + 0.5) / options.scale - 0.5
        map_px = site.full_from_level(known.xy_px[pairs[:, 1]] + corner, level)
        points_m = site.surface_points(map_px)
        stats = solve_pose(
            points_m, points_px, self._camera.matrix, options.pose, prior=self._attitude(query.telemetry)
        )
        if stats is None or stats.rotation[2, 2] > -math.cos(math.radians(MAX_TILT_DEG)):
            return query.refuse(Reason.BAD_POSE, f"no pose from {len(pairs)} matches", "sift", window=window)
        return self._fix(query, stats, window)

    def _window(self, query: Query) -> Window | None:
        pose, site = query.telemetry, self.site
        if query.prior_px is None or pose.height_agl_m is None:
            return Window(0, 0, site.width_px, site.height_px)
        attitude = pose.grid_attitude or Attitude(0.0, 0.0, 0.0)
        view = view_of(self._camera, attitude, pose.height_agl_m, query.jacobian)
        if view is None:
            return None
        footprint = view.footprint_px
        if pose.grid_heading_deg is None:
            footprint = (math.hypot(*footprint),) * 2
        return query.window(query.prior_px + view.center_px, footprint, footprint)

    def _map_features(self, query: Query, window: Window) -> tuple[Keypoints, int, Array]:
        site, options, height_m = self.site, self._options, query.frame.height_agl_m
        level = min(1, site.levels - 1)
        if height_m is not None:
            level = level_for(site.gsd_m_per_px, height_m / (self._camera.focal_px * options.scale), site.levels)
        crop = level_crop(site, window, level)
        corner = np.array([crop.x0, crop.y0], np.float64)
        if self._levels is None:
            found = self._described(crop, level, MAX_MAP_KEYPOINTS)
            return found, level, corner
        if level not in self._levels:
            rows, columns = site.level_shape(level)
            self._levels[level] = self._described(Window(0, 0, columns, rows), level, None)
        known = self._levels[level]
        xy_px = known.xy_px - corner
        inside = ((xy_px >= 0) & (xy_px < [crop.width_px, crop.height_px])).all(axis=1)
        return Keypoints(xy_px[inside], known.scale_px[inside], known.descriptors[inside]), level, corner

    def _described(self, crop: Window, level: int, most: int | None) -> Keypoints:
        """Features of a piece of the map, as dense as those of the frame."""
        site, options = self.site, self._options
        mask = site.valid(crop, level).astype(np.uint8)
        frame_px = self._camera.width_px * self._camera.height_px * options.scale**2
        count = round(options.max_keypoints * max(1.0, crop.area_px / frame_px))
        return _opencv_features(site.gray(crop, level), min(count, most or count), mask)

    def _attitude(self, pose: GridPose) -> AttitudePrior | None:
        errors, attitude = AssumedErrors(), pose.grid_attitude
        if not self._options.use_attitude or attitude is None or not pose.has_tilt:
            return None
        sigma_deg = (errors.tilt_deg, errors.tilt_deg, errors.heading_deg)
        return AttitudePrior(self._camera.enu_from_camera(attitude).T, sigma_deg)

    def _fix(self, query: Query, stats: PoseStats, window: Window) -> Fix:
        errors, site = query.errors, self.site
        slope_deg = errors.surface_slope_deg if site.has_surface else errors.unknown_slope_deg
        slope_m2 = (float(stats.center_m[2]) * math.radians(slope_deg)) ** 2
        return query.fix(
            "sift",
            site.pixel_from_enu(stats.center_m[:2]),
            stats.covariance_center_m2 + np.diag([slope_m2, slope_m2, 0]) + errors.map_m**2 * np.eye(3),
            score=float(stats.inliers.mean()),
            window=window,
            center_m=stats.center_m,
            grid_attitude=Attitude(*attitude_from_rotation(stats.rotation.T @ self._camera.mount.T)),
        )


def _opencv_features(gray: Gray, count: int, mask: Gray | None = None) -> Keypoints:
    points, words = cv2.SIFT_create(nfeatures=count).detectAndCompute(gray, mask)
    if not points:
        return Keypoints(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.float32))
    xy_px = np.array([point.pt for point in points], np.float64)
    return Keypoints(xy_px, np.array([point.size / 2 for point in points]), np.asarray(words, np.float32))
