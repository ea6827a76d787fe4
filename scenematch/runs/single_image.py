"""Locate one image on the map, without a flight."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from engine.errors import OptionError, TelemetryError
from engine.values import Fix, Frame, NoFix
from scenematch.files.frames import PICTURE_SUFFIXES, open_frames, read_image
from scenematch.runs.arguments import parse_position
from scenematch.runs.cameras import CameraInput, check_size
from scenematch.runs.map_input import MapInput, check_position
from scenematch.runs.output import SILENT, Progress, StrPath
from scenematch.runs.settings import TrackSettings


def locate_image(
    image: StrPath,
    map: MapInput | StrPath,  # noqa: A002 - what it is, as everywhere
    camera: CameraInput | StrPath | None = None,
    *,
    height_agl_m: float | None = None,
    heading_deg: float | None = None,
    roll_deg: float | None = None,
    pitch_deg: float | None = None,
    settings: TrackSettings | None = None,
    progress: Progress = SILENT,
) -> Fix | NoFix:
    """Match one image. Height, attitude and position come from the arguments, not from a photograph's EXIF.

    Args:
        image: the file.
        map: the map with its surface, or just the path of the map.
        camera: the camera, or the path of its calibration; None uses the photograph's EXIF.
        height_agl_m: above the ground; None is unknown, also for the next three.
        heading_deg: clockwise from true north.
        roll_deg: right side down.
        pitch_deg: nose up.
        settings: how to match it; its start is where to search, none is the whole map. None uses the defaults.
        progress: receives the copying of the map.

    Raises:
        OptionError: an argument is out of range.
        MapError, CalibrationError, TelemetryError: a file cannot be read, or does not fit another.
    """
    known: dict[str, Any] = {
        "height_agl_m": height_agl_m, "heading_deg": heading_deg, "roll_deg": roll_deg, "pitch_deg": pitch_deg,
    }  # fmt: skip
    for name, value in known.items():
        if value is not None and not math.isfinite(value):
            raise OptionError(f"{name}: expected a finite number, got {value}")
    if height_agl_m is not None and height_agl_m <= 0:
        raise OptionError(f"height_agl_m: expected metres above 0, got {height_agl_m:g}")
    settings = settings or TrackSettings()
    prior = parse_position("start", settings.start)
    site = MapInput.of(map).open(progress)
    _check_picture(Path(image))
    calibration = CameraInput.of(camera).load(open_frames(image), progress=progress)
    check_position("start", prior, site, OptionError)
    pixels = read_image(image)
    check_size(calibration, pixels.shape)
    matcher = settings.matcher(site, calibration)
    return matcher.locate(Frame(pixels, **known), prior)


def _check_picture(file: Path) -> None:
    """Refuse a file that is not a picture; folders and videos are for other commands."""
    if not file.exists():
        raise TelemetryError(f"{file}: expected a picture, got no such file")
    if not file.is_file() or file.suffix.lower() not in PICTURE_SUFFIXES:
        raise TelemetryError(f"{file}: expected one picture ({', '.join(PICTURE_SUFFIXES)})")
