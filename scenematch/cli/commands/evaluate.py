"""The command `evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from engine.errors import OptionError
from scenematch.cli import console, options, tables
from scenematch.cli.options import OUTPUT, option, with_options


@with_options
def evaluate(
    runs: Annotated[list[Path], typer.Argument(metavar="DIR")],
    truth: Annotated[Path | None, option("--truth", "FILE")] = None,
    out: Annotated[Path | None, option("--out", "FILE", OUTPUT)] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Score finished tracks and redraw their reports.

    For one run: prints the errors and rewrites summary.json and report.html in its folder. For several: draws one
    page with all tracks on one map and one time axis, and a table.

    Options:
        runs: Output folders of track.
        truth: truth.csv, log or photographs (default: the one that track used).
        out: Page that compares several runs (default: comparison.html).
    """
    from scenematch.runs.evaluation import evaluate as evaluate_track
    from scenematch.runs.evaluation import recorded_files
    from scenematch.runs.record import read_record
    from scenematch.runs.reporting import report
    from scenematch.runs.results import PAGE, SUMMARY

    if len(runs) == 1 and out is None:
        summary = evaluate_track(runs[0], truth, force=force, progress=console.PROGRESS)
        tables.print_summary(summary, as_json, title=f"track in {runs[0]}", out=runs[0])
        record = read_record(runs[0] / SUMMARY)
        following = options.after_track(recorded_files(record), runs[0], summary["fixes"], start=record.start)
        console.next_step(following, as_json=as_json, hint=f"open {runs[0] / PAGE}")
        return
    if truth is not None:
        raise OptionError("truth: expected with one run only")
    page = report(runs, out, force=force, progress=console.PROGRESS)
    if as_json:
        console.print_json({"report": str(page.resolve()), "runs": [str(run) for run in runs]})
    else:
        console.say(f"written to {page}")
    console.next_step(f"export {console.quoted(runs[0])} --format geojson", as_json=as_json, hint=f"open {page}")
