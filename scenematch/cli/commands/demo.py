"""The command `demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from scenematch.cli import console, options, tables
from scenematch.cli.options import OUTPUT, option, with_options


@with_options
def demo(
    out: Annotated[Path, option("--out", "DIR", OUTPUT)] = Path("demo-report"),
    frames: Annotated[int | None, option("--frames", "N", min=2)] = None,
    seed: Annotated[int, option("--seed", "N", min=0)] = 1,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Track a built-in flight with both methods.

    Generates a town and the paper's flight over it, tracks it by NCC and SIFT, each with the paper's recipe and
    with this engine's, and prints the results beside the paper's Table I. Needs no data.

    Options:
        out: Report folder.
        frames: Fly only the first N frames.
        seed: Number of the generated town and flight.
    """
    from scenematch.runs.demo import run_demo

    options.use_threads()
    results = run_demo(out, frames=frames, seed=seed, force=force, progress=console.PROGRESS)
    if as_json:
        console.print_json(results)
    else:
        tables.print_paper_table(results, seed)
    console.say(f"report: {out.resolve()}")
    console.next_step(
        "check --map MAP --frames FRAMES", as_json=as_json, hint=f"open {out}/ncc-engine/report.html"
    )
