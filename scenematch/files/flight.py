"""A flight: its frames, read one at a time, with the telemetry of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import OptionError, TelemetryError
from engine.values import Frame, Prior
from scenematch.files.frames import VIDEO_SUFFIXES, FrameSource, VideoFile, open_frames
from scenematch.files.logs.readers import is_log, open_log, stamp_frames
from scenematch.files.photos import photo_telemetry
from scenematch.files.resampling import rows_and_sources_at
from scenematch.files.ros.bags import BagFrames, is_bag
from scenematch.files.telemetry import TelemetryRow, open_telemetry

__all__ = ["Flight", "FlightFrame", "camera_info", "open_flight"]

MAX_OFFSET_S = 9e9
"""Largest offset of the frames' stamps, within 64 bits of nanoseconds."""


@dataclass(frozen=True, slots=True)
class FlightFrame:
    """One frame of a flight.

    Attributes:
        name: file name of the image, or its index in a video or bag.
        frame: the image with its telemetry.
        prior: the position in the telemetry with its sigma, or None.
        telemetry: the whole row, or None if the flight has no telemetry.
    """

    name: str
    frame: Frame
    prior: Prior | None
    telemetry: TelemetryRow | None


@dataclass
class Flight:
    """Frames in the order of capture. Iterating reads one image at a time and may be repeated.

    Attributes:
        source: source of the images.
        rows: the telemetry, one row per frame; empty if there is none.
        height_sources: if a log or photographs were read, the source of each row's height, or empty.
        names: names of the frames, in order.
        unused: number of images without a row of telemetry.
        has_gimbal: whether the attitude is a gimbal's and thus already states where the camera looks.
        remarks: doubts about the telemetry, one sentence each.
    """

    source: FrameSource
    rows: list[TelemetryRow]
    height_sources: Sequence[str] = ()
    has_gimbal: bool = False
    remarks: Sequence[str] = ()
    names: list[str] = field(init=False)
    unused: int = field(init=False)

    def __post_init__(self) -> None:
        self.names = [row.frame for row in self.rows] or list(self.source.names)
        self.unused = len(set(self.source.names) - set(self.names))

    @property
    def heights(self) -> dict[str, int]:
        """The number of frames whose height comes from each source."""
        return dict(Counter(source for source in self.height_sources if source))

    def every(self, step: int) -> Flight:
        """Every ``step``-th frame of these, from the first on, each with its own telemetry."""
        part = replace(self, rows=self.rows[::step], height_sources=self.height_sources[::step])
        part.names, part.unused = self.names[::step], self.unused
        return part

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[FlightFrame]:
        return map(self.read, range(len(self.names)))

    def read(self, index: int) -> FlightFrame:
        """Read one frame; in a video or bag this is fast for ascending indices.

        Raises:
            TelemetryError: the image is missing or cannot be decoded.
        """
        name, row = self.names[index], self.rows[index] if self.rows else None
        image = self.source.read(name)
        if row is None:
            return FlightFrame(name, Frame(image), None, None)
        return FlightFrame(name, _frame(image, row), row.prior, row)


def _frame(image: NDArray[np.uint8], row: TelemetryRow) -> Frame:
    return Frame(image, **{name: getattr(row, name) for name in FRAME_COLUMNS})


FRAME_COLUMNS = [each.name for each in fields(Frame) if each.name in TelemetryRow.__dataclass_fields__]
"""What a frame and a row of telemetry both hold."""


