"""Records: inputs and settings of a finished run, stored in its summary.json."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from engine.errors import EngineError, TelemetryError
from scenematch.files.corrections import Corrections
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
        corrections: of the telemetry, by name; None without any.
        heights: frames by the source of their height, if the telemetry is a log or the photographs' own.
        method: "ncc", "sift", "auto" or "learned".
        profile: "engine" or "paper".
        device: that computed.
        start: where the flight began, as typed.
        budget_ms: of a frame.
        changed: settings that are not the defaults, by name.
        origin: ``lat_deg`` and ``lon_deg`` of the plane of the track.
        ground_m: height of the ground on the map.
        ground_amsl_m: the same above the sea, by the telemetry.
        surface_datum: vertical system of the heights, if the file states heights above the sea.
        diagnosis: errors found in the inputs if few frames were fixed, sentences by cause.
        more: other contents of the file, by name.

    Raises:
        TelemetryError: a value has the wrong type.
    """

    map: str
    surface: str | None
    camera: str | None = None
    frames: str | None = None
    telemetry: str | None = None
    truth: str | None
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
    corrections: Mapping[str, Any] | None = None
    heights: Mapping[str, int] = field(default_factory=dict)
    method: str
    profile: str
    device: str | None = None
    start: str | None = None
    budget_ms: float | None = None
    changed: Mapping[str, Any] = field(default_factory=dict)
    origin: Mapping[str, float]
    ground_m: float
    ground_amsl_m: float | None
    surface_datum: str | None = None
    diagnosis: Mapping[str, str] | None = None
    more: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for each in fields(self):
            value, (kind, _, none) = getattr(self, each.name), str(each.type).partition(" | ")
            expected, holds = _TABLES.get(each.name) or _KINDS[kind]
            if not (holds(value) or (none and value is None)):
                or_null = " or null" if none else ""
                raise TelemetryError(f"{each.name}: expected {expected}{or_null}, got {_shown(value)}")

    @property
    def ground(self) -> Ground:
        """Level of the ground on the map."""
        return Ground(self.ground_m, self.ground_amsl_m)

    def facts(self) -> dict[str, Any]:
        """The record as JSON values."""
        values = asdict(self)
        more: dict[str, Any] = values.pop("more")
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
        more = {name: value for name, value in values.items() if name not in known}
        return RunRecord(**{name: value for name, value in values.items() if name in known}, more=more)
    except FileNotFoundError:
        raise TelemetryError(f"{path}: expected the summary of a finished track, got no such file") from None
    except TelemetryError as error:
        raise TelemetryError(f"{wrong}; settings, {error}") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise TelemetryError(f"{wrong}, got something else") from None


def _are_corrections(value: object) -> bool:
    try:
        Corrections.from_facts(value)
    except (EngineError, TypeError, AttributeError):
        return False
    return True


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value != "" and "\0" not in value


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_place(value: object) -> bool:
    if not isinstance(value, Mapping):
        return False
    lat_deg: Any = value.get("lat_deg")
    lon_deg: Any = value.get("lon_deg")
    return _is_number(lat_deg) and _is_number(lon_deg) and abs(lat_deg) <= 90.0 and abs(lon_deg) <= 360.0


def _is_table(value: object, kind: type) -> bool:
    return isinstance(value, Mapping) and all(isinstance(each, kind) for each in value.values())


_KINDS: dict[str, tuple[str, Callable[[object], bool]]] = {
    "str": ("a text", _is_text),
    "float": ("a number", _is_number),
    "int": ("a whole number above 0", lambda value: type(value) is int and value >= 1),
    "bool": ("true or false", lambda value: isinstance(value, bool)),
}
"""What a field holds, in words and as a test, by its type."""
_TABLES: dict[str, tuple[str, Callable[[object], bool]]] = {
    "origin": ("lat_deg and lon_deg on the Earth", _is_place),
    "corrections": ("corrections of the telemetry", _are_corrections),
    "heights": ("counts by source", lambda value: _is_table(value, int)),
    "diagnosis": ("sentences", lambda value: _is_table(value, str)),
    **dict.fromkeys(("changed", "more"), ("a table", lambda value: _is_table(value, object))),
}
"""The same of tables, by name."""


def _shown(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
