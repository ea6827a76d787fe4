"""Campaigns: many flights by several methods, a fresh process a run, resumable, summarised in one table."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib.metadata import version
from pathlib import Path

from engine.errors import OptionError
from scenematch.report.campaign import TABLE, TABLE_HEAD, CampaignRow, write_tables
from scenematch.runs.campaign_plan import RUNS, UNFINISHED, CampaignPlan, plan_campaign
from scenematch.runs.executors import Execute, in_processes, on_ray
from scenematch.runs.folders import StrPath, check_folder
from scenematch.runs.jobs import Job, read_result, run_job
from scenematch.runs.progress import SILENT, Progress

MARKER = "scenematch-campaign.txt"
"""Says of a folder, from its begin on, that a campaign works in it: what is unfinished there may be removed."""
_SHOWN = 5  # names in a message


def run_campaign(
    path: StrPath,
    out: StrPath,
    *,
    workers: int | None = None,
    ray: str | None = None,
    force: bool = False,
    progress: Progress = SILENT,
) -> list[CampaignRow]:
    """Do what is left of a campaign, and write its tables.

    Args:
        path: the campaign's file.
        out: its folder; what is finished in it stays.
        workers: jobs at a time on this machine; None is one a core.
        ray: address of a Ray cluster to work on, "local" for one of this machine.
        force: whether runs whose inputs have changed are done again, in place of the old ones.
        progress: is shown what the campaign does.

    Returns:
        The lines of the table: each run with its figures, or with why it failed.

    Raises:
        OptionError: the file or the folder is none for a campaign, or inputs have changed.
        TelemetryError: what a finished run left is damaged.
        MissingExtraError, BackendError: there is no Ray, or no cluster.
    """
    out = Path(out)
    plan = plan_campaign(Path(path), out.resolve())
    left = _left(plan, force, progress)
    _prepare(out, list(left.values()), force)
    failures: dict[str, str] = {}
    done = sum(job.name not in left for job in plan.runs)
    progress.message(f"{len(plan.runs)} runs, {done} of them finished before")
    runs = [job for job in plan.runs if job.name in left]
    needed = {_flight_of(job) for job in runs}
    if runs:
        with _executor(workers, ray) as execute:
            simulated = [job for job in plan.simulated if job.name in left and job.name in needed]
            failures |= _execute(execute, simulated, "flights", progress)
            possible = [job for job in runs if _flight_of(job) not in failures]
            failures |= _execute(execute, possible, "runs", progress)
    lines = [_line(job, plan.groups, failures) for job in plan.runs]
    write_tables(out, lines)
    return lines


def _left(plan: CampaignPlan, force: bool, progress: Progress) -> dict[str, Job]:
    """The jobs that are not finished, by name; those that others were finished in place of are named.

    Raises:
        OptionError: there are such, and ``force`` was not given.
    """
    left, changed = {}, []
    for job in (*plan.simulated, *plan.runs):
        result = read_result(job)
        if result is not None and result.inputs == job.inputs:
            continue
        left[job.name] = job
        if result is not None:
            names = sorted(set(result.inputs.items()) ^ set(job.inputs.items()))
            changed.append(f"{job.name} ({', '.join(dict(names))})")
    if changed:
        shown = ", ".join(changed[:_SHOWN]) + (f" and {len(changed) - _SHOWN} more" if changed[_SHOWN:] else "")
        if not force:
            raise OptionError(
                f"out: finished of other inputs: {shown}; choose another folder, or add `force` to do them again"
            )
        progress.message(f"done again, as their inputs have changed: {shown}")
    return left


def _prepare(out: Path, left: Sequence[Job], force: bool) -> None:
    """Create the campaign's folder; of an earlier start what is unfinished leaves it, and what is done again.

    Raises:
        OptionError: the folder is there and is no campaign's, or has somebody's work where ours would be removed.
    """
    if not _is_campaign(out):
        check_folder(out, force)
        if (out / UNFINISHED).exists():
            raise OptionError(
                f"out: expected a folder without {UNFINISHED}/, which is removed here, as {out} is no campaign's "
                "so far; move it away, or choose another folder"
            )
    (out / RUNS).mkdir(parents=True, exist_ok=True)
    (out / MARKER).write_text(f"A campaign of scenematch {version('scenematch-engine')}.\n", encoding="utf-8")
    shutil.rmtree(out / UNFINISHED, ignore_errors=True)
    (out / UNFINISHED).mkdir()
    for job in left:
        if job.folder.exists():
            shutil.rmtree(job.folder)


def _is_campaign(out: Path) -> bool:
    """Whether a campaign has worked in a folder: by its marker, or by its table where that was copied without."""
    if (out / MARKER).is_file():
        return True
    try:
        with (out / TABLE).open(encoding="utf-8") as file:
            return file.readline().rstrip("\n") == ",".join(TABLE_HEAD)
    except (OSError, ValueError):
        return False


def _executor(workers: int | None, ray: str | None) -> AbstractContextManager[Execute]:
    if ray is not None:
        return on_ray(ray, workers)
    return in_processes(workers or os.cpu_count() or 1)


def _flight_of(job: Job) -> str:
    return job.name.partition("/")[0]


def _execute(execute: Execute, jobs: Sequence[Job], description: str, progress: Progress) -> dict[str, str]:
    """Do the jobs; those that failed by name, with the reason."""
    failures = {}
    for job, failure in progress.track(execute(run_job, jobs), len(jobs), description):
        if failure is not None:
            progress.message(f"{job.name}: {failure}")
            failures[job.name] = failure
    return failures


def run_folder(out: Path, line: CampaignRow) -> Path:
    """The folder of a run in that of its campaign."""
    return out / RUNS / line.flight / line.run


def _line(job: Job, groups: dict[str, str], failures: dict[str, str]) -> CampaignRow:
    flight, _, run = job.name.partition("/")
    failure = failures.get(job.name) or failures.get(flight)
    result = None if failure else read_result(job)
    if result is None:
        return CampaignRow(groups[flight], flight, run, None, None, failure)
    return CampaignRow(groups[flight], flight, run, result.figures, result.latency_ms, None)
