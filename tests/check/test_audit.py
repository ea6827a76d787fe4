"""Audits: what is painted on a map is flagged as what it is, also of parts of a huge map; routes; the command."""

import json
import re
import tracemalloc

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from pyproj import Transformer
from rasterio.enums import Resampling

from engine import Camera, OptionError, OrthoMap, TelemetryError
from scenematch.check.availability import Flag, audit_of, fix_probability, predict_route
from scenematch.check.plan import AuditOptions, MapPart, plan_audit
from scenematch.check.self_match import measure_self_match
from scenematch.cli.app import run
from scenematch.files.geotiff import write_geotiff
from scenematch.files.route import read_route
from tests.support.commands import answer, refusal
from tests.support.rasters import write_sparse
from tests.support.refusals import misuse
from tests.support.towns import drawn_town

CAMERA, HEIGHT_M = Camera.from_fov(300, 300, 60.0), 75.0
GRID, UTM = np.array([[0.5, 0.0, 600_000.0], [0.0, -0.5, 4_500_000.0]]), "EPSG:32614"
SIDE = 900

NOISE = 3.0  # of the water, in grey levels
HALF = SIDE // 2
HUGE_SIDE = 24_000  # pixels of the huge map: more than are audited as a whole
CORNER = (18_000, 7_000)  # of the town on it
MIDDLE = (CORNER[0] + 450, CORNER[1] + 450)


def town_gray():
    """A town, (SIDE, SIDE)."""
    return cv2.cvtColor(drawn_town(1).ortho, cv2.COLOR_RGB2GRAY)[:SIDE, :SIDE]


def lat_lon(site, xy_px):
    """Latitudes and longitudes (N, 2) of pixels."""
    return np.stack(site.geodetic_from_pixel(np.asarray(xy_px, float)), axis=-1)


@pytest.fixture(scope="module")
def patchwork():
    """Quarters: town, water, a field that repeats every 20 m, and nodata."""
    rng = np.random.default_rng(0)
    gray, valid = town_gray(), np.ones((SIDE, SIDE), bool)
    gray[:HALF, HALF:] = np.rint(70 + rng.normal(0, NOISE, (HALF, SIDE - HALF)))
    tile = cv2.GaussianBlur(rng.uniform(60, 180, (40, 40)), (0, 0), 2.0)
    gray[HALF:, :HALF] = np.tile(tile, (12, 12))[: gray.shape[0] - HALF, :HALF]
    valid[HALF:, HALF:] = False
    return gray, valid


@pytest.fixture(scope="module")
def site(patchwork):
    gray, valid = patchwork
    return OrthoMap.from_arrays(gray, GRID, UTM, valid=valid)


@pytest.fixture(scope="module")
def found(site):
    return audit_of(plan_audit(site, CAMERA, HEIGHT_M))


def well_inside(found, x0, y0):
    """The places whose whole window lies in one quarter of the map."""
    reach = 0.8 * found.plan.view.footprint_px[0]
    low = np.array([x0, y0]) + reach
    inside = ((found.plan.centers_px > low) & (found.plan.centers_px < low + HALF - 2 * reach)).all(axis=-1)
    assert inside.sum() >= 4
    return inside


def test_each_quarter_is_flagged_as_what_it_is(found):
    for x0, y0, flag in ((HALF, 0, Flag.FLAT), (0, HALF, Flag.REPEATED), (HALF, HALF, Flag.NODATA)):
        assert (found.flags[well_inside(found, x0, y0)] == flag).all(), flag.name
    town = well_inside(found, 0, 0)
    assert (found.flags[town] == Flag.GOOD).mean() > 0.7


def test_probabilities_are_probabilities_and_nan_is_nodata_alone(found):
    unknown = np.isnan(found.availability)
    assert (unknown == np.isin(found.flags, [Flag.NODATA, Flag.EDGE])).all()
    assert ((found.availability[~unknown] > 0) & (found.availability[~unknown] < 1)).all()
    assert sum(found.shares.values()) == pytest.approx(1.0)


