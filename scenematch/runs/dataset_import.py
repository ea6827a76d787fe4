"""Importing a published data set as a flight folder, and checks that flag bad truth."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.errors import OptionError, TelemetryError
from engine.maps.rasters import open_source
from scenematch.files.datasets.alto import read_alto
from scenematch.files.datasets.anyvisloc import MODES, find_anyvisloc, read_anyvisloc, read_local_map
from scenematch.files.datasets.ortholoc import find_ortholoc, read_ortholoc
from scenematch.files.datasets.sequence import (
    MANIFEST,
    WRITTEN_FILES,
    DatasetSequence,
    ImportOptions,
    check_complete,
    clear_frames,
    write_sequence,
)
from scenematch.files.datasets.single_photos import LocalMap, campaign_text, write_local_map, write_single_photo
from scenematch.files.datasets.uav_visloc import read_uav_visloc
from scenematch.files.datasets.vpair import read_vpair
from scenematch.files.datasets.wildnav import read_wildnav
from scenematch.files.telemetry import read_telemetry
from scenematch.files.truth import read_truth
from scenematch.files.truth_checks import TruthFinding, check_truth
from scenematch.runs.arguments import check_choice
from scenematch.runs.folders import StrPath, check_folder, prepare_folder
from scenematch.runs.inputs import FOLDER_LAYOUT
from scenematch.runs.progress import SILENT, Progress

FLIGHTS, PHOTOGRAPHS = ("uav-visloc", "wildnav", "vpair", "alto"), ("anyvisloc", "ortholoc")
KINDS = (*FLIGHTS, *PHOTOGRAPHS)
CAMPAIGN = "campaign.toml"
_MAPS = "map"


def import_dataset(
    kind: str,
    root: StrPath,
    out: StrPath,
    options: ImportOptions,
    *,
    part: str | None = None,
    gsd_m: float | None = None,
    force: bool = False,
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Turn a download into a flight folder, and check its truth.

    Args:
        kind: one of :data:`FLIGHTS`.
        root: the unpacked data set.
        out: the flight folder.
        options: what the authors do not say.
        part: of a data set that has several.
        gsd_m: pixel of ALTO's aerial pictures, from which the map is then composed.
        force: whether the folder may be there already.
        progress: takes the notes and the findings.

    Returns:
        Facts, with the ``notes`` on what could not be known and the ``findings`` on the truth.

    Raises:
        OptionError: the kind is none, something is needed that nobody says, or what is read lies in the folder
            that is replaced.
        TelemetryError, MapError, CalibrationError: the data set is not of its layout, or cannot be written.
    """
    root, out = Path(root), Path(out)
    check_choice("kind", kind, FLIGHTS)
    check_folder(out, force)
    camera = options.camera if isinstance(options.camera, Path) else None
    _check_apart(
        out, ("`root`", root), ("`camera`", camera), ("`map`", options.map), ("`surface`", options.surface)
    )
    recording = _read(kind, root, part, gsd_m)
    check_complete(recording, options)
    _check_apart(out, *(("a picture of `root`", image.path) for image in recording.images))
    clear_frames(out)
    prepare_folder(out, force, WRITTEN_FILES)
    notes = write_sequence(out, recording, options)
    findings = check_flight(out)
    for text in (*notes, *(finding.text for finding in findings)):
        progress.message(f"note: {text}")
    frames = len(read_telemetry(out / FOLDER_LAYOUT["telemetry"]))
    return {
        "dataset": recording.dataset,
        "part": recording.part or None,
        "frames": frames,
        "notes": list(notes),
        "findings": [finding.text for finding in findings],
        "folder": str(out.resolve()),
    }


def _check_apart(out: Path, *inputs: tuple[str, Path | None]) -> None:
    """Refuse to read from the folder that is written: what is read there would be removed first."""
    within = out.resolve()
    for name, path in inputs:
        # As it is named and as it is meant: a link in the folder is removed, and a link elsewhere leads there.
        if path is not None and any(
            place.is_relative_to(within) for place in (path.parent.resolve() / path.name, path.resolve())
        ):
            raise OptionError(f"out: expected a folder without {name}, whose files it replaces, got {out}")


def _read(kind: str, root: Path, part: str | None, gsd_m: float | None) -> DatasetSequence:
    if (kind in ("uav-visloc", "alto")) != (part is not None):
        raise OptionError(f"part: expected {'one' if part is None else 'none'} with {kind}, got {part or 'none'}")
    if gsd_m is not None and kind != "alto":
        raise OptionError(f"gsd_m: expected with alto only, got {gsd_m:g}")
    if kind == "wildnav":
        return read_wildnav(root)
    if kind == "vpair":
        return read_vpair(root)
    return read_alto(root, part or "", gsd_m) if kind == "alto" else read_uav_visloc(root, part or "")


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographOptions:
    """Which photographs of a data set of single ones are taken.

    Attributes:
        part: scene of AnyVisLoc; None with OrthoLoC.
        reference: which of AnyVisLoc's maps, "aerial" or "satellite".
        max_tilt_deg: off nadir.
        limit: so many at most, evenly spread; None is all.

    Raises:
        OptionError: the tilt is out of its range, or there is no such reference.
    """

    part: str | None = None
    reference: str = "aerial"
    max_tilt_deg: float = 30.0
    limit: int | None = None

    def __post_init__(self) -> None:
        check_choice("reference", self.reference, MODES)
        if not 0.0 <= self.max_tilt_deg <= 90.0:
            raise OptionError(f"max_tilt_deg: expected 0 to 90 degrees, got {self.max_tilt_deg:g}")


