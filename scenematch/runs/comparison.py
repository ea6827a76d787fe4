"""Compare methods, profiles or settings on one flight: a folder for each run, one table and one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from engine.errors import OptionError
from engine.matching import METHODS
from scenematch.report.runs_page import MAX_RUNS
from scenematch.runs.evaluation import COMPARISON, draw_together
from scenematch.runs.inputs import FlightFiles, open_inputs
from scenematch.runs.output import SILENT, Progress, StrPath, check_folder, prepare_folder, write_json
from scenematch.runs.settings import TrackSettings, load_settings
from scenematch.runs.tracking import track

TABLE = "table.json"
DEFAULT_RUNS = ("ncc/paper", "ncc/engine", "sift/paper", "sift/engine")
"""The default runs: both methods, each in both profiles, as in the paper's Table I."""


def parse_runs(
    texts: Sequence[str] = (), *, settings: Sequence[StrPath] = (), **overrides: Any
) -> dict[str, TrackSettings]:
    """Settings by run name; each run is given as METHOD, METHOD/PROFILE or a settings file.

    Args:
        texts: one for each run; none means :data:`DEFAULT_RUNS`.
        settings: for all runs, files or NAME=VALUE; a run's own file takes precedence.
        overrides: settings for all runs; None is ignored.

    Raises:
        OptionError: a text is none of these, or two runs have the same name.
    """
    texts = texts or DEFAULT_RUNS
    runs: dict[str, TrackSettings] = {}
    for text in texts:
        name, parsed = _parse_run(text, settings, overrides)
        if name in runs:
            raise OptionError(f"runs: expected runs of different names, got {name!r} twice")
        runs[name] = parsed
    return runs


def _parse_run(text: str, settings: Sequence[StrPath], overrides: Mapping[str, Any]) -> tuple[str, TrackSettings]:
    method, slash, profile = text.partition("/")
    if method in METHODS and not Path(text).is_file():
        chosen: dict[str, Any] = {"method": method, "profile": profile} if slash else {"method": method}
        return text.replace("/", "-"), load_settings(*settings, **overrides, **chosen)
    if not Path(text).is_file():
        raise OptionError(
            f"runs: expected {', '.join(METHODS)}, one of them with /paper, or a settings file, got {text!r}"
        )
    return Path(text).stem, load_settings(*settings, text, **overrides)


def compare(
    files: FlightFiles,
    out: StrPath,
    runs: Mapping[str, TrackSettings] | None = None,
    *,
    force: bool = False,
    progress: Progress = SILENT,
) -> dict[str, dict[str, Any]]:
    """Track the flight once for each run; each run has the folder that :func:`scenematch.track` writes.

    The inputs are read and checked against every run's settings before the first run begins and before a folder
    is created.

    Args:
        files: of the flight.
        out: the folder, with one subfolder for each run.
        runs: settings by run name; None means :data:`DEFAULT_RUNS`.
        force: whether the folders may already exist.
        progress: receives progress and messages.

    Returns:
        The summaries by name, which ``table.json`` holds too.

    Raises:
        OptionError, TelemetryError, CalibrationError, MapError: an argument or a file is invalid.
    """
    out, runs = Path(out), parse_runs() if runs is None else runs
    check_folder(out, force)
    for name in runs:
        check_folder(out / name, force)
    inputs = open_inputs(files, list(runs.values()), progress=progress)
    prepare_folder(out, force, (TABLE, COMPARISON))
    results = {
        name: track(files, out / name, settings, force=force, inputs=inputs, diagnosis=False, progress=progress)
        for name, settings in runs.items()
    }
    write_json(out / TABLE, results)
    if len(runs) <= MAX_RUNS:  # the page has no colours for more
        draw_together(out / COMPARISON, {name: out / name for name in runs}, progress=progress)
    return results
