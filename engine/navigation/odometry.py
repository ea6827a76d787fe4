"""Visual odometry: motion between two images of the ground, from points that both show.

Pyramidal Lucas-Kanade follows corners of the earlier picture into the later one, starting where attitude and
height predict them. Those that fit one homography give the camera's motion over level ground at the known height.
The remaining rotation is estimated jointly, since a fraction of a degree looks like metres.

References:
    Lucas and Kanade, An iterative image registration technique, IJCAI 1981.
    Shi and Tomasi, Good features to track, CVPR 1994, https://doi.org/10.1109/CVPR.1994.323794.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.assumed_errors import AssumedErrors
from engine.camera import Camera
from engine.errors import OptionError
from engine.geo import larger_variance
from engine.matching.align import MAX_FIELD_DEG, to_gray
from engine.navigation.motion import GroundMotion, velocity_of
from engine.values import CHANCE, Attitude, Frame

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

_SMALL_PX = 160  # width at which a shift is estimated
_MAX_SIDE_PX = 640  # larger pictures are reduced first
_APART_PX, _QUALITY = 8, 0.01  # distance between corners; weakest over strongest
_RANSAC_PX = 1.5
_STEPS = 6  # of Gauss-Newton
_MIN_PX = 0.05  # of a point's error
_MAX_POINTS, _MIN_POINTS = 200, 20  # followed between pictures; needed to agree on one motion
_MIN_SHARE = 0.5  # of the followed points that must agree
_MIN_SPREAD = 0.12  # of those, as a share of the picture's sides: parts of the vehicle often fill a corner
_MAX_SIGMA_MPS = 2.0  # a less certain velocity is refused
_MAX_INTERVAL_S = 3.0  # between two pictures
_POINTS_PER_ERROR = 3.0  # followed points that share one error
_ERROR_MEMORY_S = 1.0  # how long an error persists, since the same ground is followed
_LEVEL_DEG = 0.02  # if roll and pitch are unknown their change is not estimated: see docs/odometry.md


@dataclass(frozen=True, slots=True)
class NoMotion:
    """Why two pictures gave no motion, in a few words."""

    reason: str


@dataclass(frozen=True, slots=True)
class _Picture:
    frame: Frame
    gray: Gray


class VisualOdometry:
    """Follows the ground from picture to picture.

    Args:
        camera: the camera, including its lens.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._last: _Picture | None = None
        self._velocity_mps: Array | None = None  # (3,) expected in the next step

    def update(self, frame: Frame) -> GroundMotion | NoMotion:
        """How far the vehicle moved since the last frame.

        Args:
            frame: the newest, with timestamp, heading and height; roll and pitch if known. A frame with a velocity
                is only kept for the next one.

        Returns:
            GroundMotion | NoMotion: the latter if pictures or telemetry do not support a motion.

        Raises:
            CalibrationError: the frame is not of the camera's resolution.
        """
        self._camera.check_size(frame.image.shape)
        gray = to_gray(frame).copy()  # the buffer may be reused
        last, self._last = self._last, _Picture(frame, gray)
        if velocity_of(frame) is not None:
            motion: GroundMotion | NoMotion = NoMotion("the velocity is known")
        elif last is None:
            motion = NoMotion("there is no picture before")
        else:
            motion = self._between(last, self._last)
        self._velocity_mps = np.append(motion.velocity_mps, 0.0) if isinstance(motion, GroundMotion) else None
        return motion

    def _between(self, last: _Picture, now: _Picture) -> GroundMotion | NoMotion:
        """The motion from one picture to the next."""
        earlier, later = last.frame, now.frame
        if earlier.timestamp_ns is None or later.timestamp_ns is None:
            return NoMotion("a frame has no timestamp")
        interval_s = (later.timestamp_ns - earlier.timestamp_ns) * 1e-9
        if not 0.0 < interval_s <= _MAX_INTERVAL_S:
            return NoMotion(f"the pictures are {interval_s:.1f} s apart")
        height_m, begin, end = earlier.height_agl_m, earlier.attitude, later.attitude
        if height_m is None or begin is None or end is None:
            return NoMotion("height or heading is unknown")
        if np.array_equal(last.gray, now.gray):
            self._last = None  # its timestamp is wrong, so the next interval would be too
            return NoMotion("the picture repeats the last one")
        view = _View(self._camera, begin, end, height_m)
        errors = AssumedErrors().of_frame(later)
        moved_m = np.zeros(3) if self._velocity_mps is None else self._velocity_mps * interval_s
        moved_m[2] = (later.height_agl_m or height_m) - height_m
        expected = view.homography(moved_m)
        if self._velocity_mps is None:
            expected = _shifted(last.gray, now.gray, expected)
        points = self._track_corners(last.gray, now.gray, expected)
        agreed = self._agreed(*points)
        if isinstance(agreed, NoMotion):
            return agreed
        known = None not in (earlier.roll_deg, earlier.pitch_deg, later.roll_deg, later.pitch_deg)
        turn_deg = math.sqrt(2.0) * np.array(
            [errors.tilt_deg, errors.tilt_deg, errors.heading_deg]
        )  # of two frames
        if not known:
            turn_deg[:2] = _LEVEL_DEG
        solved = view.solve(*agreed, moved_m, turn_deg)
        if solved is None:
            return NoMotion("the ground is seen too obliquely, or shows no single motion")
        moved_m, noise_m2 = solved
        sigma_mps = math.sqrt(larger_variance(noise_m2)) / interval_s
        if not sigma_mps <= _MAX_SIGMA_MPS:
            return NoMotion(f"the velocity is uncertain by {sigma_mps:.1f} m/s")
        lasting = math.hypot(errors.height_sigma_m(height_m) / height_m, math.radians(errors.heading_deg))
        drift = 1.0 + 2.0 * _ERROR_MEMORY_S / interval_s
        return GroundMotion(interval_s, moved_m, noise_m2, lasting, drift, len(agreed[0]))

    def _agreed(self, begin_px: Array, end_px: Array) -> tuple[Array, Array] | NoMotion:
        """The points that fit one homography, as normalised image coordinates (N, 2)."""
        camera = self._camera
        if len(begin_px) < _MIN_POINTS:
            return NoMotion(f"{len(begin_px)} points could be followed, {_MIN_POINTS} are needed")
        begin, end = camera.undistort_points(begin_px), camera.undistort_points(end_px)
        reach = _RANSAC_PX / camera.focal_px
        _, found = cv2.findHomography(begin, end, cv2.RANSAC, reach, confidence=1.0 - CHANCE)
        kept = np.zeros(len(begin), bool) if found is None else found[:, 0] > 0
        if kept.sum() < max(_MIN_POINTS, _MIN_SHARE * len(kept)):
            return NoMotion(f"{kept.sum()} of {len(kept)} points agree on one motion")
        spread = (begin_px[kept].std(axis=0) / [camera.width_px, camera.height_px]).min()
        if spread < _MIN_SPREAD:
            return NoMotion("the points that agree fill a small part of the picture")
        return begin[kept], end[kept]

    def _track_corners(self, earlier: Gray, later: Gray, expected: Array) -> tuple[Array, Array]:
        """:func:`track_corners` in pictures that are not larger than need be."""
        size = np.array([earlier.shape[1], earlier.shape[0]])
        small = np.maximum(np.round(size * min(1.0, _MAX_SIDE_PX / size.max())), 1.0)
        if (small == size).all():
            return track_corners(earlier, later, expected)
        across, down = small / size
        shrink = np.array([[across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1.0]])
        shape = small.astype(int).tolist()
        first, second = (cv2.resize(gray, shape, interpolation=cv2.INTER_AREA) for gray in (earlier, later))
        expected = shrink @ expected @ np.linalg.inv(shrink)
        points = track_corners(first, second, expected)
        begin, end = ((xy_px + 0.5) * size / small - 0.5 for xy_px in points)
        return begin, end


