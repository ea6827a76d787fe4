"""The command `track`."""

from __future__ import annotations

from typing import Annotated

from scenematch.cli import console, options, tables
from scenematch.cli.options import EXPERT, option, with_options


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
    as_json: options.JsonOption = False,
) -> None:
    """Track a flight; write track.csv and a report.

    Writes track.csv (one row per frame), summary.json and report.html into the output folder. Without --start the
    flight begins at the telemetry's first position, or anywhere on the map if it has none.

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
    tables.print_summary(summary, as_json, title=title, out=out)
    following = options.after_track(files, out, summary["fixes"], settings=settings, start=start)
    console.next_step(following, as_json=as_json, hint=f"open {out / 'report.html'}")
