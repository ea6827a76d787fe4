"""Visual odometry: motion between two images of the ground, from points that both show.

Pyramidal Lucas-Kanade follows corners of the earlier picture into the later one, starting where attitude and
height predict them. On level ground at the known height they are points of a map, so the later camera's pose is
solved as a frame's is, with the telemetry's turn as its prior: a fraction of a degree looks like metres.

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
from engine.geo import Array, larger_variance
from engine.matching.align import MAX_FIELD_DEG, to_gray
from engine.matching.pose import AttitudePrior, PoseStart, solve_pose
from engine.navigation.motion import GroundMotion, velocity_of
from engine.options import PoseOptions
from engine.values import Frame

Gray = NDArray[np.uint8]

_SMALL_PX = 160  # width at which a shift is estimated
_MAX_SIDE_PX = 640  # larger pictures are reduced first
_APART_PX, _QUALITY = 8, 0.01  # distance between corners; weakest over strongest
_AGREES_PX, _CLOSER_PX = 1.5, 0.375  # of points on one motion; of those on level ground, that determine it
_MAX_POINTS, _MIN_POINTS = 200, 20  # followed between pictures; needed to agree on one motion
_MIN_SHARE = 0.5  # of the followed points that must agree
_MIN_SPREAD = 0.12  # of those, as a share of the picture's sides: parts of the vehicle often fill a corner
_MAX_SIGMA_MPS = 2.0  # a less certain velocity is refused
_MAX_INTERVAL_S = 3.0  # between two pictures
_POINTS_PER_ERROR = 3.0  # followed points that share one error
_ERROR_MEMORY_S = 1.0  # how long an error persists, since the same ground is followed
_LEVEL_DEG = 0.02  # if roll and pitch are unknown their change is not estimated


@dataclass(frozen=True, slots=True)
class NoMotion:
    """Why two pictures gave no motion, in a few words."""

    reason: str


class VisualOdometry:
    """Follows the ground from picture to picture.

    Args:
        camera: the camera, including its lens.
    """

    def __init__(self, camera: Camera) -> None:
        sides = np.array([camera.width_px, camera.height_px])
        shorter = round(sides.min() * min(1.0, _MAX_SIDE_PX / sides.max()))
        width, height = np.round(sides * (shorter / sides.min())).astype(int).tolist()
        from engine.kernels import clusters, pose_fit  # noqa: F401  # loaded before the flight: it takes a while

        self._given, self._camera = camera, camera.scaled_to(width, height)
        self._last: tuple[Frame, Gray] | None = None
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
        self._given.check_size(frame.image.shape)
        size = self._camera.width_px, self._camera.height_px
        gray = cv2.resize(to_gray(frame), size, interpolation=cv2.INTER_AREA)  # a copy: the buffer may be reused
        last, self._last = self._last, (frame, gray)
        if velocity_of(frame) is not None:
            motion: GroundMotion | NoMotion = NoMotion("the velocity is known")
        elif last is None:
            motion = NoMotion("there is no picture before")
        else:
            motion = self._between(*last, frame, gray)
        self._velocity_mps = np.append(motion.velocity_mps, 0.0) if isinstance(motion, GroundMotion) else None
        return motion

    def _between(self, earlier: Frame, before: Gray, later: Frame, now: Gray) -> GroundMotion | NoMotion:
        """The motion from one frame and its picture to the next."""
        if earlier.timestamp_ns is None or later.timestamp_ns is None:
            return NoMotion("a frame has no timestamp")
        interval_s = (later.timestamp_ns - earlier.timestamp_ns) * 1e-9
        if not 0.0 < interval_s <= _MAX_INTERVAL_S:
            return NoMotion(f"the pictures are {interval_s:.1f} s apart")
        height_m, begin, end = earlier.height_agl_m, earlier.attitude, later.attitude
        if height_m is None or begin is None or end is None:
            return NoMotion("height or heading is unknown")
        if np.array_equal(before, now):
            self._last = None  # its timestamp is wrong, so the next interval would be too
            return NoMotion("the picture repeats the last one")
        errors = AssumedErrors().of_frame(later)
        moved_m = np.zeros(3) if self._velocity_mps is None else self._velocity_mps * interval_s
        moved_m[2] = (later.height_agl_m or height_m) - height_m
        axes = self._camera.enu_from_camera(begin), self._camera.enu_from_camera(end)
        expected = self._homography(*axes, moved_m / height_m)
        if self._velocity_mps is None:
            expected = _shifted(before, now, expected)
        points = track_corners(before, now, expected)
        turn_deg = math.sqrt(2.0) * np.array([errors.tilt_deg, errors.tilt_deg, errors.heading_deg])  # of both
        if None in (earlier.roll_deg, earlier.pitch_deg, later.roll_deg, later.pitch_deg):
            turn_deg[:2] = _LEVEL_DEG
        solved = self._solved(*points, *axes, height_m, turn_deg)
        if isinstance(solved, NoMotion):
            return solved
        moved_m, noise_m2 = solved
        sigma_mps = math.sqrt(larger_variance(noise_m2)) / interval_s
        if not sigma_mps <= _MAX_SIGMA_MPS:
            return NoMotion(f"the velocity is uncertain by {sigma_mps:.1f} m/s")
        lasting = math.hypot(errors.height_sigma_m(height_m) / height_m, math.radians(errors.heading_deg))
        drift = 1.0 + 2.0 * _ERROR_MEMORY_S / interval_s
        return GroundMotion(interval_s, moved_m, noise_m2, lasting, drift)

    def _homography(self, begin: Array, end: Array, share: Array) -> Array:
        """From pixels of the earlier picture to those of the later, over level ground.

        Args:
            begin: (3, 3) from the earlier camera's axes to east, north, up.
            end: (3, 3) from the later one's.
            share: (3,) the motion as a share of the height.
        """
        turned = end.T @ (begin + np.outer(share, begin[2]))
        return np.asarray(self._camera.matrix @ turned @ np.linalg.inv(self._camera.matrix))

    def _solved(
        self, begin_px: Array, end_px: Array, begin: Array, end: Array, height_m: float, turn_deg: Array
    ) -> tuple[Array, Array] | NoMotion:
        """The motion from points (N, 2) before and after.

        Args:
            begin_px: in the earlier picture.
            end_px: in the later one.
            begin: (3, 3) from the earlier camera's axes to east, north, up.
            end: (3, 3) from the later one's, by the telemetry.
            height_m: of the earlier camera.
            turn_deg: (3,) standard deviations of the turn about east, north and up that the telemetry leaves.

        Returns:
            (2,) metres east and north, and their covariance (2, 2).
        """
        camera, count = self._camera, len(begin_px)
        if count < _MIN_POINTS:
            return NoMotion(f"{count} points could be followed, {_MIN_POINTS} are needed")
        rays = np.column_stack([camera.undistort_points(begin_px), np.ones(count)]) @ begin.T
        if (-rays[:, 2] / np.linalg.norm(rays, axis=1)).min() < math.cos(math.radians(MAX_FIELD_DEG)):
            return NoMotion("the ground is seen too obliquely")
        ground_m = rays * (height_m / -rays[:, 2])[:, None]
        # Points that share an error count as one; so the prior weighs as much more.
        prior = AttitudePrior(end.T, tuple(turn_deg / math.sqrt(_POINTS_PER_ERROR)), end)
        focal_px = camera.focal_px
        matrix, shown_px = np.diag([focal_px, focal_px, 1.0]), focal_px * camera.undistort_points(end_px)
        pose = solve_pose(ground_m, shown_px, matrix, PoseOptions(reprojection_px=_AGREES_PX), prior=prior)
        kept = np.zeros(count, bool) if pose is None else pose.inliers
        if pose is None or kept.sum() < max(_MIN_POINTS, _MIN_SHARE * count):
            return NoMotion(f"{kept.sum()} of {count} points agree on one motion")
        if (begin_px[kept].std(axis=0) / [camera.width_px, camera.height_px]).min() < _MIN_SPREAD:
            return NoMotion("the points that agree fill a small part of the picture")
        start = PoseStart(pose.rotation, pose.center_m, _AGREES_PX)
        options = PoseOptions(reprojection_px=_CLOSER_PX)
        closer = solve_pose(ground_m[kept], shown_px[kept], matrix, options, prior=prior, start=start) or pose
        return closer.center_m[:2], _POINTS_PER_ERROR * closer.covariance_center_m2[:2, :2]


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
    shift = np.eye(3)
    shift[:2, 2] = picture_shift(shown, later)
    return np.asarray(shift @ expected)


def picture_shift(first: Gray, second: Gray) -> tuple[float, float]:
    """The shift from one picture to another by phase correlation of both at a small size.

    Args:
        first: (H, W) uint8.
        second: the same.

    Returns:
        Pixels right and down.
    """
    height, width = second.shape
    size = (_SMALL_PX, max(8, round(height * _SMALL_PX / width)))
    small = [cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32) for gray in (first, second)]
    (right, down), _ = cv2.phaseCorrelate(*small, cv2.createHanningWindow(size, cv2.CV_32F))
    return right * width / size[0], down * height / size[1]
