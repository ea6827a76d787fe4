"""Audit a map: predict where frames from a given height can be matched, over the map and along a route."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import OptionError, require
from engine.orthomap import SEARCH_LIMIT_PX, OrthoMap
from scenematch.check.availability import Audit, RouteAvailability, audit_of, predict_route
from scenematch.check.plan import AuditOptions, AuditPlan, MapPart, plan_audit
from scenematch.check.self_match import SelfMatchStatistics, measure_self_match
from scenematch.files.geotiff import write_geotiff
from scenematch.files.route import read_route
from scenematch.runs.arguments import parse_circle
from scenematch.runs.map_input import MapInput
from scenematch.runs.output import SILENT, Progress, StrPath, check_folder, prepare_folder, write_json
from scenematch.runs.renaming import renamed_in_errors

OWNED = ("matchability.tif", "audit.png", "summary.json")
NODATA = -1.0
PAPER_CAMERA, PAPER_HEIGHT_M = (300, 300, 60.0), 150.0
"""Default width, height and field of view of the camera, and height above ground: the paper's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditFiles:
    """The files of an audit, the height, and the part of the map; None for each not given.

    Attributes:
        map: the map with its surface.
        camera: calibration; None uses the paper's camera.
        route: GeoJSON LineString, or a QGroundControl .plan.
        height_agl_m: above the ground; None uses the paper's height.
        around: audit only the circle "LAT,LON,RADIUS_M".
        corridor_m: audit only this distance to either side of the route.
    """

    map: MapInput
    camera: StrPath | None = None
    route: StrPath | None = None
    height_agl_m: float | None = None
    around: str | None = None
    corridor_m: float | None = None


@dataclass(frozen=True, slots=True)
class MapAudit:
    """A finished audit.

    Attributes:
        audit: the grid of cells.
        route: availability along the route, if one was given.
        summary: the contents of summary.json.
    """

    audit: Audit
    route: RouteAvailability | None
    summary: dict[str, Any]


def audit_map(
    files: AuditFiles,
    out: StrPath,
    options: AuditOptions | None = None,
    *,
    force: bool = False,
    progress: Progress = SILENT,
) -> MapAudit:
    """Audit a map and write the raster, the picture and the summary.

    Args:
        files: the map, and the flight to audit it for.
        out: the folder.
        options: assumptions; None uses the defaults.
        force: whether the folder may already exist.
        progress: receives progress and messages.

    Raises:
        OptionError: an argument is out of range, or off the map.
        MapError, CalibrationError, TelemetryError: a file cannot be read.
        MissingExtraError: matplotlib is not installed; it draws the picture.
    """
    require("matplotlib", "desk")
    out = Path(out)
    check_folder(out, force)
    plan, waypoints = _plan(files, options or AuditOptions(), progress)
    prepare_folder(out, force, OWNED)
    audit = audit_of(plan, progress.track(measure_self_match(plan), len(plan), "auditing"))
    route = None if waypoints is None else predict_route(audit, *waypoints.T)
    _write(out, audit, route, Path(files.map.map).name)
    facts = _summary(audit, route, files)
    write_json(out / "summary.json", facts)
    return MapAudit(audit, route, facts)


def _plan(
    files: AuditFiles, options: AuditOptions, progress: Progress
) -> tuple[AuditPlan, NDArray[np.float64] | None]:
    """The plan's inputs, and the (N, 2) waypoints of the route in degrees."""
    around = parse_circle("around", files.around)
    if files.corridor_m is not None and files.route is None:
        raise OptionError("corridor_m: expected a `route` with it, got none")
    site = files.map.open(progress)
    camera = Camera.from_fov(*PAPER_CAMERA) if files.camera is None else Camera.load(files.camera)
    waypoints = None if files.route is None else read_route(files.route)
    if waypoints is not None:
        _check_route(waypoints, site)
    height_m = PAPER_HEIGHT_M if files.height_agl_m is None else files.height_agl_m
    with renamed_in_errors(part="route"):
        part = _part(around, waypoints, files.corridor_m, site)
        plan = plan_audit(site, camera, height_m, options, part)
    _check_size(plan, part)
    return plan, waypoints


