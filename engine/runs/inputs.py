"""The inputs of a run: the files of a flight, opened and checked against each other before the run begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.camera import Camera
from engine.errors import OptionError, TelemetryError
from engine.formats.flight import Flight, open_flight
from engine.formats.logs.readers import LogClock, is_log, open_truth
from engine.formats.ros.bags import is_bag, read_bag_camera
from engine.learned import load_matcher
from engine.orthomap import OrthoMap
from engine.runs.arguments import parse_position, renamed_in_errors
from engine.runs.checks import check_needs, check_pictures, check_position, check_start
from engine.runs.folders import StrPath
from engine.runs.progress import SILENT, Progress
from engine.runs.settings import TrackSettings
from engine.values import MAX_SIGMA_M, Truth

FOLDER_LAYOUT = {
    "map": "map.tif",
    "surface": "dsm.tif",
    "camera": "camera.yaml",
    "frames": "frames",
    "telemetry": "telemetry.csv",
    "truth": "truth.csv",
}
"""The files of a flight folder by what they are."""
_OPTIONAL = ("surface", "telemetry", "truth")


@dataclass(frozen=True, slots=True, kw_only=True, init=False)
class FlightFiles:
    """The files of one flight.

    Attributes:
        map: GeoTIFF, a picture with a world file, or a folder of tiles.
        surface: surface model, a GeoTIFF of heights.
        camera: calibration, or the bag that has it.
        frames: folder of pictures, video or bag.
        telemetry: telemetry.csv or a log; None takes the bag's own or the pictures' EXIF.
        truth: truth.csv or a log; None takes the one beside the telemetry.
        frame_stamps: with a log, a CSV with timestamp_ns and frame.
        log_offset_s: with a log, added to the frames' stamps.
        image_topic: of the pictures, where the frames are a bag with several.
        map_sigma_m: georeferencing accuracy of the map per axis; None is what the map states.

    Raises:
        OptionError: a file does not go with another.
    """

    map: Path
    surface: Path | None
    camera: Path
    frames: Path
    telemetry: Path | None
    truth: Path | None
    frame_stamps: Path | None
    log_offset_s: float
    image_topic: str | None
    map_sigma_m: float | None

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
        map_sigma_m: float | None = None,
    ) -> None:
        with renamed_in_errors(offset_s="log_offset_s"):
            LogClock(offset_s=log_offset_s)
        if camera is None and not is_bag(frames):
            raise OptionError("camera: expected a calibration, which only a bag may have within itself")
        if (frame_stamps is not None or log_offset_s) and (telemetry is None or not is_log(telemetry)):
            raise OptionError(f"frame_stamps, log_offset_s: expected a log as telemetry, got {telemetry}")
        if image_topic is not None and not is_bag(frames):
            raise OptionError(f"image_topic: expected a bag as frames, got {frames}")
        paths = {
            "map": map, "frames": frames, "camera": frames if camera is None else camera, "surface": surface,
            "telemetry": telemetry, "truth": truth, "frame_stamps": frame_stamps,
        }  # fmt: skip
        for name, path in paths.items():
            object.__setattr__(self, name, None if path is None else Path(path))
        object.__setattr__(self, "log_offset_s", log_offset_s)
        object.__setattr__(self, "image_topic", image_topic)
        object.__setattr__(self, "map_sigma_m", map_sigma_m)

    @classmethod
    def in_folder(cls, folder: StrPath) -> FlightFiles:
        """The files of a flight folder by their usual names.

        Surface, telemetry and truth are those that are there.
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

    def load_camera(self) -> Camera:
        """The calibration, of a file or of a bag."""
        return read_bag_camera(self.camera, self.image_topic) if is_bag(self.camera) else Camera.load(self.camera)

    def open_flight(self) -> Flight:
        """The frames with what is known of each."""
        return open_flight(self.frames, self.telemetry, clock=self.clock(), image_topic=self.image_topic)

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
    site = open_map(files.map, files.surface, files.map_sigma_m, progress=progress)
    camera = files.load_camera()
    flight = files.open_flight()
    truth_path = files.find_truth()
    stamp_ns = flight.rows[0].timestamp_ns if flight.rows else None
    truth = open_truth(truth_path, stamp_ns) if truth_path is not None else None
    for settings in runs:
        check_needs(flight, settings.method, settings.profile)
        if settings.method == "learned":
            load_matcher(settings.learned.weights, device="cpu")
        start = parse_position("start", settings.start)
        check_position("start", start, site, OptionError)
        if start is None:
            first = next((row.prior for row in flight.rows if row.prior is not None), None)
            check_position(str(files.telemetry or files.frames), first, site, TelemetryError)
            check_start(first, site)
    check_pictures(flight, camera, progress)
    if flight.unused:
        progress.message(f"frames without a row in the telemetry, left out: {flight.unused}")
    if flight.heights:
        counts = ", ".join(f"{source} {count}" for source, count in flight.heights.items())
        progress.message(f"height above ground, by source, of {len(flight)} frames: {counts}")
    return FlightInputs(site, camera, flight, truth_path, truth)


def open_map(
    path: StrPath, surface: StrPath | None = None, map_sigma_m: float | None = None, *, progress: Progress = SILENT
) -> OrthoMap:
    """The map; where it is copied into the cache, that is a task of the progress.

    Args:
        path: see :meth:`engine.OrthoMap.open`.
        surface: heights.
        map_sigma_m: georeferencing accuracy; None is what the map states.
        progress: is shown the copying.

    Raises:
        OptionError: the accuracy is not above 0, or wider than any map.
    """
    if map_sigma_m is not None and not 0.0 < map_sigma_m <= MAX_SIGMA_M:
        raise OptionError(
            f"map_sigma_m: expected a number above 0 and at most {MAX_SIGMA_M:g}, got {map_sigma_m:g}"
        )
    with progress.task("copying the map into the cache") as update:
        return OrthoMap.open(path, surface=surface, georeference_sigma_m=map_sigma_m, on_copy=update)
