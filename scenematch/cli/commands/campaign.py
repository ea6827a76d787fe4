"""The command `campaign`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console
from scenematch.cli.options import JsonOption


def campaign(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="TOML with the flights and the methods.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder of the campaign; what is finished in it stays.")
    ],
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, metavar="N", help="Runs at a time; one a core unless given.")
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option("--ray", metavar="ADDRESS", help="Work on a Ray cluster; local makes one of this machine."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Do runs again whose inputs have changed, in place of the old ones.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Many flights by several methods, resumable.

    Each flight by each method is a run in a process of its own, with one thread. The same command goes on where an
    earlier one ended, for whatever reason it did.
    """
    from scenematch.report.campaign import POOL_COLUMNS, pool_runs, pooled_cells
    from scenematch.runs.campaign import run_campaign, run_folder

    lines = run_campaign(file, out, workers=workers, ray=ray, force=force, progress=console.PROGRESS)
    if as_json:
        console.print_json([asdict(line) for line in lines])
    else:
        pools = pool_runs(lines)
        for group in dict.fromkeys(pool.group for pool in pools):
            console.print_table(group, POOL_COLUMNS, [pooled_cells(p) for p in pools if p.group == group])
        console.say(f"written to {out}")
    done = [console.quoted(run_folder(out, line)) for line in lines if not line.failure][:2]
    console.next_step(f"report {' '.join(done) or 'RUN'}", as_json=as_json)
    raise typer.Exit(1 if any(line.failure for line in lines) else 0)
