"""Audits: what is painted on a map is flagged as what it is, the raster lies where the map does, routes read."""

import json
import re

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import Transformer

from engine import Camera, OrthoMap
from engine.errors import OptionError, TelemetryError
from scenematch.check.availability import Flag, audit_site, fix_probability, predict_route
from scenematch.check.plan import AuditOptions, plan_audit
from scenematch.check.self_match import measure_self_match
from scenematch.cli.app import run
from scenematch.files.geotiff import write_geotiff
from scenematch.files.route import read_route
from tests.support.audits import CAMERA, GRID, HEIGHT_M, SIDE, UTM, audit, lat_lon, town_gray, write_route
from tests.support.commands import refusal

NOISE = 3.0  # of the water, in grey levels
HALF = SIDE // 2


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
    return audit_site(site, CAMERA, HEIGHT_M)


def well_inside(found, x0, y0):
    """The places whose whole window lies in one quarter of the map."""
    reach = 0.8 * found.plan.view.footprint_px[0]
    low = np.array([x0, y0]) + reach
    inside = ((found.plan.centers_px > low) & (found.plan.centers_px < low + HALF - 2 * reach)).all(axis=-1)
    assert inside.sum() >= 4
    return inside


def test_each_quarter_is_flagged_as_what_it_is(found):
    quarters = ((HALF, 0, Flag.FLAT), (0, HALF, Flag.REPEATED), (HALF, HALF, Flag.NODATA))
    for x0, y0, flag in quarters:
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


def test_a_field_that_repeats_is_its_own_rival(found):
    assert (found.statistics.rival[well_inside(found, 0, HALF)] > 0.95).all()
    assert (found.statistics.rival[well_inside(found, 0, 0)] < 0.9).all()


def test_more_lead_and_more_score_never_make_a_fix_less_probable():
    ladder = np.linspace(0.0, 40.0, 100)
    assert (np.diff(fix_probability(20.0, 15.0, ladder)) >= 0).all()
    assert (np.diff(fix_probability(20.0, ladder, 3.0)) >= 0).all()
    assert np.isnan(fix_probability(20.0, 15.0, np.nan))


@pytest.mark.slow
def test_fine_random_texture_is_less_stable_than_a_town():
    rng = np.random.default_rng(1)
    leaves = np.clip(90 + 25 * rng.normal(size=(600, 600)), 0, 255).astype(np.uint8)
    values = []
    for gray in (leaves, np.ascontiguousarray(town_gray()[:600, :600])):
        plan = plan_audit(OrthoMap.from_arrays(gray, GRID, UTM), CAMERA, HEIGHT_M)
        values.append(np.array([one.stability for one in measure_self_match(plan)]))
    assert np.nanmax(values[0]) < np.nanmin(values[1])


@pytest.mark.slow
def test_another_date_finds_what_changed():
    """Half of the map was built anew: the other date's half is another town."""
    before, later = town_gray(), town_gray()
    later[:, HALF:] = before[::-1, ::-1][:, HALF:]
    sites = [OrthoMap.from_arrays(gray, GRID, UTM) for gray in (before, later)]
    found = audit_site(sites[0], CAMERA, HEIGHT_M, other=sites[1])
    alone = audit_site(sites[0], CAMERA, HEIGHT_M)
    x = found.plan.centers_px[..., 0]
    known = ~np.isnan(found.availability)
    reach = found.plan.view.footprint_px[0]
    same, changed = known & (x < HALF - reach), known & (x > HALF + reach)
    assert (found.flags[same] == alone.flags[same]).all()
    was_good = changed & (alone.flags == Flag.GOOD)
    assert was_good.sum() > 4
    assert (found.flags[was_good] == Flag.STALE).all()
    assert (found.availability[changed] <= alone.availability[changed]).all()


@pytest.mark.slow
def test_the_same_map_gives_the_same_audit(site, found):
    again = audit_site(site, CAMERA, HEIGHT_M)
    assert np.array_equal(again.availability, found.availability, equal_nan=True)


def test_a_large_map_gets_no_more_places_than_asked_for(site):
    plan = plan_audit(site, CAMERA, 20.0, AuditOptions(max_cells=50))
    assert len(plan) <= 70  # rounded up along both sides
    assert len(plan_audit(site, CAMERA, 20.0)) > 500


@pytest.mark.parametrize("height_m", [0.0, -5.0, float("nan"), float("inf"), 5000.0, 0.5])
def test_a_height_that_cannot_be_is_refused(site, height_m):
    with pytest.raises(OptionError, match="height_agl_m: expected"):
        plan_audit(site, CAMERA, height_m)


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
    route = predict_route(found, *lat_lon(site, [[130, 225], [780, 225]]).T)
    (stretch,) = route.stretches
    start = site.pixel_from_geodetic(stretch.start_lat_deg, stretch.start_lon_deg)
    assert abs(start[0] - HALF) < found.plan.view.footprint_px[0]
    assert start[1] == pytest.approx(225, abs=1)
    end = site.pixel_from_geodetic(stretch.end_lat_deg, stretch.end_lon_deg)
    assert end == pytest.approx([780, 225], abs=1)


