"""Large maps: matched as a small one is, in bounded memory; copies made once; searches refused."""

import io
import tracemalloc

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import Resampling
from rich.console import Console

from engine import OptionError, OrthoMap, Prior, Reason, SceneMatcher, Window
from engine.maps import metric_copy
from scenematch.cli import console
from scenematch.cli.app import run
from scenematch.runs.inputs import check_start
from tests.support.fixes import px_off
from tests.support.rasters import from_corner, whole, write_raster, write_sparse

SIDE = 17_000
CORNER = (12_288, 6_656)  # of the town on the large map: on its cells, so that the same landmarks are chosen
MARGIN = 512  # of other ground around it
UTM = "EPSG:32633"


@pytest.fixture(scope="module")
def gray(sim_town):
    return np.maximum(cv2.cvtColor(sim_town.ortho, cv2.COLOR_RGB2GRAY), 1)


@pytest.fixture(scope="module")
def large_path(tmp_path_factory, sim_town, gray):
    """A sparse GeoTIFF of 17,000 x 17,000 pixels with overviews; all but the town is nodata."""
    path = tmp_path_factory.mktemp("large") / "map.tif"
    corner = from_corner(sim_town.pixel_to_crs) @ Affine.translation(-CORNER[0], -CORNER[1])
    around, place = np.pad(gray, MARGIN, mode="reflect"), (CORNER[0] - MARGIN, CORNER[1] - MARGIN)
    return write_sparse(path, around, place, SIDE, Resampling.average, crs=UTM, transform=corner)


@pytest.fixture(scope="module")
def large(large_path):
    return OrthoMap.open(large_path)


@pytest.fixture(scope="module")
def small(sim_town, gray):
    return OrthoMap.from_arrays(gray, sim_town.pixel_to_crs, UTM)


def prior_of(flight, sigma_m=10.0):
    row = flight.truth[5]
    return Prior(lat_deg=row.lat_deg, lon_deg=row.lon_deg, sigma_m=sigma_m)


@pytest.mark.parametrize("method", ["ncc", "sift"])
def test_a_frame_is_found_where_the_small_map_has_it_in_part_of_the_memory(large_path, small, sim_flight, method):
    """The grey levels and validity of the whole would take 578 MB."""
    frame, prior, camera = sim_flight.frames[5], prior_of(sim_flight), sim_flight.camera
    at_home = SceneMatcher(small, camera, method, "cpu").locate(frame, prior)
    tracemalloc.start()
    abroad = SceneMatcher(OrthoMap.open(large_path), camera, method, "cpu").locate(frame, prior)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # A refined pose rests on other samples, which are taken part by part of a large map.
    apart_px = np.subtract(abroad.map_xy_px, at_home.map_xy_px) - CORNER
    assert np.abs(apart_px).max() < (0.05 * at_home.sigma_m / small.gsd_m_per_px if method == "ncc" else 0.1)
    assert peak_bytes < SIDE * SIDE / 2


@pytest.mark.parametrize("level", [1, 2, 3, 5])
def test_coarse_levels_are_the_files_own_overviews_at_the_same_place(large, small, level):
    rows, columns = small.level_shape(level)
    first = [-(-v >> level) for v in CORNER]  # whole pixels of the level inside the town
    shift = [(n << level) - v for n, v in zip(first, CORNER, strict=True)]
    window = Window(*first, columns - 2, rows - 2)
    town = small.gray(Window(*shift, window.width_px << level, window.height_px << level))
    mean = town.reshape(window.height_px, 1 << level, window.width_px, 1 << level).mean(axis=(1, 3))
    assert np.abs(large.gray(window, level) - mean).max() <= 0.5 * level + 0.5  # each halving rounds
    assert large.valid(window, level).all()


def test_what_holds_no_map_is_nodata_and_the_warm_up_finds_a_place_that_does(large):
    assert large.is_large
    assert not large.valid(Window(100, 100, 50, 50)).any()
    assert large.info()["nodata_share"] > 0.98
    x, y = np.rint(large.inner_px).astype(int)
    assert large.valid(Window(x - 200, y - 200, 400, 400)).all()


# ------------------------------------------------------------------------------------------------- searching


def test_without_a_place_to_begin_only_a_map_that_is_too_large_is_refused(large, small, sim_flight, monkeypatch):
    check_start(None, small)
    monkeypatch.setattr("engine.orthomap.SEARCH_LIMIT_PX", 1_000_000)
    for method in ("ncc", "sift", "auto"):
        refused = SceneMatcher(large, sim_flight.camera, method, "cpu").locate(sim_flight.frames[5])
        assert refused.reason is Reason.MAP_TOO_LARGE
        assert "9.01 x 9.01 km" in refused.detail
    with pytest.raises(OptionError, match=r"^start: expected LAT,LON.*the map of 9.01 x 9.01 km"):
        check_start(None, large)
    check_start(Prior(lat_deg=48.0, lon_deg=16.0, sigma_m=10.0), large)


