"""Records: inputs and settings of a finished run, stored in its summary.json."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from engine.errors import OptionError, TelemetryError
from engine.geo import LocalFrame
from scenematch.files.corrections import Corrections
from scenematch.files.settings import options_from_mapping
from scenematch.report.metrics import Ground

PATHS = ("map", "surface", "camera", "frames", "telemetry", "truth", "frame_stamps")
"""The files of a record."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """The inputs and settings of a run; paths are absolute, None means not given.

    Attributes:
        map: file or folder.
        surface: heights.
        camera: calibration, or a bag that has it; None if it came from EXIF or ``hfov_deg``.
        frames: folder, video or bag.
        telemetry: telemetry.csv or a log.
        truth: truth.csv or a log.
        frame_stamps: file of capture times, if the telemetry is a log.
        log_offset_s: added to the frames' own timestamps, in the same case.
        image_topic: topic of the pictures, if the frames are a bag.
        odometry_topic: topic of the odometry that provided the velocity, if the telemetry is a bag.
        every: every Nth frame was used; None is all.
        map_sigma_m: georeferencing accuracy of the map, if given; so are the next five.
        map_bounds: bounds of a picture, as typed.
        map_crs: CRS of a map that names none.
        hfov_deg: horizontal field of view.
        mount: of the camera, by name.
        camera_pitch_deg: of the camera.
        scale_calibration: whether the calibration was scaled to the pictures.
        corrections: of the telemetry.
        heights: frames by the source of their height, if the telemetry is a log or the photographs' own.
        method: "ncc", "sift", "auto" or "learned".
        profile: "engine" or "paper".
        device: that computed.
        start: where the flight began, as typed.
        budget_ms: of a frame.
        changed: settings that are not the defaults, by name.
        origin: of the plane of the track.
        ground_m: height of the ground on the map.
        ground_amsl_m: the same above the sea, by the telemetry.
        surface_datum: vertical system of the heights, if the file states heights above the sea.
        diagnosis: errors found in the inputs if few frames were fixed, sentences by cause.
        more: other contents of the file, by name.
    """

    map: str
    surface: str | None = None
    camera: str | None = None
    frames: str | None = None
    telemetry: str | None = None
    truth: str | None = None
    frame_stamps: str | None = None
    log_offset_s: float | None = None
    image_topic: str | None = None
    odometry_topic: str | None = None
    every: int | None = None
    map_sigma_m: float | None = None
    map_bounds: str | None = None
    map_crs: str | None = None
    hfov_deg: float | None = None
    mount: str | None = None
    camera_pitch_deg: float | None = None
    scale_calibration: bool = False
    corrections: Corrections = field(default_factory=Corrections)
    heights: dict[str, int] = field(default_factory=dict)
    method: str
    profile: str
    device: str | None = None
    start: str | None = None
    budget_ms: float | None = None
    changed: dict[str, Any] = field(default_factory=dict)
    origin: LocalFrame
    ground_m: float
    ground_amsl_m: float | None = None
    surface_datum: str | None = None
    diagnosis: dict[str, str] = field(default_factory=dict)
    more: dict[str, Any] = field(default_factory=dict)

    @property
    def ground(self) -> Ground:
        """Level of the ground on the map."""
        return Ground(self.ground_m, self.ground_amsl_m)

    def facts(self) -> dict[str, Any]:
        """The record as JSON values."""
        values = asdict(self)
        more: dict[str, Any] = values.pop("more")
        values["corrections"] = None if self.corrections.changes_nothing else values["corrections"]
        values["diagnosis"] = self.diagnosis or None
        return values | more


def read_record(path: Path) -> RunRecord:
    """The settings in a summary.json.

    Raises:
        TelemetryError: the file is missing, or is not one that track wrote.
    """
    wrong = f"{path}: expected the summary that track writes"
    try:
        values = json.loads(path.read_text(encoding="utf-8"))["settings"]
        known = {each.name for each in fields(RunRecord)} - {"more"}
        given = {name: value for name, value in values.items() if name in known and value is not None}
        more = {name: value for name, value in values.items() if name not in known}
        return options_from_mapping(RunRecord, given | {"more": more})
    except FileNotFoundError:
        raise TelemetryError(f"{path}: expected the summary of a finished track, got no such file") from None
    except OptionError as error:
        raise TelemetryError(f"{wrong}; settings, {error}") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise TelemetryError(f"{wrong}, got something else") from None