def open_flight(
    frames: str | Path,
    telemetry: str | Path | None = None,
    camera: Camera | None = None,
    *,
    frame_stamps: Path | None = None,
    log_offset_s: float = 0.0,
    image_topic: str | None = None,
    columns: Mapping[str, str] = {},
    odometry_topic: str | None = None,
) -> Flight:
    """Open a flight and check that its parts belong together.

    Args:
        frames: a folder of images, a video, or a ROS bag.
        telemetry: telemetry.csv, or a log (.BIN, .ulg, .SRT, a bag) that is interpolated at the frames' times.
            None uses the bag's own telemetry, the .SRT beside a video, or the EXIF of photographs; without EXIF
            times the images come in natural order and without telemetry.
        camera: checked against the size of the first image.
        frame_stamps: capture times of the frames, if the telemetry is a log, see
            :func:`scenematch.files.logs.readers.stamp_frames`.
        log_offset_s: added to them.
        image_topic: topic of a bag's images; None if there is only one.
        columns: column names of telemetry.csv, by our names in :data:`scenematch.files.telemetry.COLUMNS`.
        odometry_topic: topic of another odometry that provides the velocity, if the telemetry is a bag.

    Returns:
        The flight; only the first image has been read.

    Raises:
        OptionError: the offset is not finite, or longer than 64 bits of nanoseconds.
        TelemetryError: a file cannot be read, or a row names a frame that does not exist.
        CalibrationError: the first image has another size than the calibration.
    """
    if not abs(log_offset_s) <= MAX_OFFSET_S:  # NaN fails too
        raise OptionError(f"log_offset_s: expected finite seconds, got {log_offset_s}")
    source = BagFrames(Path(frames), image_topic) if is_bag(frames) else open_frames(frames)
    if telemetry is None:
        telemetry = frames if isinstance(source, BagFrames) else subtitles_beside(frames)
    height_sources: list[str] = []
    remarks: list[str] = []
    of_gimbal = telemetry is None or Path(telemetry).suffix.lower() == ".srt"
    if telemetry is not None and is_log(telemetry):
        log = open_log(telemetry, odometry_topic)
        stamps_ns, names = stamp_frames(source, log, frame_stamps)
        offset_ns = round(log_offset_s * 1e9)
        rows, height_sources = rows_and_sources_at(log, [stamp_ns + offset_ns for stamp_ns in stamps_ns], names)
    elif telemetry is not None:
        _check_is_table(Path(telemetry))
        rows, remarks = open_telemetry(telemetry, source, source.description, columns)
    elif isinstance(source, VideoFile):
        rows = []
    else:
        rows, remarks = photo_telemetry([source.path / name for name in source.names])
        height_sources = ["" if row.height_agl_m is None else "take-off" for row in rows]
    has_gimbal = of_gimbal and any(row.roll_deg is not None for row in rows)
    flight = Flight(source, rows, height_sources, has_gimbal, remarks)
    if camera is not None:
        camera.check_size(source.read(flight.names[0]).shape)
    return flight


def _check_is_table(telemetry: Path) -> None:
    """Refuse metadata inside a video: no maintained, light library reads it on every supported Python."""
    if telemetry.suffix.lower() in (*VIDEO_SUFFIXES, ".klv", ".360"):
        raise TelemetryError(
            f"{telemetry}: expected a table or a flight log, got a video's metadata (MISB KLV, GoPro GPMF), "
            "which is not read; convert it to a .SRT as docs/map-and-flight-files.md shows"
        )


def subtitles_beside(frames: str | Path) -> Path | None:
    """The .SRT beside a video with the same name, as DJI writes it; None if there is none."""
    path = Path(frames)
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        return None
    beside = (path.with_suffix(suffix) for suffix in (".SRT", ".srt"))
    return next((file for file in beside if file.is_file()), None)


def camera_info(camera: Camera) -> str:
    """The text of camera.yaml: ROS camera_info and the mount."""

    def block(name: str, rows: int, values: NDArray[np.float64]) -> str:
        data = ", ".join(repr(float(value)) for value in values.ravel())
        return f"{name}:\n  rows: {rows}\n  cols: {values.size // rows}\n  data: [{data}]\n"

    return (
        f"image_width: {camera.width_px}\nimage_height: {camera.height_px}\ncamera_name: nadir\n"
        + block("camera_matrix", 3, camera.matrix)
        + f"distortion_model: {camera.distortion_model}\n"
        + block("distortion_coefficients", 1, camera.distortion)
        + "# optical (x right, y down, z forward) to body (forward, right, down): v_body = mount * v_camera\n"
        + block("mount", 3, camera.mount)
    )
