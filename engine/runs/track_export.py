"""Exporting a finished track in the formats of other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from engine.errors import TelemetryError
from engine.formats.export import WRITERS, segments
from engine.formats.logs.readers import open_truth
from engine.formats.track import TrackRow, read_track
from engine.formats.truth import interpolate_truth
from engine.geo import LocalFrame
from engine.runs.arguments import check_choice
from engine.runs.folders import StrPath, check_file
from engine.runs.record import read_record
from engine.runs.results import SUMMARY, TRACK


def export_track(
    folder: StrPath, kind: str, out: StrPath | None = None, *, truth: StrPath | None = None, force: bool = False
) -> dict[str, Any]:
    """Write a track in another format.

    Args:
        folder: of a finished run.
        kind: one of :data:`engine.formats.export.WRITERS`.
        out: the file; ``track.KIND`` in the folder where None, or ``truth.KIND``.
        truth: write this instead, where it knows the position at the times of the fixes, about the track's origin.
        force: whether the file may be there already.

    Returns:
        What was written.

    Raises:
        OptionError: the format is unknown, or the file is there and ``force`` was not given.
        TelemetryError: the folder holds no track, or the track has no fix.
    """
    folder = Path(folder)
    check_choice("kind", kind, tuple(WRITERS))
    out = folder / f"{'track' if truth is None else 'truth'}.{kind}" if out is None else Path(out)
    check_file(out, force)
    rows = read_track(folder / TRACK)
    if not segments(rows):
        raise TelemetryError(f"{folder / TRACK}: expected a track with a fix, got {len(rows)} rows without")
    if truth is not None:
        rows = _at_truth(folder, rows, Path(truth))
    parts = segments(rows)
    text = WRITERS[kind](rows)
    try:
        with out.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
    except OSError as error:
        raise TelemetryError(f"{out}: cannot be written: {error.strerror or error}") from None
    return {"file": str(out), "format": kind, "fixes": sum(map(len, parts)), "segments": len(parts)}


def _at_truth(folder: Path, rows: list[TrackRow], path: Path) -> list[TrackRow]:
    """The rows of the fixes, each at the true position of that time, where the truth knows it."""
    origin = read_record(folder / SUMMARY).origin
    frame = LocalFrame(origin["lat_deg"], origin["lon_deg"])
    truth = open_truth(path, rows[0].timestamp_ns)
    true_rows: list[TrackRow] = []
    for row in rows:
        at = interpolate_truth(truth, row.timestamp_ns) if row.fixed and row.timestamp_ns is not None else None
        if at is not None:
            east_m, north_m = map(float, frame.enu_from_geodetic(at.lat_deg, at.lon_deg))
            true_rows.append(
                replace(row, lat_deg=at.lat_deg, lon_deg=at.lon_deg, east_m=east_m, north_m=north_m, up_m=None)
            )
    if not true_rows:
        raise TelemetryError(f"{path}: expected the truth at the moment of a fix, got none")
    return true_rows
