"""The camera of a run: its calibration or field of view, and its mount."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

from engine.camera import Camera, mount_rotation
from engine.errors import CalibrationError, OptionError
from scenematch.bridges.pictures import first_picture
from scenematch.files.frames import FrameSource, PictureFolder
from scenematch.files.photo_camera import photo_camera
from scenematch.files.ros.bags import is_bag, read_bag_camera
from scenematch.runs.output import SILENT, Progress, StrPath


@dataclass(frozen=True, slots=True)
class CameraInput:
    """What the user states about a camera; None for each value not given.

    Attributes:
        camera: calibration of ROS, OpenCV or Kalibr, or a bag that has one.
        hfov_deg: horizontal field of view, instead of a calibration.
        mount: a key of :data:`engine.camera.MOUNTS`; None uses the calibration's, or nadir if that has none or
            ``camera_pitch_deg`` is given.
        camera_pitch_deg: pitch of the optical axis, -90 looks straight down.
        scale_calibration: scale the calibration to pictures of another size but the same aspect ratio.

    Raises:
        OptionError: both a field of view and a calibration are given, a value is out of range, or there is no
            calibration to scale.
    """

    camera: StrPath | None = None
    _: KW_ONLY
    hfov_deg: float | None = None
    mount: str | None = None
    camera_pitch_deg: float | None = None
    scale_calibration: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera", None if self.camera is None else Path(self.camera))
        if self.scale_calibration and self.camera is None:
            raise OptionError("scale_calibration: expected with `camera`, a calibration to scale")
        if self.hfov_deg is not None and self.camera is not None and not is_bag(self.camera):
            raise OptionError("hfov_deg: expected without `camera`, which has its own field of view")
        if self.hfov_deg is not None and not 0.0 < self.hfov_deg < 180.0:
            raise OptionError(f"hfov_deg: expected above 0 and below 180, got {self.hfov_deg:g}")
        self._check_mount()

    def _check_mount(self) -> None:
        try:
            mount_rotation(self.mount or "nadir", self.camera_pitch_deg)
        except CalibrationError as error:
            raise OptionError(str(error).replace(", or 9 numbers", "")) from None

    @classmethod
    def of(cls, value: CameraInput | StrPath | None) -> CameraInput:
        """The camera from a calibration's path, from None, or unchanged."""
        return value if isinstance(value, CameraInput) else cls(value)

    def mounted(self, camera: Camera) -> Camera:
        """The camera with its mount, if one is given."""
        if self.mount is None and self.camera_pitch_deg is None:
            return camera
        return replace(camera, mount=mount_rotation(self.mount or "nadir", self.camera_pitch_deg))

    def load(
        self,
        frames: FrameSource | None,
        names: Sequence[str] = (),
        *,
        image_topic: str | None = None,
        progress: Progress = SILENT,
    ) -> Camera:
        """The camera of some frames.

        Args:
            frames: the pictures; None if they are still to be taken.
            names: names of the pictures that are used; none is all.
            image_topic: topic of the pictures, if the calibration is from a bag with several.
            progress: receives what the photographs' EXIF states.

        Raises:
            CalibrationError: the calibration cannot be read, or nothing states the camera's focal length.
            TelemetryError: a picture cannot be read.
        """
        if self.hfov_deg is not None and frames is not None:
            return self.with_field_of_view(frames.read(frames.names[0]).shape)
        if self.camera is not None:
            path = Path(self.camera)
            camera = read_bag_camera(path, image_topic) if is_bag(path) else Camera.load(path)
            if self.scale_calibration and frames is not None:
                camera = _scaled(camera, frames.read((names or frames.names)[0]).shape, progress)
            return self.mounted(camera)
        if not isinstance(frames, PictureFolder):
            raise CalibrationError(
                "camera: expected a calibration, or `hfov_deg`: only photographs contain theirs"
            )
        try:
            camera, source = photo_camera([frames.path / name for name in names or frames.names])
        except CalibrationError as error:
            raise CalibrationError(f"camera: expected a calibration, or that of photographs: {error}") from None
        wide_deg = math.degrees(2.0 * math.atan(camera.width_px / (2.0 * camera.matrix[0, 0])))
        progress.message(f"camera, by {source} of the photographs: {wide_deg:.1f} degrees wide")
        return self.mounted(camera)

    def with_field_of_view(self, shape: tuple[int, ...]) -> Camera:
        """The camera from ``hfov_deg`` and the shape (H, W, ...) of a picture."""
        assert self.hfov_deg is not None  # checked by the callers
        height_px, width_px = shape[:2]
        return self.mounted(Camera.from_fov(width_px, height_px, self.hfov_deg))

    def load_live(self, camera_source: str, *, progress: Progress = SILENT) -> Camera:
        """A camera that has not taken pictures yet.

        Args:
            camera_source: as of :func:`scenematch.bridges.pictures.capture`; with ``hfov_deg`` it is opened once
                to learn the size of its pictures.
            progress: receives what the call waits for, and the camera found.

        Raises:
            CalibrationError: the calibration cannot be read, or there is none.
            TelemetryError: the camera does not open, or gives no picture.
        """
        if self.hfov_deg is None:
            return self.load(None)
        progress.message(f"waiting for a picture of {camera_source}, whose size is not known")
        camera = self.with_field_of_view(first_picture(camera_source).shape)
        progress.message(f"camera: {camera.width_px} x {camera.height_px}, {self.hfov_deg:g} degrees wide")
        return camera


def _scaled(camera: Camera, shape: tuple[int, ...], progress: Progress) -> Camera:
    height_px, width_px = shape[:2]
    if (width_px, height_px) == (camera.width_px, camera.height_px):
        return camera
    progress.message(
        f"the calibration for {camera.width_px} x {camera.height_px} is scaled to pictures of "
        f"{width_px} x {height_px}"
    )
    return camera.scaled_to(width_px, height_px)


def check_size(camera: Camera, shape: tuple[int, ...]) -> None:
    """Refuse a picture whose size differs from the calibration's, and name the argument that scales it.

    Raises:
        CalibrationError: the sizes differ.
    """
    try:
        camera.check_size(shape)
    except CalibrationError as error:
        raise CalibrationError(f"{error}; {_way_out(camera, shape)}") from None


def _way_out(camera: Camera, shape: tuple[int, ...]) -> str:
    """How to use a calibration for another size; it can be scaled only to the same aspect ratio."""
    try:
        camera.scaled_to(shape[1], shape[0])
    except CalibrationError:
        return "their aspect ratios differ: give the calibration of these pictures"
    return "if the pictures were resized without cropping, add `scale_calibration`"
