"""A sequence of a data set: its images with their published poses, and the writer of its flight folder."""

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
from engine.geo import wrap_heading_deg
from scenematch.files.datasets.mosaic import Mosaic, write_mosaic
from scenematch.files.flight import camera_info
from scenematch.files.telemetry import TelemetryRow, read_telemetry, write_telemetry
from scenematch.files.truth import truth_from_telemetry, write_truth

DATUMS = ("agl", "amsl", "ellipsoid")
"""Datums of heights: the ground below, mean sea level, the WGS84 ellipsoid."""
START_SIGMA_M = 15.0
"""Standard deviation of the start prior, which is the true position of the first image."""
HFOV_DEG, INTERVAL_S, GROUND_M = (0.1, 179.0), (1e-3, 86_400.0), (-10_000.0, 10_000.0)
"""Plausible ranges of the field of view, the time between two images and the level of the ground."""
MANIFEST = "dataset.json"
"""File that marks a folder as imported."""
WRITTEN_FILES = ("telemetry.csv", "truth.csv", "camera.yaml", "map.tif", "dsm.tif", MANIFEST)


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceImage:
    """One image of a data set with its pose; what is not published is None.

    Attributes:
        path: the image file.
        lat_deg: WGS84 latitude of the camera.
        lon_deg: WGS84 longitude of the camera.
        timestamp_ns: capture time.
        height_m: height in the datum of the sequence.
        heading_deg: of the body, clockwise from true north.
        roll_deg: of the body, positive right side down.
        pitch_deg: of the body, positive nose up.
    """

    path: Path
    lat_deg: float
    lon_deg: float
    timestamp_ns: int | None = None
    height_m: float | None = None
    heading_deg: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetSequence:
    """A sequence as a reader returns it.

    Attributes:
        dataset: name of the data set.
        part: part of the data set, or "".
        images: in the order of capture.
        datum: datum of their heights, one of :data:`DATUMS`; None where it is not published.
        mount: rotation (3, 3) from the camera's axes to the body's, v_body = mount * v_camera; None is the
            default, the image's top to the nose.
        map: a georeferenced file, the pieces that it is composed of, or None where the data set has none.
        notes: assumptions and omissions, one line each.
    """

    dataset: str
    part: str = ""
    images: Sequence[SequenceImage]
    datum: str | None = None
    mount: NDArray[np.float64] | None = None
    map: Path | Mosaic | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportOptions:
    """What the user adds to a data set.

    Attributes:
        camera: a calibration file, or the horizontal field of view in degrees of an ideal camera.
        map: a map that replaces that of the data set.
        surface: a surface model.
        datum: datum of the heights, where the data set does not publish it.
        ground_m: level of the ground in that datum, which converts heights to heights above the ground.
        interval_s: time between images, where the data set has no times.

    Raises:
        OptionError: a value is out of range.
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
        for name, unit, value, (low, high) in (
            ("hfov_deg", "degrees", hfov_deg, HFOV_DEG),
            ("interval_s", "seconds", self.interval_s, INTERVAL_S),
            ("ground_m", "metres", self.ground_m, GROUND_M),
        ):
            if value is not None and not low <= value <= high:
                raise OptionError(f"{name}: expected {low:g} to {high:g} {unit}, got {value:g}")


def check_complete(sequence: DatasetSequence, options: ImportOptions) -> None:
    """Check that a sequence can be written as a flight, before its folder is created.

    Raises:
        OptionError: something required is given neither by the data set nor by the user.
        TelemetryError, CalibrationError: there are no images, or the calibration cannot be read.
    """
    if options.map is None and sequence.map is None:
        raise OptionError("map: expected a map, since the data set has none")
    for name, path in (("map", options.map), ("surface", options.surface)):
        if path is not None and not path.is_file():
            raise OptionError(f"{name}: expected an existing file, got {path}")
    if isinstance(options.camera, Path):
        Camera.load(options.camera)
    _in_time(sequence, options)


def clear_frames(out: Path) -> None:
    """Remove the images of an earlier import from a flight folder: links, or copies where there are no links.

    Other files stay.

    Raises:
        OptionError: the folder of images is itself a link.
    """
    frames = out / "frames"
    if frames.is_symlink():
        raise OptionError(f"out: expected {frames} to be a folder of its own, got a link to {frames.resolve()}")
    imported = _imported(out)
    for file in frames.iterdir() if frames.is_dir() else ():
        if file.is_symlink() or (file.name in imported and file.is_file()):
            file.unlink()


def _imported(out: Path) -> set[str]:
    """Names of the images that an earlier import has put into a flight folder."""
    if not (out / MANIFEST).is_file():
        return set()
    try:
        return {row.frame for row in read_telemetry(out / "telemetry.csv")}
    except TelemetryError:
        return set()


def write_sequence(out: Path, sequence: DatasetSequence, options: ImportOptions) -> tuple[str, ...]:
    """Write a flight folder: links to pictures and rasters, telemetry, truth and calibration.

    The telemetry has the published attitudes and heights, and the first position only.

    Args:
        out: the folder, which exists.
        sequence: the sequence.
        options: what the user adds.

    Returns:
        The notes of the sequence, and what was omitted here.

    Raises:
        OptionError, CalibrationError: see :func:`check_complete`.
        TelemetryError, MapError: a file cannot be read or written.
    """
    images, notes = _in_time(sequence, options)
    datum = options.datum or sequence.datum
    rows = [
        _telemetry_row(image, stamp_ns, datum, options, first=not k) for k, (image, stamp_ns) in enumerate(images)
    ]
    if datum is None and any(image.height_m is not None for image, _ in images):
        notes += ("heights are left out: the authors do not say what they are counted from, `datum` does",)
    elif options.ground_m is not None and (count := _below_ground(images, datum, options.ground_m)):
        notes += (f"heights of {count} of {len(images)} pictures are left out: they are not above `ground_m`",)
    elif datum not in (None, "agl") and options.ground_m is None:
        notes += (
            f"heights above the ground are unknown: they are {datum}, and `ground_m` gives the ground's level",
        )
    # Written first: it marks the images as imported.
    about: dict[str, Any] = {"dataset": sequence.dataset, "part": sequence.part, "notes": notes}
    (out / MANIFEST).write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    write_telemetry(out / "telemetry.csv", rows)
    _link_frames(out / "frames", [image.path for image, _ in images])
    truth = [
        truth_from_telemetry(row, image.lat_deg, image.lon_deg)
        for row, (image, _) in zip(rows, images, strict=True)
    ]
    write_truth(out / "truth.csv", truth)
    _write_camera(out / "camera.yaml", options.camera, images[0][0].path, sequence.mount)
    _write_map(out / "map.tif", options.map or sequence.map)
    if options.surface is not None:
        _link(options.surface, out / "dsm.tif")
    return notes


def _in_time(
    sequence: DatasetSequence, options: ImportOptions
) -> tuple[list[tuple[SequenceImage, int]], tuple[str, ...]]:
    """The images that exist with increasing stamps in nanoseconds, and the notes."""
    present = [image for image in sequence.images if image.path.is_file()]
    notes = list(sequence.notes)
    if len(present) < len(sequence.images):
        notes.append(
            f"{len(sequence.images) - len(present)} of {len(sequence.images)} pictures are missing, left out"
        )
    if not present:
        raise TelemetryError(f"{sequence.images[0].path}: expected the data set's pictures, got none of them")
    if options.interval_s is not None:
        return [(image, round(1e9 * options.interval_s * k)) for k, image in enumerate(present)], tuple(notes)
    kept: list[tuple[SequenceImage, int]] = []
    for image in present:
        if image.timestamp_ns is None:
            raise OptionError("interval_s: expected seconds between pictures, since the data set has no times")
        if not kept or image.timestamp_ns > kept[-1][1]:
            kept.append((image, image.timestamp_ns))
    if len(kept) < len(present):
        notes.append(f"{len(present) - len(kept)} of {len(present)} stamps repeat or go back, left out")
    return kept, tuple(notes)


def _below_ground(images: Sequence[tuple[SequenceImage, int]], datum: str | None, ground_m: float) -> int:
    """Number of heights, other than above the ground, that are not above the level of the ground."""
    heights_m = [image.height_m for image, _ in images if image.height_m is not None and datum != "agl"]
    return sum(height_m <= ground_m for height_m in heights_m)


def _telemetry_row(
    image: SequenceImage, stamp_ns: int, datum: str | None, options: ImportOptions, *, first: bool
) -> TelemetryRow:
    height_m = image.height_m
    above_m = height_m if datum == "agl" else None
    if height_m is not None and datum in ("amsl", "ellipsoid") and options.ground_m is not None:
        above_m = height_m - options.ground_m
    return TelemetryRow(
        timestamp_ns=stamp_ns,
        frame=image.path.name,
        height_agl_m=above_m if above_m is not None and above_m > 0.0 else None,
        alt_amsl_m=height_m if datum == "amsl" else None,
        heading_deg=None if image.heading_deg is None else wrap_heading_deg(image.heading_deg),
        roll_deg=image.roll_deg,
        pitch_deg=image.pitch_deg,
        lat_deg=image.lat_deg if first else None,
        lon_deg=image.lon_deg if first else None,
        sigma_m=START_SIGMA_M if first else None,
    )


def _link_frames(frames: Path, pictures: Sequence[Path]) -> None:
    frames.mkdir(exist_ok=True)
    for picture in pictures:
        _link(picture, frames / picture.name)


def _link(source: Path, target: Path) -> None:
    """Link a file, or copy it where the file system has no links: published data sets are large."""
    try:
        os.symlink(source.resolve(strict=True), target)
    except FileExistsError:
        raise TelemetryError(
            f"{target}: expected unique file names in the data set, none of which exists already"
        ) from None
    except (NotImplementedError, PermissionError):
        shutil.copyfile(source, target)


def _write_camera(path: Path, camera: Path | float, picture: Path, mount: NDArray[np.float64] | None) -> None:
    """Copy the user's calibration, or write an ideal camera of the image's size with the data set's mount."""
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
