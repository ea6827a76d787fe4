"""``map audit``: where on a map frames from a given height can be matched, and what a route will meet."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.audit.availability import Audit, RouteAvailability, gather, predict_route
from engine.audit.plan import AuditOptions, AuditPlan, MapPart, plan_audit
from engine.audit.self_match import SelfMatchStatistics, measure_self_match
from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import check_folder, named_as_typed, open_map, parse_circle, prepare_folder
from engine.errors import OptionError
from engine.formats.geotiff import write_geotiff
from engine.formats.route import read_route
from engine.orthomap import SEARCH_LIMIT_PX, OrthoMap

OWNED = ("matchability.tif", "audit.png", "summary.json")
NODATA = -1.0
PAPER_CAMERA, PAPER_HEIGHT_M = (300, 300, 60.0), 150.0
"""Width, height and field of view of the paper's camera, and its height: what an audit assumes unless told."""


@dataclass(frozen=True, slots=True)
class AuditFiles:
    """The files of an audit, the height, and what part of the map it is of; None where not given.

    Attributes:
        around: LAT,LON,RADIUS_M.
        corridor_m: how far to each side of the route.
    """

    map: Path
    surface: Path | None
    camera: Path | None
    route: Path | None
    other: Path | None
    height_agl_m: float | None
    around: str | None = None
    corridor_m: float | None = None


