"""The commands of `map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console, tables
from scenematch.cli.options import (
    ForceOption,
    JsonOption,
    MapBoundsOption,
    MapCrsOption,
    MapSigmaOption,
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
    from scenematch.runs.map_input import MapInput

    site = MapInput(map_path, surface=surface, map_bounds=map_bounds, map_crs=map_crs).open(console.PROGRESS)
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
    from scenematch.runs.map_audit import AuditFiles, audit_map
    from scenematch.runs.map_input import MapInput

    use_threads(threads)
    files = AuditFiles(
        map=MapInput(map_path, surface=surface, map_bounds=map_bounds, map_crs=map_crs), camera=camera, route=route, other=other, height_agl_m=height_agl_m,
        around=around, corridor_m=corridor_m,
    )  # fmt: skip
    result = audit_map(files, out, prior_sigma_m=prior_sigma_m, force=force, progress=console.PROGRESS)
    if as_json:
        console.print_json(result.summary)
    else:
        tables.print_audit(result, str(map_path))
        console.say(f"written to {out}")
    files_given = console.options(map=map_path, surface=surface, camera=camera)
    console.next_step(f"track {files_given} --frames FRAMES --out out", as_json=as_json)


def fetch(
    around: Annotated[
        str, typer.Option("--around", metavar="LAT,LON|DIR", help="The middle; or photographs with positions.")
    ],
    source: Annotated[
        str,
        typer.Option(
            "--source", metavar="URL", help="Tiles as https://host/{z}/{x}/{y}.png, or a WMS or WMTS: your choice."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The map, a GeoTIFF.")],
    radius_m: Annotated[
        float | None,
        typer.Option("--radius-m", metavar="M", help="To each edge, at least; else what the photographs saw."),
    ] = None,
    gsd_m_per_px: Annotated[
        float | None,
        typer.Option(
            "--gsd-m-per-px", metavar="M", help="Tiles are so fine or finer; 0.5, or as photographs need."
        ),
    ] = None,
    layer: Annotated[
        str | None, typer.Option("--layer", metavar="NAME", help="Of a WMS or WMTS that has several.")
    ] = None,
    crs: Annotated[
        str | None, typer.Option("--crs", metavar="EPSG:N", help="Of a WMS or WMTS; else UTM or Web Mercator.")
    ] = None,
    image_format: Annotated[
        str | None,
        typer.Option("--image-format", metavar="TYPE", help="Of a WMS or WMTS; else image/png if offered."),
    ] = None,
    tile_px: Annotated[int, typer.Option("--tile-px", metavar="N", help="Side of a template's tiles.")] = 256,
    map_sigma_m: MapSigmaOption = None,
    attribution: Annotated[
        str | None, typer.Option("--attribution", metavar="TEXT", help="Whom to credit; kept in the file.")
    ] = None,
    licence: Annotated[
        str | None, typer.Option("--licence", metavar="TEXT", help="What you may do with it; kept in the file.")
    ] = None,
    surface: Annotated[
        str | None,
        typer.Option(
            "--surface", metavar="FILE|URL", help="Heights to cut out as well; {lat} and {lon} as N48 and E016."
        ),
    ] = None,
    surface_datum: Annotated[
        str | None,
        typer.Option("--surface-datum", metavar="EPSG:N", help="Of its heights, where the file does not say."),
    ] = None,
    surface_slope_sigma_deg: Annotated[
        float | None,
        typer.Option("--surface-slope-sigma-deg", metavar="DEG", help="Accuracy of its slope over one frame."),
    ] = None,
    max_tiles: Annotated[
        int, typer.Option("--max-tiles", min=1, metavar="N", help="More are refused before any is asked for.")
    ] = 2000,
    pause_ms: Annotated[float, typer.Option("--pause-ms", metavar="MS", help="Between two requests.")] = 100.0,
    timeout_s: Annotated[float, typer.Option("--timeout-s", metavar="S", help="Without a byte.")] = 30.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be fetched.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Fetch a map from a server that you name.

    One request at a time. What was fetched stays beside the file until it is complete: the same command goes on
    after an interruption. The server's terms decide what you may fetch, keep and use.
    """
    from scenematch.runs.map_fetch import FetchSettings, fetch_map

    settings = FetchSettings(
        around=around, radius_m=radius_m, source=source, gsd_m_per_px=gsd_m_per_px, layer=layer, crs=crs,
        image_format=image_format, tile_px=tile_px, map_sigma_m=map_sigma_m, attribution=attribution,
        licence=licence, surface=surface, surface_datum=surface_datum,
        surface_slope_sigma_deg=surface_slope_sigma_deg, max_tiles=max_tiles, pause_ms=pause_ms,
        timeout_s=timeout_s, dry_run=dry_run, force=force,
    )  # fmt: skip
    facts = fetch_map(settings, out, console.PROGRESS)
    console.facts(facts, as_json, title=f"map around {around}")
    if dry_run:
        given = console.options(around=around, radius_m=radius_m)
        console.next_step(
            f"map fetch {given} --source URL --out FILE", as_json=as_json, hint="leave out --dry-run"
        )
    else:
        console.next_step(f"map info {console.quoted(out)}", as_json=as_json)
