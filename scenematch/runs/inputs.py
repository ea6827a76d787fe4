"""The inputs of a run: the files of a flight, opened and checked against each other before the run begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from engine.camera import Camera
from engine.errors import MapError, OptionError, TelemetryError
from engine.orthomap import OrthoMap
from engine.values import MAX_SIGMA_M, Truth
from scenematch.files.corrections import Corrections
from scenematch.files.flight import Flight, open_flight, subtitles_beside
from scenematch.files.frames import VIDEO_SUFFIXES
from scenematch.files.logs.readers import LogClock, is_log, is_photographs, open_truth
from scenematch.files.ros.bags import is_bag
from scenematch.runs.arguments import check_every, is_in_degrees, parse_bounds, parse_position
from scenematch.runs.cameras import CameraFiles
from scenematch.runs.checks import (
    check_gimbal,
    check_needs,
    check_pictures,
    check_position,
    check_start,
    say_what_lacks,
)
from scenematch.runs.folders import StrPath
from scenematch.runs.progress import SILENT, Progress
from scenematch.runs.renaming import renamed_in_errors
from scenematch.runs.settings import TrackSettings

FOLDER_LAYOUT = {
    "map": "map.tif",
    "surface": "dsm.tif",
    "camera": "camera.yaml",
    "frames": "frames",
    "telemetry": "telemetry.csv",
    "truth": "truth.csv",
}
"""The files of a flight folder by what they are."""
_OPTIONAL = ("surface", "camera", "telemetry", "truth")


@dataclass(frozen=True, slots=True, kw_only=True, init=False)
class FlightFiles:
    """The files of one flight.

    Attributes:
        map: GeoTIFF, a picture with a world file, or a folder of tiles.
        surface: surface model, a GeoTIFF of heights.
        camera: calibration, or the bag that has it; None takes ``hfov_deg`` or the photographs' EXIF.
        frames: folder of pictures, video or bag.
        telemetry: telemetry.csv or a log; None takes the bag's own, the subtitles beside a video, or the
            pictures' EXIF.
        truth: truth.csv, a log or a folder of photographs; None takes the truth.csv beside the telemetry.
        frame_stamps: with a log, a CSV with timestamp_ns and frame.
        log_offset_s: with a log, added to the frames' stamps.
        image_topic: of the pictures, where the frames are a bag with several.
        odometry_topic: another odometry that the velocity is taken from, where the telemetry is a bag.
        every: one frame in so many is used, from the first on.
        map_sigma_m: georeferencing accuracy of the map per axis; None is what the map states.
        map_bounds: "W,S,E,N" of the outer edges of a picture, in degrees or in ``map_crs``; None is the
            file's own.
        map_crs: coordinate reference system of a map that names none, such as "EPSG:32636".
        hfov_deg: horizontal field of view, in place of a calibration.
        mount: how the camera is mounted, a key of :data:`engine.camera.MOUNTS`; None is the calibration's.
        camera_pitch_deg: of the camera against the vehicle's horizontal, -90 looks straight down.
        scale_calibration: whether the calibration is scaled to pictures of another size and the same shape.
        corrections: of telemetry that is wrong in a known way.

    Raises:
        OptionError: a file does not go with another.
    """

    map: Path
    surface: Path | None
    camera: Path | None
    frames: Path
    telemetry: Path | None
    truth: Path | None
    frame_stamps: Path | None
    log_offset_s: float
    image_topic: str | None
    odometry_topic: str | None
    every: int
    map_sigma_m: float | None
    map_bounds: str | None
    map_crs: str | None
    hfov_deg: float | None
    mount: str | None
    camera_pitch_deg: float | None
    scale_calibration: bool
    corrections: Corrections

    def __init__(
        self,
        *,
        map: StrPath,  # noqa: A002 - what the file is, as everywhere
        frames: StrPath,
        camera: StrPath | None = None,
        surface: StrPath | None = None,
        telemetry: StrPath | None = None,
        truth: StrPath | None = None,
        frame_stamps: StrPath | None = None,
        log_offset_s: float = 0.0,
        image_topic: str | None = None,
        odometry_topic: str | None = None,
        every: int = 1,
        map_sigma_m: float | None = None,
        map_bounds: str | None = None,
        map_crs: str | None = None,
        hfov_deg: float | None = None,
        mount: str | None = None,
        camera_pitch_deg: float | None = None,
        scale_calibration: bool = False,
        corrections: Corrections | None = None,
    ) -> None:
        with renamed_in_errors(offset_s="log_offset_s"):
            LogClock(offset_s=log_offset_s)
        parse_bounds("map_bounds", map_bounds)
        if telemetry is None:
            telemetry = subtitles_beside(frames)
        if camera is None and is_bag(frames):
            camera = frames
        if camera is None and hfov_deg is None and Path(frames).suffix.lower() in VIDEO_SUFFIXES:
            raise OptionError("camera: expected a calibration, or `hfov_deg`: a video has neither within itself")
        if (frame_stamps is not None or log_offset_s) and (telemetry is None or not is_log(telemetry)):
            raise OptionError(f"frame_stamps, log_offset_s: expected a log as telemetry, got {telemetry}")
        if image_topic is not None and not is_bag(frames):
            raise OptionError(f"image_topic: expected a bag as frames, got {frames}")
        if odometry_topic is not None and not is_bag(telemetry or frames):
            raise OptionError(f"odometry_topic: expected a bag as telemetry, got {telemetry or frames}")
        check_every(every)
        paths = {
            "map": map, "frames": frames, "camera": camera, "surface": surface,
            "telemetry": telemetry, "truth": truth, "frame_stamps": frame_stamps,
        }  # fmt: skip
        for name, path in paths.items():
            object.__setattr__(self, name, None if path is None else Path(path))
        values = {
            "log_offset_s": log_offset_s, "image_topic": image_topic, "odometry_topic": odometry_topic,
            "every": every,
            "map_sigma_m": map_sigma_m, "map_bounds": map_bounds, "map_crs": map_crs, "hfov_deg": hfov_deg,
            "mount": mount, "camera_pitch_deg": camera_pitch_deg, "scale_calibration": scale_calibration,
            "corrections": corrections or Corrections(),
        }  # fmt: skip
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self.camera_files()

    @classmethod
    def in_folder(cls, folder: StrPath) -> FlightFiles:
        """The files of a flight folder by their usual names.

        Surface, camera, telemetry and truth are those that are there.
        """
        paths: dict[str, Any] = {name: Path(folder) / file for name, file in FOLDER_LAYOUT.items()}
        return cls(**{name: path for name, path in paths.items() if name not in _OPTIONAL or path.exists()})

    @property
    def has_clock(self) -> bool:
        """Whether it is given when the frames were taken."""
        return self.frame_stamps is not None or self.log_offset_s != 0.0

    def clock(self) -> LogClock:
        """When the frames were taken, where the telemetry is a log."""
        return LogClock(self.frame_stamps, self.log_offset_s)

    def camera_files(self) -> CameraFiles:
        """What is said of the camera."""
        return CameraFiles(
            calibration=self.camera,
            image_topic=self.image_topic,
            hfov_deg=self.hfov_deg,
            mount=self.mount,
            camera_pitch_deg=self.camera_pitch_deg,
            scale_calibration=self.scale_calibration,
        )

    def load_camera(self, flight: Flight, progress: Progress = SILENT) -> Camera:
        """The calibration, of a file, a bag or the photographs of the flight."""
        camera = self.camera_files().load(flight.source, flight.names, progress=progress)
        check_gimbal(flight, camera)
        return camera

    def open_map(self, progress: Progress = SILENT) -> OrthoMap:
        """The map with its surface; see :func:`open_map`."""
        return open_map(
            self.map, self.surface, self.map_sigma_m, bounds=self.map_bounds, crs=self.map_crs, progress=progress
        )

    def open_flight(self, columns: Mapping[str, str] = {}) -> Flight:
        """The frames with what is known of each, corrected.

        Args:
            columns: what the telemetry.csv calls a column, by our name for it.

        Raises:
            OptionError: columns are named, and the telemetry is no table.
        """
        if columns and (self.telemetry is None or is_log(self.telemetry)):
            raise OptionError(f"telemetry_columns: expected a table as telemetry, got {self.telemetry}")
        flight = open_flight(
            self.frames, self.telemetry, clock=self.clock(), image_topic=self.image_topic, columns=columns,
            odometry_topic=self.odometry_topic,
        )  # fmt: skip
        if not self.corrections.changes_nothing:  # before frames are left out: they interpolate between rows
            flight = replace(flight, rows=self.corrections.applied(flight.rows))
        return flight.every(self.every)

    def find_truth(self) -> Path | None:
        """The truth that was named, else ``truth.csv`` beside the telemetry where there is one."""
        if self.truth is not None or self.telemetry is None:
            return self.truth
        beside = self.telemetry.with_name(FOLDER_LAYOUT["truth"])
        return beside if beside.is_file() else None


@dataclass(frozen=True)
class FlightInputs:
    """A flight whose every part was read and found to fit the others."""

    site: OrthoMap
    camera: Camera
    flight: Flight
    truth_path: Path | None
    truth: list[Truth] | None


def open_inputs(files: FlightFiles, runs: Sequence[TrackSettings], *, progress: Progress = SILENT) -> FlightInputs:
    """Read what runs of one flight need, and check it against the settings of every run.

    Raises:
        OptionError, TelemetryError, CalibrationError, MapError: something cannot be read, or does not belong
            together, or is of no use to one of the runs.
    """
    site = files.open_map(progress)
    flight = files.open_flight(_columns(runs))
    camera = files.load_camera(flight, progress)
    truth_path = files.find_truth()
    stamp_ns = flight.rows[0].timestamp_ns if flight.rows else None
    truth = None if truth_path is None else open_run_truth(truth_path, stamp_ns, progress)
    for settings in runs:
        check_needs(flight, settings.method, settings.profile)
        say_what_lacks(flight, settings.method, settings.profile, progress)
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
        progress.message(f"one frame in {files.every} is used, {len(flight)} of all")
    if flight.unused:
        progress.message(f"frames without a row in the telemetry, left out: {flight.unused}")
    for remark in flight.remarks:
        progress.message(remark)
    if flight.heights:
        counts = ", ".join(f"{source} {count}" for source, count in flight.heights.items())
        progress.message(f"height above ground, by source, of {len(flight)} frames: {counts}")
    return FlightInputs(site, camera, flight, truth_path, truth)


def open_run_truth(path: Path, stamp_ns: int | None, progress: Progress = SILENT) -> list[Truth]:
    """Read a truth (:func:`scenematch.files.logs.readers.open_truth`), and say where it is a receiver's only."""
    truth = open_truth(path, stamp_ns)
    if is_photographs(path):
        progress.message(
            f"truth: {len(truth)} positions in the photographs' EXIF, by their receiver: the errors hold its own, "
            "of metres"
        )
    return truth