def test_texture_of_water_is_its_noise(found):
    """Smoothed by 1-2-1 in both directions, white noise keeps 6/16 of its deviation."""
    water = well_inside(found, HALF, 0)
    assert found.statistics.texture[water] == pytest.approx(np.full(water.sum(), NOISE * 6 / 16), rel=0.08)


def test_more_lead_and_more_score_never_make_a_fix_less_probable():
    ladder = np.linspace(0.0, 40.0, 100)
    assert (np.diff(fix_probability(20.0, 15.0, ladder)) >= 0).all()
    assert (np.diff(fix_probability(20.0, ladder, 3.0)) >= 0).all()
    assert np.isnan(fix_probability(20.0, 15.0, np.nan))


@pytest.mark.slow
def test_fine_random_texture_is_less_stable_than_a_town():
    leaves = np.clip(90 + 25 * np.random.default_rng(1).normal(size=(600, 600)), 0, 255).astype(np.uint8)
    values = []
    for gray in (leaves, np.ascontiguousarray(town_gray()[:600, :600])):
        plan = plan_audit(OrthoMap.from_arrays(gray, GRID, UTM), CAMERA, HEIGHT_M)
        values.append(np.array([one.stability for one in measure_self_match(plan)]))
    assert np.nanmax(values[0]) < np.nanmin(values[1])


@pytest.mark.slow
def test_the_same_map_gives_the_same_audit(site, found):
    again = audit_of(plan_audit(site, CAMERA, HEIGHT_M))
    assert np.array_equal(again.availability, found.availability, equal_nan=True)


def test_a_large_map_gets_no_more_places_than_asked_for(site):
    assert len(plan_audit(site, CAMERA, 20.0, AuditOptions(max_cells=50))) <= 70  # rounded up along both sides
    assert len(plan_audit(site, CAMERA, 20.0)) > 500


@pytest.mark.parametrize("height_m", [0.0, -5.0, float("nan"), float("inf"), 5000.0, 0.5])
def test_a_height_that_cannot_be_is_refused(site, height_m):
    assert "height_agl_m: expected" in misuse(plan_audit, site, CAMERA, height_m)


# ---------------------------------------------------------------------------------------------------- routes


def test_a_route_over_the_town_is_better_than_one_over_water(site, found):
    town = predict_route(found, *lat_lon(site, [[130, 225], [310, 225]]).T)
    water = predict_route(found, *lat_lon(site, [[600, 225], [780, 225]]).T)
    assert town.availability > 0.5  # the least that is flagged good
    assert town.stretches == ()
    assert water.availability < 0.3
    assert [one.flag for one in water.stretches] == ["flat"]
    assert water.stretches[0].length_m == pytest.approx(water.length_m)
    assert water.length_m == pytest.approx(90.0, rel=2e-3)


def test_a_poor_stretch_begins_and_ends_where_the_water_does(site, found):
    (stretch,) = predict_route(found, *lat_lon(site, [[130, 225], [780, 225]]).T).stretches
    start = site.pixel_from_geodetic(stretch.start_lat_deg, stretch.start_lon_deg)
    assert abs(start[0] - HALF) < found.plan.view.footprint_px[0]
    assert start[1] == pytest.approx(225, abs=1)
    end = site.pixel_from_geodetic(stretch.end_lat_deg, stretch.end_lon_deg)
    assert end == pytest.approx([780, 225], abs=1)


def test_off_the_map_nothing_is_available(site, found):
    route = predict_route(found, *lat_lon(site, [[-3000, -3000], [-2000, -3000]]).T)
    assert (route.availability, route.stretches[0].flag) == (0.0, "edge")


@pytest.mark.slow
def test_where_a_forward_camera_looks_counts_not_where_it_is(site):
    """A camera that is mounted 20 degrees ahead sees the water before it is over it, whichever way it flies."""
    turn = cv2.Rodrigues(np.array([0.0, np.radians(20.0), 0.0]))[0]
    found = audit_of(plan_audit(site, Camera(300, 300, CAMERA.matrix, mount=turn @ CAMERA.mount), HEIGHT_M))
    east = predict_route(found, *lat_lon(site, [[HALF, 250], [HALF + 20, 250]]).T)
    west = predict_route(found, *lat_lon(site, [[HALF + 20, 250], [HALF, 250]]).T)
    assert (turn @ CAMERA.mount)[0, 2] > 0  # the axis points ahead
    assert east.availability < west.availability - 0.1


