"""The camera: pinhole intrinsics, lens distortion and mount on the body.

Convention:
    Pixels (x, y) have their centres at integers, the origin at the centre of the top-left pixel (as in OpenCV).
    The optical frame is x right, y down, z forward. ``mount`` takes optical vectors to body
    forward-right-down: v_body = mount @ v_camera. The default mount looks straight down with the top of
    the picture towards the nose.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import CalibrationError
from engine.geo import Array, enu_from_body
from engine.values import Attitude

DISTORTION_MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,), "fisheye": (4,)}
"""Names of ROS camera_info, and the valid numbers of coefficients of each."""
_FISHEYES = ("equidistant", "fisheye")
SIDE_STEPS = 16
"""Into which each side of a frame, or of a picture of the ground, is divided where its projection is computed."""
NADIR_PITCH_DEG = -90.0
"""Pitch of a camera that looks straight down."""
MOUNTS = {
    "nadir": (0.0, NADIR_PITCH_DEG),
    "nadir-right": (90.0, NADIR_PITCH_DEG),
    "nadir-tail": (180.0, NADIR_PITCH_DEG),
    "nadir-left": (270.0, NADIR_PITCH_DEG),
    "forward-45": (0.0, -45.0),
}
"""Mounts by name, each two angles in degrees: the side of the vehicle, clockwise from the nose, to which the top
of the picture points if the camera looks down; and the pitch."""


def mount_rotation(name: str = "nadir", pitch_deg: float | None = None) -> Array:
    """Rotation from the optical frame to the body, for a mount by name.

    Args:
        name: a key of :data:`MOUNTS`.
        pitch_deg: pitch of the optical axis from the body's horizontal: -90 looks straight down, -60 is turned up
            by 30 degrees towards the side to which the top of the picture points. None takes the name's.

    Returns:
        (3, 3) v_body = mount @ v_camera.

    Raises:
        CalibrationError: there is no such mount, or the camera would not look down.
    """
    if name not in MOUNTS:
        raise CalibrationError(f"mount: expected one of {', '.join(MOUNTS)}, or 9 numbers, got {name!r}")
    side_deg, named_pitch_deg = MOUNTS[name]
    if pitch_deg is None:
        pitch_deg = named_pitch_deg
    elif named_pitch_deg != NADIR_PITCH_DEG and pitch_deg != named_pitch_deg:
        raise CalibrationError(f"camera_pitch_deg: expected none with the mount {name}, got {pitch_deg:g}")
    if not NADIR_PITCH_DEG <= pitch_deg < 0.0:  # NaN fails too
        raise CalibrationError(f"camera_pitch_deg: expected -90 (straight down) to below 0, got {pitch_deg:g}")
    sin_p, cos_p = np.sin(np.radians(pitch_deg)), np.cos(np.radians(pitch_deg))
    sin_s, cos_s = np.sin(np.radians(side_deg)), np.cos(np.radians(side_deg))
    pitched = np.array([[0.0, sin_p, cos_p], [1.0, 0.0, 0.0], [0.0, cos_p, -sin_p]])
    turned = np.array([[cos_s, -sin_s, 0.0], [sin_s, cos_s, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(np.round(turned @ pitched, 15) + 0.0, np.float64)  # quarter turns are whole numbers


@dataclass(frozen=True, eq=False)  # == of arrays is elementwise
class Camera:
    """Intrinsics and mount of one camera.

    Attributes:
        width_px: columns of a frame.
        height_px: rows of a frame.
        matrix: (3, 3) pinhole matrix K.
        distortion_model: a key of :data:`DISTORTION_MODELS`.
        distortion: its coefficients, in OpenCV's order; none, or any number of zeros, if there is no distortion.
        mount: (3, 3) rotation, v_body = mount @ v_camera.

    Raises:
        CalibrationError: a field is out of range, has the wrong shape or is not finite, the distortion model is
            unknown, or the mount is no rotation.
    """

    width_px: int
    height_px: int
    matrix: Array
    distortion_model: str = "plumb_bob"
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    mount: Array = field(default_factory=mount_rotation)

    def __post_init__(self) -> None:
        for name in ("matrix", "distortion", "mount"):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))
        if self.width_px < 1 or self.height_px < 1:
            raise CalibrationError(f"image size: expected 1 x 1 or more, got {self.width_px} x {self.height_px}")
        if self.matrix.shape != (3, 3) or not np.isfinite(self.matrix).all():
            raise CalibrationError(f"camera_matrix: expected 9 finite numbers, got shape {self.matrix.shape}")
        if self.matrix[0, 0] <= 0 or self.matrix[1, 1] <= 0:
            raise CalibrationError(
                f"camera_matrix: expected positive focal lengths, got {self.matrix[0, 0]}, {self.matrix[1, 1]}"
            )
        if not np.allclose(self.matrix[[1, 2, 2, 2], [0, 0, 1, 2]], (0.0, 0.0, 0.0, 1.0)):
            raise CalibrationError(  # typically a transposed matrix
                f"camera_matrix: expected fx 0 cx, 0 fy cy, 0 0 1 row by row, got {self.matrix.ravel().tolist()}"
            )
        if self.distortion_model not in DISTORTION_MODELS:
            known = ", ".join(DISTORTION_MODELS)
            raise CalibrationError(f"distortion_model: expected one of {known}, got {self.distortion_model!r}")
        lengths = DISTORTION_MODELS[self.distortion_model]
        if not self.distortion.any():  # ROS writes an ideal camera as none, four or five zeros
            object.__setattr__(self, "distortion", np.zeros(lengths[-1]))
        if self.distortion.shape not in [(n,) for n in lengths] or not np.isfinite(self.distortion).all():
            raise CalibrationError(
                f"distortion_coefficients: {self.distortion_model} takes {' or '.join(map(str, lengths))} "
                f"finite numbers, got {self.distortion.tolist()}"
            )
        if self.mount.shape != (3, 3) or not np.allclose(self.mount @ self.mount.T, np.eye(3), atol=1e-3):
            raise CalibrationError("mount: expected a 3 x 3 rotation, got a matrix that is not orthonormal")
        if np.linalg.det(self.mount) < 0:
            raise CalibrationError("mount: expected a rotation, got a reflection (determinant -1)")

    @classmethod
    def from_fov(cls, width_px: int, height_px: int, fov_deg: float) -> Camera:
        """An ideal nadir camera from its horizontal field of view: f = W / (2 tan(fov / 2)).

        Raises:
            CalibrationError: the field of view is not between 0 and 180 degrees, or the size is not positive.
        """
        if not 0.0 < fov_deg < 180.0:
            raise CalibrationError(f"fov_deg: expected above 0 and below 180, got {fov_deg}")
        focal = width_px / (2.0 * np.tan(np.radians(fov_deg) / 2.0))
        centre = ((width_px - 1) / 2.0, (height_px - 1) / 2.0)
        return cls(width_px, height_px, np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]]))

    @classmethod
    def load(cls, path: str | Path) -> Camera:
        """Read a calibration file by ROS (camera_info), OpenCV or Kalibr, with an optional ``mount``.

        The mount is 9 numbers, or a name of :data:`MOUNTS` with an optional ``camera_pitch_deg``.

        Args:
            path: see :func:`engine.calibration_files.read_calibration`.

        Raises:
            CalibrationError: the file is missing or in no such format, or a field is missing or invalid.
        """
        from engine.calibration_files import read_calibration

        content = read_calibration(path)
        try:
            return cls._from_camera_info(content)
        except KeyError as error:
            raise CalibrationError(f"camera: {path} lacks the field {error.args[0]}") from None
        except (CalibrationError, TypeError, ValueError) as error:
            raise CalibrationError(f"camera: {path}: {str(error).splitlines()[0]}") from None

    @classmethod
    def _from_camera_info(cls, info: dict[str, Any]) -> Camera:
        def numbers(name: str, count: int | None = None) -> Array:
            block = info[name]
            data = block.get("data") if isinstance(block, dict) else block
            try:
                values = np.asarray(data, dtype=np.float64).ravel()
            except (TypeError, ValueError):
                raise CalibrationError(f"{name}: expected numbers, got {str(data)[:60]!r}") from None
            if count not in (None, values.size):
                raise CalibrationError(f"{name}: expected {count} numbers, got {values.size}")
            return values

        def pixels(name: str) -> int:
            value = info[name]
            if not isinstance(value, int) or isinstance(value, bool):
                raise CalibrationError(f"{name}: expected a whole number of pixels, got {value!r}")
            return value

        pinhole, model = numbers("camera_matrix", 9), str(info.get("distortion_model", "plumb_bob"))
        distortion = numbers("distortion_coefficients") if "distortion_coefficients" in info else np.zeros(0)
        named, pitch_deg = info.get("mount", "nadir"), info.get("camera_pitch_deg")
        if not isinstance(named, str) and pitch_deg is not None:
            raise CalibrationError("camera_pitch_deg: expected a mount by name, got one of numbers")
        if isinstance(named, str):
            mount = mount_rotation(named, None if pitch_deg is None else float(pitch_deg))
        else:
            mount = numbers("mount", 9).reshape(3, 3)
        size = pixels("image_width"), pixels("image_height")
        return cls(*size, pinhole.reshape(3, 3), model, distortion, mount)

    def scaled_to(self, width_px: int, height_px: int) -> Camera:
        """The same camera with its pictures resized as a whole, without cropping.

        The frame's edges stay in place: half a pixel outside the centres of the outer pixels.

        Args:
            width_px: columns of the pictures.
            height_px: rows.

        Raises:
            CalibrationError: the aspect ratio differs from the calibrated one.
        """
        across, down = width_px / self.width_px, height_px / self.height_px
        if min(abs(height_px - across * self.height_px), abs(width_px - down * self.width_px)) > 1.0:
            raise CalibrationError(
                f"camera: calibrated for {self.width_px} x {self.height_px}, expected that aspect ratio to "
                f"scale it to, got {width_px} x {height_px}: a part may have been cut off"
            )
        matrix = np.diag([across, down, 1.0]) @ self.matrix
        matrix[:2, 2] += [(across - 1.0) / 2.0, (down - 1.0) / 2.0]
        return replace(self, width_px=width_px, height_px=height_px, matrix=matrix)

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels."""
        return float((self.matrix[0, 0] + self.matrix[1, 1]) / 2.0)

    def enu_from_camera(self, attitude: Attitude) -> Array:
        """Rotation from the camera's axes to east, north, up.

        Args:
            attitude: of the body; its heading counts from the north of the result.

        Returns:
            (3, 3) v_enu = R v_camera.
        """
        turn = enu_from_body(attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg)
        return np.asarray(turn @ self.mount)

    @cached_property
    def frame_rays(self) -> Array:
        """(5, 3) optical rays of the frame's outer corners, clockwise from the top left, and of its middle."""
        w, h = self.width_px - 0.5, self.height_px - 0.5
        return self._rays(np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h], [(w - 0.5) / 2, (h - 0.5) / 2]]))

    @cached_property
    def border_rays(self) -> Array:
        """(N, 3) optical rays through the border of the frame; the last goes through its middle."""
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        sides = np.linspace(corners, np.roll(corners, -1, axis=0), SIDE_STEPS, endpoint=False, axis=1)
        xy = np.vstack([*sides, [0.5, 0.5]])
        return self._rays(xy * [self.width_px - 1, self.height_px - 1])

    def _rays(self, xy_px: Array) -> Array:
        """(N, 3) optical rays of pixels (N, 2)."""
        return np.asarray(np.c_[xy_px, np.ones(len(xy_px))] @ np.linalg.inv(self.matrix).T, np.float64)

    @property
    def distorts(self) -> bool:
        """Whether pictures must be undistorted before the pinhole model holds."""
        return bool(self.distortion.any()) or self.distortion_model in _FISHEYES

    @property
    def _lens(self) -> Any:
        """OpenCV's functions for the distortion model."""
        import cv2

        return cv2.fisheye if self.distortion_model in _FISHEYES else cv2

    @cached_property
    def _undistort_maps(self) -> tuple[Any, Any]:
        import cv2

        given, size = (self.matrix, self.distortion, np.eye(3), self.matrix), (self.width_px, self.height_px)
        maps: tuple[Any, Any] = self._lens.initUndistortRectifyMap(*given, size, cv2.CV_16SC2)
        return maps

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture that a pinhole camera with the same matrix would have taken.

        The lookup table is computed once per camera.

        Args:
            image: (H, W) or (H, W, 3).

        Returns:
            The same shape, 0 outside the lens's field of view; ``image`` itself if there is no distortion.

        Raises:
            CalibrationError: the picture's size is not the camera's.
        """
        self.check_size(image.shape)
        if not self.distorts:
            return image
        import cv2

        undistorted = cv2.remap(image, *self._undistort_maps, cv2.INTER_LINEAR)
        return np.asarray(undistorted, dtype=np.uint8)

    def undistort_points(self, xy_px: Array) -> Array:
        """Normalised image coordinates: where the pixels' rays meet the plane z = 1.

        Args:
            xy_px: (N, 2) pixels of pictures as they were taken.

        Returns:
            (N, 2) x / z and y / z of the pixels' rays.
        """
        if not len(xy_px):
            return np.zeros((0, 2))
        import cv2

        pixels = np.asarray(xy_px, np.float64)[:, None]
        # OpenCV's default is half a pixel off in the corners of a wide lens.
        closely = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
        flat = self._lens.undistortPoints(pixels, self.matrix, self.distortion, criteria=closely)
        return np.asarray(flat, np.float64)[:, 0]

    def check_size(self, shape: tuple[int, ...]) -> None:
        """Refuse a picture whose resolution differs from the calibration's.

        Raises:
            CalibrationError: the sizes differ.
        """
        if tuple(shape[:2]) != (self.height_px, self.width_px):
            raise CalibrationError(
                f"camera: calibrated for {self.width_px} x {self.height_px}, "
                f"but the frame is {shape[1]} x {shape[0]}"
            )
