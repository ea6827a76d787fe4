"""`dataset`: a published data set as a flight folder, and checks that flag bad truth."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.cli import console
from engine.cli.arguments import check_choice, check_folder, prepare_folder
from engine.errors import OptionError, TelemetryError
from engine.formats.datasets.alto import read_alto
from engine.formats.datasets.anyvisloc import MODES, find_anyvisloc, read_anyvisloc, read_local_map
from engine.formats.datasets.ortholoc import find_ortholoc, read_ortholoc
from engine.formats.datasets.sequence import (
    MANIFEST,
    WRITTEN_FILES,
    DatasetSequence,
    ImportOptions,
    check_complete,
    clear_frames,
    write_sequence,
)
from engine.formats.datasets.single_photos import campaign_text, write_local_map, write_single_photo
from engine.formats.datasets.uav_visloc import read_uav_visloc
from engine.formats.datasets.vpair import read_vpair
from engine.formats.datasets.wildnav import read_wildnav
from engine.formats.telemetry import read_telemetry
from engine.formats.truth import read_truth
from engine.formats.truth_checks import TruthFinding, check_truth
from engine.maps.rasters import open_source

FLIGHTS, SINGLES = ("uav-visloc", "wildnav", "vpair", "alto"), ("anyvisloc", "ortholoc")
KINDS = (*FLIGHTS, *SINGLES)
CAMPAIGN = "campaign.toml"
_MAPS = "map"


def run_import(
    kind: str, root: Path, out: Path, told: ImportOptions, *, part: str | None, gsd_m: float | None, force: bool
) -> dict[str, Any]:
    """Turn a download into a flight folder, and look at its truth.

    Args:
        kind: one of :data:`FLIGHTS`.
        root: the unpacked data set.
        out: the flight folder.
        told: what the authors do not say.
        part: of a data set that has several.
        gsd_m: pixel of ALTO's aerial pictures, from which the map is then made.
        force: whether the folder may be there already.

    Returns:
        Facts, with the ``notes`` on what could not be known and the ``findings`` on the truth.

    Raises:
        OptionError: the kind is none, something is needed that nobody says, or what is read lies in the folder
            that is replaced.
        TelemetryError, MapError, CalibrationError: the data set is not of its layout, or cannot be written.
    """
    check_choice("KIND", kind, FLIGHTS)
    check_folder(out, force)
    camera = told.camera if isinstance(told.camera, Path) else None
    _check_apart(out, ("DIR", root), ("--camera", camera), ("--map", told.map), ("--surface", told.surface))
    recording = _read(kind, root, part, gsd_m)
    check_complete(recording, told)
    _check_apart(out, *(("a picture of DIR", image.path) for image in recording.images))
    clear_frames(out)
    prepare_folder(out, force, WRITTEN_FILES)
    notes = write_sequence(out, recording, told)
    findings = check_flight(out)
    for text in (*notes, *(finding.text for finding in findings)):
        console.say(f"note: {text}")
    frames = len(read_telemetry(out / "telemetry.csv"))
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
            raise OptionError(f"--out: expected a folder without {name}, whose files it replaces, got {out}")


def _read(kind: str, root: Path, part: str | None, gsd_m: float | None) -> DatasetSequence:
    if (kind in ("uav-visloc", "alto")) != (part is not None):
        raise OptionError(
            f"--part: expected {'one' if part is None else 'none'} with {kind}, got {part or 'none'}"
        )
    if gsd_m is not None and kind != "alto":
        raise OptionError(f"--gsd-m: expected with alto only, got {gsd_m:g}")
    if kind == "wildnav":
        return read_wildnav(root)
    if kind == "vpair":
        return read_vpair(root)
    return read_alto(root, part or "", gsd_m) if kind == "alto" else read_uav_visloc(root, part or "")


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Which photographs of a data set of single ones are taken.

    Attributes:
        part: scene of AnyVisLoc.
        reference: which of its two maps.
        max_tilt_deg: of the optical axis from straight down.
        limit: how many, evenly spread; None takes all.

    Raises:
        OptionError: the tilt is no angle from 0 to 90 degrees.
    """

    part: str | None = None
    reference: str
    max_tilt_deg: float
    limit: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.max_tilt_deg <= 90.0:
            raise OptionError(f"--max-tilt-deg: expected 0 to 90 degrees, got {self.max_tilt_deg:g}")


