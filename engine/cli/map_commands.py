"""The commands of `map`: what each takes, and whom it calls."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from engine.cli import console
from engine.cli.options import (
    ForceOption,
    JsonOption,
    OutOption,
    SurfaceOption,
    ThreadsOption,
    use_threads,
)


def info(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="GeoTIFF, or a picture with a world file.")],
    surface: SurfaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Size, ground sample distance, CRS, bounds."""
    from engine.cli.arguments import open_map

    console.facts(open_map(map_path, surface).info(), as_json, title=str(map_path))


def audit(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="GeoTIFF, or a picture with a world file.")],
    out: OutOption,
    surface: SurfaceOption = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", metavar="FILE", help="Calibration; without it 300 x 300 px with 60 degrees."),
    ] = None,
    height_agl: Annotated[
        float | None, typer.Option("--height-agl", metavar="M", help="Metres above the ground; 150 unless told.")
    ] = None,
    route: Annotated[
        Path | None,
        typer.Option("--route", metavar="FILE", help="GeoJSON LineString, or a QGroundControl .plan."),
    ] = None,
    around: Annotated[
        str | None,
        typer.Option("--around", metavar="LAT,LON,RADIUS_M", help="Only what lies so near to a place."),
    ] = None,
    corridor: Annotated[
        float | None,
        typer.Option("--corridor-m", metavar="M", help="Only what lies so near to the route."),
    ] = None,
    other: Annotated[
        Path | None,
        typer.Option("--other", metavar="FILE", help="The same ground at another date; finds what is stale."),
    ] = None,
    sigma: Annotated[
        float, typer.Option("--sigma-m", metavar="M", help="How well the position is known before a match.")
    ] = 10.0,
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Where frames can be matched, and where not.

    Writes matchability.tif (probability of a fix by NCC), audit.png and summary.json. With --route the
    availability along it is predicted, and its poor stretches are listed. A huge map is audited in part: around a
    place, along the route, or both.
    """
    from engine.runs.map_audit import AuditFiles, run_audit

    use_threads(threads)
    inputs = AuditFiles(map_path, surface, camera, route, other, height_agl, around, corridor)
    run_audit(inputs, out, sigma_m=sigma, force=force, as_json=as_json)