def test_a_vague_place_is_searched_coarse_to_fine_and_too_vague_a_one_refused(large, sim_flight, monkeypatch):
    frame, prior = sim_flight.frames[5], prior_of(sim_flight, sigma_m=400.0)
    matcher = SceneMatcher(large, sim_flight.camera, "ncc", "cpu")
    truth = large.pixel_from_geodetic(prior.lat_deg, prior.lon_deg)
    found = matcher.locate(frame, prior)
    assert px_off(found, truth) < 4.0
    assert found.window.area_px > 16e6
    monkeypatch.setattr("engine.matching.ncc.MAX_WINDOW_PX", 100_000)
    assert matcher.locate(frame, prior).reason is Reason.MAP_TOO_LARGE


# -------------------------------------------------------------------------------------------- surface models


def test_a_surface_read_by_tiles_is_the_surface_in_memory(tmp_path, gray, sim_town, monkeypatch):
    rows, columns = gray.shape
    heights = np.random.default_rng(3).uniform(100.0, 130.0, (rows, columns)).astype(np.float32)
    heights[300:420, 200:500] = -9999.0
    for name, data in (("map.tif", gray), ("dsm.tif", heights)):
        write_raster(tmp_path / name, data, crs=UTM, transform=from_corner(sim_town.pixel_to_crs))
    kept = OrthoMap.open(tmp_path / "map.tif", tmp_path / "dsm.tif")
    monkeypatch.setattr("engine.maps.surface.SURFACE_LIMIT_PX", 10_000)
    monkeypatch.setattr("engine.maps.surface.TILE_PX", 100)
    tiled = OrthoMap.open(tmp_path / "map.tif", tmp_path / "dsm.tif")
    xy = np.random.default_rng(4).uniform(-5.0, [columns + 5.0, rows + 5.0], (60, 40, 2))
    heights = kept.surface_at(xy)
    expected = np.where(heights == kept.ground_m, tiled.ground_m, heights)  # its own for what is unknown
    # What is in memory is interpolated by a compiled loop.
    np.testing.assert_allclose(tiled.surface_at(xy), expected, rtol=1e-14, atol=0.0)
    planes = [site.ground_at([150.0, 100.0]) for site in (tiled, kept)]
    assert planes[0] == pytest.approx(planes[1], rel=1e-12)
    assert tiled.ground_m == pytest.approx(kept.ground_m, abs=1.0)


def test_a_surface_of_a_small_part_of_the_map_gives_its_ground(large_path, tmp_path, sim_town):
    corner = from_corner(sim_town.pixel_to_crs) @ Affine.translation(200, 300)
    dsm = write_raster(tmp_path / "dsm.tif", np.full((40, 40), 77.0, np.float32), crs=UTM, transform=corner)
    assert OrthoMap.open(large_path, dsm).ground_m == 77.0


# ---------------------------------------------------------------------------------------------------- copies


@pytest.fixture
def tiny_limits(monkeypatch):
    """A map of a few hundred pixels a side counts as large, and its copy is written in blocks of 128."""
    monkeypatch.setattr("engine.maps.rasters.MEMORY_LIMIT_PX", 20_000)
    monkeypatch.setattr("engine.maps.pyramid.COARSE_LIMIT_PX", 20_000)
    monkeypatch.setattr(metric_copy, "BLOCK_PX", 128)


@pytest.fixture
def picture(request, tmp_path):
    """A smooth map without overviews, in metres unless asked otherwise; a corner and a tile inside are nodata."""
    noise = np.random.default_rng(1).uniform(0.0, 255.0, (400, 500))
    data = np.clip(128.0 + 8.0 * (cv2.GaussianBlur(noise, (0, 0), 4.0) - 127.5), 1, 254).astype(np.uint8)
    data[:128, :128] = data[128:256, 256:384] = 0
    crs, corner = (UTM, Affine(0.5, 0, 607400, 0, -0.5, 5345369))
    if getattr(request, "param", "metric") == "in degrees":
        crs, corner = "EPSG:4326", Affine(1e-5, 0, 33.0, 0, -8e-6, 32.0)
    return write_raster(tmp_path / "map.tif", data, crs=crs, transform=corner, nodata=0)


def copy_in(cache):
    """The folder of the only copy in a cache."""
    (folder,) = cache.iterdir()
    return folder


@pytest.fixture
def made(monkeypatch):
    """The files that are written from now on."""
    paths, write = [], metric_copy._write

    def noted(path, *arguments):
        paths.append(path)
        return write(path, *arguments)

    monkeypatch.setattr(metric_copy, "_write", noted)
    return paths


def same(one, other):
    """Equal, but for the rounding of places in blocks that begin elsewhere, where it was resampled."""
    valid = one.valid(whole(one))
    assert np.array_equal(valid, other.valid(whole(other)))
    apart = np.abs(one.gray(whole(one))[valid].astype(int) - other.gray(whole(other))[valid])
    assert apart.max() <= (1 if one.info()["resampled"] else 0)
    assert (apart > 0).mean() < 1e-3
    assert one.bounds_deg == other.bounds_deg


