"""The command `evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console, tables
from scenematch.cli.options import JsonOption, flight_options


def evaluate(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder of track.")],
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="FILE", help="truth.csv, log or photographs; else track's."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score a finished track against truth.

    Prints the errors and rewrites the folder's summary.json and report.
    """
    from scenematch.runs.evaluation import evaluate as evaluate_track
    from scenematch.runs.evaluation import recorded_files
    from scenematch.runs.record import read_record
    from scenematch.runs.results import SUMMARY

    summary = evaluate_track(directory, truth, progress=console.PROGRESS)
    tables.print_summary(summary, as_json, title=f"track in {directory}", out=directory)
    page = f"open {directory / 'report.html'}"
    following = f"export {console.quoted(directory)} --format tum"
    if not summary["fixes"]:
        record = read_record(directory / SUMMARY)
        following = f"check {flight_options(recorded_files(record), start=record.start)}"
    console.next_step(following, as_json=as_json, hint=page)
