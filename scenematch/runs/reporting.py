"""Redraw reports on finished runs: one run's own page, or one page for several runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from engine.errors import OptionError
from engine.orthomap import OrthoMap
from scenematch.files.track import read_track
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.runs_page import MAX_RUNS, write_runs_page
from scenematch.runs.evaluation import evaluate, open_recorded_map
from scenematch.runs.folders import StrPath, check_file
from scenematch.runs.inputs import open_run_truth
from scenematch.runs.progress import SILENT, Progress
from scenematch.runs.record import read_record
from scenematch.runs.results import PAGE, SUMMARY, TRACK, figures_of

COMPARISON = "comparison.html"
"""Default name of the page on several runs."""


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
    write_runs_page(page, {name: _finished(folder, site) for name, folder in runs.items()})


def _finished(folder: Path, site: OrthoMap) -> FinishedTrack:
    """A finished run on a map, with its figures recomputed."""
    rows, record = read_track(folder / TRACK), read_record(folder / SUMMARY)
    truth = open_run_truth(record.truth, rows)
    summary = figures_of(rows, truth, site, record.ground) | {"settings": record.facts()}
    return FinishedTrack(rows, truth, site, record.ground, summary, None)
