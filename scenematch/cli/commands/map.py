"""The commands of `map`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console, options, tables
from scenematch.cli.options import EXPERT, MAP, OUTPUT, flag, option, with_options

MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="GeoTIFF, or a picture with a world file.")]


@with_options
def info(
    map_path: MapArgument,
    surface: options.SurfaceOption = None,
    map_bounds: Annotated[str | None, option("--map-bounds", "W,S,E,N", MAP)] = None,
    map_crs: Annotated[str | None, option("--map-crs", "EPSG:N", MAP)] = None,
) -> None:
    """Show size, ground sample distance, CRS and bounds.

    For a picture without georeference --map-bounds and --map-crs say where it lies; other commands take them as
    --settings input.map_bounds=W,S,E,N and --settings input.map_crs=EPSG:N.

    Options:
        map_bounds: Bounds of a picture without georeference, in degrees or in --map-crs.
        map_crs: CRS, if the map names none.
    """
    from scenematch.runs.map_input import MapInput

    source = MapInput(map_path, surface=surface, map_bounds=map_bounds, map_crs=map_crs)
    console.facts(source.open(console.PROGRESS).info(), title=str(map_path))
    place = f"{console.quoted(map_path)} --camera CAMERA --height-agl METRES"
    console.next_step(f"map audit {place} --out audit")


@with_options
def audit(
    map_path: MapArgument,
    out: options.OutOption,
    surface: options.SurfaceOption = None,
    camera: Annotated[Path | None, option("--camera", "FILE")] = None,
    height_agl_m: Annotated[float | None, option("--height-agl", "M")] = None,
    route: Annotated[Path | None, option("--route", "FILE")] = None,
    around: Annotated[str | None, option("--around", "LAT,LON,RADIUS_M")] = None,
    corridor_m: Annotated[float | None, option("--corridor-m", "M")] = None,
    settings: options.SettingsOption = None,
    force: options.ForceOption = False,
) -> None:
    """Predict where frames can be matched.

    Writes matchability.tif (probability of a fix by NCC), audit.png and summary.json. With --route it also
    predicts availability along the route and lists poor stretches. Audit a huge map in part: around a place, along
        the route, or both.

    Options:
        camera: Calibration file (default: 300 x 300 px with a 60 degree field of view).
        height_agl_m: Metres above the ground (default: 150).
        route: GeoJSON LineString, or a QGroundControl .plan.
        around: Audit only this circle.
        corridor_m: Audit only this distance to either side of the route.
    """
    from scenematch.runs.map_audit import AuditFiles, audit_map
    from scenematch.runs.map_input import MapInput

    given = options.read_settings(settings)
    site = MapInput(map_path, surface=surface, **options.table(given, "input").of(MapInput))
    files = AuditFiles(
        map=site, camera=camera, route=route, height_agl_m=height_agl_m, around=around, corridor_m=corridor_m
    )
    result = audit_map(files, out, options.table(given, "audit"), force=force, progress=console.PROGRESS)
    if not console.answered_as_json(result.summary):
        tables.print_audit(result, str(map_path))
        console.say(f"written to {out}")
    console.next_step(f"track --map {console.quoted(map_path)} --frames FRAMES --out out")


@dataclass(frozen=True, kw_only=True)
class WantedMap:
    """What is fetched.

    Attributes:
        around: Centre of the map, or a folder of photographs with positions.
        source: Tiles as https://host/{z}/{x}/{y}.png, a WMS or a WMTS.
        radius_m: Least distance from the centre to each edge (for photographs by default what they cover).
        gsd_m_per_px: Coarsest resolution (default: 0.5, or what the photographs need).
        layer: Layer, if a WMS or WMTS has several.
        surface: Surface model to fetch too; {lat} and {lon} stand for each degree, such as N48 and E016.
    """

    around: Annotated[str, option("--around", "LAT,LON|DIR")]
    source: Annotated[str, option("--source", "URL")]
    radius_m: Annotated[float | None, option("--radius-m", "M")] = None
    gsd_m_per_px: Annotated[float | None, option("--gsd-m-per-px", "M")] = None
    layer: Annotated[str | None, option("--layer", "NAME")] = None
    surface: Annotated[str | None, option("--surface", "FILE|URL")] = None


@with_options
def fetch(
    what: WantedMap,
    out: Annotated[Path, option("--out", "FILE", OUTPUT)],
    settings: options.SettingsOption = None,
    dry_run: Annotated[bool, flag("--dry-run", EXPERT)] = False,
    force: options.ForceOption = False,
) -> None:
    """Fetch a map from a server that you name.

    Sends one request at a time. If interrupted, run the same command again to resume. The server's terms decide
    what you may fetch, keep and use.

    Options:
        out: The map, a GeoTIFF.
        dry_run: Show what would be fetched, then exit.
    """
    from scenematch.runs.map_fetch import fetch_map

    given = asdict(what) | {"dry_run": dry_run, "force": force}
    wanted = options.table(options.read_settings(settings), "fetch", **given)
    facts = fetch_map(wanted, out, console.PROGRESS)
    console.facts(facts, title=f"map around {what.around}")
    if dry_run:
        console.next_step("map fetch", hint="with the same options, without --dry-run")
    else:
        console.next_step(f"map info {console.quoted(out)}")
