"""A recording: the pictures of a data set with what its authors say of each, and its writer as a flight folder."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import OptionError, TelemetryError
from engine.formats.datasets.mosaic import Mosaic, write_mosaic
from engine.formats.flight import camera_info
from engine.formats.telemetry import TelemetryRow, read_telemetry, write_telemetry
from engine.formats.truth import truth_at, write_truth
from engine.geo import wrap_heading_deg

DATUMS = ("agl", "amsl", "ellipsoid")
"""What a height is counted from: the ground below, the mean sea level, the WGS84 ellipsoid."""
START_SIGMA_M = 15.0
"""How well the flight knows where it begins: the first picture's true place, with this standard deviation."""
HFOV_DEG, INTERVAL_S, GROUND_M = (0.1, 179.0), (1e-3, 86_400.0), (-10_000.0, 10_000.0)
"""Within what a field of view, the time between two pictures and the level of the ground can be believed."""
ABOUT = "dataset.json"
OWNED = ("telemetry.csv", "truth.csv", "camera.yaml", "map.tif", "dsm.tif", ABOUT)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """One picture of a data set; what its authors do not say is None.

    Attributes:
        picture: the file.
        lat_deg: WGS84 latitude of the camera.
        lon_deg: WGS84 longitude of the same.
        timestamp_ns: capture time.
        height_m: as the data set has it, in the datum of its recording.
        heading_deg: of the body, clockwise from true north.
        roll_deg: of the body, positive right side down.
        pitch_deg: of the body, positive nose up.
    """

    picture: Path
    lat_deg: float
    lon_deg: float
    timestamp_ns: int | None = None
    height_m: float | None = None
    heading_deg: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """What a reader makes of a data set.

    Attributes:
        dataset: its name.
        part: of the data set, or "".
        shots: in the order of capture.
        datum: of their heights, one of :data:`DATUMS`; None where the authors do not say.
        mount: rotation (3, 3) from the camera's axes to the body's, v_body = mount * v_camera; None is the usual
            one, the picture's top to the nose.
        map: a georeferenced file, the pieces that it is laid together from, or None where the data set has none.
        notes: what could not be known, and what was left out; a line each.
    """

    dataset: str
    part: str = ""
    shots: Sequence[Shot]
    datum: str | None = None
    mount: NDArray[np.float64] | None = None
    map: Path | Mosaic | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportOptions:
    """What the user adds to a data set that its authors do not say.

    Attributes:
        camera: a calibration file, or the horizontal field of view in degrees of an ideal camera.
        map: a map in place of the data set's.
        surface: a surface model.
        datum: of the heights, where the data set leaves it open.
        ground_m: level of the ground in the same datum, which makes heights above the ground of the others.
        interval_s: time between pictures, where the data set has no times.

    Raises:
        OptionError: a value is none that can be.
    """

    camera: Path | float
    map: Path | None = None
    surface: Path | None = None
    datum: str | None = None
    ground_m: float | None = None
    interval_s: float | None = None

    def __post_init__(self) -> None:
        if self.datum is not None and self.datum not in DATUMS:
            raise OptionError(f"datum: expected one of {', '.join(DATUMS)}, got {self.datum!r}")
        hfov_deg = None if isinstance(self.camera, Path) else self.camera
        for name, unit, value, (least, most) in (
            ("hfov_deg", "degrees", hfov_deg, HFOV_DEG),
            ("interval_s", "seconds", self.interval_s, INTERVAL_S),
            ("ground_m", "metres", self.ground_m, GROUND_M),
        ):
            if value is not None and not least <= value <= most:
                raise OptionError(f"{name}: expected {least:g} to {most:g} {unit}, got {value:g}")


def check_complete(recording: Recording, told: ImportOptions) -> None:
    """Refuse what cannot become a flight, before a folder is made for it.

    Raises:
        OptionError: something is needed that neither the data set nor the user says.
        TelemetryError, CalibrationError: there are no pictures, or the calibration cannot be read.
    """
    if told.map is None and recording.map is None:
        raise OptionError("map: expected a map, since the data set has none")
    for name, path in (("map", told.map), ("surface", told.surface)):
        if path is not None and not path.is_file():
            raise OptionError(f"{name}: expected a file that is there, got {path}")
    if isinstance(told.camera, Path):
        Camera.load(told.camera)
    _in_time(recording, told)


def clear_frames(out: Path) -> None:
    """Take the pictures of an earlier import out of a flight folder: links, and its copies where a disk has none.

    Whatever else lies there stays.

    Raises:
        OptionError: the pictures' folder is itself a link, whose files are somebody else's.
    """
    frames = out / "frames"
    if frames.is_symlink():
        raise OptionError(f"out: expected {frames} to be a folder of its own, got a link to {frames.resolve()}")
    imported = _imported(out)
    for file in frames.iterdir() if frames.is_dir() else ():
        if file.is_symlink() or (file.name in imported and file.is_file()):
            file.unlink()


def _imported(out: Path) -> set[str]:
    """The pictures that an earlier import has put into a flight folder, by name."""
    if not (out / ABOUT).is_file():
        return set()
    try:
        return {row.frame for row in read_telemetry(out / "telemetry.csv")}
    except TelemetryError:
        return set()


