"""The commands on a flight: `check`, `track` and `compare`; on its results: `evaluate` and `export`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from engine.errors import OptionError
from scenematch.cli import console, options, tables
from scenematch.cli.options import EXPERT, OUTPUT, option, with_options


@with_options
def check(
    flight: options.FlightOptions,
    correct: options.CorrectOption = None,
    start: options.StartOption = None,
    settings: options.SettingsOption = None,
) -> None:
    """Find errors in a flight's inputs.

    Locates a few pictures on the map, relying on the telemetry as little as possible, then reports which change of
    unit, sign, offset, mount, focal length or clock would make it agree with them. Takes the same files as track.
    """
    from scenematch.runs.checking import as_rows, diagnose_flight

    given = options.read_settings(settings)
    files = flight.files(given, correct)
    names = given.track().telemetry_columns
    found = diagnose_flight(files, start, columns=names, progress=console.PROGRESS)
    if not console.answered_as_json(asdict(found)):
        rows = as_rows(found, corrected=not files.corrections.changes_nothing)
        console.print_pairs(f"check of {flight.frames}", rows)
    console.next_step("track --out out", hint="with the same files")


@with_options
def track(
    flight: options.FlightOptions,
    out: options.OutOption,
    correct: options.CorrectOption = None,
    start: options.StartOption = None,
    method: options.MethodOption = None,
    profile: Annotated[str | None, option("--profile", "engine|paper", EXPERT)] = None,
    device: options.DeviceOption = None,
    budget_ms: Annotated[float | None, option("--budget-ms", "MS", EXPERT)] = None,
    settings: options.SettingsOption = None,
    rerun: options.RerunOption = None,
    force: options.ForceOption = False,
) -> None:
    """Track a flight; write track.csv and a report.

    Writes track.csv (one row per frame), summary.json and report.html into the output folder. Without --start each
    frame is searched about the position in its telemetry; if there is none, the flight may begin anywhere.

    Options:
        profile: paper: the paper's own recipe for ncc or sift (default: engine).
        budget_ms: Longest time per frame; later answers are refused.
    """
    from scenematch.runs.tracking import track as track_flight

    given = options.read_settings(settings)
    files = flight.files(given, correct)
    how = given.track(method=method, profile=profile, device=device, start=start, budget_ms=budget_ms)
    shown = options.live_view(rerun)
    summary = track_flight(files, out, how, force=force, live_view=shown, progress=console.PROGRESS)
    title = f"{how.method} ({how.profile} profile) on {flight.frames}"
    tables.print_summary(summary, title=title, out=out)


@with_options
def compare(
    flight: options.FlightOptions,
    out: options.OutOption,
    runs: Annotated[list[str] | None, option("--run", "METHOD[/PROFILE]|FILE")] = None,
    start: options.StartOption = None,
    settings: options.SettingsOption = None,
    force: options.ForceOption = False,
) -> None:
    """Compare methods or settings on one flight.

    Tracks the flight once per run, each into its own folder, and compares the runs in one table and on one page.
    --settings applies to all runs; a run's own file takes precedence.

    Options:
        runs: One run; repeat for more (default: ncc and sift, each in both profiles).
    """
    from scenematch.runs.comparison import compare as compare_runs
    from scenematch.runs.comparison import parse_runs
    from scenematch.runs.evaluation import COMPARISON

    given = options.read_settings(settings)
    parsed = parse_runs(runs or [], settings=settings or (), start=start)
    results = compare_runs(flight.files(given), out, parsed, force=force, progress=console.PROGRESS)
    if not console.answered_as_json(results):
        tables.print_comparison(results, str(flight.frames))
        console.say(f"written to {out}")
    drawn = out / COMPARISON if (out / COMPARISON).is_file() else out
    hint = f"open {console.quoted(drawn)}; with the same files"
    console.next_step("track --out out", hint=hint)


@with_options
def evaluate(
    runs: Annotated[list[Path], typer.Argument(metavar="DIR")],
    truth: Annotated[Path | None, option("--truth", "FILE")] = None,
    out: Annotated[Path | None, option("--out", "FILE", OUTPUT)] = None,
    force: options.ForceOption = False,
) -> None:
    """Score finished tracks and redraw their reports.

    For one run: prints the errors and rewrites summary.json and report.html in its folder. For several: draws one
    page with all tracks on one map and one time axis, and a table.

    Options:
        runs: Output folders of track.
        truth: truth.csv, log or photographs, for one run (default: the one that track used).
        out: Page that compares several runs (default: comparison.html).
        force: Replace an existing page; for one run, let its report lose pictures that no longer exist.
    """
    from scenematch.runs.evaluation import evaluate as evaluate_track
    from scenematch.runs.evaluation import report

    if len(runs) == 1 and out is None:
        summary = evaluate_track(runs[0], truth, force=force, progress=console.PROGRESS)
        tables.print_summary(summary, title=f"track in {runs[0]}", out=runs[0])
        return
    if truth is not None:
        raise OptionError("truth: expected with one run only")
    page = report(runs, out, force=force, progress=console.PROGRESS)
    if not console.answered_as_json({"report": str(page.resolve()), "runs": [str(run) for run in runs]}):
        console.say(f"written to {page}")
    console.next_step(f"export {console.quoted(runs[0])} --format geojson", hint=f"open {page}")


@with_options
def export(
    directory: Annotated[Path, typer.Argument(metavar="DIR")],
    kind: Annotated[str, option("--format", "gpx|geojson|tum")],
    out: Annotated[Path | None, option("--out", "FILE", OUTPUT)] = None,
    truth: Annotated[Path | None, option("--truth", "FILE")] = None,
    force: options.ForceOption = False,
) -> None:
    """Export a finished track as GPX, GeoJSON or TUM.

    Refused frames leave gaps. Times of day are written only if the frames' timestamps are UTC.

    Options:
        directory: Output folder of track.
        kind: What is written.
        out: File to write (default: in DIR, track.FORMAT or, with --truth, truth.FORMAT).
        truth: Export this reference at the times of the fixes instead of the track.
    """
    from scenematch.runs.track_export import export_track

    facts = export_track(directory, kind, out, truth=truth, force=force)
    console.facts(facts, title=f"track in {directory}")
    console.next_step(f"evaluate {console.quoted(directory)} OTHER_RUN")
