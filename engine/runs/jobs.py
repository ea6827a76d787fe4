"""Jobs of a campaign: a flight that is drawn or followed, in a process of its own, its folder made in one step."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.device import set_threads
from engine.errors import EngineError, TelemetryError
from engine.report.campaign import are_valid_figures, are_valid_latencies
from engine.runs.simulation import WorldSettings, run_simulate
from engine.runs.tracking import FlightFiles, Settings, run_track

RESULT, LOG = "result.json", "log.txt"
_TIMES = ("latency_ms", "deadlines_missed", "settings")
"""What a summary has that another machine, or the same one on another day, has otherwise."""


@dataclass(frozen=True, slots=True)
class Draw:
    """A simulated flight, drawn into its folder."""

    scene: WorldSettings
    frames: int | None

    def work(self, folder: Path) -> dict[str, Any]:
        """Draw it; returns how many frames it has."""
        return {"frames": run_simulate(folder, self.scene, frames=self.frames, force=True)["frames"]}


@dataclass(frozen=True, slots=True)
class Follow:
    """A flight that is followed by one method with its settings."""

    inputs: FlightFiles
    settings: Settings

    def work(self, folder: Path) -> dict[str, Any]:
        """Write track.csv and summary.json; returns those figures of the summary that are no times."""
        summary = run_track(self.inputs, folder, self.settings, force=True, report=False)
        return {name: value for name, value in summary.items() if name not in _TIMES}


@dataclass(frozen=True, slots=True)
class Job:
    """Work that leaves one folder.

    Attributes:
        name: stable from one start of the campaign to the next.
        folder: where the result is; it is there as a whole or not at all.
        workshop: a folder for what is not finished, on the same disk.
        inputs: what the work is made of, by name: hashes and values.
        task: the work.
    """

    name: str
    folder: Path
    workshop: Path
    inputs: dict[str, str]
    task: Draw | Follow


def do(job: Job) -> str | None:
    """Work with one thread, and put the folder in its place when all is in it.

    Returns:
        None, or in one line why the work could not be done. What it had written then stays in the workshop.
    """
    set_threads(1)
    folder = Path(tempfile.mkdtemp(prefix=job.name.replace("/", ".") + ".", dir=job.workshop))
    try:
        with _quietly(folder / LOG):
            figures = job.task.work(folder)
    except (EngineError, OSError) as error:
        return " ".join(str(error).split())
    except Exception as error:  # a fault of ours in one run must not cost the others
        (folder / LOG).write_text(traceback.format_exc(), encoding="utf-8")
        return f"{type(error).__name__}: {' '.join(str(error).split())} (see {folder / LOG})"
    result = {"name": job.name, "inputs": job.inputs, "figures": figures}
    (folder / RESULT).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    _publish(folder, job.folder)
    return None


@contextlib.contextmanager
def _quietly(log: Path) -> Iterator[None]:
    """What would be printed goes to a file: many runs at a time would talk across each other."""
    with (
        log.open("w", encoding="utf-8") as stream,
        contextlib.redirect_stderr(stream),
        contextlib.redirect_stdout(stream),
    ):
        yield


def _publish(folder: Path, target: Path) -> None:
    """Move a finished folder to its place; one that another process finished first stays."""
    folder.chmod(0o755)  # mkdtemp's is for its owner alone
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        folder.rename(target)
    except OSError:
        if not (target / RESULT).is_file():
            raise
        shutil.rmtree(folder)


@dataclass(frozen=True, slots=True)
class Result:
    """What a finished job left.

    Attributes:
        inputs: what it was made of, as :class:`Job` has them.
        figures: of a flight that was followed those of its summary, without times.
        latency_ms: p50, p95, p99 and max of its frames; None of a flight that was drawn.
    """

    inputs: dict[str, str]
    figures: dict[str, Any]
    latency_ms: dict[str, float | None] | None


def read_result(job: Job) -> Result | None:
    """What a finished job left, or None where it has not been done.

    Raises:
        TelemetryError: its folder is there and holds something else, or what it holds is damaged.
    """
    if not job.folder.exists():
        return None
    told = _read(job.folder / RESULT, "inputs", "figures")
    inputs, figures, latency_ms = told["inputs"], told["figures"], None
    whole = isinstance(inputs, dict) and all(isinstance(value, str) for value in inputs.values())
    followed = isinstance(job.task, Follow)
    if not (whole and isinstance(figures, dict) and (not followed or are_valid_figures(figures))):
        raise _damaged(job.folder / RESULT)
    if followed:
        latency_ms = _read(job.folder / "summary.json", "latency_ms")["latency_ms"]
        if not are_valid_latencies(latency_ms):
            raise _damaged(job.folder / "summary.json")
    return Result(inputs, figures, latency_ms)


def _read(path: Path, *names: str) -> dict[str, Any]:
    """Values of a file by name."""
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        return {name: told[name] for name in names}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise _damaged(path) from None


def _damaged(path: Path) -> TelemetryError:
    return TelemetryError(
        f"{path}: expected the result of a run, got something else; without its folder the run is done again"
    )
