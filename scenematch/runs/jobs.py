"""Jobs of a campaign: a flight that is simulated or tracked, in a process of its own, its folder in one step."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from engine.errors import EngineError, TelemetryError
from engine.runtime.threads import set_threads
from scenematch.report.campaign import are_valid_figures, are_valid_latencies
from scenematch.runs.inputs import FlightFiles
from scenematch.runs.progress import Progress
from scenematch.runs.settings import TrackSettings
from scenematch.runs.simulation import WorldSettings, simulate
from scenematch.runs.tracking import track

RESULT, LOG = "result.json", "log.txt"
_TIMES = ("latency_ms", "deadlines_missed", "settings")
"""What a summary has that another machine, or the same one on another day, has otherwise."""


@dataclass(frozen=True, slots=True)
class SimulateTask:
    """A flight that is simulated into its folder."""

    world: WorldSettings
    frames: int | None

    def run(self, folder: Path, progress: Progress) -> dict[str, Any]:
        """Simulate it; returns how many frames it has."""
        facts = simulate(folder, self.world, frames=self.frames, force=True, progress=progress)
        return {"frames": facts["frames"]}


@dataclass(frozen=True, slots=True)
class TrackTask:
    """A flight that is tracked by one method with its settings."""

    files: FlightFiles
    settings: TrackSettings

    def run(self, folder: Path, progress: Progress) -> dict[str, Any]:
        """Write track.csv and summary.json; returns those figures of the summary that are no times."""
        summary = track(
            self.files, folder, self.settings, force=True, report=False, diagnosis=False, progress=progress
        )
        return {name: value for name, value in summary.items() if name not in _TIMES}


@dataclass(frozen=True, slots=True)
class Job:
    """Work that leaves one folder.

    Attributes:
        name: stable from one start of the campaign to the next.
        folder: where the result is; it is there as a whole or not at all.
        unfinished: a folder for what is not finished, on the same disk.
        inputs: what the work is made of, by name: hashes and values.
        task: the work.
    """

    name: str
    folder: Path
    unfinished: Path
    inputs: dict[str, str]
    task: SimulateTask | TrackTask


def run_job(job: Job) -> str | None:
    """Work with one thread, and put the folder in its place when all is in it.

    Returns:
        None, or in one line why the work could not be done. What it had written then stays in ``unfinished``.
    """
    set_threads(1)
    folder = Path(tempfile.mkdtemp(prefix=job.name.replace("/", ".") + ".", dir=job.unfinished))
    try:
        with _logged(folder / LOG) as progress:
            figures = job.task.run(folder, progress)
    except (EngineError, OSError) as error:
        return " ".join(str(error).split())
    except Exception as error:  # a fault of ours in one run must not cost the others
        (folder / LOG).write_text(traceback.format_exc(), encoding="utf-8")
        return f"{type(error).__name__}: {' '.join(str(error).split())} (see {folder / LOG})"
    result = {"name": job.name, "inputs": job.inputs, "figures": figures}
    (folder / RESULT).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    _publish(folder, job.folder)
    return None


class _Log(Progress):
    """Writes messages to a file."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def message(self, text: str) -> None:
        self._stream.write(f"{' '.join(text.split())}\n")
        self._stream.flush()


@contextlib.contextmanager
def _logged(log: Path) -> Iterator[Progress]:
    """A run's messages, and what libraries print, go to a file: those of many runs at a time would mix."""
    with (
        log.open("w", encoding="utf-8") as stream,
        contextlib.redirect_stderr(stream),
        contextlib.redirect_stdout(stream),
    ):
        yield _Log(stream)


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
        figures: of a flight that was tracked those of its summary, without times.
        latency_ms: p50, p95, p99 and max of its frames; None of a flight that was simulated.
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
    values = _read(job.folder / RESULT, "inputs", "figures")
    inputs, figures, latency_ms = values["inputs"], values["figures"], None
    whole = isinstance(inputs, dict) and all(isinstance(value, str) for value in inputs.values())
    tracked = isinstance(job.task, TrackTask)
    if not (whole and isinstance(figures, dict) and (not tracked or are_valid_figures(figures))):
        raise _damaged(job.folder / RESULT)
    if tracked:
        latency_ms = _read(job.folder / "summary.json", "latency_ms")["latency_ms"]
        if not are_valid_latencies(latency_ms):
            raise _damaged(job.folder / "summary.json")
    return Result(inputs, figures, latency_ms)


def _read(path: Path, *names: str) -> dict[str, Any]:
    """Values of a file by name."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        return {name: values[name] for name in names}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise _damaged(path) from None


def _damaged(path: Path) -> TelemetryError:
    return TelemetryError(
        f"{path}: expected the result of a run, got something else; without its folder the run is done again"
    )
