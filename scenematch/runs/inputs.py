"""The inputs of a run: open a flight's files and check that they fit together before the run begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from engine.camera import Camera, mount_rotation
from engine.errors import CalibrationError, OptionError, TelemetryError
from engine.orthomap import OrthoMap
from engine.values import Prior, Truth
from scenematch.files.corrections import Corrections
from scenematch.files.flight import MAX_OFFSET_S, Flight, open_flight, subtitles_beside
from scenematch.files.frames import VIDEO_SUFFIXES, PictureFolder, opened_picture
from scenematch.files.logs.readers import is_log, is_photographs, open_truth
from scenematch.files.ros.bags import is_bag
from scenematch.files.telemetry import TelemetryRow
from scenematch.files.track import TrackRow
from scenematch.runs.arguments import check_between, check_every, parse_position
from scenematch.runs.cameras import CameraInput, check_size
from scenematch.runs.map_input import MapInput, check_position
from scenematch.runs.output import SILENT, Progress, StrPath
from scenematch.runs.settings import TrackSettings

FOLDER_LAYOUT = {
    "map": "map.tif",
    "surface": "dsm.tif",
    "camera": "camera.yaml",
    "frames": "frames",
    "telemetry": "telemetry.csv",
    "truth": "truth.csv",
}
"""The usual file names in a flight folder, by field."""
_OPTIONAL = ("surface", "camera", "telemetry", "truth")


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightFiles:
    """The files of one flight.

    Attributes:
        map: the map with its surface.
        camera: the camera; without a calibration, a bag's own is used, or the photographs' EXIF.
        frames: folder of pictures, video or bag.
        telemetry: telemetry.csv or a log; None uses the bag's own, the subtitles beside a video, or the pictures'
            EXIF.
        truth: truth.csv, a log or a folder of photographs; None uses truth.csv beside the telemetry.
        frame_stamps: CSV with timestamp_ns and frame, if the telemetry is a log.
        log_offset_s: added to the frames' timestamps, if the telemetry is a log.
        image_topic: topic of the pictures, if the frames are a bag with several.
        odometry_topic: topic of another odometry that provides the velocity, if the telemetry is a bag.
        every: use every Nth frame, starting with the first.
        corrections: for telemetry that is wrong in a known way.

    Raises:
        OptionError: a file does not fit another.
    """

    map: MapInput
    camera: CameraInput = field(default_factory=CameraInput)
    frames: Path
    telemetry: Path | None = None
    truth: Path | None = None
    frame_stamps: Path | None = None
    log_offset_s: float = 0.0
    image_topic: str | None = None
    odometry_topic: str | None = None
    every: int = 1
    corrections: Corrections = field(default_factory=Corrections)

    def __post_init__(self) -> None:
        for name in ("frames", "telemetry", "truth", "frame_stamps"):
            path = getattr(self, name)
            object.__setattr__(self, name, None if path is None else Path(path))
        check_between("log_offset_s", self.log_offset_s, -MAX_OFFSET_S, MAX_OFFSET_S)
        check_every(self.every)
        frames, camera, telemetry = self.frames, self.camera, self.telemetry or subtitles_beside(self.frames)
        if camera.camera is None and is_bag(frames):
            camera = replace(camera, camera=frames)
        object.__setattr__(self, "telemetry", telemetry)
        object.__setattr__(self, "camera", camera)
        if camera.camera is None and camera.hfov_deg is None and frames.suffix.lower() in VIDEO_SUFFIXES:
            raise OptionError("camera: expected a calibration, or `hfov_deg`: a video contains neither")
        if (self.frame_stamps is not None or self.log_offset_s) and (telemetry is None or not is_log(telemetry)):
            raise OptionError(f"frame_stamps, log_offset_s: expected a log as telemetry, got {telemetry}")
        if self.image_topic is not None and not is_bag(frames):
            raise OptionError(f"image_topic: expected a bag as frames, got {frames}")
        if self.odometry_topic is not None and not is_bag(telemetry or frames):
            raise OptionError(f"odometry_topic: expected a bag as telemetry, got {telemetry or frames}")

    @classmethod
    def from_flat(cls, **values: Any) -> FlightFiles:
        """The files by their names in :meth:`flat`, including those of map and camera."""

        def taken(kind: type[MapInput | CameraInput]) -> dict[str, Any]:
            return {each.name: values.pop(each.name) for each in fields(kind) if each.name in values}

        return cls(map=MapInput(**taken(MapInput)), camera=CameraInput(**taken(CameraInput)), **values)

    def flat(self) -> dict[str, Any]:
        """All fields by name, with the fields of map and camera in their place."""
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        return asdict(own.pop("map")) | asdict(own.pop("camera")) | own

    @classmethod
    def in_folder(cls, folder: StrPath) -> FlightFiles:
        """The files of a flight folder by their usual names.

        Surface, camera, telemetry and truth are used if they exist.
        """
        paths: dict[str, Any] = {name: Path(folder) / file for name, file in FOLDER_LAYOUT.items()}
        there = {name: path for name, path in paths.items() if name not in _OPTIONAL or path.exists()}
        return cls.from_flat(**there)

    def load_camera(self, flight: Flight, progress: Progress = SILENT) -> Camera:
        """The calibration from a file, a bag or the photographs of the flight."""
        camera = self.camera.load(flight.source, flight.names, image_topic=self.image_topic, progress=progress)
        _check_gimbal(flight, camera)
        return camera

    def open_flight(self, columns: Mapping[str, str] = {}) -> Flight:
        """The frames with their corrected telemetry.

        Args:
            columns: telemetry.csv's own names of standard columns: ``{"height_agl_m": "alt"}``.

        Raises:
            OptionError: columns are named, but the telemetry is not a table.
        """
        if columns and (self.telemetry is None or is_log(self.telemetry)):
            raise OptionError(f"telemetry_columns: expected a table as telemetry, got {self.telemetry}")
        flight = open_flight(
            self.frames, self.telemetry, frame_stamps=self.frame_stamps, log_offset_s=self.log_offset_s,
            image_topic=self.image_topic, columns=columns, odometry_topic=self.odometry_topic,
        )  # fmt: skip
        if not self.corrections.changes_nothing:  # before frames are dropped, because it interpolates between rows
            flight = replace(flight, rows=self.corrections.applied(flight.rows))
        return flight.every(self.every)

    def find_truth(self) -> Path | None:
        """The given truth, else ``truth.csv`` beside the telemetry if it exists."""
        if self.truth is not None or self.telemetry is None:
            return self.truth
        beside = self.telemetry.with_name(FOLDER_LAYOUT["truth"])
        return beside if beside.is_file() else None


@dataclass(frozen=True)
class FlightInputs:
    """A flight whose parts have been read and fit together."""

    site: OrthoMap
    camera: Camera
    flight: Flight
    truth_path: Path | None
    truth: list[Truth] | None


def open_inputs(files: FlightFiles, runs: Sequence[TrackSettings], *, progress: Progress = SILENT) -> FlightInputs:
    """Read the inputs that runs of one flight share, and check them against each run's settings.

    Raises:
        OptionError, TelemetryError, CalibrationError, MapError: something cannot be read, does not fit together,
            or cannot be used by one of the runs.
    """
    site = files.map.open(progress)
    flight = files.open_flight(_columns(runs))
    camera = files.load_camera(flight, progress)
    truth_path = files.find_truth()
    truth = open_run_truth(truth_path, flight.rows, progress)
    for settings in runs:
        _check_needs(flight, settings.method, settings.profile, progress)
        if settings.method == "learned":
            from engine.learned import load_matcher

            load_matcher(settings.learned.weights, device="cpu")
        start = parse_position("start", settings.start)
        check_position("start", start, site, OptionError)
        if start is None:
            first = next((row.prior for row in flight.rows if row.prior is not None), None)
            check_position(str(files.telemetry or files.frames), first, site, TelemetryError)
            check_start(first, site)
    check_pictures(flight, camera, progress)
    if files.every > 1:
        progress.message(f"using one frame in {files.every}, {len(flight)} in all")
    if flight.unused:
        progress.message(f"frames left out because the telemetry has no row: {flight.unused}")
    for remark in flight.remarks:
        progress.message(remark)
    if flight.heights:
        counts = ", ".join(f"{source} {count}" for source, count in flight.heights.items())
        progress.message(f"height above ground of {len(flight)} frames, by source: {counts}")
    return FlightInputs(site, camera, flight, truth_path, truth)


def open_run_truth(
    path: StrPath | None, rows: Sequence[TelemetryRow] | Sequence[TrackRow], progress: Progress = SILENT
) -> list[Truth] | None:
    """Read the truth of a run, if there is one, and report if it is only a receiver's.

    Args:
        path: see :func:`scenematch.files.logs.readers.open_truth`.
        rows: of the run, with its timestamps.
        progress: receives the message.
    """
    if path is None:
        return None
    truth = open_truth(Path(path), rows[0].timestamp_ns if rows else None)
    if is_photographs(path):
        progress.message(
            f"truth: {len(truth)} positions from the photographs' EXIF, by a receiver: errors include its own, "
            "of metres"
        )
    return truth


def _columns(runs: Sequence[TrackSettings]) -> Mapping[str, str]:
    """The telemetry's column names, which all runs of a flight must share."""
    for settings in runs:
        if settings.telemetry_columns != runs[0].telemetry_columns:
            raise OptionError("telemetry_columns: expected the same of all runs of a flight, got others")
    return runs[0].telemetry_columns if runs else {}


