"""The commands of `map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from engine.cli import console, tables
from engine.cli.options import (
    ForceOption,
    JsonOption,
    MapBoundsOption,
    MapCrsOption,
    OutOption,
    SurfaceOption,
    ThreadsOption,
    use_threads,
)


def info(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="GeoTIFF, or a picture with a world file.")],
    surface: SurfaceOption = None,
    map_bounds: MapBoundsOption = None,
    map_crs: MapCrsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Size, ground sample distance, CRS, bounds."""
    from engine.runs.inputs import open_map

    site = open_map(map_path, surface, bounds=map_bounds, crs=map_crs, progress=console.PROGRESS)
    console.facts(site.info(), as_json, title=str(map_path))
    place = f"{console.quoted(map_path)} --camera CAMERA --height-agl METRES"
    console.next_step(f"map audit {place} --out audit", as_json=as_json)


def audit(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="GeoTIFF, or a picture with a world file.")],
    out: OutOption,
    surface: SurfaceOption = None,
    map_bounds: MapBoundsOption = None,
    map_crs: MapCrsOption = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", metavar="FILE", help="Calibration; without it 300 x 300 px with 60 degrees."),
    ] = None,
    height_agl_m: Annotated[
        float | None, typer.Option("--height-agl", metavar="M", help="Metres above the ground; 150 unless given.")
    ] = None,
    route: Annotated[
        Path | None,
        typer.Option("--route", metavar="FILE", help="GeoJSON LineString, or a QGroundControl .plan."),
    ] = None,
    around: Annotated[
        str | None,
        typer.Option("--around", metavar="LAT,LON,RADIUS_M", help="Only what lies so near to a place."),
    ] = None,
    corridor_m: Annotated[
        float | None,
        typer.Option("--corridor-m", metavar="M", help="Only what lies so near to the route."),
    ] = None,
    other: Annotated[
        Path | None,
        typer.Option("--other", metavar="FILE", help="The same ground at another date; finds what is stale."),
    ] = None,
    prior_sigma_m: Annotated[
        float, typer.Option("--sigma-m", metavar="M", help="Uncertainty of the position before a match.")
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
    from engine.runs.map_audit import AuditFiles, audit_map

    use_threads(threads)
    files = AuditFiles(
        map=map_path, surface=surface, camera=camera, route=route, other=other, height_agl_m=height_agl_m,
        around=around, corridor_m=corridor_m, map_bounds=map_bounds, map_crs=map_crs,
    )  # fmt: skip
    result = audit_map(files, out, prior_sigma_m=prior_sigma_m, force=force, progress=console.PROGRESS)
    if as_json:
        console.print_json(result.summary)
    else:
        tables.print_audit(result, str(map_path))
        console.say(f"written to {out}")
    files_given = console.options(map=map_path, surface=surface, camera=camera)
    console.next_step(f"track {files_given} --frames FRAMES --out out", as_json=as_json)
