"""The command `check`."""

from __future__ import annotations

from dataclasses import asdict

from scenematch.cli import console, options
from scenematch.cli.options import with_options


@with_options
def check(
    flight: options.FlightOptions,
    correct: options.CorrectOption = None,
    start: options.StartOption = None,
    settings: options.SettingsOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Find errors in a flight's inputs.

    Locates a few pictures on the map without using the telemetry, then reports which change of unit, sign, offset,
    mount, focal length or clock would make the telemetry agree with them. Takes the same files as track.
    """
    from scenematch.runs.checking import as_rows, diagnose_flight

    given = options.read_settings(settings)
    files = flight.files(given, correct)
    names = given.track().telemetry_columns
    found = diagnose_flight(files, start, columns=names, progress=console.PROGRESS)
    if as_json:
        console.print_json(asdict(found))
    else:
        rows = as_rows(found, corrected=not files.corrections.changes_nothing)
        console.print_pairs(f"check of {flight.frames}", rows)
    following = options.flight_options(files, settings=settings, start=start)
    console.next_step(f"track {following} --out out", as_json=as_json)