def import_photographs(
    kind: str,
    root: StrPath,
    out: StrPath,
    options: PhotographOptions,
    *,
    force: bool = False,
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Turn single photographs into flights of one frame each, and a campaign's file that lists them.

    Args:
        kind: one of :data:`PHOTOGRAPHS`.
        root: AnyVisLoc's folder of scenes, or a folder of OrthoLoC's samples.
        out: a folder of flight folders.
        options: which are taken.
        force: whether the folder may be there already.
        progress: is shown the photographs, and takes the notes.

    Returns:
        Facts about the import.

    Raises:
        OptionError: an option is out of its range, nothing is left by it, or a folder that no import created is in
            the way.
        TelemetryError, MapError, CalibrationError: the data set is not of its layout, or cannot be written.
    """
    root, out = Path(root), Path(out)
    check_choice("kind", kind, PHOTOGRAPHS)
    if (kind == "anyvisloc") != (options.part is not None):
        raise OptionError(
            f"part: expected {'a scene with anyvisloc' if options.part is None else 'none with ortholoc'}"
        )
    scene = root / (options.part or "")
    check_folder(out, force)
    _check_apart(out, ("`root`", scene))
    paths = _photographs(kind, scene, options.limit)
    scene_map = read_local_map(scene, options.reference) if kind == "anyvisloc" else None
    for path in paths:
        _check_replaceable(out / path.stem)
    prepare_folder(out, force, (CAMPAIGN, *(f"{_MAPS}/{FOLDER_LAYOUT[name]}" for name in ("map", "surface"))))
    names = _write_photographs(kind, progress.track(paths, len(paths), kind), out, scene_map, options.max_tilt_deg)
    (out / CAMPAIGN).write_text(campaign_text(names), encoding="utf-8")
    for note in _PHOTOGRAPH_NOTES:
        progress.message(f"note: {note}")
    return {
        "dataset": _NAMES[kind],
        "part": options.part,
        "frames": len(names),
        "too oblique": len(paths) - len(names),
        "campaign": str((out / CAMPAIGN).resolve()),
    }


def _photographs(kind: str, scene: Path, limit: int | None) -> list[Path]:
    """The samples of a scene, or so many of them, evenly spread."""
    paths = find_anyvisloc(scene) if kind == "anyvisloc" else find_ortholoc(scene)
    if not paths:
        raise TelemetryError(f"{scene}: expected samples of {kind}, got none")
    count = min(limit or len(paths), len(paths))
    return [paths[k * len(paths) // count] for k in range(count)]


def _write_photographs(
    kind: str, paths: Iterable[Path], out: Path, scene_map: LocalMap | None, max_tilt_deg: float
) -> list[str]:
    """The flight folders of the photographs that are not too oblique, by name.

    Raises:
        OptionError: all of them are.
    """
    if scene_map is not None:
        write_local_map(out / _MAPS, scene_map)
    names = []
    for path in paths:
        single, site = read_ortholoc(path) if scene_map is None else (read_anyvisloc(path), scene_map)
        if single.tilt_deg > max_tilt_deg:
            continue
        folder = out / single.name
        if folder.exists():
            shutil.rmtree(folder)
        write_single_photo(folder, single, site, folder if scene_map is None else out / _MAPS, _NAMES[kind])
        if scene_map is None:
            write_local_map(folder, site)
        names.append(single.name)
    if not names:
        raise OptionError(f"max_tilt_deg: expected some picture within {max_tilt_deg:g} degrees, got none")
    return names


def _check_replaceable(folder: Path) -> None:
    """Refuse a folder in the way of a flight that no import created."""
    if folder.is_symlink() or (folder.exists() and not (folder / MANIFEST).is_file()):
        raise OptionError(f"out: expected flights of an earlier import to replace, but {folder} is no such one")


_NAMES = {"anyvisloc": "AnyVisLoc", "ortholoc": "OrthoLoC"}
_PHOTOGRAPH_NOTES = (
    "height and attitude of the telemetry are the true ones: the data set has no sensors'",
    "the places are made anonymous: the flights lie somewhere in UTM zone 31, true to each other only",
)


def check_flight(folder: StrPath, max_speed_mps: float = 70.0) -> list[TruthFinding]:
    """What is doubtful about the truth of a flight folder.

    Args:
        folder: with a truth.csv.
        max_speed_mps: that the vehicle can fly over ground.

    Raises:
        TelemetryError, MapError: a file is missing or cannot be read.
    """
    paths = {name: Path(folder) / file for name, file in FOLDER_LAYOUT.items()}
    if not paths["truth"].is_file():
        raise TelemetryError(f"{paths['truth']}: no such file")
    site, surface = (
        open_source(paths[name], name) if paths[name].is_file() else None for name in ("map", "surface")
    )
    rows = read_telemetry(paths["telemetry"]) if paths["telemetry"].is_file() else []
    return check_truth(read_truth(paths["truth"]), rows, site=site, surface=surface, max_speed_mps=max_speed_mps)
