"""`dataset`: a published data set as a flight folder, and checks that flag bad truth."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.cli import console
from engine.cli.arguments import check_choice, prepare_folder
from engine.errors import OptionError, TelemetryError
from engine.formats.datasets.alto import read_alto
from engine.formats.datasets.anyvisloc import MODES, find_anyvisloc, read_anyvisloc, read_place
from engine.formats.datasets.ortholoc import find_ortholoc, read_ortholoc
from engine.formats.datasets.recording import OWNED, Recording, Told, check_complete, write_recording
from engine.formats.datasets.singles import campaign_text, write_place, write_single
from engine.formats.datasets.uav_visloc import read_uav_visloc
from engine.formats.datasets.vpair import read_vpair
from engine.formats.datasets.wildnav import read_wildnav
from engine.formats.telemetry import read_telemetry
from engine.formats.truth import read_truth
from engine.formats.truth_checks import Finding, check_truth
from engine.rasters import open_source

FLIGHTS, SINGLES = ("uav-visloc", "wildnav", "vpair", "alto"), ("anyvisloc", "ortholoc")
KINDS = (*FLIGHTS, *SINGLES)
CAMPAIGN = "campaign.toml"
_MAPS = "map"


def run_import(
    kind: str, root: Path, out: Path, told: Told, *, part: str | None, gsd_m: float | None, force: bool
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
        OptionError: the kind is none, or something is needed that nobody says.
        TelemetryError, MapError, CalibrationError: the data set is not of its layout, or cannot be written.
    """
    check_choice("KIND", kind, FLIGHTS)
    recording = _read(kind, root, part, gsd_m)
    check_complete(recording, told)
    prepare_folder(out, force, OWNED)
    shutil.rmtree(out / "frames", ignore_errors=True)
    notes = write_recording(out, recording, told)
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


def _read(kind: str, root: Path, part: str | None, gsd_m: float | None) -> Recording:
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
    """

    part: str | None = None
    reference: str
    max_tilt_deg: float
    limit: int | None = None


def run_import_singles(kind: str, root: Path, out: Path, choice: Choice, *, force: bool) -> dict[str, Any]:
    """Turn single photographs into flights of one frame each, and a campaign's file that lists them.

    Args:
        kind: one of :data:`SINGLES`.
        root: AnyVisLoc's folder of scenes, or a folder of OrthoLoC's samples.
        out: a folder of flight folders.
        choice: which are taken.
        force: whether the folder may be there already.

    Raises:
        OptionError: a choice is none, or nothing is left by it.
        TelemetryError, MapError, CalibrationError: the data set is not of its layout, or cannot be written.
    """
    check_choice("KIND", kind, SINGLES)
    check_choice("--reference", choice.reference, MODES)
    if (kind == "anyvisloc") != (choice.part is not None):
        raise OptionError(
            f"--part: expected {'a scene with anyvisloc' if choice.part is None else 'none with ortholoc'}"
        )
    scene = root / (choice.part or "")
    paths = find_anyvisloc(scene) if kind == "anyvisloc" else find_ortholoc(root)
    if not paths:
        raise TelemetryError(f"{scene}: expected samples of {kind}, got none")
    if choice.limit is not None:
        paths = [paths[k * len(paths) // choice.limit] for k in range(min(choice.limit, len(paths)))]
    shared = read_place(scene, choice.reference) if kind == "anyvisloc" else None
    prepare_folder(out, force, (CAMPAIGN,))
    if shared is not None:
        write_place(out / _MAPS, shared)
    names = []
    for path in console.progress(paths, len(paths), kind):
        single, place = read_ortholoc(path) if shared is None else (read_anyvisloc(path), shared)
        if single.tilt_deg > choice.max_tilt_deg:
            continue
        folder = out / single.name
        shutil.rmtree(folder, ignore_errors=True)
        if shared is None:
            write_place(folder, place)
        write_single(folder, single, place, folder if shared is None else out / _MAPS, _NAMES[kind])
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


_NAMES = {"anyvisloc": "AnyVisLoc", "ortholoc": "OrthoLoC"}
_SINGLE_NOTES = (
    "height and attitude of the telemetry are the true ones: the data set has no sensors'",
    "the places are made anonymous: the flights lie somewhere in UTM zone 31, true to each other only",
)


def check_flight(folder: Path, max_speed_mps: float = 70.0) -> list[Finding]:
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


def print_findings(findings: Sequence[Finding], title: str) -> None:
    """A line a finding."""
    pairs = [(finding.kind, finding.text) for finding in findings] or [("nothing found", "")]
    console.print_pairs(title, pairs)
