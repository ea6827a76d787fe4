"""Score finished tracks again, and redraw their reports: one run's own page, or one page for several runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from engine.errors import EngineError, OptionError, TelemetryError
from engine.orthomap import OrthoMap
from scenematch.files.settings import nested, options_from_mapping
from scenematch.files.track import TrackRow, read_track
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.metrics import summarise
from scenematch.report.page import shows_frames
from scenematch.report.runs_page import MAX_RUNS, write_runs_page
from scenematch.runs.cameras import CameraInput
from scenematch.runs.inputs import FlightFiles, open_run_truth
from scenematch.runs.map_input import MapInput
from scenematch.runs.output import SILENT, Progress, StrPath, check_file
from scenematch.runs.record import RunRecord, read_record
from scenematch.runs.results import PAGE, SUMMARY, TRACK, ReportFrames, write_results
from scenematch.runs.settings import TrackSettings

COMPARISON = "comparison.html"
"""Default name of the page on several runs."""


def evaluate(
    folder: StrPath, truth: StrPath | None = None, *, force: bool = False, progress: Progress = SILENT
) -> dict[str, Any]:
    """Score a finished track again, if there is truth, and rewrite its summary and page from its own record.

    Args:
        folder: folder of a finished run.
        truth: truth.csv, a log or a folder of photographs; None uses the run's own.
        force: allow the page to lose pictures that no longer exist; not needed with another truth.
        progress: receives progress and messages.

    Returns:
        The summary.

    Raises:
        TelemetryError: the folder holds no finished track, or the given truth is of other times.
        OptionError: the page would lose its frames.
    """
    folder = Path(folder)
    rows = read_track(folder / TRACK)
    record = read_record(folder / SUMMARY)
    path = record.truth if truth is None else truth
    truth_rows = open_run_truth(path, rows, progress)
    site = open_recorded_map(record, progress)
    frames = _report_frames(record, rows, site)
    if frames.flight is None and shows_frames(folder / PAGE):
        if truth is None and not force:
            raise OptionError(
                f"runs: {folder / PAGE} shows frames, which redrawing would lose; add `force` to do it anyway; "
                f"{frames.why_missing}"
            )
        progress.message(f"{folder / PAGE} loses the frames that it shows: {frames.why_missing}")
    if path is not None:
        record = replace(record, truth=str(Path(path).resolve()))
    is_to_score = truth is not None
    return write_results(
        folder, rows, truth_rows, site, record, frames, is_to_score=is_to_score, progress=progress
    )


def open_recorded_map(record: RunRecord, progress: Progress = SILENT) -> OrthoMap:
    """The map of a finished run."""
    return MapInput(**{each.name: getattr(record, each.name) for each in fields(MapInput)}).open(progress)


def _report_frames(record: RunRecord, rows: list[TrackRow], site: OrthoMap) -> ReportFrames:
    """The flight and matcher of a finished run, if its record and files still provide them."""
    try:
        values = {"method": record.method, "profile": record.profile} | dict(record.changed)
        settings = options_from_mapping(TrackSettings, nested(values))
        files = recorded_files(record)
        flight = files.open_flight(settings.telemetry_columns)
        stamps = [row.timestamp_ns for row in flight.rows]
        recorded = [row.timestamp_ns for row in rows if row.timestamp_ns is not None]
        if (stamps, flight.names) != (recorded, [row.frame for row in rows]):
            return ReportFrames(why_missing="the frames or their telemetry have changed since the run.")
        camera = files.load_camera(flight)
        return ReportFrames(flight, settings.matcher(site, camera))
    except (EngineError, OSError) as error:
        return ReportFrames(why_missing=f"{error}.")


def recorded_files(record: RunRecord) -> FlightFiles:
    """The files of a finished run.

    Raises:
        TelemetryError: the record does not name the frames.
        OptionError: the files that it names do not fit together.
    """
    if record.frames is None:
        raise TelemetryError("the record of the run lacks its frames")
    names = {each.name for kind in (MapInput, CameraInput, FlightFiles) for each in fields(kind)} - {"truth"}
    values = {name: getattr(record, name) for name in names & {each.name for each in fields(RunRecord)}}
    unset = {"log_offset_s": record.log_offset_s or 0.0, "every": record.every or 1}
    return FlightFiles.from_flat(**values | unset | {"corrections": record.corrections})


def report(
    folders: Sequence[StrPath], out: StrPath | None = None, *, force: bool = False, progress: Progress = SILENT
) -> Path:
    """Draw the report on finished runs.

    Args:
        folders: one run, whose page is rewritten, or several, drawn on the first one's map.
        out: the page on several runs; None is ``comparison.html`` in the working directory.
        force: allow that file to exist; for one run, allow its page to lose frames that no longer exist.
        progress: receives progress and messages.

    Returns:
        The page.

    Raises:
        OptionError: there are too many runs, one is given twice, ``out`` is given with one run or is in no folder,
            or a page would lose its frames.
        TelemetryError: a folder holds no finished track.
    """
    runs = [Path(folder) for folder in folders]
    if len(runs) == 1:
        if out is not None:
            raise OptionError(f"out: expected none with one run, whose page is {runs[0] / PAGE}")
        evaluate(runs[0], force=force, progress=progress)
        return runs[0] / PAGE
    page = Path(COMPARISON if out is None else out)
    check_file(page, force)
    if not page.parent.is_dir():  # before the runs are drawn
        raise OptionError(f"out: expected a file in a folder that exists, got {page}")
    draw_together(page, run_names(runs), progress=progress)
    return page


def run_names(folders: Sequence[Path]) -> dict[str, Path]:
    """Folders by the shortest ends of their paths that tell them apart.

    Raises:
        OptionError: there are fewer than two or too many, or two are the same.
    """
    resolved = [folder.resolve() for folder in folders]
    if not 2 <= len(set(resolved)) == len(resolved) <= MAX_RUNS:
        raise OptionError(f"runs: expected up to {MAX_RUNS} different folders, got {', '.join(map(str, folders))}")
    parts = 1
    while len({path.parts[-parts:] for path in resolved}) < len(resolved):
        parts += 1
    return {"/".join(path.parts[-parts:]): folder for path, folder in zip(resolved, folders, strict=True)}


def draw_together(page: Path, runs: dict[str, Path], *, progress: Progress = SILENT) -> None:
    """Write the page on several finished runs.

    Args:
        page: the file, replaced if it exists.
        runs: folders by the names of their runs.
        progress: receives progress and messages.
    """
    records = {name: read_record(folder / SUMMARY) for name, folder in runs.items()}
    first, *others = records
    for other in others:
        if records[other].map != records[first].map:
            progress.message(f"{other} used another map, {records[other].map}; it is drawn on that of {first}")
    site = open_recorded_map(records[first], progress)
    write_runs_page(page, {name: _finished(folder, site, records[name]) for name, folder in runs.items()})


def _finished(folder: Path, site: OrthoMap, record: RunRecord) -> FinishedTrack:
    """A finished run on a map, with its figures recomputed."""
    rows = read_track(folder / TRACK)
    truth = open_run_truth(record.truth, rows)
    summary = summarise(rows, truth, frame=site.frame, ground=record.ground) | {"settings": record.facts()}
    return FinishedTrack(rows, truth, site, record.ground, summary)