def check_pictures(flight: Flight, camera: Camera, progress: Progress = SILENT) -> None:
    """Check that every picture decodes and has the camera's size; of a video only the first frame is checked.

    Raises:
        TelemetryError: a picture is empty, truncated or not a picture.
        CalibrationError: a picture has another size.
    """
    source = flight.source
    if not isinstance(source, PictureFolder):
        check_size(camera, source.read(flight.names[0]).shape)
        return
    for name in progress.track(flight.names, len(flight), "checking pictures"):
        path = source.path / name
        size = _decoded_size(path)
        try:
            check_size(camera, (size[1], size[0]))
        except CalibrationError as error:
            raise CalibrationError(f"{path}: {error}") from None


def _decoded_size(path: Path) -> tuple[int, int]:
    """Width and height; a JPEG is decoded at 1/8 scale, of a PNG the checksums are read, others are decoded."""
    with opened_picture(path, str(path)) as picture:
        size = picture.size
        if picture.format == "PNG":
            picture.verify()
        else:
            picture.draft("L", (1, 1))
            picture.load()
        return size


def _check_gimbal(flight: Flight, camera: Camera) -> None:
    """Refuse a mount in addition to a gimbal's angles, which already state where the camera looks.

    Raises:
        CalibrationError: the camera would be turned twice.
    """
    if flight.has_gimbal and not np.allclose(camera.mount, mount_rotation(), atol=1e-3):
        raise CalibrationError(
            "mount: expected nadir, since the telemetry's gimbal angles already state where the camera looks"
        )