def test_a_route_without_a_way_is_refused(found):
    assert "route: expected two or more waypoints" in misuse(predict_route, found, [40.0, 40.0], [-100.0, -100.0])


def simple(command, *place):
    """A mission item; by default its place is where the vehicle then is."""
    lat, lon = place or (None, None)
    return {"type": "SimpleItem", "command": command, "params": [0, 0, 0, None, lat, lon, 50]}


LINE = {"type": "LineString", "coordinates": [[8.0, 47.0, 500.0], [8.1, 47.2]]}
FEATURE = {"type": "Feature", "properties": {}, "geometry": LINE}
POINT = {"type": "Feature", "geometry": {"type": "Point", "coordinates": [1, 2]}}
SURVEY = {"type": "ComplexItem", "TransectStyleComplexItem": {"Items": [simple(16, 47.2, 8.1)]}}
SPEED = {"type": "SimpleItem", "command": 178, "params": [1, 5, -1, 0, 1, 1, 0]}
ITEMS = [simple(22), simple(16, 47.0, 8.0), SPEED, SURVEY, simple(20)]  # from take-off to the return home
PLAN = {"fileType": "Plan", "mission": {"plannedHomePosition": [46.9, 7.9, 400], "items": ITEMS}}


def written(tmp_path, content):
    path = tmp_path / "route.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


@pytest.mark.parametrize("content", [LINE, FEATURE, {"type": "FeatureCollection", "features": [POINT, FEATURE]}])
def test_geojson_gives_latitude_before_longitude(tmp_path, content):
    assert read_route(written(tmp_path, content)).tolist() == [[47.0, 8.0], [47.2, 8.1]]


def test_a_plan_gives_what_it_flies_to_and_home(tmp_path):
    assert read_route(written(tmp_path, PLAN)).tolist() == [[47.0, 8.0], [47.2, 8.1], [46.9, 7.9]]


NEITHER = "expected one GeoJSON LineString, or a QGroundControl plan"
BAD_ROUTES = {
    "not JSON": NEITHER,
    "[]": NEITHER,
    '{"type": "Polygon", "coordinates": []}': NEITHER,
    '{"type": "LineString", "coordinates": [[1, 2]]}': "expected two or more",
    '{"type": "LineString", "coordinates": [[1, 2], [1]]}': NEITHER,
    '{"type": "LineString", "coordinates": [[1, 2], ["a", 2]]}': NEITHER,
    '{"type": "LineString", "coordinates": [[1, 2], [2, NaN]]}': "within 90",
    '{"type": "LineString", "coordinates": [[1, 2], [2, 91]]}': "within 90",
    '{"fileType": "Plan"}': NEITHER,
    '{"fileType": "Plan", "mission": {"items": [3]}}': NEITHER,
    '{"fileType": "Plan", "mission": {"items": []}}': "expected two or more",
}


@pytest.mark.parametrize(("content", "words"), BAD_ROUTES.items())
def test_a_bad_route_is_one_clear_line(tmp_path, content, words):
    with pytest.raises(TelemetryError, match=re.escape(words)) as error:
        read_route(written(tmp_path, content))
    assert str(error.value).startswith("route: ")
    assert "\n" not in str(error.value)


# -------------------------------------------------------------------------------------------------- parts of a map


@pytest.fixture(scope="module")
def town():
    return OrthoMap.from_arrays(np.maximum(town_gray(), 1), GRID, UTM)


@pytest.fixture(scope="module")
def huge_path(tmp_path_factory):
    """A sparse GeoTIFF with overviews; all but the town is nodata, over which averages would take long."""
    path = tmp_path_factory.mktemp("huge") / "huge.tif"
    at = Affine(0.5, 0.0, 600_000.0 - 0.5 * CORNER[0], 0.0, -0.5, 4_500_000.0 + 0.5 * CORNER[1])
    blocks = {"blockxsize": 512, "blockysize": 512}
    town = np.maximum(town_gray(), 1)
    return write_sparse(path, town, CORNER, HUGE_SIDE, Resampling.nearest, crs=UTM, transform=at, **blocks)


