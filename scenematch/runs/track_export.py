"""Export a finished track in the formats of other programs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from engine.errors import TelemetryError
from engine.geo import LocalFrame
from engine.values import Truth
from scenematch.files.export import WRITERS, segments, tum_rows
from scenematch.files.logs.readers import open_truth
from scenematch.files.track import TrackRow, read_track, with_notes
from scenematch.report.metrics import height_pairs_m, truth_per_row
from scenematch.runs.arguments import check_choice
from scenematch.runs.output import StrPath, check_file
from scenematch.runs.record import read_record
from scenematch.runs.results import NOTES, SUMMARY, TRACK


def export_track(
    folder: StrPath, kind: str, out: StrPath | None = None, *, truth: StrPath | None = None, force: bool = False
) -> dict[str, Any]:
    """Write a track in another format.

    Args:
        folder: folder of a finished run.
        kind: one of :data:`scenematch.files.export.WRITERS`.
        out: the file; None is ``track.KIND`` in the folder or, with ``truth``, ``truth.KIND``.
        truth: write this instead, at the times of the fixes and about the track's origin.
        force: whether the file may already exist.

    Returns:
        What was written; for TUM also how many fixes were left out (:func:`scenematch.files.export.tum_rows`).

    Raises:
        OptionError: the format is unknown, or the file exists and ``force`` was not given.
        TelemetryError: the folder holds no track, or the track has no fix.
    """
    folder = Path(folder)
    check_choice("kind", kind, tuple(WRITERS))
    out = folder / f"{'track' if truth is None else 'truth'}.{kind}" if out is None else Path(out)
    check_file(out, force)
    track = read_track(folder / TRACK)
    if not any(row.fixed for row in track):
        raise TelemetryError(f"{folder / TRACK}: expected a track with a fix, got {len(track)} rows without")
    rows = _poses(folder, track) if truth is None else _at_truth(folder, track, Path(truth))
    parts = segments(rows)
    text = WRITERS[kind](rows)
    try:
        with out.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
    except OSError as error:
        raise TelemetryError(f"{out}: cannot be written: {error.strerror or error}") from None
    fixes = sum(map(len, parts))
    facts = {"file": str(out), "format": kind, "fixes": fixes, "segments": len(parts)}
    return facts | ({"left_out": fixes - len(tum_rows(rows))} if kind == "tum" else {})


def _poses(folder: Path, track: list[TrackRow]) -> list[TrackRow]:
    """The track with the rest of each pose from the run's notes, and heights above the sea if it has those."""
    rows = with_notes(track, folder / NOTES)
    is_amsl = (folder / SUMMARY).is_file() and read_record(folder / SUMMARY).surface_datum is not None
    return [replace(row, alt_amsl_m=row.up_m) for row in rows] if is_amsl else rows


def _at_truth(folder: Path, track: list[TrackRow], path: Path) -> list[TrackRow]:
    """The rows of the fixes with the true pose at each time, if known.

    Heights are in the datum of the surface model, as compared in ``summary.json``.
    """
    record = read_record(folder / SUMMARY)
    ground, frame = record.ground, record.origin
    fixes = [row for row in track if row.fixed]
    truth = open_truth(path, track[0].timestamp_ns)
    heights_m = height_pairs_m(fixes, truth, ground)[:, 1] + ground.ground_m
    true_rows = [
        _true_row(row, at, frame, float(height_m))
        for row, at, height_m in zip(fixes, truth_per_row(fixes, truth), heights_m, strict=True)
        if at is not None
    ]
    if not true_rows:
        raise TelemetryError(f"{path}: expected the truth at the moment of a fix, got none")
    return true_rows


def _true_row(row: TrackRow, at: Truth, frame: LocalFrame, up_m: float) -> TrackRow:
    """The true pose at the time of a fix; a height that is not a number is unknown."""
    east_m, north_m = map(float, frame.enu_from_geodetic(at.lat_deg, at.lon_deg))
    names = ("lat_deg", "lon_deg", "alt_amsl_m", "roll_deg", "pitch_deg", "heading_deg")
    known = {name: getattr(at, name) for name in names} | {"up_m": up_m if math.isfinite(up_m) else None}
    own = {name: getattr(row, name) for name in ("timestamp_ns", "frame", "status")}
    return TrackRow(**own, **known, east_m=east_m, north_m=north_m)