@pytest.mark.parametrize("picture", ["metric", "in degrees"], indirect=True)
def test_a_large_map_without_overviews_is_copied_and_is_the_same(picture, tmp_path, request):
    small = OrthoMap.open(picture, cache_dir=tmp_path / "small")
    request.getfixturevalue("tiny_limits")
    copied = OrthoMap.open(picture, cache_dir=tmp_path / "cache")
    assert copied.is_large
    same(copied, small)
    for level in (1, 2, 3):
        window = whole(small, level)
        both = copied.valid(window, level) & small.valid(window, level)
        apart = copied.gray(window, level)[both].astype(int) - small.gray(window, level)[both]
        assert both.mean() > 0.5
        assert np.abs(apart).mean() < 1.0
    folder = copy_in(tmp_path / "cache")
    assert sorted(path.name for path in folder.iterdir()) == ["map.state", "map.tif"]
    with rasterio.open(folder / "map.tif") as dataset:
        assert dataset.overviews(1) == [2, 4, 8, 16, 32]


def test_a_copy_that_was_interrupted_leaves_nothing_and_is_made_anew(picture, tmp_path, tiny_limits, made):
    cache = tmp_path / "cache"

    def interrupt(done_px, all_px):
        if 2 * done_px > all_px:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        OrthoMap.open(picture, cache_dir=cache, on_copy=interrupt)
    assert list(copy_in(cache).iterdir()) == []
    site = OrthoMap.open(picture, cache_dir=cache)
    same(OrthoMap.open(picture, cache_dir=cache), site)
    assert len(made) == 2


@pytest.fixture
def opened(picture, tmp_path):
    """Open the picture with a cache: the map, and what was said of its copying."""

    def open_picture():
        stated = []
        site = OrthoMap.open(picture, cache_dir=tmp_path / "cache", on_copy=lambda *pixels: stated.append(pixels))
        return site, stated

    return open_picture


def test_a_small_map_in_metres_is_not_copied(opened):
    assert opened()[1] == []


@pytest.mark.parametrize("picture", ["metric", "in degrees"], indirect=True)
def test_a_copy_says_how_far_it_is_and_one_that_is_there_says_nothing(opened, tiny_limits):
    site, stated = opened()
    area_px, done = site.width_px * site.height_px, [pixels for pixels, _ in stated]
    assert (done[0], done[-1]) == (0, area_px)  # the first before anything is read
    assert done == sorted(done)
    assert {total for _, total in stated} == {area_px}
    assert len(stated) == 1 + -(-site.width_px // 128) * -(-site.height_px // 128)
    assert opened()[1] == []


def test_what_a_copy_is_padded_by_is_no_nodata(tmp_path, tiny_limits):
    """Tiles of a GeoTIFF have sides of 16 pixels, and a copy's overviews halve them."""
    corner = Affine(1, 0, 607400, 0, -1, 5345369)
    path = write_raster(tmp_path / "map.tif", np.full((300, 301), 90, np.uint8), crs=UTM, transform=corner)
    site = OrthoMap.open(path, cache_dir=tmp_path / "cache")
    assert site.info()["source_nodata_share"] == site.info()["nodata_share"] == 0.0


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_shows_the_copying_and_a_pipe_does_not(picture, tmp_path, tiny_limits, monkeypatch, terminal):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    stream = io.StringIO()
    monkeypatch.setattr(console, "_errors", lambda: Console(file=stream, force_terminal=terminal, width=100))
    assert run(["map", "info", str(picture)]) == 0
    shown = stream.getvalue()
    assert "copying the map into the cache" in shown if terminal else shown == ""
    assert run(["map", "info", str(picture)]) == 0
    assert stream.getvalue() == shown  # the copy is there


@pytest.mark.parametrize("damage", ["bytes", "cut", "gone", "note cut off", "no note"])
def test_a_copy_that_is_not_as_it_was_left_is_made_anew(picture, tmp_path, tiny_limits, made, damage):
    cache = tmp_path / "cache"
    site = OrthoMap.open(picture, cache_dir=cache)
    pixels, valid = site.gray(whole(site)), site.valid(whole(site))
    copy, noted = copy_in(cache) / "map.tif", copy_in(cache) / "map.state"
    content, state = copy.read_bytes(), noted.read_text()
    if damage == "bytes":
        copy.write_bytes(content[:-40] + bytes(40))
    elif damage == "cut":
        copy.write_bytes(content[: len(content) // 2])
    elif damage == "gone":
        copy.unlink()
    else:
        noted.write_text("" if damage == "no note" else state[:20])
    made.clear()
    again = OrthoMap.open(picture, cache_dir=cache)
    assert made
    assert np.array_equal(again.valid(whole(again)), valid)
    assert np.array_equal(again.gray(whole(again))[valid], pixels[valid])
