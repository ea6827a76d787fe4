"""The commands of `dataset`: what each takes, and whom it calls."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from engine.cli import console
from engine.cli.options import ForceOption, JsonOption, OutOption, SurfaceOption
from engine.errors import OptionError


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
        Path | None, typer.Option("--camera", metavar="FILE", help="Calibration, a ROS camera_info YAML file.")
    ] = None,
    hfov: Annotated[
        float | None,
        typer.Option("--hfov-deg", metavar="DEG", help="Horizontal field of view, in place of a calibration."),
    ] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", metavar="FILE", help="A map in place of the data set's.")
    ] = None,
    surface: SurfaceOption = None,
    gsd: Annotated[
        float | None,
        typer.Option("--gsd-m", metavar="M", help="Of alto: pixel of the pictures that make the map."),
    ] = None,
    height_is: Annotated[
        str | None,
        typer.Option("--height-is", metavar="agl|amsl|ellipsoid", help="What the heights are counted from."),
    ] = None,
    ground: Annotated[
        float | None, typer.Option("--ground-m", metavar="M", help="Level of the ground, counted from the same.")
    ] = None,
    interval: Annotated[
        float | None, typer.Option("--interval-s", metavar="S", help="Time between pictures without times.")
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option("--reference", metavar="aerial|satellite", help="Of anyvisloc: which of its maps."),
    ] = None,
    max_tilt: Annotated[
        float | None,
        typer.Option("--max-tilt-deg", metavar="DEG", help="Of single photographs, off nadir; 30 unless told."),
    ] = None,
    limit: Annotated[
        int | None, typer.Option("--limit", min=1, metavar="N", help="Of single photographs, evenly spread.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """A published data set as a flight folder.

    Links its pictures, lays its map together, and says what could not be known and what is doubtful about its
    truth. Single photographs become flights of one frame each, with a campaign's file that lists them.
    """
    from engine.formats.datasets.sequence import ImportOptions
    from engine.runs.dataset_import import SINGLES, Choice, run_import, run_import_singles

    of_singles = {"reference": reference, "max_tilt_deg": max_tilt, "limit": limit}
    added = {
        "camera": camera, "hfov_deg": hfov, "map": map_path, "surface": surface, "gsd_m": gsd,
        "height_is": height_is, "ground_m": ground, "interval_s": interval,
    }  # fmt: skip
    for name, value in (added if kind in SINGLES else of_singles).items():
        if value is not None:
            raise OptionError(f"--{name.replace('_', '-')}: expected none with {kind}, got {value}")
    if kind in SINGLES:
        choice = Choice(
            part=part,
            reference=reference or "aerial",
            max_tilt_deg=30.0 if max_tilt is None else max_tilt,
            limit=limit,
        )
        facts = run_import_singles(kind, root, out, choice, force=force)
    else:
        if (camera is None) == (hfov is None):
            raise OptionError("--camera, --hfov-deg: expected one of the two")
        told = ImportOptions(
            camera=camera if camera is not None else float(hfov or 0.0),
            map=map_path,
            surface=surface,
            datum=height_is,
            ground_m=ground,
            interval_s=interval,
        )
        facts = run_import(kind, root, out, told, part=part, gsd_m=gsd, force=force)
    shown = {name: value for name, value in facts.items() if as_json or name not in ("notes", "findings")}
    console.facts(shown, as_json, title=f"{kind} from {root}")


def check(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Flight folder with a truth.csv.")],
    max_speed: Annotated[
        float, typer.Option("--max-speed-mps", min=0.1, metavar="V", help="That the vehicle can fly over ground.")
    ] = 70.0,
    as_json: JsonOption = False,
) -> None:
    """What is doubtful about a flight's truth.

    Exits with 1 where something was found.
    """
    from engine.runs.dataset_import import check_flight, print_findings

    findings = check_flight(directory, max_speed)
    if as_json:
        console.print_json([asdict(finding) for finding in findings])
    else:
        print_findings(findings, f"truth of {directory}")
    raise typer.Exit(1 if findings else 0)
