"""The command `track`."""

from __future__ import annotations

from typing import Annotated

from scenematch.cli import console, tables
from scenematch.cli.options import (
    EXPERT,
    CorrectOption,
    DeviceOption,
    FlightOptions,
    ForceOption,
    JsonOption,
    MethodOption,
    OutOption,
    RerunOption,
    SettingsOption,
    StartOption,
    after_track,
    live_view,
    option,
    read_settings,
    with_options,
)


@with_options
def track(
    flight: FlightOptions,
    out: OutOption,
    correct: CorrectOption = None,
    start: StartOption = None,
    method: MethodOption = None,
    profile: Annotated[str | None, option("--profile", "engine|paper", EXPERT)] = None,
    device: DeviceOption = None,
    budget_ms: Annotated[float | None, option("--budget-ms", "MS", EXPERT)] = None,
    settings: SettingsOption = None,
    rerun: RerunOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Track a flight; write track.csv and a report.

    Writes track.csv (one row per frame), summary.json and report.html into the output folder. Without --start the
    flight begins at the telemetry's first position, or anywhere on the map if it has none.

    Options:
        profile: paper: the paper's own recipe for ncc or sift (default: engine).
        budget_ms: Longest time per frame; later answers are refused.
    """
    from scenematch.runs.tracking import track as track_flight

    given = read_settings(settings)
    files = flight.files(given, correct)
    how = given.track(method=method, profile=profile, device=device, start=start, budget_ms=budget_ms)
    summary = track_flight(files, out, how, force=force, live_view=live_view(rerun), progress=console.PROGRESS)
    title = f"{how.method} ({how.profile} profile) on {flight.frames}"
    tables.print_summary(summary, as_json, title=title, out=out)
    following = after_track(files, out, summary["fixes"], settings=settings, start=start)
    console.next_step(following, as_json=as_json, hint=f"open {out / 'report.html'}")
