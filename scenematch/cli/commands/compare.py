"""The command `compare`."""

from __future__ import annotations

from typing import Annotated

from scenematch.cli import console, options, tables
from scenematch.cli.options import option, with_options


@with_options
def compare(
    flight: options.FlightOptions,
    out: options.OutOption,
    runs: Annotated[list[str] | None, option("--run", "METHOD[/PROFILE]|FILE")] = None,
    start: options.StartOption = None,
    settings: options.SettingsOption = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Compare methods or settings on one flight.

    Tracks the flight once per run, each into its own folder, and compares the runs in one table and on one page.
    --settings applies to all runs; a run's own file takes precedence.

    Options:
        runs: One run; repeat for more (default: the paper's Table I).
    """
    from scenematch.runs.comparison import compare as compare_runs
    from scenematch.runs.comparison import parse_runs
    from scenematch.runs.reporting import COMPARISON

    given = options.read_settings(settings)
    parsed = parse_runs(runs or [], settings=settings or (), start=start)
    files = flight.files(given)
    results = compare_runs(files, out, parsed, force=force, progress=console.PROGRESS)
    if as_json:
        console.print_json(results)
    else:
        tables.print_comparison(results, str(flight.frames))
        console.say(f"written to {out}")
    drawn = out / COMPARISON if (out / COMPARISON).is_file() else out
    following = f"track {options.flight_options(files, settings=settings, start=start)} --out out"
    console.next_step(following, as_json=as_json, hint=f"open {console.quoted(drawn)}")