def _part(
    around: tuple[float, float, float] | None,
    waypoints: NDArray[np.float64] | None,
    corridor_m: float | None,
    site: OrthoMap,
) -> MapPart | None:
    """The part of the map to audit; None is all of it, which is refused for a huge map.

    Raises:
        OptionError: the map is huge and no part is given, or the part lies off the map.
    """
    if around is not None:
        x, y = site.pixel_from_geodetic(*around[:2])
        if not (-0.5 <= x < site.width_px - 0.5 and -0.5 <= y < site.height_px - 0.5):
            raise OptionError(f"around: expected a place on the map {site.name}, got {around[0]:g},{around[1]:g}")
        return MapPart(around=around, route=waypoints, corridor_m=corridor_m)
    if waypoints is not None and (corridor_m is not None or not site.is_searchable):
        return MapPart(route=waypoints, corridor_m=corridor_m)
    if not site.is_searchable:
        raise OptionError(
            f"around: expected LAT,LON,RADIUS_M, or a `route` to audit along: the map of {site.size_km} is too "
            "large to audit as a whole"
        )
    return None


def _check_size(plan: AuditPlan, part: MapPart | None) -> None:
    """Refuse a part so large that its cells would not represent the ground between them.

    Raises:
        OptionError: it has more pixels than the largest map audited as a whole.
    """
    if part is not None and plan.area_px > SEARCH_LIMIT_PX:
        name = "around" if part.around is not None else "corridor_m"
        most, got = (n * plan.site.gsd_m_per_px**2 / 1e6 for n in (SEARCH_LIMIT_PX, plan.area_px))
        raise OptionError(f"{name}: expected at most {most:.0f} km2 of the map to audit, got {got:.0f} km2")


def _check_route(waypoints: NDArray[np.float64], site: OrthoMap) -> None:
    xy = site.pixel_from_geodetic(*waypoints.T)
    low, high = np.nanmin(xy, axis=0), np.nanmax(xy, axis=0)
    if not (np.isfinite(xy).all() and (high >= 0).all() and (low <= [site.width_px, site.height_px]).all()):
        lat, lon = waypoints[0]
        raise OptionError(
            f"route: expected a route over the map {site.name}, got one that begins at {lat:g},{lon:g}"
        )


def _write(out: Path, audit: Audit, route: RouteAvailability | None, title: str) -> None:
    from scenematch.report.audit import draw_audit

    raster = np.nan_to_num(audit.availability, nan=NODATA).astype(np.float32)
    affine, epsg = _cells_to_crs(audit)
    write_geotiff(out / "matchability.tif", raster, affine, epsg, nodata=NODATA)
    seen = f"{title}, from {audit.plan.height_agl_m:g} m"
    draw_audit(out / "audit.png", audit, route, title=seen)


def _cells_to_crs(audit: Audit) -> tuple[NDArray[np.float64], int]:
    """(2, 3) from cells to the map's CRS, and its EPSG code; WGS84 if the map's CRS has no code."""
    from pyproj import Transformer

    plan = audit.plan
    epsg = plan.site.crs.to_epsg() or 4326
    to_crs = Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
    cells = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    lat, lon = plan.site.geodetic_from_pixel(plan.pixel_from_cell(cells))
    origin, right, below = np.stack(to_crs.transform(lon, lat), axis=-1)
    return np.column_stack([right - origin, below - origin, origin]), epsg


def _summary(audit: Audit, route: RouteAvailability | None, files: AuditFiles) -> dict[str, Any]:
    """The contents of summary.json."""
    plan = audit.plan
    known = np.isfinite(audit.availability)
    scale = 2.0**plan.level * plan.site.gsd_m_per_px
    return {
        "map": str(files.map.map),
        "surface": None if files.map.surface is None else str(files.map.surface),
        "camera": None if files.camera is None else str(files.camera),
        "height_agl_m": plan.height_agl_m,
        "prior_sigma_m": plan.options.prior_sigma_m,
        "footprint_m": [n * scale for n in plan.view.footprint_px],
        "level": plan.level,
        "part": _part_facts(plan, files),
        "places": list(plan.cells),
        "spacing_m": (plan.spacing_px * plan.site.gsd_m_per_px).tolist(),
        "availability": float(audit.availability[known].mean()) if known.any() else None,
        "shares": audit.shares,
        "evidence_median": {
            one.name: _median(getattr(audit.statistics, one.name)) for one in fields(SelfMatchStatistics)
        },
        "route": None if route is None else _route_facts(route, str(files.route)),
    }


def _part_facts(plan: AuditPlan, files: AuditFiles) -> dict[str, Any] | None:
    """The part of the map that was audited; None for all of it."""
    if plan.audited.all() and plan.window.area_px == plan.site.width_px * plan.site.height_px:
        return None
    return {
        "around": files.around,
        "corridor_m": files.corridor_m,
        "places": len(plan),
        "area_km2": plan.area_px * plan.site.gsd_m_per_px**2 / 1e6,
    }


def _median(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _route_facts(route: RouteAvailability, path: str) -> dict[str, Any]:
    return {
        "path": path,
        "length_m": route.length_m,
        "availability": route.availability,
        "stretches": [asdict(stretch) for stretch in route.stretches],
    }
