"""``export``: a finished track in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from engine.cli.arguments import check_choice
from engine.errors import OptionError, TelemetryError
from engine.formats.export import WRITERS, segments
from engine.formats.track import read_track


def run_export(directory: Path, kind: str, out: Path | None, *, force: bool = False) -> dict[str, Any]:
    """Write a track in another format; returns what was written.

    Args:
        directory: the output folder of track.
        kind: one of :data:`engine.formats.export.WRITERS`.
        out: the file; ``track.KIND`` in the folder where None.
        force: whether the file may be there already.

    Raises:
        OptionError: the format is unknown, or the file is there and ``force`` was not given.
        TelemetryError: the folder holds no track, or the track has no fix.
    """
    check_choice("--format", kind, tuple(WRITERS))
    out = directory / f"track.{kind}" if out is None else out
    if out.is_dir():
        raise OptionError(f"--out: expected a file, but {out} is a folder")
    if out.exists() and not force:
        raise OptionError(f"--out: {out} exists; choose another file, or add --force to replace it")
    rows = read_track(directory / "track.csv")
    runs = segments(rows)
    if not runs:
        raise TelemetryError(
            f"{directory / 'track.csv'}: expected a track with a fix, got {len(rows)} rows without"
        )
    text = WRITERS[kind](rows)
    try:
        with out.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
    except OSError as error:
        raise TelemetryError(f"{out}: cannot be written: {error.strerror or error}") from None
    return {"file": str(out), "format": kind, "fixes": sum(map(len, runs)), "segments": len(runs)}
