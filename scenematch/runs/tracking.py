"""Track a flight: pass its frames through the navigator, and write track.csv, summary.json and a report."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from engine.budget import Budget
from engine.errors import EngineError, TelemetryError
from engine.geo import wrap_difference_deg
from engine.navigation.navigator import Navigator
from engine.values import Fix, NoFix, Prior, Reason
from engine.window import SPREAD_SIGMAS
from scenematch.files.flight import FlightFrame
from scenematch.files.settings import changed
from scenematch.files.telemetry import TelemetryRow, ground_amsl_m
from scenematch.files.track import TrackRow, read_track, track_row, write_notes, write_track
from scenematch.runs.arguments import parse_budget, parse_position
from scenematch.runs.checking import as_rows, diagnose_flight
from scenematch.runs.inputs import FlightFiles, FlightInputs, open_inputs
from scenematch.runs.live_viewing import NO_LIVE_VIEW, LiveViewTarget, open_view
from scenematch.runs.output import SILENT, Progress, StrPath, check_folder, prepare_folder
from scenematch.runs.record import PATHS, RunRecord
from scenematch.runs.results import NOTES, OWNED, TRACK, ReportFrames, write_results
from scenematch.runs.settings import TrackSettings

if TYPE_CHECKING:  # rerun is optional
    from scenematch.report.live_view import LiveView

# Shares of frames that are as they should be: below the first the inputs are checked, below the second what the
# check says is always kept.
_CHECKED_SHARE, _FEW_SHARE = 0.9, 0.5


def track(
    files: FlightFiles,
    out: StrPath,
    settings: TrackSettings | None = None,
    *,
    force: bool = False,
    report: bool = True,
    diagnosis: bool = True,
    live_view: LiveViewTarget = NO_LIVE_VIEW,
    inputs: FlightInputs | None = None,
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Track a flight and write the output folder.

    The inputs are checked before the output folder is created; of a video only the first picture is.

    Args:
        files: files of the flight.
        out: the folder, created by this run.
        settings: of the run; None uses the defaults.
        force: whether the folder may already exist.
        report: whether to draw the page; :func:`scenematch.runs.evaluation.evaluate` can draw it later.
        diagnosis: whether to check the inputs if few frames were fixed, or few show the stated heading.
        live_view: where to send the live view.
        inputs: the inputs, if :func:`scenematch.runs.inputs.open_inputs` has already read them.
        progress: receives progress and messages.

    Returns:
        The contents of summary.json.

    Raises:
        OptionError, TelemetryError, CalibrationError, MapError: an argument or a file is invalid.
    """
    out, settings = Path(out), settings or TrackSettings()
    check_folder(out, force)
    live_view.check(force=force)
    start, budget = parse_position("start", settings.start), parse_budget("budget_ms", settings.budget_ms)
    inputs = inputs or open_inputs(files, [settings], progress=progress)
    site, flight = inputs.site, inputs.flight
    matcher = settings.matcher(site, inputs.camera)
    with progress.task("compiling") as report_compiled:
        matcher.warmup(report_compiled)
    prepare_folder(out, force, OWNED)
    navigator = Navigator(matcher, start, budget, settings.acceptance)
    description = f"{settings.method}, {settings.profile} profile"
    frames = progress.track(flight, len(flight), description)
    with open_view(matcher, live_view) as view:
        answered = _answered(frames, navigator, budget, use_priors=start is None, view=view)
        answers = write_track(out / TRACK, answered)
        write_notes(out / NOTES, answers)
    # From the rows in the file, so that evaluate gives the same figures.
    rows, shown = read_track(out / TRACK), ReportFrames(flight, matcher)
    record = _record(files, settings, inputs, str(matcher.device))
    what, share = _worst_share(answers, flight.rows, settings.acceptance.heading_bias_deg)
    if diagnosis and settings.profile == "engine" and share < _CHECKED_SHARE:
        progress.message(f"{share:.0%} of the frames {what}: looking for errors in the inputs")
        record = replace(record, diagnosis=_diagnosis(files, settings, inputs, share, progress))
    return write_results(out, rows, inputs.truth, site, record, shown, report=report, progress=progress)


