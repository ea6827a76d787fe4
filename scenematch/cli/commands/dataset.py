"""The commands of `dataset`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from engine.errors import OptionError
from scenematch.cli import console, tables
from scenematch.cli.argument_names import as_typed
from scenematch.cli.options import ForceOption, JsonOption, OutOption, SurfaceOption


def import_dataset(
    kind: Annotated[
        str, typer.Argument(metavar="NAME", help="uav-visloc, wildnav, vpair, alto, anyvisloc, ortholoc.")
    ],
    root: Annotated[Path, typer.Argument(metavar="DIR", help="The unpacked data set.")],
    out: OutOption,
    part: Annotated[
        str | None,
        typer.Option("--part", metavar="NAME", help="Sequence, split or scene of a data set that has several."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", metavar="FILE", help="Calibration: ROS camera_info, OpenCV's or Kalibr's."),
    ] = None,
    hfov_deg: Annotated[
        float | None,
        typer.Option("--hfov-deg", metavar="DEG", help="Horizontal field of view, in place of a calibration."),
    ] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", metavar="FILE", help="A map in place of the data set's.")
    ] = None,
    surface: SurfaceOption = None,
    gsd_m: Annotated[
        float | None,
        typer.Option("--gsd-m", metavar="M", help="Of alto: pixel of the pictures that make the map."),
    ] = None,
    datum: Annotated[
        str | None,
        typer.Option("--height-is", metavar="agl|amsl|ellipsoid", help="What the heights are counted from."),
    ] = None,
    ground_m: Annotated[
        float | None, typer.Option("--ground-m", metavar="M", help="Level of the ground, counted from the same.")
    ] = None,
    interval_s: Annotated[
        float | None, typer.Option("--interval-s", metavar="S", help="Time between pictures without times.")
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option("--reference", metavar="aerial|satellite", help="Of anyvisloc: which of its maps."),
    ] = None,
    max_tilt_deg: Annotated[
        float | None,
        typer.Option("--max-tilt-deg", metavar="DEG", help="Of single photographs, off nadir; 30 unless given."),
    ] = None,
    limit: Annotated[
        int | None, typer.Option("--limit", min=1, metavar="N", help="Of single photographs, evenly spread.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """A published data set as a flight folder.

    Links its pictures, composes its map, and says what could not be known and what is doubtful about its
    truth. Single photographs become flights of one frame each, with a campaign's file that lists them.
    """
    import scenematch
    from scenematch.runs.dataset_import import PHOTOGRAPHS

    of_flights = {
        "camera": camera, "hfov_deg": hfov_deg, "map": map_path, "surface": surface, "gsd_m": gsd_m,
        "datum": datum, "ground_m": ground_m, "interval_s": interval_s,
    }  # fmt: skip
    of_photographs: dict[str, Any] = {"reference": reference, "max_tilt_deg": max_tilt_deg, "limit": limit}
    for name, value in (of_flights if kind in PHOTOGRAPHS else of_photographs).items():
        if value is not None:
            raise OptionError(f"{name}: expected none with {kind}, got {value}")
    if kind in PHOTOGRAPHS:
        given = {name: value for name, value in of_photographs.items() if value is not None}
        choice = scenematch.PhotographOptions(part=part, **given)
        facts = scenematch.import_photographs(kind, root, out, choice, force=force, progress=console.PROGRESS)
    else:
        if (camera is None) == (hfov_deg is None):
            raise OptionError("camera, hfov_deg: expected one of the two")
        options = scenematch.ImportOptions(
            camera=camera if camera is not None else float(hfov_deg or 0.0),
            map=map_path,
            surface=surface,
            datum=datum,
            ground_m=ground_m,
            interval_s=interval_s,
        )
        facts = scenematch.import_dataset(
            kind, root, out, options, part=part, gsd_m=gsd_m, force=force, progress=console.PROGRESS
        )
        facts["notes"] = [as_typed(note) for note in facts["notes"]]
    shown = {name: value for name, value in facts.items() if as_json or name not in ("notes", "findings")}
    console.facts(shown, as_json, title=f"{kind} from {root}")
    if kind in PHOTOGRAPHS:
        console.next_step(f"campaign {console.quoted(out / 'campaign.toml')} --out out", as_json=as_json)
    else:
        console.next_step(f"dataset check {console.quoted(out)}", as_json=as_json)


def check(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Flight folder with a truth.csv.")],
    max_speed_mps: Annotated[
        float, typer.Option("--max-speed-mps", min=0.1, metavar="V", help="That the vehicle can fly over ground.")
    ] = 70.0,
    as_json: JsonOption = False,
) -> None:
    """What is doubtful about a flight's truth.

    Exits with 1 where something was found.
    """
    from scenematch.runs.dataset_import import check_flight

    findings = check_flight(directory, max_speed_mps)
    if as_json:
        console.print_json([asdict(finding) for finding in findings])
    else:
        tables.print_findings(findings, f"truth of {directory}")
    flight = console.options(map=directory / "map.tif", frames=directory / "frames")
    more = console.options(camera=directory / "camera.yaml", telemetry=directory / "telemetry.csv")
    console.next_step(f"track {flight} {more} --out out", as_json=as_json)
    raise typer.Exit(1 if findings else 0)