def test_off_the_map_nothing_is_available(site, found):
    route = predict_route(found, *lat_lon(site, [[-3000, -3000], [-2000, -3000]]).T)
    assert route.availability == 0.0
    assert route.stretches[0].flag == "edge"


@pytest.mark.slow
def test_where_a_forward_camera_looks_counts_not_where_it_is(site):
    """A camera that is mounted 20 degrees ahead sees the water before it is over it, whichever way it flies."""
    turn = cv2.Rodrigues(np.array([0.0, np.radians(20.0), 0.0]))[0]
    ahead = Camera(300, 300, CAMERA.matrix, mount=turn @ CAMERA.mount)
    found = audit_site(site, ahead, HEIGHT_M)
    east = predict_route(found, *lat_lon(site, [[HALF, 250], [HALF + 20, 250]]).T)
    west = predict_route(found, *lat_lon(site, [[HALF + 20, 250], [HALF, 250]]).T)
    assert abs(east.availability - west.availability) > 0.1
    assert (turn @ CAMERA.mount)[0, 2] > 0  # the axis points ahead
    assert east.availability < west.availability


def test_a_route_without_a_way_is_refused(found):
    with pytest.raises(OptionError, match="route: expected two or more waypoints"):
        predict_route(found, [40.0, 40.0], [-100.0, -100.0])


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


BAD_ROUTES = {
    "not JSON": "cannot be read as JSON",
    "[]": "expected one route",
    '{"type": "Polygon", "coordinates": []}': "expected one route",
    '{"type": "LineString", "coordinates": [[1, 2]]}': "expected two or more",
    '{"type": "LineString", "coordinates": [[1, 2], [1]]}': "expected a position",
    '{"type": "LineString", "coordinates": [[1, 2], ["a", 2]]}': "expected a latitude",
    '{"type": "LineString", "coordinates": [[1, 2], [2, NaN]]}': "expected a latitude",
    '{"type": "LineString", "coordinates": [[1, 2], [2, 91]]}': "within 90",
    '{"fileType": "Plan"}': "mission.items",
    '{"fileType": "Plan", "mission": {"items": [3]}}': "expected mission items",
    '{"fileType": "Plan", "mission": {"items": []}}': "expected two or more",
}


@pytest.mark.parametrize(("content", "words"), BAD_ROUTES.items())
def test_a_bad_route_is_one_clear_line(tmp_path, content, words):
    with pytest.raises(TelemetryError, match=re.escape(words)) as error:
        read_route(written(tmp_path, content))
    assert str(error.value).startswith("route: ")
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------------------------------------- command line


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
        assert raster.crs == ground.crs
        assert raster.nodata == -1.0
    assert values.dtype == np.float32
    assert (cell.c, cell.f) == pytest.approx((pixel.c, pixel.f), abs=0.01)
    assert np.array(values.shape) * (-cell.e, cell.a) == pytest.approx(SIDE * pixel.a, abs=0.01)
    x, y = cell.c + 4.5 * cell.a, cell.f + 3.5 * cell.e
    assert ((values == -1.0) == np.isnan(found.availability)).mean() > 0.97
    lon, lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(x, y)
    place = found.plan.site.pixel_from_geodetic(lat, lon)
    assert place == pytest.approx(found.plan.centers_px[3, 4], abs=0.02)


@pytest.mark.slow
def test_people_get_a_table_and_a_pipe_no_escapes(map_file, route_file, tmp_path, capsys):
    assert run(audit(map_file, tmp_path / "out", f"--route={route_file}")) == 0
    printed = capsys.readouterr()
    assert re.search(r"^good +\d+\.\d%$", printed.out, re.MULTILINE)
    assert "poor: flat" in printed.out
    stated = printed.err.splitlines()
    assert stated[0] == f"written to {tmp_path / 'out'}"
    assert len(stated) == 2
    assert stated[1].startswith("next: scenematch track --map ")
    assert "\x1b" not in printed.out


@pytest.mark.slow
def test_a_folder_that_exists_is_kept_unless_forced(map_file, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine", encoding="utf-8")
    assert "--force" in refusal(capsys, audit(map_file, out))
    assert [path.name for path in out.iterdir()] == ["mine.txt"]
    assert run(audit(map_file, out, "--force")) == 0
    assert (out / "mine.txt").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize(
    ("more", "code", "words"),
    [
        (["--height-agl=0"], 2, "--height-agl: expected"),
        (["--settings=audit.prior_sigma_m=-1"], 2, "--settings audit.prior_sigma_m: expected"),
        (["--route=nowhere.plan"], 1, "--route: no such file: nowhere.plan"),
        (["--camera=nowhere.yaml"], 1, "nowhere.yaml"),
        (["--surface=nowhere.tif"], 1, "nowhere.tif"),
        (["--other=nowhere.tif"], 1, "nowhere.tif"),
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