def _columns(runs: Sequence[TrackSettings]) -> Mapping[str, str]:
    """What the telemetry calls its columns, as all runs of a flight say."""
    for settings in runs:
        if settings.telemetry_columns != runs[0].telemetry_columns:
            raise OptionError("telemetry_columns: expected the same of all runs of a flight, got others")
    return runs[0].telemetry_columns if runs else {}


def open_map(
    path: StrPath,
    surface: StrPath | None = None,
    map_sigma_m: float | None = None,
    *,
    bounds: str | None = None,
    crs: str | None = None,
    progress: Progress = SILENT,
) -> OrthoMap:
    """The map; where it is copied into the cache, that is a task of the progress.

    Args:
        path: see :meth:`engine.OrthoMap.open`.
        surface: heights.
        map_sigma_m: georeferencing accuracy; None is what the map states.
        bounds: "W,S,E,N" of the outer edges of a picture without georeference, in degrees or in the CRS; numbers
            that may be degrees are degrees.
        crs: of a file that names none.
        progress: is shown the copying.

    Raises:
        OptionError: the accuracy is not above 0 or wider than any map, or bounds or CRS do not suit the file.
        MapError: a file cannot be read, or is nowhere on the Earth.
    """
    if map_sigma_m is not None and not 0.0 < map_sigma_m <= MAX_SIGMA_M:
        raise OptionError(
            f"map_sigma_m: expected a number above 0 and at most {MAX_SIGMA_M:g}, got {map_sigma_m:g}"
        )
    corners = parse_bounds("map_bounds", bounds)
    in_degrees = crs is None or corners is None or is_in_degrees(corners)
    try:
        with (
            progress.task("copying the map into the cache") as update,
            renamed_in_errors(bounds_deg="map_bounds", bounds_crs="map_bounds", crs="map_crs"),
        ):
            return OrthoMap.open(
                path,
                surface,
                bounds_deg=corners if in_degrees else None,
                bounds_crs=None if in_degrees else corners,
                crs=crs,
                georeference_sigma_m=map_sigma_m,
                on_copy=update,
            )
    except MapError as error:
        if str(error).startswith(("map_bounds:", "map_crs:")):
            raise OptionError(str(error)) from None
        raise
