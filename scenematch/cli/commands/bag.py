"""The command `bag`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console
from scenematch.cli.options import JsonOption


def bag(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Flight folder.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE|DIR", help="One file X.bag, X.mcap or X.db3, or a folder.")
    ],
    kind: Annotated[
        str | None,
        typer.Option(
            "--format", metavar="ros1|ros2-sqlite3|ros2-mcap", help="Without it as the file ends, else ros2-mcap."
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a bag that exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """A flight folder as a bag of ROS 1 or ROS 2.

    With pictures, calibration, telemetry and truth under the names that a camera driver and MAVROS use.
    """
    from scenematch.runs.bag_conversion import convert_to_bag

    facts = convert_to_bag(directory, out, kind, force=force, progress=console.PROGRESS)
    console.facts(facts, as_json, title=f"flight in {directory}")
    flight = console.options(map=directory / "map.tif", frames=out)
    console.next_step(f"track {flight} --out out", as_json=as_json)
