"""Audits of a part of a map, around a place or along a route, and of a map too large to be audited as a whole."""

import json
import tracemalloc

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from pyproj import Transformer
from rasterio.enums import Resampling
from rasterio.windows import Window as RasterWindow

from engine import Camera, OrthoMap
from engine.errors import OptionError
from scenematch.check.availability import Flag, audit_site, predict_route
from scenematch.check.plan import AuditOptions, MapPart, plan_audit
from scenematch.cli.app import run
from tests.support.audits import CAMERA, GRID, HEIGHT_M, UTM, audit, lat_lon, town_gray, write_route
from tests.support.commands import refusal

HUGE_SIDE = 24_000  # pixels of the huge map: more than are audited as a whole
CORNER = (18_000, 7_000)  # of the town on it
MIDDLE = (CORNER[0] + 450, CORNER[1] + 450)


@pytest.fixture(scope="module")
def gray():
    return np.maximum(town_gray(), 1)


@pytest.fixture(scope="module")
def site(gray):
    return OrthoMap.from_arrays(gray, GRID, UTM)


@pytest.fixture(scope="module")
def huge_path(gray, tmp_path_factory):
    """A sparse GeoTIFF with overviews; all but the town is nodata, over which averages would take long."""
    path = tmp_path_factory.mktemp("huge") / "huge.tif"
    at = Affine(0.5, 0.0, 600_000.0 - 0.5 * CORNER[0], 0.0, -0.5, 4_500_000.0 + 0.5 * CORNER[1])
    profile = {"driver": "GTiff", "dtype": "uint8", "count": 1, "crs": UTM, "transform": at, "nodata": 0}
    profile |= {"tiled": True, "blockxsize": 512, "blockysize": 512, "sparse_ok": True, "compress": "deflate"}
    profile |= {"width": HUGE_SIDE, "height": HUGE_SIDE}
    with rasterio.Env(SPARSE_OK_OVERVIEW="ON"), rasterio.open(path, "w", **profile) as dataset:
        dataset.write(gray, 1, window=RasterWindow(*CORNER, 900, 900))
        dataset.build_overviews([2, 4, 8, 16, 32], Resampling.nearest)
    return path


@pytest.fixture(scope="module")
def huge(huge_path):
    return OrthoMap.open(huge_path)


def around(site, xy_px, radius_m):
    return (*lat_lon(site, xy_px).tolist(), radius_m)


# --------------------------------------------------------------------------------------------------- planning


def test_around_a_place_all_within_the_radius_is_looked_at_and_nothing_else(site):
    plan = plan_audit(site, CAMERA, HEIGHT_M, part=MapPart(around=around(site, [450, 300], 100.0)))
    off_m = np.hypot(*np.moveaxis(plan.centers_px - [450, 300], -1, 0)) * site.gsd_m_per_px
    np.testing.assert_array_equal(plan.audited, off_m <= 100.0)
    assert plan.area_px * site.gsd_m_per_px**2 == pytest.approx(np.pi * 100.0**2, rel=0.1)
    whole = plan_audit(site, CAMERA, HEIGHT_M)
    assert plan.spacing_px == pytest.approx(whole.spacing_px, rel=0.1)
    assert len(plan) < len(whole) / 4


def test_a_radius_below_the_spacing_is_one_place_there(site):
    plan = plan_audit(site, CAMERA, HEIGHT_M, part=MapPart(around=around(site, [450, 300], 1.0)))
    assert plan.centers_px[plan.audited] == pytest.approx(np.array([[450, 300]]), abs=3.0)


def test_a_part_at_the_edge_ends_with_the_map(site):
    plan = plan_audit(site, CAMERA, HEIGHT_M, part=MapPart(around=around(site, [5, 890], 60.0)))
    assert (plan.window.x0, plan.window.y0 + plan.window.height_px) == (0, 900)


@pytest.mark.slow
def test_a_route_is_predicted_from_its_corridor_as_from_the_whole_map(site):
    route = lat_lon(site, [[200, 250], [640, 300], [700, 650]])
    whole = audit_site(site, CAMERA, HEIGHT_M)
    part = audit_site(site, CAMERA, HEIGHT_M, part=MapPart(route=route, corridor_m=10.0))
    assert len(part.plan) < 0.5 * len(whole.plan)
    stated, expected = (predict_route(one, *route.T) for one in (part, whole))
    assert stated.length_m == expected.length_m
    assert stated.availability == pytest.approx(expected.availability, abs=0.05)
    assert Flag.OUTSIDE not in part.flag_at(stated.xy_px)
    assert (part.flags == Flag.OUTSIDE).any()
    np.testing.assert_array_equal(part.flags == Flag.OUTSIDE, ~part.plan.audited)
    assert np.isnan(part.availability[~part.plan.audited]).all()
    assert sum(part.shares.values()) == pytest.approx(1.0)


def test_the_corridor_is_of_what_the_camera_sees_not_of_where_it_flies(site):
    """A camera that looks 30 degrees to one side sees ground beside the route."""
    turn = cv2.Rodrigues(np.radians([30.0, 0.0, 0.0]))[0]
    aside = Camera(300, 300, CAMERA.matrix, mount=turn @ CAMERA.mount)
    route = lat_lon(site, [[200, 450], [700, 450]])
    fine = AuditOptions(spacing=0.05)
    plan = plan_audit(site, aside, HEIGHT_M, fine, part=MapPart(route=route, corridor_m=5.0))
    beside_m = abs(plan.centers_px[plan.audited][:, 1].mean() - 450) * site.gsd_m_per_px
    assert beside_m == pytest.approx(HEIGHT_M * np.tan(np.radians(30.0)), abs=3.0)


