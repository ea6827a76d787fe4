"""The demo: the built-in flight, tracked by both methods in both profiles, beside the paper's figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scenematch.runs.comparison import TABLE, compare, parse_runs
from scenematch.runs.output import SILENT, Progress, StrPath, check_folder, prepare_folder
from scenematch.runs.simulation import write_flight
from scenematch.simulator import plan_flight

PAPER_TABLE = {"ncc": (2.4, 40.0), "sift": (2.1, 121.0)}
"""Table I of the paper: RMS error in metres and execution time in milliseconds."""
OWNED = (TABLE, "flight/frames/[0-9]*.jpg")


def run_demo(
    out: StrPath,
    *,
    frames: int | None = None,
    seed: int = 1,
    force: bool = False,
    progress: Progress = SILENT,
) -> dict[str, dict[str, Any]]:
    """Fly and match; the folder contains the flight and the output of :func:`scenematch.runs.comparison.compare`.

    Args:
        out: the folder.
        frames: number of frames to fly; None is all.
        seed: of town, path, sensors and camera.
        force: whether the folder may already exist.
        progress: receives progress and messages.

    Returns:
        The summaries by the name of their run, such as "ncc-paper".

    Raises:
        OptionError: an argument is invalid.
    """
    out = Path(out)
    check_folder(out, force)
    progress.message("drawing the town and the flight over it")
    plan = plan_flight(seed, frames=frames)
    prepare_folder(out, force, OWNED)
    files = write_flight(out / "flight", plan, progress=progress)
    return compare(files, out, parse_runs(), force=True, progress=progress)
