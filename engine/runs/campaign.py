"""`campaign`: many flights by several methods, a fresh process a run, resumable, told in one table."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib.metadata import version
from pathlib import Path

from engine.cli import console
from engine.cli.arguments import check_folder
from engine.errors import OptionError
from engine.report.campaign import TABLE, TABLE_HEAD, CampaignRow, write_tables
from engine.runs.campaign_plan import RUNS, WORKSHOP, CampaignPlan, plan_campaign
from engine.runs.executors import Execute, in_processes, on_ray
from engine.runs.jobs import Job, do, read_result

MARKER = "scenematch-campaign.txt"
"""Says of a folder, from its begin on, that a campaign works in it: what is unfinished there may be removed."""
_SHOWN = 5  # names in a message


def run_campaign(
    path: Path, out: Path, *, workers: int | None = None, ray: str | None = None, force: bool = False
) -> list[CampaignRow]:
    """Do what is left of a campaign, and write its tables.

    Args:
        path: the campaign's file.
        out: its folder; what is finished in it stays.
        workers: jobs at a time on this machine; None is one a core.
        ray: address of a Ray cluster to work on, "local" for one of this machine.
        force: whether runs whose inputs have changed are done again, in place of the old ones.

    Returns:
        The lines of the table: each run with its figures, or with why it failed.

    Raises:
        OptionError: the file or the folder is none for a campaign, or inputs have changed.
        TelemetryError: what a finished run left is damaged.
        BackendError: there is no Ray, or no cluster.
    """
    plan = plan_campaign(path, out.resolve())
    left = _left(plan, force)
    _prepare(out, list(left.values()), force)
    failures: dict[str, str] = {}
    done = sum(job.name not in left for job in plan.runs)
    console.say(f"{len(plan.runs)} runs, {done} of them finished before")
    runs = [job for job in plan.runs if job.name in left]
    needed = {_flight_of(job) for job in runs}
    if runs:
        with _executor(workers, ray) as execute:
            drawn = [job for job in plan.drawn if job.name in left and job.name in needed]
            failures |= _work(execute, drawn, "flights")
            failures |= _work(execute, [job for job in runs if _flight_of(job) not in failures], "runs")
    lines = [_line(job, plan.groups, failures) for job in plan.runs]
    write_tables(out, lines)
    return lines


def _left(plan: CampaignPlan, force: bool) -> dict[str, Job]:
    """The jobs that are not finished, by name; those that others were finished in place of are named.

    Raises:
        OptionError: there are such, and ``force`` was not given.
    """
    left, changed = {}, []
    for job in (*plan.drawn, *plan.runs):
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
                f"--out: finished of other inputs: {shown}; choose another folder, or add --force to do them again"
            )
        console.say(f"done again, as their inputs have changed: {shown}")
    return left


def _prepare(out: Path, left: Sequence[Job], force: bool) -> None:
    """Make the campaign's folder; of an earlier start what is unfinished leaves it, and what is done again.

    Raises:
        OptionError: the folder is there and is no campaign's, or has somebody's work where ours would be removed.
    """
    if not _is_campaign(out):
        check_folder(out, force)
        if (out / WORKSHOP).exists():
            raise OptionError(
                f"--out: expected a folder without {WORKSHOP}/, which is removed here, as {out} is no campaign's "
                "so far; move it away, or choose another folder"
            )
    (out / RUNS).mkdir(parents=True, exist_ok=True)
    (out / MARKER).write_text(f"A campaign of scenematch {version('scenematch')}.\n", encoding="utf-8")
    shutil.rmtree(out / WORKSHOP, ignore_errors=True)
    (out / WORKSHOP).mkdir()
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


def _work(execute: Execute, jobs: Sequence[Job], what: str) -> dict[str, str]:
    """Do the jobs; those that failed by name, with the reason."""
    failures = {}
    for job, failure in console.progress(execute(do, jobs), len(jobs), what):
        if failure is not None:
            console.say(f"{job.name}: {failure}")
            failures[job.name] = failure
    return failures


def _line(job: Job, groups: dict[str, str], failures: dict[str, str]) -> CampaignRow:
    flight, _, run = job.name.partition("/")
    failure = failures.get(job.name) or failures.get(flight)
    result = None if failure else read_result(job)
    if result is None:
        return CampaignRow(groups[flight], flight, run, None, None, failure)
    return CampaignRow(groups[flight], flight, run, result.figures, result.latency_ms, None)
