"""The results of a run: summary.json and the report page, in the run's folder."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from engine.errors import EngineError, TelemetryError
from engine.matching.matcher import SceneMatcher
from engine.orthomap import OrthoMap
from engine.values import Truth
from scenematch.files.flight import Flight
from scenematch.files.resampling import UTC_FROM_NS
from scenematch.files.track import TrackRow, with_notes
from scenematch.report.explain import explain_frames
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.loop_record import read_loop_csv
from scenematch.report.metrics import summarise
from scenematch.report.page import write_page
from scenematch.runs.output import SILENT, Progress, write_json
from scenematch.runs.record import RunRecord

TRACK, SUMMARY, NOTES, PAGE = "track.csv", "summary.json", "notes.csv", "report.html"
LOOP = "loop.csv"
"""File of a closed loop, besides its track."""
OWNED = (TRACK, SUMMARY, NOTES, PAGE)
"""The files of an output folder."""


@dataclass(frozen=True, slots=True)
class ReportFrames:
    """The frames and the matcher for showing single frames in the report; or None, and why they are missing."""

    flight: Flight | None = None
    matcher: SceneMatcher | None = None
    why_missing: str = "the frames were not kept."


def write_results(
    out: Path,
    rows: list[TrackRow],
    truth: list[Truth] | None,
    site: OrthoMap,
    record: RunRecord,
    frames: ReportFrames,
    *,
    report: bool = True,
    is_to_score: bool = False,
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Write summary.json and, if requested, the report page, replacing older ones.

    Raises:
        TelemetryError: it is only to be scored, and the truth is of other times.
    """
    telemetry = None if frames.flight is None else frames.flight.rows
    summary = summarise(rows, truth, frame=site.frame, ground=record.ground) | {"settings": record.facts()}
    if summary.get("scored_fixes") == 0 and summary["fixes"]:
        fixed = [row.timestamp_ns for row in rows if row.fixed and row.timestamp_ns is not None]
        given = [row.timestamp_ns for row in truth or []]
        text = f"expected a truth at the times of the fixes, {_span(fixed)}, got {_span(given)} in {record.truth}"
        if is_to_score:
            raise TelemetryError(f"truth: {text}")
        progress.message(f"no fix is scored: {text}")
    write_json(out / SUMMARY, summary)
    if report:
        is_loop = "closed_loop" in summary["settings"]  # a loop.csv may be another run's
        loop = read_loop_csv(out / LOOP) if is_loop and (out / LOOP).is_file() else None
        track = FinishedTrack(with_notes(rows, out / NOTES), truth, site, record.ground, summary, telemetry, loop)
        _write_page(out / PAGE, track, frames)
    return summary


def _span(stamps_ns: list[int]) -> str:
    """First and last timestamp as text: dates if UTC, else seconds."""
    if not stamps_ns:
        return "none"
    ends = (min(stamps_ns), max(stamps_ns))
    if ends[0] >= UTC_FROM_NS:
        return " to ".join(f"{datetime.fromtimestamp(ns / 1e9, UTC):%Y-%m-%dT%H:%M:%SZ}" for ns in ends)
    return f"{ends[0] / 1e9:.1f} to {ends[1] / 1e9:.1f} s"


def _write_page(path: Path, track: FinishedTrack, frames: ReportFrames) -> None:
    """Write the report, with some frames matched again if possible."""
    if frames.flight is None or frames.matcher is None:
        return write_page(path, track, why_not=f"No frames are shown: {frames.why_missing}")
    if not track.has_notes:
        return write_page(path, track, why_not=f"No frames are shown: the run left no {NOTES} of its windows.")
    try:
        shown = explain_frames(track, frames.flight, frames.matcher)
    except EngineError as error:
        return write_page(path, track, why_not=f"No frames are shown: {error}")
    return write_page(path, track, shown)