@pytest.fixture(scope="module")
def huge(huge_path):
    return OrthoMap.open(huge_path)


def around(site, xy_px, radius_m):
    return (*lat_lon(site, xy_px).tolist(), radius_m)


def test_around_a_place_all_within_the_radius_is_looked_at_and_nothing_else(town):
    plan = plan_audit(town, CAMERA, HEIGHT_M, part=MapPart(around=around(town, [450, 300], 100.0)))
    off_m = np.hypot(*np.moveaxis(plan.centers_px - [450, 300], -1, 0)) * town.gsd_m_per_px
    np.testing.assert_array_equal(plan.audited, off_m <= 100.0)
    assert plan.area_px * town.gsd_m_per_px**2 == pytest.approx(np.pi * 100.0**2, rel=0.1)
    whole = plan_audit(town, CAMERA, HEIGHT_M)
    assert plan.spacing_px == pytest.approx(whole.spacing_px, rel=0.1)
    assert len(plan) < len(whole) / 4


def test_a_radius_below_the_spacing_is_one_place_there(town):
    plan = plan_audit(town, CAMERA, HEIGHT_M, part=MapPart(around=around(town, [450, 300], 1.0)))
    assert plan.centers_px[plan.audited] == pytest.approx(np.array([[450, 300]]), abs=3.0)


def test_a_part_at_the_edge_ends_with_the_map(town):
    plan = plan_audit(town, CAMERA, HEIGHT_M, part=MapPart(around=around(town, [5, 890], 60.0)))
    assert (plan.window.x0, plan.window.y0 + plan.window.height_px) == (0, 900)


@pytest.mark.slow
def test_a_route_is_predicted_from_its_corridor_as_from_the_whole_map(town):
    route = lat_lon(town, [[200, 250], [640, 300], [700, 650]])
    whole = audit_of(plan_audit(town, CAMERA, HEIGHT_M))
    part = audit_of(plan_audit(town, CAMERA, HEIGHT_M, part=MapPart(route=route, corridor_m=10.0)))
    assert len(part.plan) < 0.5 * len(whole.plan)
    stated, expected = (predict_route(one, *route.T) for one in (part, whole))
    assert stated.length_m == expected.length_m
    assert stated.availability == pytest.approx(expected.availability, abs=0.05)
    assert Flag.OUTSIDE not in part.flag_at(stated.xy_px)
    assert (part.flags == Flag.OUTSIDE).any()
    np.testing.assert_array_equal(part.flags == Flag.OUTSIDE, ~part.plan.audited)
    assert np.isnan(part.availability[~part.plan.audited]).all()
    assert sum(part.shares.values()) == pytest.approx(1.0)


def test_the_corridor_is_of_what_the_camera_sees_not_of_where_it_flies(town):
    """A camera that looks 30 degrees to one side sees ground beside the route."""
    turn = cv2.Rodrigues(np.radians([30.0, 0.0, 0.0]))[0]
    aside = Camera(300, 300, CAMERA.matrix, mount=turn @ CAMERA.mount)
    route = lat_lon(town, [[200, 450], [700, 450]])
    fine = AuditOptions(spacing=0.05)
    plan = plan_audit(town, aside, HEIGHT_M, fine, part=MapPart(route=route, corridor_m=5.0))
    beside_m = abs(plan.centers_px[plan.audited][:, 1].mean() - 450) * town.gsd_m_per_px
    assert beside_m == pytest.approx(HEIGHT_M * np.tan(np.radians(30.0)), abs=3.0)


def test_both_parts_are_looked_at(town):
    place, route = around(town, [200, 200], 50.0), lat_lon(town, [[500, 700], [800, 700]])
    both = plan_audit(town, CAMERA, HEIGHT_M, part=MapPart(around=place, route=route))
    parts = MapPart(around=place), MapPart(route=route)
    one, other = (plan_audit(town, CAMERA, HEIGHT_M, part=part) for part in parts)
    assert len(both) == pytest.approx(len(one) + len(other), rel=0.15)


