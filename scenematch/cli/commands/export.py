"""The command `export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console, options
from scenematch.cli.options import OUTPUT, option, with_options


@with_options
def export(
    directory: Annotated[Path, typer.Argument(metavar="DIR")],
    kind: Annotated[str, option("--format", "gpx|geojson|tum")],
    out: Annotated[Path | None, option("--out", "FILE", OUTPUT)] = None,
    truth: Annotated[Path | None, option("--truth", "FILE")] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Export a finished track as GPX, GeoJSON or TUM.

    Refused frames leave gaps. Times of day are written only if the frames' timestamps are UTC.

    Options:
        directory: Output folder of track.
        kind: What is written.
        out: File to write (default: track.FORMAT in DIR).
        truth: Export this reference at the times of the fixes instead of the track.
    """
    from scenematch.runs.track_export import export_track

    facts = export_track(directory, kind, out, truth=truth, force=force)
    console.facts(facts, as_json, title=f"track in {directory}")
    if kind == "tum" and truth is None:
        console.next_step(f"export {console.quoted(directory)} --format tum --truth TRUTH", as_json=as_json)
    else:
        console.next_step(f"evaluate {console.quoted(directory)} OTHER_RUN", as_json=as_json)