def odometry_of(matcher: object) -> VisualOdometry:
    """Odometry with a matcher's camera.

    Raises:
        OptionError: the matcher has no camera.
    """
    camera = getattr(matcher, "camera", None)
    if not isinstance(camera, Camera):
        raise OptionError(f"odometry: expected a matcher with a `camera`, got {type(matcher).__name__} without")
    return VisualOdometry(camera)


def track_corners(earlier: Gray, later: Gray, expected: Array) -> tuple[Array, Array]:
    """Corners of one picture, and where another shows them, by Lucas-Kanade.

    Args:
        earlier: (H, W) uint8.
        later: the same.
        expected: (3, 3) homography from pixels of the earlier to those of the later; only the motion beyond it is
            searched for, so a turn or a long way costs nothing.

    Returns:
        Two (N, 2) lists of pixels.
    """
    none = np.zeros((0, 2))
    corners = cv2.goodFeaturesToTrack(earlier, _MAX_POINTS, _QUALITY, _APART_PX)
    if corners is None:
        return none, none
    begin, size = np.asarray(corners, np.float32), (later.shape[1], later.shape[0])
    start = cv2.perspectiveTransform(begin, expected)
    inside = ((start >= 0) & (start <= np.array(size) - 1)).all(axis=(1, 2))
    begin, start = begin[inside], start[inside]
    if not len(start):
        return none, none
    shown = cv2.warpPerspective(earlier, expected, size, borderMode=cv2.BORDER_REPLICATE)
    end, found, _ = cv2.calcOpticalFlowPyrLK(shown, later, start, None)
    good = found[:, 0] > 0
    return begin[good, 0].astype(np.float64), end[good, 0].astype(np.float64)


