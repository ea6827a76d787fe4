"""Fetch a map and a surface model from servers that the user names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from engine.errors import OptionError
from engine.geo import LocalFrame
from engine.maps.accuracy import GEOREFERENCE_TAG, SLOPE_TAG
from engine.values import MAX_SIGMA_M
from scenematch.fetch.grid import FINE_ENOUGH, Bounds, FetchSettings, Grid, Place, Wanted
from scenematch.fetch.heights import GLO30, GLO30_SLOPE_SIGMA_DEG, Heights, files_for, read_part, write_heights
from scenematch.fetch.pictures import fetch_pictures, kept_pictures, remove_pictures
from scenematch.fetch.servers import is_template, plan
from scenematch.fetch.urls import check_url, shown
from scenematch.files.photos import exif_telemetry
from scenematch.runs.arguments import check_above, check_between, check_unused, parse_place
from scenematch.runs.output import SILENT, Progress, StrPath, check_file

NOTE = "you named this server: its terms decide what may be fetched, kept and used, and whom to credit"
_MAX_RADIUS_M = 100_000.0
GSD_M_PER_PX = 0.5
_USUAL_HEIGHT_M = 150.0  # of a camera that suits the ground sample distance
_MARGIN_M = 50.0  # beyond what the photographs cover
_MUCH_EMPTY = 0.5  # of a map: more is reported


def fetch_map(settings: FetchSettings, out: StrPath, progress: Progress = SILENT) -> dict[str, Any]:
    """Fetch a map into one GeoTIFF, and a surface model beside it.

    What has been fetched is kept beside the map until it is complete: the same call resumes.

    Args:
        settings: what, and how.
        out: the map; the surface model is ``NAME-surface.tif`` beside it.
        progress: receives progress and messages.

    Returns:
        What was planned, requested and written.

    Raises:
        OptionError: a setting is invalid, more tiles are needed than allowed, or a file already exists.
        TelemetryError: the photographs state no positions.
        MapError: a server refuses, cannot be reached, or sends something else.
    """
    out = Path(out)
    surface_out = out.with_name(f"{out.stem}-surface.tif")
    folder = out.with_name(f"{out.name}.tiles")
    wanted = _checked(settings, folder, progress)
    for file in (out, surface_out) if settings.surface else (out,):
        check_file(file, settings.force)
    progress.message(f"note: {NOTE}")
    grid = plan(settings.source, wanted)
    files = [] if settings.surface is None else files_for(settings.surface, _bounds_deg(grid))
    _check_surface_stays(files, (out, surface_out))
    _say_what_comes(grid, settings, wanted, progress)
    facts = _plan_facts(settings, grid)
    if settings.dry_run:
        return facts | {"surface_files": list(map(shown, files)), "dry_run": True}
    fetched_utc = datetime.now(UTC).isoformat(timespec="seconds")
    surface = (files, grid.bounds, grid.crs, settings.surface_datum, settings.timeout_s)
    heights = read_part(*surface) if files else None
    facts = {"file": str(out)} | facts | _write(settings, grid, folder, out, fetched_utc, progress)
    return facts | _write_surface(settings, heights, files, surface_out, fetched_utc)


def _say_what_comes(grid: Grid, settings: FetchSettings, wanted: Wanted, progress: Progress) -> None:
    """Report what a person should know before the download."""
    for name, text in grid.states.items():
        progress.message(f"the server states as {name}: {text}")
    got, asked = grid.gsd_m_per_px, wanted.gsd_m_per_px
    coarser = ", coarser than asked: the server has no finer level" if got > asked * FINE_ENOUGH else ""
    progress.message(f"{grid.kind} level {grid.level}: {got:.3g} m/px{coarser}")
    if settings.map_sigma_m is None:
        progress.message("the map's accuracy is not stated (`map_sigma_m`): matching will assume 3 m per axis")


def _write(
    settings: FetchSettings, grid: Grid, folder: Path, out: Path, fetched_utc: str, progress: Progress
) -> dict[str, Any]:
    """Fetch the pictures and write the map; on failure, fetched pictures stay in the folder.

    Raises:
        MapError: the server refuses, or has nothing there.
    """
    cached, complete = len(kept_pictures(folder)), False
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        pictures = fetch_pictures(
            grid, out, _map_tags(settings, grid, fetched_utc), url=settings.source, cached=cached,
            pause_s=settings.pause_ms / 1e3, say=progress.message,
        )  # fmt: skip
        known = sum(progress.track(pictures, grid.tiles, "fetching"))
        complete = True
    finally:
        remove_pictures(folder, all_of_them=complete)
    nodata_share = 1.0 - known / (grid.size_px[0] * grid.size_px[1])
    if nodata_share > _MUCH_EMPTY:
        progress.message(f"{nodata_share:.0%} of the map is empty; does the server cover `around`?")
    return {"nodata_share": nodata_share, "file_mb": out.stat().st_size / 1e6}


def _checked(settings: FetchSettings, folder: Path, progress: Progress) -> Wanted:
    """The request that the settings describe.

    Raises:
        OptionError: a setting is invalid.
        TelemetryError: the folder of photographs cannot be read.
    """
    wanted = _wanted(settings, folder, progress)
    check_above("radius_m", wanted.place.radius_m, 0.0, _MAX_RADIUS_M)
    check_above("gsd_m_per_px", wanted.gsd_m_per_px, 0.0, 1e3)
    check_above("timeout_s", settings.timeout_s, 0.0, 3600.0)
    check_above("map_sigma_m", settings.map_sigma_m, 0.0, MAX_SIGMA_M)
    check_above("surface_slope_sigma_deg", settings.surface_slope_sigma_deg, 0.0, 45.0)
    check_between("pause_ms", settings.pause_ms, 0, 60_000)
    check_between("tile_px", settings.tile_px, 16, 4096)
    if settings.surface is None:
        names = ("surface_datum", "surface_slope_sigma_deg")
        check_unused({name: getattr(settings, name) for name in names}, "surface")
    if is_template(settings.source):
        for name in ("layer", "crs", "image_format"):
            if getattr(settings, name) is not None:
                raise OptionError(f"{name}: expected with a WMS or WMTS only, not with a template of tiles")
    check_url("source", settings.source)
    return wanted


def _wanted(settings: FetchSettings, folder: Path, progress: Progress) -> Wanted:
    """The given place, or that of the photographs, and the request for it.

    Raises:
        OptionError: it is not a place, or its radius is missing.
        TelemetryError: the folder cannot be read.
    """
    radius_m, gsd_m_per_px = settings.radius_m, settings.gsd_m_per_px
    if Path(settings.around).is_dir():
        place, finest_m_per_px = _seen_by_photographs(Path(settings.around))
        place = place if radius_m is None else replace(place, radius_m=radius_m)
        gsd_m_per_px = finest_m_per_px if gsd_m_per_px is None else gsd_m_per_px
        progress.message(
            f"the photographs' place: {place.lat_deg:.6f},{place.lon_deg:.6f}, radius {place.radius_m:.0f} m; "
            f"asked for {gsd_m_per_px:.2g} m/px"
        )
    elif radius_m is None:
        raise OptionError("radius_m: expected with LAT,LON; it is optional only with photographs")
    else:
        place = Place(*parse_place("around", settings.around), radius_m)
    gsd_m_per_px = GSD_M_PER_PX if gsd_m_per_px is None else gsd_m_per_px
    return Wanted(place, gsd_m_per_px, settings, folder)


def _seen_by_photographs(folder: Path) -> tuple[Place, float]:
    """The square that the photographs cover, and the ground sample distance that suits their height.

    Raises:
        OptionError: they have no positions.
    """
    rows = [row for row in exif_telemetry(folder) if row.lat_deg is not None]
    if not rows:
        raise OptionError(f"around: expected LAT,LON or photographs with positions, got none in {folder}")
    lat_deg, lon_deg = (np.array([getattr(row, name) for row in rows]) for name in ("lat_deg", "lon_deg"))
    frame = LocalFrame(float(lat_deg[0]), float(lon_deg[0]))
    where = frame.enu_from_geodetic(lat_deg, lon_deg)[..., :2]
    low, high = where.min(axis=0), where.max(axis=0)
    middle = frame.geodetic_from_enu(*((low + high) / 2.0))
    heights_m = [row.height_agl_m for row in rows if row.height_agl_m is not None] or [_USUAL_HEIGHT_M]
    radius_m = float((high - low).max()) / 2.0 + max(heights_m) + _MARGIN_M
    finest_m_per_px = min(GSD_M_PER_PX, float(np.median(heights_m)) / _USUAL_HEIGHT_M * GSD_M_PER_PX)
    return Place(float(middle[0]), float(middle[1]), radius_m), finest_m_per_px


def _plan_facts(settings: FetchSettings, grid: Grid) -> dict[str, Any]:
    """Facts known before the first request for a picture."""
    width, height = grid.size_px
    return {
        "source": shown(settings.source),
        "kind": grid.kind,
        "level": grid.level,
        "crs": grid.crs.to_string(),
        "gsd_m_per_px": grid.gsd_m_per_px,
        "width_px": width,
        "height_px": height,
        "bounds_deg": list(_bounds_deg(grid)),
        "tiles": grid.tiles,
        "georeference_sigma_m": settings.map_sigma_m,
        "attribution": settings.attribution,
        "licence": settings.licence,
        "server_states": [f"{name}: {text}" for name, text in grid.states.items()],
        "note": NOTE,
    }


def _bounds_deg(grid: Grid) -> Bounds:
    """West, south, east, north of the map in degrees."""
    from pyproj import Transformer

    found: Bounds = Transformer.from_crs(grid.crs, 4326, always_xy=True).transform_bounds(*grid.bounds)
    return found


def _map_tags(settings: FetchSettings, grid: Grid, fetched_utc: str) -> dict[str, object]:
    """Metadata items of the map: its accuracy and origin."""
    tags = {
        GEOREFERENCE_TAG: settings.map_sigma_m,
        "SOURCE": shown(settings.source),
        "SOURCE_LEVEL": grid.level,
        "FETCHED_UTC": fetched_utc,
        "ATTRIBUTION": settings.attribution or grid.states.get("Attribution"),
        "LICENCE": settings.licence,
        "SERVER_ACCESS_CONSTRAINTS": grid.states.get("AccessConstraints"),
    }
    return {name: value for name, value in tags.items() if value is not None}


# ---------------------------------------------------------------------------------------------- surface model


def _check_surface_stays(files: Sequence[str], outputs: Sequence[Path]) -> None:
    """Refuse to overwrite the heights that are being read, even with ``force``.

    Raises:
        OptionError: a file of heights is also an output of the fetch.
    """
    for file in map(Path, files):  # a URL is no existing file
        for output in outputs:
            if file.exists() and output.exists() and file.samefile(output):
                raise OptionError(f"out: {output} is also the input `surface`; choose another file")


def _write_surface(
    settings: FetchSettings, heights: Heights | None, files: Sequence[str], out: Path, fetched_utc: str
) -> dict[str, Any]:
    """Write the heights under the map, with the accuracy of their slope if it is known."""
    if heights is None:
        return {"surface": None}
    known = GLO30_SLOPE_SIGMA_DEG if any(GLO30 in file for file in files) else None
    slope_sigma_deg = settings.surface_slope_sigma_deg or known
    tags = {SLOPE_TAG: slope_sigma_deg, "SOURCE": ", ".join(map(shown, files)), "FETCHED_UTC": fetched_utc}
    write_heights(heights, out, {name: value for name, value in tags.items() if value is not None})
    return {
        "surface": str(out),
        "surface_datum": heights.datum,
        "surface_range_m": [float(np.nanmin(heights.heights_m)), float(np.nanmax(heights.heights_m))],
        "surface_nodata_share": float(np.isnan(heights.heights_m).mean()),
        "slope_sigma_deg": slope_sigma_deg,
    }
