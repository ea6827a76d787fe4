"""Folders of tiles, MBTiles and GeoPackages: the picture that they were cut from, or one clear line."""

import re
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from affine import Affine
from rasterio.shutil import copy

from engine import MapError, OrthoMap, Window
from engine.maps.accuracy import GEOREFERENCE_TAG
from tests.support.rasters import write_raster
from tests.support.refusals import refusal

UTM, WEST, NORTH, STEP_M = "EPSG:32633", 607400.0, 5345369.0, 0.5
SIDE, TILE = 300, 128
GAP = (1, 2)  # row and column of the tile that is missing
WINDOWS = [Window(0, 0, SIDE, SIDE), Window(100, 90, 77, 61), Window(127, 127, 2, 2), Window(250, 120, 40, 20)]


def transform_at(x=0.0, y=0.0, step=STEP_M):
    return Affine(step, 0.0, WEST + x * STEP_M, 0.0, -step, NORTH - y * STEP_M)


def write(path, data, **profile):
    return write_raster(path, data, **({"crs": UTM, "transform": transform_at()} | profile))


def tiles_of(folder, data, *, gap=GAP, **profile):
    """Cut (bands, H, W) into tiles of a folder."""
    folder.mkdir()
    for row in range(0, data.shape[1], TILE):
        for column in range(0, data.shape[2], TILE):
            if (row // TILE, column // TILE) != gap:
                part = data[:, row : row + TILE, column : column + TILE]
                name = f"{row // TILE}-{column // TILE}.tif"
                write(folder / name, part, transform=transform_at(column, row), **profile)
    return folder


@pytest.fixture(scope="module")
def picture():
    """(3, H, W) without pure black or white; what is smooth in it survives a JPEG."""
    import cv2

    noise = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3)).astype(np.uint8)
    return np.moveaxis(np.clip(cv2.GaussianBlur(noise, (0, 0), 3.0) * 3.0 - 256.0, 2, 253), -1, 0).astype(np.uint8)


@pytest.fixture(scope="module")
def plain(tmp_path_factory, picture):
    return write(tmp_path_factory.mktemp("plain") / "map.tif", picture)


@pytest.mark.parametrize("nodata", [None, 1])
def test_a_folder_of_tiles_is_the_picture_it_was_cut_from_and_a_gap_is_nodata(tmp_path, plain, picture, nodata):
    whole, cut = OrthoMap.open(plain), OrthoMap.open(tiles_of(tmp_path / "tiles", picture, nodata=nodata))
    assert (cut.width_px, cut.height_px, cut.bounds_deg) == (whole.width_px, whole.height_px, whole.bounds_deg)
    there = np.ones((SIDE, SIDE), np.bool_)
    there[TILE * GAP[0] : TILE * (GAP[0] + 1), TILE * GAP[1] : TILE * (GAP[1] + 1)] = False
    for window in WINDOWS:
        part = np.s_[window.y0 : window.y0 + window.height_px, window.x0 : window.x0 + window.width_px]
        np.testing.assert_array_equal(cut.valid(window), there[part])
        np.testing.assert_array_equal(cut.gray(window)[there[part]], whole.gray(window)[there[part]])
    assert cut.info()["driver"] == "VRT"


def test_a_cog_is_the_picture_byte_by_byte(tmp_path, plain):
    path = tmp_path / "map.tif"
    copy(plain, path, driver="COG", compress="deflate")
    whole, other = OrthoMap.open(plain), OrthoMap.open(path)
    for window in WINDOWS:
        np.testing.assert_array_equal(other.gray(window), whole.gray(window))
        assert other.valid(window).all()
    assert other.bounds_deg == whole.bounds_deg