def test_both_parts_are_looked_at(site):
    place, route = around(site, [200, 200], 50.0), lat_lon(site, [[500, 700], [800, 700]])
    both = plan_audit(site, CAMERA, HEIGHT_M, part=MapPart(around=place, route=route))
    one, other = (
        plan_audit(site, CAMERA, HEIGHT_M, part=part) for part in (MapPart(around=place), MapPart(route=route))
    )
    assert len(both) == pytest.approx(len(one) + len(other), rel=0.15)


@pytest.mark.slow
def test_a_long_way_over_a_huge_map_has_no_more_places_and_no_finer_grid_than_memory_allows(huge):
    route = lat_lon(huge, [[10, 10], [23_990, 23_990], [23_990, 10]])
    plan = plan_audit(huge, CAMERA, 20.0, AuditOptions(max_cells=500), part=MapPart(route=route, corridor_m=5.0))
    assert 100 < len(plan) <= 500
    assert plan.audited.size < 200_000


def test_a_part_of_nothing_is_refused():
    with pytest.raises(OptionError, match="part: expected around or route"):
        MapPart()
    with pytest.raises(OptionError, match="around: expected metres above 0, got 0"):
        MapPart(around=(40.0, -99.0, 0.0))


def test_a_part_beside_the_map_is_refused(site):
    with pytest.raises(OptionError, match="part: expected one on the map arrays, got one off it"):
        plan_audit(site, CAMERA, HEIGHT_M, part=MapPart(around=around(site, [-5000, 100], 100.0)))


# ----------------------------------------------------------------------------------------------- command line


@pytest.fixture(scope="module")
def route_file(huge, tmp_path_factory):
    return write_route(tmp_path_factory.mktemp("route"), huge, np.array([[200, 250], [640, 300]]) + CORNER)


def place_option(site, xy_px, radius_m):
    lat, lon = lat_lon(site, xy_px)
    return f"--around={lat:.8f},{lon:.8f},{radius_m:g}"


@pytest.mark.slow
def test_a_huge_map_is_audited_around_a_place_in_a_part_of_the_memory(huge_path, huge, tmp_path, capsys):
    """Its grey levels and validity would take 1,152 MB."""
    import matplotlib.figure  # noqa: F401  an import while memory is traced takes long

    tracemalloc.start()
    code = run(audit(huge_path, tmp_path / "out", place_option(huge, MIDDLE, 80.0), "--json"))
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert code == 0
    assert peak_bytes < HUGE_SIDE * HUGE_SIDE / 3
    summary = json.loads(capsys.readouterr().out)
    assert summary["part"]["area_km2"] == pytest.approx(np.pi * 0.08**2, rel=0.15)
    assert summary["part"]["places"] < np.prod(summary["places"])
    assert summary["shares"]["nodata"] == 0.0
    assert summary["availability"] > 0.3
    with rasterio.open(tmp_path / "out" / "matchability.tif") as raster:
        values, at = raster.read(1), raster.transform
        x, y = at @ (values.shape[1] / 2, values.shape[0] / 2)
    lon, lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(x, y)
    assert huge.pixel_from_geodetic(lat, lon) == pytest.approx(MIDDLE, abs=2.0)
    assert values[0, 0] == -1.0  # a corner of the square about the circle
    assert values[values.shape[0] // 2, values.shape[1] // 2] >= 0.0
    assert cv2.imread(str(tmp_path / "out" / "audit.png"), cv2.IMREAD_GRAYSCALE).std() > 5


@pytest.mark.slow
def test_a_huge_map_is_audited_along_a_route(huge_path, route_file, tmp_path, capsys):
    assert run(audit(huge_path, tmp_path / "out", f"--route={route_file}", "--json")) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["route"]["availability"] > 0.3
    assert 0.02 < summary["part"]["area_km2"] < 0.08
    assert run(audit(huge_path, tmp_path / "near", f"--route={route_file}", "--corridor-m=10", "--json")) == 0
    assert json.loads(capsys.readouterr().out)["part"]["area_km2"] < summary["part"]["area_km2"] / 2


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ([], "--around: expected LAT,LON,RADIUS_M, or a --route to audit along: the map of 12 x 12 km is too"),
        (["--around=40.6,-97.7"], "--around: expected LAT,LON,RADIUS_M in degrees and metres, got '40.6,-97.7'"),
        (["--around=north"], "--around: expected LAT,LON,RADIUS_M in degrees and metres, got 'north'"),
        (["--around=40.6,-97.7,0"], "--around: expected a place on the Earth and a radius above 0 m"),
        (["--around=95,-97.7,10"], "--around: expected a place on the Earth and a radius above 0 m"),
        (["--around=41.6,-97.7,10"], "--around: expected a place on the map huge.tif, got 41.6,-97.7"),
        (["--corridor-m=50"], "--corridor-m: expected a --route with it, got none"),
    ],
)  # fmt: skip
def test_what_cannot_be_audited_is_one_line_and_no_folder(huge_path, tmp_path, capsys, more, words):
    assert refusal(capsys, audit(huge_path, tmp_path / "out", *more)).startswith(words)
    assert not (tmp_path / "out").exists()


def test_a_corridor_of_no_width_is_refused_by_the_name_that_was_typed(huge_path, route_file, tmp_path, capsys):
    command = audit(huge_path, tmp_path / "out", f"--route={route_file}", "--corridor-m=-1")
    assert refusal(capsys, command) == "--corridor-m: expected metres above 0, got -1\n"


def test_a_part_as_large_as_a_huge_map_is_refused(huge_path, huge, tmp_path, capsys):
    command = audit(huge_path, tmp_path / "out", place_option(huge, [12_000, 12_000], 9000.0))
    assert "--around: expected at most 134 km2 of the map to audit, got 14" in refusal(capsys, command)
