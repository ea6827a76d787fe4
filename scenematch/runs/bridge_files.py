"""Inputs of the MAVLink bridge: map, camera, and live or recorded pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from pathlib import Path

from engine.camera import Camera
from engine.errors import OptionError
from engine.runtime.realtime import Realtime
from scenematch.bridges.pictures import CapturedImage, capture, replay
from scenematch.files.flight import open_flight
from scenematch.files.frames import VIDEO_SUFFIXES
from scenematch.runs.arguments import check_between, check_every, check_unused
from scenematch.runs.cameras import CameraInput
from scenematch.runs.map_input import MapInput
from scenematch.runs.output import SILENT, Progress, StrPath

_MAX_GRAB_MS = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgeFiles:
    """The map, the camera, and the source of pictures: either files or a camera.

    Attributes:
        map: the map with its surface.
        camera: the camera; taken from the recorded pictures if not given.
        frames: recorded pictures, a folder or a video, replayed in real time.
        telemetry: telemetry.csv or a log that times the replay; None uses a video's .SRT or own times, or EXIF.
        camera_source: number of a camera, URL of a stream, or ``exec:COMMAND`` that writes JPEG pictures.
        rate_hz: rate of pictures without timestamps; None is 10.
        every: replay every Nth picture, at its own time.
        exposure_to_grab_ms: camera latency, from exposure to arrival here; None is 0.
        gimbal: whether the camera is on a gimbal whose attitude the autopilot reports.

    Raises:
        OptionError: a number is out of its range, or an argument does not go with another.
    """

    map: MapInput
    camera: CameraInput = field(default_factory=CameraInput)
    frames: StrPath | None = None
    telemetry: StrPath | None = None
    camera_source: str | None = None
    rate_hz: float | None = None
    every: int = 1
    exposure_to_grab_ms: float | None = None
    gimbal: bool = False

    def __post_init__(self) -> None:
        if (self.frames is None) == (self.camera_source is None):
            raise OptionError("frames: expected either `frames` or `camera_source`")
        if self.frames is None:
            every = None if self.every == 1 else self.every
            check_unused({"telemetry": self.telemetry, "rate_hz": self.rate_hz, "every": every}, "frames")
            self._check_live_camera()
        else:
            check_unused({"exposure_to_grab_ms": self.exposure_to_grab_ms}, "camera_source")
        check_every(self.every)
        if self.rate_hz is not None and not 1e-3 <= self.rate_hz < math.inf:
            raise OptionError(f"rate_hz: expected a number of 0.001 or more, got {self.rate_hz:g}")
        check_between("exposure_to_grab_ms", self.exposure_to_grab_ms, 0.0, _MAX_GRAB_MS)

    def _check_live_camera(self) -> None:
        if self.camera.camera is None and self.camera.hfov_deg is None:
            raise OptionError(
                "camera: expected a calibration of the camera that `camera_source` opens, or `hfov_deg`"
            )
        source = Path(self.camera_source or "")
        if source.suffix.lower() in VIDEO_SUFFIXES and source.is_file():  # it would be read as fast as possible
            raise OptionError(f"camera_source: expected a camera, got the video {source}; `frames` plays it")

    def load_camera(self, progress: Progress = SILENT) -> Camera:
        """The calibration, or what the pictures give; a camera is opened once to get one."""
        if self.camera_source is not None:
            return self.camera.load_live(self.camera_source, progress=progress)
        if self.camera.camera is not None or self.frames is None:
            return self.camera.load(None)
        flight = open_flight(self.frames, self.telemetry)
        return self.camera.load(flight.source, flight.names, progress=progress)

    def pictures(
        self, wait: Callable[[], None] | None = None, realtime: Realtime | None = None
    ) -> Generator[CapturedImage | None, None, None]:
        """Pictures as they are captured; None if the camera delivers none for a while.

        A replay begins when ``wait`` returns; ``realtime`` schedules the thread that reads a camera.
        """
        if self.frames is not None:
            telemetry = None if self.telemetry is None else Path(self.telemetry)
            rate_hz = self.rate_hz or 10.0
            return replay(Path(self.frames), telemetry, rate_hz=rate_hz, every=self.every, wait=wait)
        assert self.camera_source is not None  # one of the two is given
        grab_ms = self.exposure_to_grab_ms or 0.0
        return capture(self.camera_source, exposure_to_grab_ms=grab_ms, realtime=realtime)