def run_import_singles(kind: str, root: Path, out: Path, choice: Choice, *, force: bool) -> dict[str, Any]:
    """Turn single photographs into flights of one frame each, and a campaign's file that lists them.

    Args:
        kind: one of :data:`SINGLES`.
        root: AnyVisLoc's folder of scenes, or a folder of OrthoLoC's samples.
        out: a folder of flight folders.
        choice: which are taken.
        force: whether the folder may be there already.

    Raises:
        OptionError: a choice is none, nothing is left by it, or a folder that is no such flight's is in the way.
        TelemetryError, MapError, CalibrationError: the data set is not of its layout, or cannot be written.
    """
    check_choice("KIND", kind, SINGLES)
    check_choice("--reference", choice.reference, MODES)
    if (kind == "anyvisloc") != (choice.part is not None):
        raise OptionError(
            f"--part: expected {'a scene with anyvisloc' if choice.part is None else 'none with ortholoc'}"
        )
    scene = root / (choice.part or "")
    check_folder(out, force)
    _check_apart(out, ("DIR", scene))
    paths = find_anyvisloc(scene) if kind == "anyvisloc" else find_ortholoc(root)
    if not paths:
        raise TelemetryError(f"{scene}: expected samples of {kind}, got none")
    limit = min(choice.limit or len(paths), len(paths))
    paths = [paths[k * len(paths) // limit] for k in range(limit)]
    shared = read_local_map(scene, choice.reference) if kind == "anyvisloc" else None
    for path in paths:
        _check_replaceable(out / path.stem)
    prepare_folder(out, force, (CAMPAIGN, *(f"{_MAPS}/{name}" for name in ("map.tif", "dsm.tif"))))
    if shared is not None:
        write_local_map(out / _MAPS, shared)
    names = []
    for path in console.progress(paths, len(paths), kind):
        single, place = read_ortholoc(path) if shared is None else (read_anyvisloc(path), shared)
        if single.tilt_deg > choice.max_tilt_deg:
            continue
        folder = out / single.name
        if folder.exists():
            shutil.rmtree(folder)
        write_single_photo(folder, single, place, folder if shared is None else out / _MAPS, _NAMES[kind])
        if shared is None:
            write_local_map(folder, place)
        names.append(single.name)
    if not names:
        raise OptionError(
            f"--max-tilt-deg: expected some picture within {choice.max_tilt_deg:g} degrees, got none"
        )
    (out / CAMPAIGN).write_text(campaign_text(names), encoding="utf-8")
    for note in _SINGLE_NOTES:
        console.say(f"note: {note}")
    return {
        "dataset": _NAMES[kind],
        "part": choice.part,
        "frames": len(names),
        "too oblique": len(paths) - len(names),
        "campaign": str((out / CAMPAIGN).resolve()),
    }


def _check_replaceable(folder: Path) -> None:
    """Refuse a folder in a flight's place that no import made."""
    if folder.is_symlink() or (folder.exists() and not (folder / MANIFEST).is_file()):
        raise OptionError(f"--out: expected flights of an earlier import to replace, but {folder} is no such one")


_NAMES = {"anyvisloc": "AnyVisLoc", "ortholoc": "OrthoLoC"}
_SINGLE_NOTES = (
    "height and attitude of the telemetry are the true ones: the data set has no sensors'",
    "the places are made anonymous: the flights lie somewhere in UTM zone 31, true to each other only",
)


def check_flight(folder: Path, max_speed_mps: float = 70.0) -> list[TruthFinding]:
    """What is doubtful about the truth of a flight folder.

    Raises:
        TelemetryError, MapError: a file is missing or cannot be read.
    """
    truth, telemetry = folder / "truth.csv", folder / "telemetry.csv"
    if not truth.is_file():
        raise TelemetryError(f"{truth}: no such file")
    site, surface = (
        open_source(path, name) if path.is_file() else None
        for path, name in ((folder / "map.tif", "map"), (folder / "dsm.tif", "surface"))
    )
    rows = read_telemetry(telemetry) if telemetry.is_file() else []
    return check_truth(read_truth(truth), rows, site=site, surface=surface, max_speed_mps=max_speed_mps)


def print_findings(findings: Sequence[TruthFinding], title: str) -> None:
    """A line a finding."""
    pairs = [(finding.kind, finding.text) for finding in findings] or [("nothing found", "")]
    console.print_pairs(title, pairs)
