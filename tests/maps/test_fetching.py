"""Maps fetched from a server on loopback are what it serves, where it lies; what goes wrong is one clear line."""

import io
import itertools
import json
import re
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from PIL import Image
from pyproj import CRS, Transformer
from rasterio.transform import Affine

from engine import MapError, OptionError, OrthoMap, Window
from scenematch.cli.app import run
from scenematch.fetch import pictures
from scenematch.fetch.heights import files_for, read_part
from scenematch.runs.map_fetch import FetchSettings, fetch_map
from tests.support.commands import answer
from tests.support.map_servers import HALF_WORLD_M, serving
from tests.support.photos import gimbal, photograph
from tests.support.rasters import whole, write_raster
from tests.support.refusals import refusal

SIZE = 700
GSD_M = 0.5
CORNER = (613_000.0, 5_345_000.0)  # UTM 33N, near Vienna: easting and northing
ZOOM = 18


def from_origin(west, north, step):
    return Affine(step, 0.0, west, 0.0, -step, north)


def encoded(size):
    """(H, W, 3) whose pixels say their own column and row."""
    row, column = np.mgrid[:size, :size]
    return np.stack([column % 256, row % 256, column // 256 * 16 + row // 256 + 1], axis=-1).astype(np.uint8)


def place_of(pixels):
    """(..., 2) column and row that pixels (..., 3) say."""
    r, g, b = np.moveaxis(pixels.astype(int), -1, 0)
    return np.stack([r + 256 * ((b - 1) // 16), g + 256 * ((b - 1) % 16)], axis=-1)


@pytest.fixture(scope="module")
def raster(tmp_path_factory):
    path = tmp_path_factory.mktemp("served") / "ortho.tif"
    corner = from_origin(*CORNER, GSD_M)
    return write_raster(path, np.moveaxis(encoded(SIZE), 2, 0), crs="EPSG:32633", transform=corner)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return tmp_path_factory.mktemp("files")


@pytest.fixture(scope="module")
def one_server(raster, files):
    with serving(raster, files) as server:
        yield server


@pytest.fixture
def server(one_server, raster, monkeypatch):
    """Asked without a proxy, and nothing of another test left."""
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(pictures, "FIRST_WAIT_S", 0.01)
    one_server.begin(raster)
    return one_server


@pytest.fixture(scope="module")
def middle():
    lon, lat = Transformer.from_crs(32633, 4326, always_xy=True).transform(CORNER[0] + 175.0, CORNER[1] - 175.0)
    return f"{lat},{lon}"


@pytest.fixture
def settings(middle):
    """Settings of a fetch about the middle of the raster."""

    def make(source, radius_m=60.0, **others):
        others = {"gsd_m_per_px": 0.5, "pause_ms": 0.0, "timeout_s": 60.0} | others
        return FetchSettings(around=middle, radius_m=radius_m, source=source, **others)

    return make


@pytest.fixture
def fetched(settings, tmp_path):
    """Fetch into a new file: the facts, the pixels (H, W, 4) and the open dataset's profile."""
    numbers = itertools.count()

    def fetch(source, radius_m=60.0, **others):
        out = tmp_path / f"map-{next(numbers)}.tif"
        facts = fetch_map(settings(source, radius_m, **others), out)
        with rasterio.open(out) as file:
            pixels = np.moveaxis(np.concatenate([file.read(), file.dataset_mask()[None]]), 0, 2)
            return facts, pixels, file.profile | {"tags": file.tags(), "bounds": file.bounds}

    return fetch


def refused(wanted, folder, error=MapError):
    """Why a fetch into a folder fails."""
    return refusal(fetch_map, wanted, folder / "map.tif", error=error)


def tile_answer(side_px=256):
    """A grey tile, as a server sends it."""
    picture = io.BytesIO()
    Image.new("RGB", (side_px, side_px), (90, 100, 110)).save(picture, "PNG")
    return picture.getvalue()


def offsets_px(pixels, profile):
    """Distance of what each valid pixel says from where it lies, in pixels of the served raster."""
    row, column = np.nonzero(pixels[..., 3])
    x, y = profile["transform"] @ (column + 0.5, row + 0.5)
    east, north = Transformer.from_crs(profile["crs"], 32633, always_xy=True).transform(x, y)
    here = np.stack([(east - CORNER[0]) / GSD_M, (CORNER[1] - north) / GSD_M], axis=-1) - 0.5
    return np.abs(place_of(pixels[row, column, :3]) - here).max(axis=-1)


# ------------------------------------------------------------ what is fetched


@pytest.mark.parametrize("template", ["tiles/{z}/{x}/{y}.png", "tms/{z}/{x}/{-y}.png", "quadkeys/{q}"])
def test_tiles_lie_where_they_say(server, fetched, template):
    facts, pixels, profile = fetched(f"{server.url}/{template}")
    found = (facts["kind"], facts["level"], facts["crs"], profile["count"])
    assert found == ("XYZ", str(ZOOM), "EPSG:3857", 3)
    assert facts["gsd_m_per_px"] == pytest.approx(0.399, abs=0.002)  # of level 18 at 48 degrees
    assert offsets_px(pixels, profile).max() < 0.51
    assert facts["tiles"] == len(server.asked) == facts["width_px"] * facts["height_px"] // 256**2


@pytest.mark.parametrize(
    ("version", "crs"),
    [
        ("1.3.0", "EPSG:31256"), ("1.3.0", "EPSG:4326"), ("1.3.0", "CRS:84"), ("1.3.0", None),
        ("1.1.1", "EPSG:3857"), ("1.1.1", "EPSG:4326"), ("1.1.1", "EPSG:31256"),
    ],
)  # fmt: skip
def test_a_wms_draws_on_the_grid_that_is_asked_for(server, fetched, version, crs):
    server.wms_version = version
    server.most_px = 200 if version == "1.3.0" else 1024  # 1.1.1 does not state it
    facts, pixels, profile = fetched(f"{server.url}/wms?map=/town.map", crs=crs)
    assert profile["crs"].to_epsg() == {None: 32633, "CRS:84": 4326}.get(crs) or profile["crs"] == crs
    assert facts["gsd_m_per_px"] == pytest.approx(0.5, rel=1e-6)
    assert facts["tiles"] == (4 if version == "1.3.0" else 1)  # 240 px a side and a little
    assert pixels[..., 3].all()
    assert offsets_px(pixels, profile).max() < 0.51 + (0.1 if crs in ("EPSG:4326", "CRS:84") else 0.0)
    assert all("map=/town.map" in path for path in server.asked)
    assert facts["server_states"] == [
        "Title: The town", "Fees: none", "AccessConstraints: only for tests", "Attribution: the town's surveyor",
    ]  # fmt: skip
    assert profile["tags"]["ATTRIBUTION"] == "the town's surveyor"


@pytest.mark.parametrize("kvp", [False, True], ids=["template", "query"])
def test_a_wmts_is_read_in_its_own_grid(server, fetched, kvp):
    server.kvp = kvp
    facts, pixels, profile = fetched(f"{server.url}/wmts" + ("" if kvp else "/1.0.0/WMTSCapabilities.xml"))
    assert (facts["kind"], facts["level"], profile["crs"].to_epsg()) == ("WMTS", "EPSG:31256", 31256)
    assert (profile["transform"].a, profile["transform"].e) == pytest.approx((0.5, -0.5), rel=1e-9)
    assert offsets_px(pixels, profile).max() < 0.51
    assert facts["server_states"][1] == "AccessConstraints: CC BY"


def test_the_engine_reads_the_pixels_that_were_served(server, tmp_path):
    """Of tiles cut from a picture that is on their grid: equal to the bit, in the same place."""
    step, corner = 2.0 * HALF_WORLD_M / (256 << ZOOM), (143_000 * 256 + 70, 90_900 * 256 + 40)
    origin = corner[0] * step - HALF_WORLD_M, HALF_WORLD_M - corner[1] * step
    noise = np.random.default_rng(0).integers(1, 255, (3, SIZE, SIZE), np.uint8)
    write_raster(tmp_path / "own.tif", noise, crs="EPSG:3857", transform=from_origin(*origin, step))
    centre = origin[0] + SIZE / 2 * step, origin[1] - SIZE / 2 * step
    lon, lat = Transformer.from_crs(3857, 4326, always_xy=True).transform(*centre)
    server.raster = tmp_path / "own.tif"
    wanted = FetchSettings(
        around=f"{lat},{lon}", radius_m=260.0, source=server.tiles, pause_ms=0.0,
        map_sigma_m=1.5, attribution="a surveyor", licence="CC BY 4.0",
    )  # fmt: skip
    facts = fetch_map(wanted, tmp_path / "map.tif")
    own, site = OrthoMap.open(tmp_path / "own.tif"), OrthoMap.open(tmp_path / "map.tif")
    x, y = np.rint(site.pixel_from_geodetic(*own.geodetic_from_pixel([0.0, 0.0]))).astype(int).tolist()
    first = own.geodetic_from_pixel([0.0, 0.0])
    np.testing.assert_allclose(site.geodetic_from_pixel([float(x), float(y)]), first, atol=1e-9)
    part = Window(x, y, SIZE, SIZE)
    assert site.valid(part).all()
    np.testing.assert_array_equal(site.gray(part), own.gray(Window(0, 0, SIZE, SIZE)))
    everything = site.valid(whole(site))
    assert everything.sum() == SIZE * SIZE  # what is beside the picture, or in a missing tile, is nodata
    assert facts["nodata_share"] == pytest.approx(1.0 - everything.mean())
    assert site.georeference_sigma_m == 1.5
    with rasterio.open(tmp_path / "map.tif") as file:
        assert (file.tags()["ATTRIBUTION"], file.tags()["LICENCE"]) == ("a surveyor", "CC BY 4.0")
        assert file.tags()["SOURCE"] == wanted.source
        assert (file.profile["compress"], file.profile["tiled"]) == ("deflate", True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.tif", "own.tif"]


# ------------------------------------------------------------ manners, interruptions


def test_nothing_is_asked_for_where_too_much_is_wanted_or_nothing_is_to_be_fetched(server, settings, tmp_path):
    line = refused(settings(server.tiles, 300.0, max_tiles=9), tmp_path, OptionError)
    count = int(re.search(r"max_tiles: expected at most 9 tiles, but the area has (\d+)", line)[1])
    facts = fetch_map(settings(server.tiles, 300.0, max_tiles=count, dry_run=True), tmp_path / "map.tif")
    assert (facts["tiles"], facts["dry_run"]) == (count, True)
    assert server.asked == []
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_fetch_goes_on_where_it_was(server, settings, tmp_path):
    wanted, out = settings(server.tiles, 120.0), tmp_path / "map.tif"
    fetch_map(wanted, tmp_path / "whole.tif")
    first_asked = list(server.asked)
    server.asked.clear()
    server.trouble[:] = [(first_asked[4], (403, {}))]
    assert "answers 403: access denied" in refused(wanted, tmp_path)
    assert len(server.asked) == 5
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith("map.tif")] == ["map.tif.tiles"]
    (tmp_path / "map.tif.tiles" / "mine.txt").write_text("the user's own", encoding="utf-8")
    server.asked.clear()
    fetch_map(wanted, out)
    assert server.asked == first_asked[4:]
    assert [path.name for path in (tmp_path / "map.tif.tiles").rglob("*")] == ["mine.txt"]
    with rasterio.open(out) as one, rasterio.open(tmp_path / "whole.tif") as other:
        np.testing.assert_array_equal(one.read(), other.read())
        assert one.transform == other.transform


def test_a_busy_server_is_waited_for(server, settings, tmp_path, monkeypatch):
    waits = []
    monkeypatch.setattr(pictures.time, "sleep", waits.append)
    server.trouble[:] = [("/tiles/", (429, {})), ("/tiles/", (503, {})), ("/tiles/", (502, {}))]
    facts = fetch_map(settings(server.tiles, pause_ms=250.0), tmp_path / "map.tif")
    assert len(server.asked) == facts["tiles"] + 3
    assert waits == pytest.approx([0.0, 0.01, 0.02, 0.04] + [0.25] * (facts["tiles"] - 1))
    assert len(server.agents) == 1
    assert server.agents.pop().startswith("scenematch")
    server.trouble[:] = [("/tiles/", (503, {}))] * 5
    with pytest.raises(MapError, match=r"the server answers 503, at attempt 5$"):
        fetch_map(settings(server.tiles), tmp_path / "other.tif")


def test_what_is_no_picture_is_refused_in_one_line(server, settings, tmp_path):
    source = f"{server.tiles}?key=S3CRET"
    for sent, text in (
        (b"<html><body>Please <b>log in</b></body></html>", "expected pictures, got something else"),
        (tile_answer(512), "Incorrect size 512 x 512 of downloaded block, expected 256 x 256"),
        ("break", "expected pictures, got something else"),
        ((401, {}), "the server answers 401: access denied"),
    ):
        server.trouble[:] = [("/tiles/", sent)]
        message = refused(settings(source), tmp_path)
        assert text in message
        assert "S3CRET" not in message
    assert list(tmp_path.iterdir()) == []


def test_where_nothing_is(server, settings, tmp_path):
    tile = "{z}/{x}/{y}.png"
    for source, words in (
        (f"{server.url}/nowhere/{tile}", "source: the server has no data there on level '18', 0.398 m/px"),
        (f"{server.url}/nowhere", "/nowhere?SERVICE=WMS&REQUEST=GetCapabilities: the server answers 404"),
        (f"http://no-such-host.invalid/{tile}", "Could not resolve host: no-such-host"),
        (f"http://127.0.0.1:9/{tile}", "Failed to connect to 127"),
    ):
        assert words in refused(settings(source), tmp_path)
    with pytest.raises(MapError, match="source: the server has no data there on level 'EPSG:3857'"):
        fetch_map(replace(settings(f"{server.url}/wms", gsd_m_per_px=None), around="10,10"), tmp_path / "map.tif")


def test_a_proxy_that_is_not_there_is_one_line_without_its_password(settings, tmp_path, monkeypatch):
    monkeypatch.setenv("http_proxy", "http://user:secret@127.0.0.1:9")
    monkeypatch.delenv("no_proxy", raising=False)
    line = refused(settings("http://example.org/{z}/{x}/{y}.png"), tmp_path)
    assert "Failed to connect to example.org port 80 via 127" in line
    assert "secret" not in line


def test_a_wms_says_which_layers_it_has_and_what_was_wrong(server, settings, tmp_path):
    server.layers = ("ortho", "cadastre")
    for layer, got in ((None, "none"), ("roofs", "roofs")):
        line = refused(settings(f"{server.url}/wms", layer=layer), tmp_path, OptionError)
        assert f"layer: expected one that the server has, ortho, cadastre, got {got}" in line
    server.trouble[:] = [("GetMap", b"<ServiceExceptionReport><ServiceException code='X'>Style &lt;no&gt; unknown"
                          b"</ServiceException></ServiceExceptionReport>")]  # fmt: skip
    assert "Style <no> unknown" in refused(settings(f"{server.url}/wms?LAYERS=ortho"), tmp_path)
    server.asked.clear()
    fetch_map(settings(f"{server.url}/wms", layer="cadastre", image_format="image/jpeg"), tmp_path / "map.tif")
    assert all("format=image/jpeg" in path.lower() for path in server.asked[1:]), server.asked


# ------------------------------------------------------------ surface models


def height_tile(path, lat, lon, nodata=None):
    """A file as Copernicus GLO-30 has them, coarser: the first pixel's centre is on the north-western degree."""
    step = 1.0 / 1200.0
    transform = Affine(step, 0.0, lon - step / 2, 0.0, -step, lat + 1 + step / 2)
    heights = plane(*np.meshgrid(*(transform @ (np.arange(1200) + 0.5, np.arange(1200) + 0.5))))
    write_raster(path, heights, crs="EPSG:4326", transform=transform, nodata=nodata, tiled=True)


def plane(lon, lat):
    """Heights that say where they are."""
    return (200.0 + 1e3 * (lon - 16.0) - 2e3 * (lat - 48.0)).astype(np.float32)


@pytest.mark.parametrize("remote", [True, False], ids=["url", "files"])
def test_a_surface_is_cut_from_the_files_of_degrees(server, files, settings, tmp_path, remote):
    """Over the corner of three files, the fourth being sea: heights as they are, their datum and slope stated."""
    names = "Copernicus_DSM_COG_10_{lat}_00_{lon}_00_DEM.tif"
    for lat, lon in ((48, 16), (48, 17), (47, 16)):
        height_tile(files / names.format(lat=f"N{lat}", lon=f"E0{lon}"), lat, lon)
    surface = f"{server.url}/files/{names}" if remote else f"{files}/{names}"
    wanted = replace(settings(server.tiles, 2000.0, gsd_m_per_px=50.0, surface=surface), around="48.0,17.0")
    server.trouble[:] = [("/tiles/", tile_answer()) for _ in range(4)]
    facts = fetch_map(wanted, tmp_path / "map.tif")
    stated = (facts["surface"], facts["surface_datum"])
    assert stated == (str(tmp_path / "map-surface.tif"), "EGM2008 height")
    assert 0.1 < facts["surface_nodata_share"] < 0.5
    with rasterio.open(tmp_path / "map-surface.tif") as file, rasterio.open(tmp_path / "map.tif") as ground:
        heights, known = file.read(1), file.dataset_mask() > 0
        row, column = np.nonzero(known)
        lon, lat = file.transform @ (column + 0.5, row + 0.5)
        np.testing.assert_allclose(heights[known], plane(lon, lat), atol=1e-2)  # float32, and no resampling
        lon, lat = file.transform @ (np.indices(known.shape)[::-1] + 0.5)
        half = file.transform.a / 2
        np.testing.assert_array_equal(known, ~((lon > 17.0 - half) & (lat < 48.0 + half)))  # the south-east is sea
        around = np.subtract(file.bounds, rasterio.warp.transform_bounds("EPSG:3857", "EPSG:4326", *ground.bounds))
        assert (around * [1, 1, -1, -1] < 0.0).all()  # it reaches beyond the map on every side
    site = OrthoMap.open(tmp_path / "map.tif", surface=tmp_path / "map-surface.tif")
    assert (site.surface_datum, site.slope_sigma_deg) == ("EGM2008 height", 0.5)


def test_files_of_degrees_by_their_names():
    assert files_for("d/{lat}{lon}.tif", (-0.2, -0.2, 0.2, 0.2)) == [
        "d/S01W001.tif", "d/S01E000.tif", "d/N00W001.tif", "d/N00E000.tif"
    ]  # fmt: skip
    assert files_for("own.tif", (0, 0, 1, 1)) == ["own.tif"]


def test_surfaces_that_cannot_be(server, files, settings, tmp_path):
    height_tile(files / "far.tif", 10, 10)
    (files / "tiles/0/0").mkdir(parents=True)
    (files / "tiles/0/0/0.png").write_bytes(tile_answer())
    (files / "page.tif").write_bytes(b"<html>not here</html>")
    for surface, datum, error, text in (
        (f"{server.url}/files/none.tif", None, MapError, "there is no http://127.0.0.1"),
        (f"{server.url}/files/page.tif", None, MapError, "page.tif: cannot be read as a GeoTIFF"),
        (str(files / "none.tif"), None, MapError, "surface: expected a file of heights, but there is no /"),
        (str(files / "{lat}{lon}.tif"), None, MapError, "surface: expected a file of heights, but there is no "),
        (str(files / "far.tif"), None, MapError, "surface: "),
        (str(files / "tiles"), None, MapError, "surface: expected georeferenced raster files in the folder"),
        (str(files / "far.tif"), "EPSG:4326", OptionError, "surface_datum: expected a vertical datum in metres"),
    ):
        assert text in refused(settings(server.tiles, surface=surface, surface_datum=datum), tmp_path, error)
    assert not (tmp_path / "map.tif").exists()


@pytest.mark.slow
def test_heights_are_waited_for_no_longer_than_agreed(server, files):
    height_tile(files / "silent.tif", 48, 16)
    server.trouble[:] = [("silent.tif", "silence")] * 99
    begin_s = time.monotonic()
    with pytest.raises(MapError, match=re.escape("silent.tif: cannot be read as a GeoTIFF in byte ranges")):
        read_part([f"{server.url}/files/silent.tif"], (16.2, 48.2, 16.3, 48.3), CRS.from_epsg(4326), None, 1.0)
    assert time.monotonic() - begin_s < 60.0  # GDAL asks again, some times


# ------------------------------------------------------------ the command


def test_the_command_says_what_it_does(server, middle, tmp_path, capsys):
    out = tmp_path / "map.tif"
    given = [
        "map", "fetch", f"--around={middle}", "--radius-m=50", f"--source={server.url}/wms", f"--out={out}",
        "--settings=fetch.pause_ms=0",
    ]  # fmt: skip
    planned = answer(capsys, [*given, "--dry-run"])
    assert planned["dry_run"]
    assert run([*given, "--json"]) == 0
    printed = capsys.readouterr()
    facts = json.loads(printed.out)
    assert (facts["file"], facts["tiles"]) == (str(out), planned["tiles"])
    assert "its terms decide what may be fetched, kept and used" in printed.err
    assert "the server states as AccessConstraints: only for tests" in printed.err
    found = answer(capsys, given, 2)
    assert (found["argument"], "exists" in found["error"]) == ("--out", True)
    assert run([*given, "--force", "--settings=fetch.max_tiles=1", "--radius-m=150"]) == 2
    assert "--settings fetch.max_tiles: expected at most 1 tiles" in capsys.readouterr().err


def test_around_photographs_the_map_holds_what_they_saw_as_fine_as_their_height_needs(server, tmp_path):
    """Two photographs 100 m apart from 75 m: half of 100 m, the height and 50 m about their middle, 0.25 m/px."""
    lat, lon = 48.246, 16.5245
    further = lat + 100.0 / 111_200.0
    for name, degrees in (("a.jpg", lat), ("b.jpg", further)):
        place = {1: "N", 2: (degrees, 0.0, 0.0), 3: "E", 4: (lon, 0.0, 0.0)}
        photograph(tmp_path / name, gps=place, xmp=gimbal(height="+75.00"))
    said: list[str] = []
    wanted = FetchSettings(around=str(tmp_path), source=f"{server.url}/wms", crs="EPSG:32633", dry_run=True)
    facts = fetch_map(wanted, tmp_path / "map.tif", SimpleNamespace(message=said.append))
    west, south, east, north = facts["bounds_deg"]
    assert ((south + north) / 2.0, (west + east) / 2.0) == pytest.approx(((lat + further) / 2.0, lon), abs=2e-5)
    half_m = (north - south) / 2.0 * 111_200.0  # at least what was asked for; UTM is turned by 1.1 degrees there
    assert 50.0 + 75.0 + 50.0 <= half_m < 1.05 * 175.0
    assert facts["gsd_m_per_px"] == pytest.approx(0.25, rel=1e-3)
    assert any(line.startswith("the photographs' place: 48.246") for line in said)
    (tmp_path / "none").mkdir()
    photograph(tmp_path / "none" / "a.jpg")
    for place, radius_m, words in (
        ("48.25,16.44", None, "radius_m: expected with LAT,LON"),
        ("Duluth, MN", 100.0, "got 'Duluth, MN'; place names are not looked up"),
        (str(tmp_path / "none"), None, "around: expected LAT,LON or photographs with positions"),
    ):
        assert words in refused(replace(wanted, around=place, radius_m=radius_m), tmp_path, OptionError)
