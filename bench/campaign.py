"""Many flights by several methods, each run `scenematch track` in a process of its own; resumable, one table.

    python -m bench.campaign PLAN.toml --out DIR [--workers N]

The plan gives options of `track` and `simulate` by their names, a list for one that is given several times; paths
are as seen from where this is started::

    [runs.ncc]                      # by what the flights are followed
    method = "ncc"
    [runs.sift-paper]
    method = "sift"
    profile = "paper"
    settings = ["navigator.odometry=true"]
    [flights.campus]                # a flight folder
    folder = "flights/campus"
    [flights.valley]                # other files; flights of one group are pooled
    map = "site.tif"
    frames = "flight.mp4"
    telemetry = "log.ulg"
    truth = "log.ulg"
    group = "survey of May"
    [simulated]                     # every seed in every condition, and other options of `simulate`
    seeds = [1, 2, 3]
    conditions = ["noon", "haze"]
    frames = 60

A folder is moved to its place when it is complete, and what is complete is not done again: the same command goes
on where an earlier one ended. A run that fails is in the table with its reason, and is tried again next time.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.accuracy.truth import pooled
from bench.pages.text import percent, table_of
from scenematch.runs.inputs import FOLDER_LAYOUT

RUNS, FLIGHTS, UNFINISHED = "runs", "flights", "unfinished"


@dataclass(frozen=True)
class Job:
    """A command that fills one folder."""

    name: str
    group: str
    folder: Path
    arguments: tuple[str, ...]


def jobs_of(plan: Mapping[str, Any], out: Path) -> tuple[list[Job], list[Job]]:
    """The flights to be simulated, and the runs."""
    simulated = dict(plan.get("simulated", {}))
    seeds, conditions = simulated.pop("seeds", []), simulated.pop("conditions", ["noon"])
    flights = {name: dict(given) for name, given in plan.get("flights", {}).items()}
    made = []
    for condition in conditions:
        for seed in seeds:
            name, group = f"town-{seed}-{condition}", f"simulated {condition}"
            arguments = options({"seed": seed, "condition": condition, **simulated})
            made.append(Job(name, group, out / FLIGHTS / name, ("simulate", *arguments)))
            flights[name] = {"folder": str(out / FLIGHTS / name), "group": group}
    runs = []
    for name, given in flights.items():
        group, folder = given.pop("group", name), given.pop("folder", None)
        files = {} if folder is None else {key: f"{folder}/{file}" for key, file in FOLDER_LAYOUT.items()}
        for run, how in plan["runs"].items():
            arguments = options({**files, **given, **how})
            runs.append(Job(f"{name}/{run}", group, out / RUNS / name / run, ("track", *arguments)))
    return made, runs


def options(given: Mapping[str, Any]) -> list[str]:
    """Options of the command line; true is a flag, "none" leaves one out, a list repeats it."""
    words = []
    for name, value in given.items():
        option = f"--{name.replace('_', '-')}"
        if value is True:
            words.append(option)
        elif value not in (False, "none"):
            words += [f"{option}={each}" for each in (value if isinstance(value, list) else [value])]
    return words


def done(job: Job, unfinished: Path) -> str | None:
    """Do a job that is not done; why it failed, else None."""
    if job.folder.exists():
        return None
    folder = unfinished / job.name.replace("/", ".")
    shutil.rmtree(folder, ignore_errors=True)
    # A surface model and truth are optional in a flight folder.
    given = [a for a in job.arguments if not (a.startswith(("--surface=", "--truth=")) and not _is_there(a))]
    command = [sys.executable, "-m", "scenematch", *given, f"--out={folder}"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode:
        return ended.stderr.strip().rpartition("\n")[2].removeprefix("scenematch: ") or f"exit {ended.returncode}"
    job.folder.parent.mkdir(parents=True, exist_ok=True)
    folder.rename(job.folder)
    return None


def _is_there(argument: str) -> bool:
    return Path(argument.partition("=")[2]).exists()


def do_all(jobs: Sequence[Job], unfinished: Path, workers: int) -> Iterator[tuple[Job, str | None]]:
    """Each job with why it failed, in order."""
    with ThreadPoolExecutor(workers) as pool:  # threads wait for processes
        yield from zip(jobs, pool.map(lambda job: done(job, unfinished), jobs), strict=True)


def page(runs: Sequence[Job], failures: Mapping[str, str]) -> str:
    """Markdown: every group's runs pooled, each fix counting alike, every run, and what failed."""
    found = (("frames", "frames", "d"), ("fixed", "availability", percent), ("RMS m", "rms_m", ".2f"))
    wrong = (("false", "false_fixes", "d"), ("off > 10 m", "wrong_over_10m", "d"))
    columns = (*found, ("worst RMS m", "worst_rms_m", ".2f"), *wrong)
    figures = {job: _figures(job) for job in runs if job.name not in failures}
    lines = ["# Campaign", ""]
    for group in dict.fromkeys(job.group for job in runs):
        by_run: dict[str, list[dict[str, Any]]] = {}
        for job, one in figures.items():
            if job.group == group:
                by_run.setdefault(job.name.partition("/")[2], []).append(one)
        rows = [{"run": name, **pooled(each)} for name, each in by_run.items()]
        lines += [f"## {group}", "", *table_of(rows, ("run", "run", "s"), ("flights", "tracks", "d"), *columns)]
    every = [dict(zip(("flight", "run"), job.name.split("/"), strict=True), **pooled([one]))
             for job, one in figures.items()]  # fmt: skip
    lines += ["## Every run", "", *table_of(every, ("flight", "flight", "s"), ("run", "run", "s"), *columns)]
    lines += ["## Failed", "", *(f"- {name}: {why}" for name, why in failures.items()), ""] if failures else []
    return "\n".join(lines)


def _figures(job: Job) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((job.folder / "summary.json").read_text(encoding="utf-8"))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    given = parser.parse_args()
    made, runs = jobs_of(tomllib.loads(given.plan.read_text(encoding="utf-8")), given.out)
    (given.out / UNFINISHED).mkdir(parents=True, exist_ok=True)
    failures: dict[str, str] = {}
    for jobs in (made, runs):
        for job, failure in do_all(jobs, given.out / UNFINISHED, given.workers):
            print(f"{job.name}: {failure or 'done'}", file=sys.stderr)
            if failure:
                failures[job.name] = failure
    text = page(runs, failures)
    (given.out / "campaign.md").write_text(text, encoding="utf-8")
    print(text)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