def write_recording(out: Path, recording: Recording, told: ImportOptions) -> tuple[str, ...]:
    """Write a flight folder: links to pictures and rasters, telemetry, truth and calibration.

    The telemetry knows what the data set says of attitude and height, and of the places the first one only.

    Args:
        out: the folder, which is there.
        recording: what a reader found.
        told: what the user adds.

    Returns:
        The recording's notes, and what of it was left out here.

    Raises:
        OptionError, CalibrationError: see :func:`check_complete`.
        TelemetryError, MapError: a file cannot be read or written.
    """
    shots, notes = _in_time(recording, told)
    datum = told.datum or recording.datum
    rows = [_telemetry_row(shot, stamp_ns, datum, told, first=not k) for k, (shot, stamp_ns) in enumerate(shots)]
    if datum is None and any(shot.height_m is not None for shot, _ in shots):
        notes += ("heights are left out: the authors do not say what they are counted from, `datum` does",)
    elif told.ground_m is not None and (count := _below_ground(shots, datum, told.ground_m)):
        notes += (f"heights of {count} of {len(shots)} pictures are left out: they are not above `ground_m`",)
    elif datum not in (None, "agl") and told.ground_m is None:
        notes += (
            f"heights above the ground are unknown: they are {datum}, and `ground_m` gives the ground's level",
        )
    # First, since they say of the pictures that an import has put them there.
    about: dict[str, Any] = {"dataset": recording.dataset, "part": recording.part, "notes": notes}
    (out / ABOUT).write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    write_telemetry(out / "telemetry.csv", rows)
    _link_frames(out / "frames", [shot.picture for shot, _ in shots])
    truth = [truth_at(row, shot.lat_deg, shot.lon_deg) for row, (shot, _) in zip(rows, shots, strict=True)]
    write_truth(out / "truth.csv", truth)
    _write_camera(out / "camera.yaml", told.camera, shots[0][0].picture, recording.mount)
    _write_map(out / "map.tif", told.map or recording.map)
    if told.surface is not None:
        _link(told.surface, out / "dsm.tif")
    return notes


def _in_time(recording: Recording, told: ImportOptions) -> tuple[list[tuple[Shot, int]], tuple[str, ...]]:
    """The shots whose pictures are there with their stamps, each later than the one before."""
    here = [shot for shot in recording.shots if shot.picture.is_file()]
    notes = list(recording.notes)
    if len(here) < len(recording.shots):
        notes.append(
            f"{len(recording.shots) - len(here)} of {len(recording.shots)} pictures are not there, left out"
        )
    if not here:
        raise TelemetryError(f"{recording.shots[0].picture}: expected the data set's pictures, got none of them")
    if told.interval_s is not None:
        return [(shot, round(1e9 * told.interval_s * k)) for k, shot in enumerate(here)], tuple(notes)
    kept: list[tuple[Shot, int]] = []
    for shot in here:
        if shot.timestamp_ns is None:
            raise OptionError("interval_s: expected seconds between pictures, since the data set has no times")
        if not kept or shot.timestamp_ns > kept[-1][1]:
            kept.append((shot, shot.timestamp_ns))
    if len(kept) < len(here):
        notes.append(f"{len(here) - len(kept)} of {len(here)} stamps repeat or go back, left out")
    return kept, tuple(notes)


def _below_ground(shots: Sequence[tuple[Shot, int]], datum: str | None, ground_m: float) -> int:
    """How many heights are not above a ground whose level counts for them."""
    heights_m = [shot.height_m for shot, _ in shots if shot.height_m is not None and datum != "agl"]
    return sum(height_m <= ground_m for height_m in heights_m)


def _telemetry_row(
    shot: Shot, stamp_ns: int, datum: str | None, told: ImportOptions, *, first: bool
) -> TelemetryRow:
    height_m = shot.height_m
    above_m = height_m if datum == "agl" else None
    if height_m is not None and datum in ("amsl", "ellipsoid") and told.ground_m is not None:
        above_m = height_m - told.ground_m
    return TelemetryRow(
        timestamp_ns=stamp_ns,
        frame=shot.picture.name,
        height_agl_m=above_m if above_m is not None and above_m > 0.0 else None,
        alt_amsl_m=height_m if datum == "amsl" else None,
        heading_deg=None if shot.heading_deg is None else wrap_heading_deg(shot.heading_deg),
        roll_deg=shot.roll_deg,
        pitch_deg=shot.pitch_deg,
        lat_deg=shot.lat_deg if first else None,
        lon_deg=shot.lon_deg if first else None,
        sigma_m=START_SIGMA_M if first else None,
    )


def _link_frames(frames: Path, pictures: Sequence[Path]) -> None:
    frames.mkdir(exist_ok=True)
    for picture in pictures:
        _link(picture, frames / picture.name)


def _link(source: Path, target: Path) -> None:
    """A link, or where the disk has none a copy: published data sets are large."""
    try:
        os.symlink(source.resolve(strict=True), target)
    except FileExistsError:
        raise TelemetryError(
            f"{target}: expected each file name once in the data set, and none of them there before"
        ) from None
    except (NotImplementedError, PermissionError):
        shutil.copyfile(source, target)


def _write_camera(path: Path, camera: Path | float, picture: Path, mount: NDArray[np.float64] | None) -> None:
    """The user's calibration as it is, or an ideal camera of the picture's size on the data set's mount."""
    from PIL import Image

    if isinstance(camera, Path):
        shutil.copyfile(camera, path)
        return
    with Image.open(picture) as opened:
        width_px, height_px = opened.size
    ideal = Camera.from_fov(width_px, height_px, camera)
    path.write_text(camera_info(ideal if mount is None else replace(ideal, mount=mount)), encoding="utf-8")


def _write_map(path: Path, found: Path | Mosaic | None) -> None:
    if isinstance(found, Path):
        _link(found, path)
    elif found is not None:
        write_mosaic(path, found)
