"""The camera of a run: its calibration, or what else is known of its lens, and how it is mounted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from engine.camera import Camera, mount_rotation
from engine.errors import CalibrationError, OptionError
from engine.formats.frames import FrameSource, PictureFolder
from engine.formats.photo_camera import photo_camera
from engine.formats.ros.bags import is_bag, read_bag_camera
from engine.runs.progress import SILENT, Progress


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFiles:
    """What is said of a camera; None where it is not.

    Attributes:
        calibration: a file of ROS, OpenCV or Kalibr, or a bag that has the calibration.
        image_topic: of the pictures, where it is a bag with several.
        hfov_deg: horizontal field of view, in place of a calibration.
        mount: a key of :data:`engine.camera.MOUNTS`; None is the calibration's, else nadir.
        camera_pitch_deg: of the optical axis, -90 looks straight down.

    Raises:
        OptionError: there is a field of view besides a calibration, or a value is out of range.
    """

    calibration: Path | None = None
    image_topic: str | None = None
    hfov_deg: float | None = None
    mount: str | None = None
    camera_pitch_deg: float | None = None

    def __post_init__(self) -> None:
        if self.hfov_deg is not None and self.calibration is not None and not is_bag(self.calibration):
            raise OptionError("hfov_deg: expected without `camera`, which has its own field of view")
        if self.hfov_deg is not None and not 0.0 < self.hfov_deg < 180.0:
            raise OptionError(f"hfov_deg: expected above 0 and below 180, got {self.hfov_deg:g}")
        self._check_mount()

    def _check_mount(self) -> None:
        try:
            mount_rotation(self.mount or "nadir", self.camera_pitch_deg)
        except CalibrationError as error:
            raise OptionError(str(error).replace(", or 9 numbers", "")) from None

    @property
    def has_mount(self) -> bool:
        """Whether it is said how the camera is mounted."""
        return self.mount is not None or self.camera_pitch_deg is not None

    def mounted(self, camera: Camera) -> Camera:
        """The camera as it is mounted."""
        if not self.has_mount:
            return camera
        return replace(camera, mount=mount_rotation(self.mount or "nadir", self.camera_pitch_deg))

    def load(
        self, frames: FrameSource | None, names: Sequence[str] = (), *, progress: Progress = SILENT
    ) -> Camera:
        """The camera of some frames.

        Args:
            frames: the pictures; None where they are not known before they are taken.
            names: of those pictures that are used; none is all.
            progress: is told what a photograph's EXIF said.

        Raises:
            CalibrationError: the calibration cannot be read, or nothing says what the camera's focal length is.
            TelemetryError: a picture cannot be read.
        """
        if self.hfov_deg is not None and frames is not None:
            height_px, width_px = frames.read(frames.names[0]).shape[:2]
            return self.mounted(Camera.from_fov(width_px, height_px, self.hfov_deg))
        if self.calibration is not None and is_bag(self.calibration):
            return self.mounted(read_bag_camera(self.calibration, self.image_topic))
        if self.calibration is not None:
            return self.mounted(Camera.load(self.calibration))
        if not isinstance(frames, PictureFolder):
            raise CalibrationError("camera: expected a calibration, or `hfov_deg`: only photographs say theirs")
        try:
            found = photo_camera([frames.path / name for name in names or frames.names])
        except CalibrationError as error:
            raise CalibrationError(f"camera: expected a calibration, or that of photographs: {error}") from None
        wide_deg = math.degrees(2.0 * math.atan(found.camera.width_px / (2.0 * found.camera.matrix[0, 0])))
        progress.message(f"camera, by {found.source} of the photographs: {wide_deg:.1f} degrees wide")
        return self.mounted(found.camera)
