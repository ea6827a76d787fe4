"""GeoPackages as GDAL writes them: the picture or the heights that they were made of, or one clear line."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest
from affine import Affine
from rasterio.shutil import copy

from engine.errors import MapError
from engine.orthomap import OrthoMap
from engine.values import Window
from tests.support.rasters import write_raster

SIDE, WHOLE = 300, Window(20, 20, 200, 200)
AT = Affine(0.5, 0.0, 607400.0, 0.0, -0.5, 5345369.0)


def geotiff(path, data):
    return write_raster(path, data, crs="EPSG:32633", transform=AT)


@pytest.fixture
def picture():
    return np.random.default_rng(0).integers(2, 253, (3, SIDE, SIDE)).astype(np.uint8)


def test_a_geopackage_is_the_picture_that_it_was_made_of(tmp_path, picture):
    whole = geotiff(tmp_path / "map.tif", picture)
    copy(whole, tmp_path / "map.gpkg", driver="GPKG", tile_format="PNG")
    wanted, found = OrthoMap.open(whole), OrthoMap.open(tmp_path / "map.gpkg")
    assert found.info()["driver"] == "GPKG"
    corner = np.rint(found.pixel_from_geodetic(*wanted.geodetic_from_pixel([0.0, 0.0]))).astype(int)
    lies = Window(int(corner[0]) + 20, int(corner[1]) + 20, 200, 200)
    np.testing.assert_array_equal(found.gray(lies), wanted.gray(WHOLE))
    assert found.valid(lies).all()


def test_heights_in_a_geopackage_are_a_surface(tmp_path, picture):
    heights = (200.0 + np.add.outer(np.arange(SIDE), np.arange(SIDE)) / 10.0).astype(np.float32)[None]
    whole = geotiff(tmp_path / "dsm.tif", heights)
    copy(whole, tmp_path / "dsm.gpkg", driver="GPKG")
    ortho = geotiff(tmp_path / "map.tif", picture)
    wanted, found = OrthoMap.open(ortho, whole), OrthoMap.open(ortho, tmp_path / "dsm.gpkg")
    pixels = np.array([[50.0, 60.0], [200.5, 100.25]])
    assert found.surface_at(pixels) == pytest.approx(wanted.surface_at(pixels), abs=0.01)


def test_several_rasters_and_none_are_refused(tmp_path, picture):
    path = tmp_path / "map.gpkg"
    whole = geotiff(tmp_path / "map.tif", picture)
    copy(whole, path, driver="GPKG", raster_table="NORTH")
    copy(whole, path, driver="GPKG", raster_table="SOUTH", append_subdataset="yes")
    with pytest.raises(MapError, match="map: expected a GeoPackage with one raster, got NORTH, SOUTH in"):
        OrthoMap.open(path)
    with closing(sqlite3.connect(path)) as base:
        base.execute("UPDATE gpkg_contents SET data_type = 'features'")
        base.commit()
    with pytest.raises(MapError, match="expected a GeoPackage with one raster, got none in"):
        OrthoMap.open(path)


def test_what_only_calls_itself_a_geopackage_is_refused(tmp_path):
    path = tmp_path / "map.gpkg"
    path.write_bytes(b"SQLite format 3\0".ljust(68, b"\0") + b"GPKG" + bytes(100))
    with pytest.raises(MapError, match="map: cannot read"):
        OrthoMap.open(path)