def run_audit(inputs: AuditFiles, out: Path, *, sigma_m: float, force: bool, as_json: bool) -> dict[str, Any]:
    """Audit, write raster, picture and summary, and print the summary."""
    check_folder(out, force)
    around = parse_circle("--around", inputs.around)
    if inputs.corridor_m is not None and inputs.route is None:
        raise OptionError("--corridor-m: expected a --route with it, got none")
    site = open_map(inputs.map, inputs.surface)
    other = None if inputs.other is None else _same_place(open_map(inputs.other), site)
    camera = Camera.from_fov(*PAPER_CAMERA) if inputs.camera is None else Camera.load(inputs.camera)
    waypoints = None if inputs.route is None else read_route(inputs.route)
    if waypoints is not None:
        _check_route(waypoints, site)
    height_m = PAPER_HEIGHT_M if inputs.height_agl_m is None else inputs.height_agl_m
    typed = {"height_agl_m": "--height-agl", "prior_sigma_m": "--sigma-m", "camera": "--camera"}
    with named_as_typed(**typed, corridor_m="--corridor-m", part="--route"):
        part = _part(around, waypoints, inputs.corridor_m, site)
        plan = plan_audit(site, camera, height_m, AuditOptions(prior_sigma_m=sigma_m), other, part)
    _check_size(plan, part)
    prepare_folder(out, force, OWNED)
    audit = gather(plan, console.progress(measure_self_match(plan), len(plan), "auditing"))
    route = None if waypoints is None else predict_route(audit, *waypoints.T)
    _write(out, audit, route, inputs.map.name)
    result = summary(audit, route, inputs)
    (out / "summary.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if as_json:
        console.print_json(result)
    else:
        console.print_pairs(f"audit of {inputs.map}", _pairs(audit, route))
        console.say(f"written to {out}")
    return result


def _part(
    around: tuple[float, float, float] | None,
    waypoints: NDArray[np.float64] | None,
    corridor_m: float | None,
    site: OrthoMap,
) -> MapPart | None:
    """The part of the map that was asked for; None is all of it, which a huge map is never audited as.

    Raises:
        OptionError: the map is huge and nothing was asked for, or it was asked for a place beside it.
    """
    if around is not None:
        x, y = site.pixel_from_geodetic(*around[:2])
        if not (-0.5 <= x < site.width_px - 0.5 and -0.5 <= y < site.height_px - 0.5):
            raise OptionError(
                f"--around: expected a place on the map {site.name}, got {around[0]:g},{around[1]:g}"
            )
        return MapPart(around=around, route=waypoints, corridor_m=corridor_m)
    if waypoints is not None and (corridor_m is not None or not site.is_searchable):
        return MapPart(route=waypoints, corridor_m=corridor_m)
    if not site.is_searchable:
        raise OptionError(
            f"--around: expected LAT,LON,RADIUS_M, or a --route to audit along: the map of {site.size_km} is not "
            "audited as a whole"
        )
    return None


def _check_size(plan: AuditPlan, part: MapPart | None) -> None:
    """Refuse a part so large that its places would say nothing of what lies between them.

    Raises:
        OptionError: it has more pixels than a map that is audited as a whole.
    """
    if part is not None and plan.area_px > SEARCH_LIMIT_PX:
        name = "--around" if part.around is not None else "--corridor-m"
        most, got = (n * plan.site.gsd_m_per_px**2 / 1e6 for n in (SEARCH_LIMIT_PX, plan.area_px))
        raise OptionError(f"{name}: expected at most {most:.0f} km2 of the map to audit, got {got:.0f} km2")


def _same_place(other: OrthoMap, site: OrthoMap) -> OrthoMap:
    """The other map, if it has anything to do with the first."""
    (west, south, east, north), (left, low, right, high) = other.bounds_deg, site.bounds_deg
    if west > right or east < left or south > high or north < low:
        raise OptionError(
            f"--other: expected a map of the same ground as {site.name}, got {other.name}, elsewhere"
        )
    return other


def _check_route(waypoints: NDArray[np.float64], site: OrthoMap) -> None:
    xy = site.pixel_from_geodetic(*waypoints.T)
    low, high = np.nanmin(xy, axis=0), np.nanmax(xy, axis=0)
    if not (np.isfinite(xy).all() and (high >= 0).all() and (low <= [site.width_px, site.height_px]).all()):
        lat, lon = waypoints[0]
        raise OptionError(
            f"--route: expected a route over the map {site.name}, got one that begins at {lat:g},{lon:g}"
        )


def _write(out: Path, audit: Audit, route: RouteAvailability | None, title: str) -> None:
    from engine.report.audit import draw_audit

    raster = np.nan_to_num(audit.availability, nan=NODATA).astype(np.float32)
    affine, epsg = _cells_to_crs(audit)
    write_geotiff(out / "matchability.tif", raster, affine, epsg, nodata=NODATA)
    seen = f"{title}, from {audit.plan.height_agl_m:g} m"
    draw_audit(out / "audit.png", audit, route, title=seen)


def _cells_to_crs(audit: Audit) -> tuple[NDArray[np.float64], int]:
    """(2, 3) from cells to the map's CRS, and its EPSG code; WGS84 where the map's CRS has no code."""
    from pyproj import Transformer

    plan = audit.plan
    epsg = plan.site.crs.to_epsg() or 4326
    to_crs = Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
    cells = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    lat, lon = plan.site.geodetic_from_pixel(plan.pixel_from_cell(cells))
    origin, right, below = np.stack(to_crs.transform(lon, lat), axis=-1)
    return np.column_stack([right - origin, below - origin, origin]), epsg


def summary(audit: Audit, route: RouteAvailability | None, inputs: AuditFiles) -> dict[str, Any]:
    """What summary.json holds."""
    plan = audit.plan
    known = np.isfinite(audit.availability)
    scale = 2.0**plan.level * plan.site.gsd_m_per_px
    return {
        "map": str(inputs.map),
        "surface": None if inputs.surface is None else str(inputs.surface),
        "camera": None if inputs.camera is None else str(inputs.camera),
        "other": None if inputs.other is None else str(inputs.other),
        "height_agl_m": plan.height_agl_m,
        "prior_sigma_m": plan.options.prior_sigma_m,
        "footprint_m": [n * scale for n in plan.view.footprint_px],
        "level": plan.level,
        "part": _part_facts(plan, inputs),
        "places": list(plan.cells),
        "spacing_m": (plan.spacing_px * plan.site.gsd_m_per_px).tolist(),
        "availability": float(audit.availability[known].mean()) if known.any() else None,
        "shares": audit.shares,
        "evidence_median": {
            one.name: _median(getattr(audit.statistics, one.name)) for one in fields(SelfMatchStatistics)
        },
        "route": None if route is None else _route_facts(route, str(inputs.route)),
    }


def _part_facts(plan: AuditPlan, inputs: AuditFiles) -> dict[str, Any] | None:
    """What part of the map was audited; None for all of it."""
    if plan.audited.all() and plan.window.area_px == plan.site.width_px * plan.site.height_px:
        return None
    return {
        "around": inputs.around,
        "corridor_m": inputs.corridor_m,
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


def _pairs(audit: Audit, route: RouteAvailability | None) -> list[tuple[str, str]]:
    plan = audit.plan
    footprint = " x ".join(f"{n * 2.0**plan.level * plan.site.gsd_m_per_px:.0f}" for n in plan.view.footprint_px)
    pairs = [
        ("frame on the ground", f"{footprint} m from {plan.height_agl_m:g} m"),
        ("places", f"{len(plan)}, every {plan.spacing_px.mean() * plan.site.gsd_m_per_px:.0f} m"),
        ("of the map", f"{plan.area_px * plan.site.gsd_m_per_px**2 / 1e6:.3g} km2"),
    ]
    pairs += [(name, f"{share:.1%}") for name, share in audit.shares.items() if share > 0.0 or name == "good"]
    if route is not None:
        pairs.append(("route", f"{route.length_m:,.0f} m, predicted availability {route.availability:.1%}"))
        for one in route.stretches:
            ends = (
                f"{one.start_lat_deg:.6f},{one.start_lon_deg:.6f} to {one.end_lat_deg:.6f},{one.end_lon_deg:.6f}"
            )
            pairs.append((f"poor: {one.flag}", f"{ends}, {one.length_m:,.0f} m, {one.availability:.0%}"))
    return pairs