def _shifted(earlier: Gray, later: Gray, expected: Array) -> Array:
    """The expected homography and the shift that small pictures show beyond it, by phase correlation."""
    shown = cv2.warpPerspective(earlier, expected, later.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    (right, down), (width, height) = small_shift(shown, later)
    shift = np.eye(3)
    shift[:2, 2] = right * later.shape[1] / width, down * later.shape[0] / height
    return np.asarray(shift @ expected)


def small_shift(first: Gray, second: Gray) -> tuple[tuple[float, float], tuple[int, int]]:
    """The shift from one picture to another by phase correlation of both at a small size.

    Args:
        first: (H, W) uint8.
        second: the same.

    Returns:
        Pixels right and down at the small size; and its width and height.
    """
    size = (_SMALL_PX, max(8, round(second.shape[0] * _SMALL_PX / second.shape[1])))
    small = [cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32) for gray in (first, second)]
    (right, down), _ = cv2.phaseCorrelate(*small, cv2.createHanningWindow(size, cv2.CV_32F))
    return (right, down), size


class _View:
    """Two pictures of level ground: how it moves between them as the camera moves."""

    def __init__(self, camera: Camera, begin: Attitude, end: Attitude, height_m: float) -> None:
        self._camera, self._height_m = camera, height_m
        self._begin, self._end = camera.enu_from_camera(begin), camera.enu_from_camera(end)

    def homography(self, moved_m: Array) -> Array:
        """From pixels of the earlier picture to those of the later, by a motion (3,) east, north, up."""
        down = -self._begin[2]
        turned = self._end.T @ (self._begin - np.outer(moved_m, down) / self._height_m)
        matrix = self._camera.matrix
        return np.asarray(matrix @ turned @ np.linalg.inv(matrix))

    def solve(self, begin: Array, end: Array, moved_m: Array, turn_deg: Array) -> tuple[Array, Array] | None:
        """The motion from normalised image coordinates before and after.

        Args:
            begin: (N, 2).
            end: (N, 2).
            moved_m: (3,) a first guess.
            turn_deg: (3,) standard deviations of the turn about east, north and up that the telemetry leaves.

        Returns:
            (2,) metres east and north, and their covariance (2, 2); None if it cannot be solved for.
        """
        rays = np.column_stack([begin, np.ones(len(begin))]) @ self._begin.T
        steep = -rays[:, 2] / np.linalg.norm(rays, axis=1)
        if steep.min() < math.cos(math.radians(MAX_FIELD_DEG)):
            return None
        ground_m = rays * (self._height_m / -rays[:, 2])[:, None]
        prior = np.diag([*np.radians(turn_deg) ** -2.0, 0.0, 0.0, 0.0])
        state = np.array([0.0, 0.0, 0.0, *moved_m])  # turn about east, north, up; motion
        for _ in range(_STEPS):
            seen, by_state = self._seen(ground_m, state)
            if seen is None:
                return None
            off = end - seen
            weights = _weights(np.hypot(*off.T), _MIN_PX / self._camera.focal_px) / _POINTS_PER_ERROR
            weighted = (by_state * weights[:, None, None]).reshape(-1, 6).T
            try:
                covariance = np.linalg.inv(weighted @ by_state.reshape(-1, 6) + prior)
            except np.linalg.LinAlgError:
                return None
            state = state + covariance @ (weighted @ off.ravel() - prior @ state)
        return (state[3:5], np.asarray(covariance[3:5, 3:5])) if np.isfinite(covariance).all() else None

    def _seen(self, ground_m: Array, state: Array) -> tuple[Array | None, Array]:
        """Places (N, 2) of the ground in the later picture and their derivatives (N, 2, 6) by the state."""
        turn = cv2.Rodrigues(state[:3])[0] @ self._end
        apart_m = ground_m - state[3:]
        place = apart_m @ turn
        depth = place[:, 2]
        if depth.min() <= 0.0:
            return None, np.zeros(0)
        cross = np.zeros((len(apart_m), 3, 3))  # of each place, so that cross @ w = place x w
        for row, column, axis, sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 2, 0, -1)):
            cross[:, row, column], cross[:, column, row] = sign * apart_m[:, axis], -sign * apart_m[:, axis]
        moves = np.concatenate([turn.T @ cross, np.broadcast_to(-turn.T, cross.shape)], axis=2)
        seen = place[:, :2] / depth[:, None]
        return seen, (moves[:, :2] - seen[:, :, None] * moves[:, 2:]) / depth[:, None, None]


def _weights(off: Array, least: float) -> Array:
    """Weight of each point by its distance (N,) from the expected place (Huber); sigma is at least ``least``."""
    sigma = max(float(np.median(off)) / math.sqrt(2.0 * math.log(2.0)), least)  # the median of Rayleigh's law
    return np.minimum(1.0, sigma / np.maximum(off, sigma)) / sigma**2
