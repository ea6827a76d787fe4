"""``compare``: several methods, profiles or settings over one flight, told apart in one table and one chart."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.cli import console
from engine.cli.arguments import check_folder, prepare_folder
from engine.errors import OptionError
from engine.formats.logs.readers import open_truth
from engine.formats.track import read_track
from engine.methods import METHODS
from engine.report.comparison import draw_comparison
from engine.runs.tracking import FlightFiles, Settings, open_inputs, run_track, settings_from

TABLE, CHART = "table.json", "comparison.png"
USUAL = ("ncc/paper", "ncc/engine", "sift/paper", "sift/engine")
"""What is compared unless told: the paper's Table I."""

COLUMNS = ("RMS m", "p50 ms", "p95 ms", "fixed", "false", "NEES", "up m")


@dataclass(frozen=True, slots=True)
class Run:
    """One of the runs that are compared: the name of its folder, and how the flight is followed."""

    name: str
    settings: Settings


def parse_runs(texts: Sequence[str], **given: Any) -> list[Run]:
    """Runs from METHOD, METHOD/PROFILE or a settings file each.

    Args:
        texts: one a run; none of them is :data:`USUAL`.
        given: settings that hold for all of them, where not None.

    Raises:
        OptionError: a text is none of these, or two runs have one name.
    """
    runs = [_run(text, given) for text in texts or USUAL]
    names = [run.name for run in runs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise OptionError(f"--run: expected runs of different names, got {twice!r} twice")
    return runs


def _run(text: str, given: Mapping[str, Any]) -> Run:
    method, slash, profile = text.partition("/")
    if method in METHODS and not Path(text).is_file():
        chosen = {"method": method, "profile": profile} if slash else {"method": method}
        return Run(text.replace("/", "-"), settings_from(None, **given, **chosen))
    if not Path(text).is_file():
        raise OptionError(
            f"--run: expected {', '.join(METHODS)}, one of them with /paper, or a settings file, got {text!r}"
        )
    return Run(Path(text).stem, settings_from(Path(text), **given))


def run_compare(inputs: FlightFiles, out: Path, runs: Sequence[Run], *, force: bool) -> dict[str, dict[str, Any]]:
    """Follow the flight once for each run; every run's folder is as ``track`` writes it.

    The inputs are read and held against every run's settings before the first run begins and before a folder is
    made.

    Returns:
        The summaries by name, which ``table.json`` holds too.
    """
    check_folder(out, force)
    for run in runs:
        check_folder(out / run.name, force)
    opened = open_inputs(inputs, [run.settings for run in runs])
    prepare_folder(out, force, (TABLE, CHART))
    results = {
        run.name: run_track(inputs, out / run.name, run.settings, force=force, opened=opened) for run in runs
    }
    (out / TABLE).write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    tracks = {run.name: read_track(out / run.name / "track.csv") for run in runs}
    path = inputs.find_truth()
    first = next(iter(tracks.values()))
    truth = open_truth(path, first[0].timestamp_ns if first else None) if path is not None else None
    draw_comparison(out / CHART, tracks, truth)
    return results


def print_comparison(results: Mapping[str, Mapping[str, Any]], title: str) -> None:
    """The table, a run a row."""
    rows = [(name, *cells(summary)) for name, summary in results.items()]
    console.print_table(title, ("run", *COLUMNS), rows)


def cells(summary: Mapping[str, Any]) -> tuple[str, ...]:
    """The figures of :data:`COLUMNS`; what is unknown is a dash."""
    latency = summary["latency_ms"]

    def shown(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    return (
        shown(summary.get("rms_m"), "{:.2f}"),
        shown(latency["p50"], "{:.1f}"),
        shown(latency["p95"], "{:.1f}"),
        shown(summary.get("availability"), "{:.1%}"),
        shown(summary.get("false_fixes"), "{}"),
        shown(summary.get("nees_mean"), "{:.2f}"),
        shown(summary.get("height_rms_m"), "{:.2f}"),
    )