@pytest.mark.slow
def test_a_long_way_over_a_huge_map_has_no_more_places_and_no_finer_grid_than_memory_allows(huge):
    route = lat_lon(huge, [[10, 10], [23_990, 23_990], [23_990, 10]])
    plan = plan_audit(huge, CAMERA, 20.0, AuditOptions(max_cells=500), part=MapPart(route=route, corridor_m=5.0))
    assert 100 < len(plan) <= 500
    assert plan.audited.size < 200_000


def test_a_part_of_nothing_is_refused():
    assert "part: expected around or route" in misuse(MapPart)
    assert "around: expected metres above 0, got 0" in misuse(MapPart, around=(40.0, -99.0, 0.0))


def test_a_part_beside_the_map_is_refused(town):
    with pytest.raises(OptionError, match="part: expected one on the map arrays, got one off it"):
        plan_audit(town, CAMERA, HEIGHT_M, part=MapPart(around=around(town, [-5000, 100], 100.0)))


# ---------------------------------------------------------------------------------------------- command line


def audit(map_file, out, *more):
    """The command."""
    return ["map", "audit", str(map_file), f"--height-agl={HEIGHT_M:g}", f"--out={out}", *map(str, more)]


def write_route(folder, site, xy_px):
    """A route through pixels of a map, as GeoJSON."""
    return written(folder, {"type": "LineString", "coordinates": lat_lon(site, xy_px)[:, ::-1].tolist()})


@pytest.fixture(scope="module")
def map_file(patchwork, tmp_path_factory):
    gray, valid = patchwork
    path = tmp_path_factory.mktemp("map") / "map.tif"
    write_geotiff(path, np.where(valid, np.maximum(gray, 1), 0).astype(np.uint8), GRID, 32614, nodata=0)
    return path


@pytest.fixture(scope="module")
def route_file(site, tmp_path_factory):
    return write_route(tmp_path_factory.mktemp("route"), site, [[130, 225], [780, 225]])


