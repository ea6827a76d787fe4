"""The command `report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console
from scenematch.cli.options import ForceOption, JsonOption, after_track


def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Output folders of track.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Page on several runs; comparison.html unless given."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Draw the report on finished runs again.

    Of one run its own report.html; of several one page: all tracks on one map and one time axis, and a table.
    """
    from scenematch.files.track import read_track
    from scenematch.runs.evaluation import recorded_files
    from scenematch.runs.record import read_record
    from scenematch.runs.reporting import report as draw_report
    from scenematch.runs.results import SUMMARY, TRACK

    page = draw_report(runs, out, force=force, progress=console.PROGRESS)
    if as_json:
        console.print_json({"report": str(page.resolve()), "runs": [str(run) for run in runs]})
    else:
        console.say(f"written to {page}")
    record, fixes = read_record(runs[0] / SUMMARY), sum(row.fixed for row in read_track(runs[0] / TRACK))
    console.next_step(after_track(recorded_files(record), runs[0], fixes, start=record.start), as_json=as_json)