def test_tiles_of_any_order_sign_and_kind_join(tmp_path, picture):
    """Sixteen bits, a tag for nodata in each tile, and files beside them that are none."""
    deep = picture[:1].astype(np.uint16) * 100
    deep[0, 40:60, 50:90] = 7
    cut = tiles_of(tmp_path / "tiles", deep, nodata=7)
    (cut / "README.txt").write_text("tiles of a survey")
    (cut / "0-0.tfw").write_text("0.5\n0\n0\n-0.5\n0\n0\n")
    (cut / "more").mkdir()
    write(cut / "0-0.tif.ovr", picture[:1, :5, :5])
    whole, joined = OrthoMap.open(write(tmp_path / "map.tif", deep, nodata=7)), OrthoMap.open(cut)
    known = joined.valid(WINDOWS[0])
    np.testing.assert_array_equal(known[:TILE], whole.valid(WINDOWS[0])[:TILE])
    assert not known[40:60, 50:90].any()
    apart = joined.gray(WINDOWS[0])[known].astype(int) - whole.gray(WINDOWS[0])[known]
    assert np.abs(apart).max() <= 12  # the stretch is that of the pixels that are there


def test_a_folder_says_of_itself_what_all_its_tiles_say(tmp_path, picture):
    cut = tiles_of(tmp_path / "tiles", picture, tags={GEOREFERENCE_TAG: "0.4"})
    assert OrthoMap.open(cut).georeference_sigma_m == 0.4
    write(cut / "0-0.tif", picture[:, :TILE, :TILE], tags={GEOREFERENCE_TAG: "0.9"})
    assert OrthoMap.open(cut).georeference_sigma_m is None


@pytest.mark.parametrize(("kind", "most_m"), [("folder", 0.0), ("GeoPackage", 0.01)])
def test_a_surface_may_be_tiles_too(tmp_path, plain, kind, most_m):
    heights = (100.0 + 0.05 * np.add.outer(np.arange(SIDE), 2 * np.arange(SIDE))).astype(np.float32)[None]
    whole, other = write(tmp_path / "dsm.tif", heights), tmp_path / "dsm.gpkg"
    if kind == "folder":
        other = tiles_of(tmp_path / "dsm", heights, gap=None)
    else:
        copy(whole, other, driver="GPKG")
    wanted, found = OrthoMap.open(plain, whole), OrthoMap.open(plain, other)
    xy = np.random.default_rng(0).uniform(0, SIDE - 1, (500, 2))
    np.testing.assert_allclose(found.surface_at(xy), wanted.surface_at(xy), rtol=0, atol=most_m)
    assert found.ground_m == pytest.approx(wanted.ground_m, abs=most_m)


@pytest.mark.parametrize("dtype", ["int32", "uint32", "int8", "int16", "float64"])
def test_tiles_are_of_the_element_types_that_one_file_may_be_of(tmp_path, plain, dtype):
    """Heights are any real numbers; pixels of a map are not, in a file or in tiles."""
    heights = (np.add.outer(np.arange(SIDE), 2 * np.arange(SIDE)) // 8).astype(dtype)[None]
    whole, tiles = write(tmp_path / "dsm.tif", heights), tiles_of(tmp_path / "dsm", heights, gap=None)
    xy = np.random.default_rng(0).uniform(0, SIDE - 1, (500, 2))
    one, other = (OrthoMap.open(plain, surface).surface_at(xy) for surface in (whole, tiles))
    np.testing.assert_array_equal(one, other)
    if dtype not in ("int16", "float64"):
        for path in (whole, tiles):
            assert f"got {dtype} in {path}" in refusal(OrthoMap.open, path, error=MapError)


# ------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"crs": "EPSG:32634"}, "tiles of one CRS, got EPSG:32633 in 0-0.tif and EPSG:32634 in .*9-9.tif"),
        ({"transform": transform_at(0, 400, 0.25)}, "tiles of one size of a pixel"),
        ({"transform": transform_at(0.4, 400)}, r"tiles of one grid, got .*9-9.tif \+0.40, \+0.00 px off"),
        ({"dtype": np.uint16}, "tiles of one bands, element type, nodata, scale and offset"),
        ({"dtype": np.int32}, "element type.* and .3, 'int32'"),
    ],
)
def test_tiles_that_do_not_fit_together_are_refused(tmp_path, picture, changed, words):
    cut = tiles_of(tmp_path / "tiles", picture)
    changed = {"transform": transform_at(0, 400)} | changed
    write(cut / "9-9.tif", picture[:, :50, :50].astype(changed.pop("dtype", np.uint8)), **changed)
    assert re.search(words, refusal(OrthoMap.open, cut, error=MapError))


