"""Locating one image on the map, without a flight around it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from engine.errors import OptionError, TelemetryError
from engine.matching import METHODS
from engine.matching.matcher import SceneMatcher
from engine.options import MatcherOptions
from engine.values import Fix, Frame, NoFix
from scenematch.files.frames import PICTURE_SUFFIXES, open_frames, read_image
from scenematch.runs.arguments import check_choice, check_device, parse_position
from scenematch.runs.cameras import CameraFiles, check_size
from scenematch.runs.checks import check_position
from scenematch.runs.folders import StrPath
from scenematch.runs.inputs import open_map
from scenematch.runs.progress import SILENT, Progress
from scenematch.runs.settings import with_weights


def locate_image(
    image: StrPath,
    map: StrPath,  # noqa: A002 - what the file is, as everywhere
    camera: StrPath | None = None,
    *,
    surface: StrPath | None = None,
    map_sigma_m: float | None = None,
    map_bounds: str | None = None,
    map_crs: str | None = None,
    hfov_deg: float | None = None,
    mount: str | None = None,
    camera_pitch_deg: float | None = None,
    scale_calibration: bool = False,
    height_agl_m: float | None = None,
    heading_deg: float | None = None,
    roll_deg: float | None = None,
    pitch_deg: float | None = None,
    near: str | None = None,
    method: str = "auto",
    weights: Sequence[StrPath] = (),
    device: str = "auto",
    progress: Progress = SILENT,
) -> Fix | NoFix:
    """Match one image. Height, attitude and position are the arguments', not those of a photograph's EXIF.

    Args:
        image: the file.
        map: GeoTIFF, a picture with a world file, or a folder of tiles.
        camera: calibration file of ROS, OpenCV or Kalibr; None takes ``hfov_deg`` or the photograph's EXIF.
        surface: surface model, a GeoTIFF of heights.
        map_sigma_m: georeferencing accuracy of the map per axis; None is what the map states.
        map_bounds: "W,S,E,N" of a picture without georeference, in degrees or in ``map_crs``.
        map_crs: of a map that names none.
        hfov_deg: horizontal field of view, in place of a calibration.
        mount: how the camera is mounted, by name; None is the calibration's, else nadir.
        camera_pitch_deg: of the camera, -90 looks straight down.
        scale_calibration: to a picture of another size and the same shape.
        height_agl_m: above the ground; None is unknown, as of the next three.
        heading_deg: clockwise from true north.
        roll_deg: right side down.
        pitch_deg: nose up.
        near: where to search, "LAT,LON" or "LAT,LON,SIGMA_M"; None is the whole map.
        method: "ncc", "sift", "auto" or "learned".
        weights: files of the learned method.
        device: where tensors live.
        progress: is shown the copying of the map.

    Raises:
        OptionError: an argument is out of its range.
        MapError, CalibrationError, TelemetryError: a file cannot be read, or does not fit another.
    """
    known = {
        "height_agl_m": height_agl_m, "heading_deg": heading_deg, "roll_deg": roll_deg, "pitch_deg": pitch_deg,
    }  # fmt: skip
    _check_numbers(known)
    check_choice("method", method, METHODS)
    options = MatcherOptions(learned=with_weights(method, weights))
    check_device(device)
    prior = parse_position("near", near)
    described = CameraFiles(
        calibration=None if camera is None else Path(camera),
        hfov_deg=hfov_deg,
        mount=mount,
        camera_pitch_deg=camera_pitch_deg,
        scale_calibration=scale_calibration,
    )
    site = open_map(map, surface, map_sigma_m, bounds=map_bounds, crs=map_crs, progress=progress)
    _check_picture(Path(image))
    calibration = described.load(open_frames(image), progress=progress)
    check_position("near", prior, site, OptionError)
    pixels = read_image(image)
    check_size(calibration, pixels.shape)
    frame = Frame(
        pixels, height_agl_m=height_agl_m, heading_deg=heading_deg, roll_deg=roll_deg, pitch_deg=pitch_deg
    )
    return SceneMatcher(site, calibration, method, device, options).locate(frame, prior)


def _check_picture(file: Path) -> None:
    """Refuse what is no picture by its own name: a folder or a video serves other commands."""
    if not file.exists():
        raise TelemetryError(f"{file}: expected a picture, got no such file")
    if not file.is_file() or file.suffix.lower() not in PICTURE_SUFFIXES:
        raise TelemetryError(f"{file}: expected one picture ({', '.join(PICTURE_SUFFIXES)})")


def _check_numbers(known: Mapping[str, float | None]) -> None:
    for name, value in known.items():
        if value is not None and not math.isfinite(value):
            raise OptionError(f"{name}: expected a finite number, got {value}")
    height_agl_m = known["height_agl_m"]
    if height_agl_m is not None and height_agl_m <= 0:
        raise OptionError(f"height_agl_m: expected metres above 0, got {height_agl_m:g}")