def _fixed_share(rows: Sequence[TrackRow]) -> float:
    """The share of frames fixed, without late ones, which say nothing about the inputs."""
    answered = [row for row in rows if row.reason != Reason.LATE.value]
    return sum(row.fixed for row in answered) / len(answered) if answered else 1.0


def _worst_share(
    answers: Sequence[TrackRow], telemetry: Sequence[TelemetryRow], bias_deg: float
) -> tuple[str, float]:
    """The share of frames that were fixed, or of those that show the stated heading, whichever is smaller."""
    stated_deg = {row.timestamp_ns: row.heading_deg for row in telemetry if row.heading_deg is not None}
    off_deg = [
        abs(wrap_difference_deg(row.heading_deg - stated_deg[row.timestamp_ns]))
        for row in answers
        if row.heading_deg is not None and row.timestamp_ns in stated_deg
    ]
    agreeing = sum(off <= SPREAD_SIGMAS * bias_deg for off in off_deg) / len(off_deg) if off_deg else 1.0
    return min(
        ("were fixed", _fixed_share(answers)), ("show the stated heading", agreeing), key=lambda each: each[1]
    )


def _diagnosis(
    files: FlightFiles, settings: TrackSettings, inputs: FlightInputs, share: float, progress: Progress
) -> dict[str, str]:
    """Errors found in the inputs; none if the check fails, which must not lose the track."""
    try:
        found = diagnose_flight(files, settings.start, inputs=inputs, progress=progress)
    except (EngineError, MemoryError, KeyboardInterrupt):
        return {}
    if not found.findings and share >= _FEW_SHARE:
        return {}
    return dict(as_rows(found, corrected=not files.corrections.changes_nothing))


def _record(files: FlightFiles, settings: TrackSettings, inputs: FlightInputs, device: str) -> RunRecord:
    """The record of a run, for summary.json."""
    given = files.flat() | {"truth": inputs.truth_path}
    for name in PATHS:
        given[name] = None if given[name] is None else str(Path(given[name]).resolve())
    given |= {"log_offset_s": files.log_offset_s or None, "every": files.every if files.every > 1 else None}
    return RunRecord(
        **given,
        heights=dict(inputs.flight.heights),
        method=settings.method,
        profile=settings.profile,
        device=device,
        start=settings.start,
        budget_ms=settings.budget_ms,
        changed=changed(settings),
        origin=inputs.site.frame,
        ground_m=inputs.site.ground_m,
        ground_amsl_m=ground_amsl_m(inputs.flight.rows),
        surface_datum=inputs.site.surface_datum,
    )


def _answered(
    frames: Iterable[FlightFrame],
    navigator: Navigator,
    budget: Budget | None,
    *,
    use_priors: bool,
    view: LiveView | None = None,
) -> Iterator[TrackRow]:
    """Pass every frame through the navigator.

    Args:
        frames: in their order.
        navigator: fresh.
        budget: of each frame.
        use_priors: whether to use the telemetry's own positions; a given start replaces them.
        view: receives each frame once it is answered and its row is taken.
    """
    for index, item in enumerate(frames):
        prior = item.prior if use_priors else None
        begin = time.perf_counter()
        result = _update(navigator, item, prior)
        latency_ms = (time.perf_counter() - begin) * 1e3
        met = None if budget is None else latency_ms <= budget.total_ms
        state = navigator.state
        yield track_row(item.name, result, latency_ms=latency_ms, deadline_met=met, state=state.value)
        if view is not None:
            view.show(index, item.name, item.frame, result, state, latency_ms)


def _update(navigator: Navigator, item: FlightFrame, prior: Prior | None) -> Fix | NoFix:
    """The frame's result; an error in mid-flight names the frame and does not count as wrong usage."""
    try:
        return navigator.update(item.frame, prior)
    except EngineError as error:
        raise TelemetryError(f"frame {item.name}: {error}") from error
