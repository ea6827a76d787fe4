"""The command `evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from engine.cli import console, tables
from engine.cli.options import JsonOption


def evaluate(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder of track.")],
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="FILE", help="truth.csv; without it the one that track used.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score a finished track against truth.

    Prints the errors and rewrites the folder's summary.json and figures.
    """
    from engine.runs.evaluation import evaluate as evaluate_track

    summary = evaluate_track(directory, truth, progress=console.PROGRESS)
    tables.print_summary(summary, as_json, title=f"track in {directory}", out=directory)
    page = f"open {directory / 'report.html'}"
    console.next_step(f"export {console.quoted(directory)} --format tum", as_json=as_json, hint=page)