@pytest.mark.slow
def test_the_command_writes_raster_picture_and_summary(map_file, route_file, found, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(audit(map_file, out, f"--route={route_file}", "--json")) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    summary = json.loads(printed.out)
    assert summary == json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert {path.name for path in out.iterdir()} == {"matchability.tif", "audit.png", "summary.json"}
    assert summary["shares"] == pytest.approx(found.shares, abs=0.03)
    assert [one["flag"] for one in summary["route"]["stretches"]] == ["flat"]
    assert cv2.imread(str(out / "audit.png"), cv2.IMREAD_GRAYSCALE).std() > 5


@pytest.mark.slow
def test_the_raster_lies_where_the_map_does(map_file, found, tmp_path):
    out = tmp_path / "out"
    assert run(audit(map_file, out)) == 0
    with rasterio.open(out / "matchability.tif") as raster, rasterio.open(map_file) as ground:
        values, cell, pixel = raster.read(1), raster.transform, ground.transform
        assert (raster.crs, raster.nodata) == (ground.crs, -1.0)
    assert values.dtype == np.float32
    assert (cell.c, cell.f) == pytest.approx((pixel.c, pixel.f), abs=0.01)
    assert np.array(values.shape) * (-cell.e, cell.a) == pytest.approx(SIDE * pixel.a, abs=0.01)
    x, y = cell.c + 4.5 * cell.a, cell.f + 3.5 * cell.e
    assert ((values == -1.0) == np.isnan(found.availability)).mean() > 0.97
    lon, lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(x, y)
    place = found.plan.site.pixel_from_geodetic(lat, lon)
    assert place == pytest.approx(found.plan.centers_px[3, 4], abs=0.02)


@pytest.mark.slow
def test_people_get_a_table_and_a_folder_is_kept_unless_forced(map_file, route_file, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").touch()
    command = audit(map_file, tmp_path / "out", f"--route={route_file}")
    assert "--force" in refusal(capsys, command)
    assert run([*command, "--force"]) == 0
    assert (tmp_path / "out" / "mine.txt").exists()
    printed = capsys.readouterr()
    assert re.search(r"^good +\d+\.\d%$", printed.out, re.MULTILINE)
    assert "poor: flat" in printed.out
    first, second = printed.err.splitlines()
    assert first == f"written to {tmp_path / 'out'}"
    assert second.startswith("next: scenematch track --map ")
    assert "\x1b" not in printed.out


@pytest.mark.parametrize(
    ("more", "code", "words"),
    [
        (["--height-agl=0"], 2, "--height-agl: expected"),
        (["--settings=audit.prior_sigma_m=-1"], 2, "--settings audit.prior_sigma_m: expected"),
        (["--route=nowhere.plan"], 1, "--route: no such file: nowhere.plan"),
        (["--camera=nowhere.yaml"], 1, "nowhere.yaml"),
        (["--surface=nowhere.tif"], 1, "nowhere.tif"),
    ],
)
def test_bad_input_is_one_line_and_no_folder(map_file, tmp_path, capsys, more, code, words):
    out = tmp_path / "out"
    assert words in refusal(capsys, audit(map_file, out, *more), code)
    assert not out.exists()


def test_a_route_elsewhere_is_refused(map_file, tmp_path, capsys):
    line = refusal(capsys, audit(map_file, tmp_path / "out", f"--route={written(tmp_path, LINE)}"))
    assert line.startswith("--route: expected a route over the map")
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def huge_route(huge, tmp_path_factory):
    return write_route(tmp_path_factory.mktemp("route"), huge, np.array([[200, 250], [640, 300]]) + CORNER)


@pytest.mark.slow
def test_a_huge_map_is_audited_around_a_place_in_a_part_of_the_memory(huge_path, huge, tmp_path, capsys):
    """Its grey levels and validity would take 1,152 MB."""
    import matplotlib.figure  # noqa: F401  an import while memory is traced takes long

    lat, lon = lat_lon(huge, MIDDLE)
    tracemalloc.start()
    summary = answer(capsys, audit(huge_path, tmp_path / "out", f"--around={lat:.8f},{lon:.8f},80"))
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < HUGE_SIDE * HUGE_SIDE / 3
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
def test_a_huge_map_is_audited_along_a_route(huge_path, huge_route, tmp_path, capsys):
    summary = answer(capsys, audit(huge_path, tmp_path / "out", f"--route={huge_route}"))
    assert summary["route"]["availability"] > 0.3
    assert 0.02 < summary["part"]["area_km2"] < 0.08
    near = answer(capsys, audit(huge_path, tmp_path / "near", f"--route={huge_route}", "--corridor-m=10"))
    assert near["part"]["area_km2"] < summary["part"]["area_km2"] / 2


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ([], "--around: expected LAT,LON,RADIUS_M, or a --route to audit along: the map of 12 x 12 km is too"),
        (["--around=40.6,-97.7"], "--around: expected LAT,LON,RADIUS_M in degrees and metres, got '40.6,-97.7'"),
        (["--around=north"], "--around: expected LAT,LON,RADIUS_M in degrees and metres, got 'north'"),
        (["--around=40.6,-97.7,0"], "--around: expected a place on the Earth and a radius above 0 m"),
        (["--around=95,-97.7,10"], "--around: expected a place on the Earth and a radius above 0 m"),
        (["--around=41.6,-97.7,10"], "--around: expected a place on the map huge.tif, got 41.6,-97.7"),
        (["--around=40.62,-97.85,9000"], "--around: expected at most 134 km2 of the map to audit, got 14"),
        (["--corridor-m=50"], "--corridor-m: expected a --route with it, got none"),
        (["--route=route.json", "--corridor-m=-1"], "--corridor-m: expected metres above 0, got -1"),
    ],
)  # fmt: skip
def test_what_cannot_be_audited_is_one_line(huge_path, huge_route, tmp_path, capsys, monkeypatch, more, words):
    monkeypatch.chdir(huge_route.parent)
    assert refusal(capsys, audit(huge_path, tmp_path / "out", *more)).startswith(words)
    assert not (tmp_path / "out").exists()