def test_a_vrt_is_refused_with_what_to_give_instead(save):
    path = save('<VRTDataset rasterXSize="1" rasterYSize="1"/>', "map.vrt")
    words = "map.vrt, which is none of these; of a VRT give the folder of its tiles, or a GeoTIFF by gdal_tr"
    assert words in refusal(OrthoMap.open, path, error=MapError)


def test_a_folder_of_web_tiles_is_refused_with_what_to_give_instead(tmp_path):
    (tmp_path / "18" / "143000").mkdir(parents=True)
    (tmp_path / "18" / "143000" / "90500.png").write_bytes(b"\x89PNG")
    (tmp_path / "leaflet.html").write_text("a viewer")
    words = r"expected georeferenced raster files in the folder .*, found none; .* give MBTiles or a GeoTIFF"
    assert re.search(words, refusal(OrthoMap.open, tmp_path, error=MapError))


# ------------------------------------------------------------------------------------ MBTiles and GeoPackages


@pytest.mark.parametrize(
    ("driver", "form", "most"), [("MBTiles", "PNG", 0.0), ("MBTiles", "JPEG", 4.0), ("GPKG", "PNG", 0.0)]
)
def test_a_database_of_tiles_is_the_picture_that_it_was_made_of(tmp_path, picture, plain, driver, form, most):
    if driver == "MBTiles":
        step = 156543.03392804097 / 2**18  # the pixels of zoom level 18
        origin, column, row = 20037508.342789244, 36621000, 23256000
        at = Affine(step, 0.0, column * step - origin, 0.0, -step, origin - row * step)
        plain = write(tmp_path / "map.tif", picture, crs="EPSG:3857", transform=at)
    path = tmp_path / f"map.{driver.lower()}"
    copy(plain, path, driver=driver, tile_format=form, quality=95)
    whole, found = OrthoMap.open(plain), OrthoMap.open(path)
    assert found.info()["driver"] == driver
    x, y = np.rint(found.pixel_from_geodetic(*whole.geodetic_from_pixel([20.0, 20.0]))).astype(int).tolist()
    there = found.geodetic_from_pixel([x, y])
    assert np.allclose(there, whole.geodetic_from_pixel([20, 20]), rtol=0, atol=1e-9)
    lies = Window(x, y, 200, 200)
    apart = found.gray(lies).astype(float) - whole.gray(Window(20, 20, 200, 200))
    assert np.abs(apart).mean() <= most
    assert found.valid(lies).all()


def test_a_geopackage_of_several_rasters_or_none_is_refused(tmp_path, plain):
    path = tmp_path / "map.gpkg"
    copy(plain, path, driver="GPKG", raster_table="NORTH")
    copy(plain, path, driver="GPKG", raster_table="SOUTH", append_subdataset="yes")
    words = "map: expected a GeoPackage with one raster, got NORTH, SOUTH in"
    assert words in refusal(OrthoMap.open, path, error=MapError)
    with closing(sqlite3.connect(path)) as base:
        base.execute("UPDATE gpkg_contents SET data_type = 'features'")
        base.commit()
    assert re.search(r"map: expected a raster file .*map\.gpkg", refusal(OrthoMap.open, path, error=MapError))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.mbtiles", b"hello", "expected a raster file"),
        ("b.mbtiles", b"SQLite format 3\0 and nothing more", "expected a raster file"),
        ("c.gpkg", b"SQLite format 3\0".ljust(68, b"\0") + b"GPKG" + bytes(100), "cannot read"),
    ],
)
def test_a_file_that_only_calls_itself_a_database_of_tiles_is_refused(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    assert f"map: {words}" in refusal(OrthoMap.open, tmp_path / name, error=MapError)