def _check_needs(flight: Flight, method: str, profile: str, progress: Progress) -> None:
    """Report how many frames the method will certainly refuse for lack of telemetry, and which method would not.

    Raises:
        TelemetryError: every frame would be refused.
    """
    needs = ["height_agl_m"] if profile == "paper" or method == "ncc" else []
    needs += ["heading_deg"] if method == "ncc" else []
    other = "" if profile == "paper" else "; sift and auto do not need it"
    if needs and not any(all(getattr(row, name) is not None for name in needs) for row in flight.rows):
        asked, doubts = " and ".join(needs), "".join(f"; {remark}" for remark in flight.remarks)
        raise TelemetryError(f"telemetry: {method} needs {asked}, got no frame with a value there{other}{doubts}")
    for name in needs:
        lacking = sum(getattr(row, name) is None for row in flight.rows)
        if lacking:
            progress.message(f"{lacking} of {len(flight)} frames lack {name}, so {method} will refuse them{other}")


def check_start(start: Prior | None, site: OrthoMap) -> None:
    """Refuse a flight without a start if the map is too large to search.

    Raises:
        OptionError: no position is known.
    """
    if start is None and not site.is_searchable:
        raise OptionError(
            f"start: expected LAT,LON or LAT,LON,SIGMA_M: the map of {site.size_km} is too large to search, "
            "and the telemetry has no position"
        )
