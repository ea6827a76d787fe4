"""``export``: a finished track in the formats of other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from engine.cli.arguments import check_choice
from engine.errors import OptionError, TelemetryError
from engine.formats.export import WRITERS, segments
from engine.formats.logs.readers import open_truth
from engine.formats.track import TrackRow, read_track
from engine.formats.truth import interpolate_truth
from engine.geo import LocalFrame
from engine.runs.record import read_record


def run_export(
    directory: Path, kind: str, out: Path | None, *, truth: Path | None = None, force: bool = False
) -> dict[str, Any]:
    """Write a track in another format; returns what was written.

    Args:
        directory: the output folder of track.
        kind: one of :data:`engine.formats.export.WRITERS`.
        out: the file; ``track.KIND`` in the folder where None, or ``truth.KIND``.
        truth: write this instead, where it knows the place at the fixes' moments, about the track's origin.
        force: whether the file may be there already.

    Raises:
        OptionError: the format is unknown, or the file is there and ``force`` was not given.
        TelemetryError: the folder holds no track, or the track has no fix.
    """
    check_choice("--format", kind, tuple(WRITERS))
    out = directory / f"{'track' if truth is None else 'truth'}.{kind}" if out is None else out
    if out.is_dir():
        raise OptionError(f"--out: expected a file, but {out} is a folder")
    if out.exists() and not force:
        raise OptionError(f"--out: {out} exists; choose another file, or add --force to replace it")
    rows = read_track(directory / "track.csv")
    if not segments(rows):
        raise TelemetryError(
            f"{directory / 'track.csv'}: expected a track with a fix, got {len(rows)} rows without"
        )
    if truth is not None:
        rows = _at_truth(directory, rows, truth)
    runs = segments(rows)
    text = WRITERS[kind](rows)
    try:
        with out.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
    except OSError as error:
        raise TelemetryError(f"{out}: cannot be written: {error.strerror or error}") from None
    return {"file": str(out), "format": kind, "fixes": sum(map(len, runs)), "segments": len(runs)}


def _at_truth(directory: Path, rows: list[TrackRow], path: Path) -> list[TrackRow]:
    """The rows of the fixes, each where the truth has the vehicle at that moment; those that it knows."""
    origin = read_record(directory / "summary.json").origin
    frame = LocalFrame(origin["lat_deg"], origin["lon_deg"])
    truth = open_truth(path, rows[0].timestamp_ns)
    moved: list[TrackRow] = []
    for row in rows:
        place = interpolate_truth(truth, row.timestamp_ns) if row.fixed and row.timestamp_ns is not None else None
        if place is not None:
            east_m, north_m = map(float, frame.enu_from_geodetic(place.lat_deg, place.lon_deg))
            moved.append(
                replace(
                    row, lat_deg=place.lat_deg, lon_deg=place.lon_deg, east_m=east_m, north_m=north_m, up_m=None
                )
            )
    if not moved:
        raise TelemetryError(f"{path}: expected the truth at the moment of a fix, got none")
    return moved
