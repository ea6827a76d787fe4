"""Colours of a map by window, against the file read plainly; of a grid of its own, of a table, of other types."""

import numpy as np
import pytest
from rasterio import Affine

from engine import OrthoMap, Window
from scenematch.report.page_map import map_colours
from tests.support.rasters import write_raster


def picture(height=120, width=160):
    """Red grows with x, green with y, blue is their product: each pixel has its place written on it."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x, y, (x * y) // width]).astype(np.uint8)


def written(path, data, crs="EPSG:32643", step=(0.5, 0.5), corner=(500_000.0, 3_700_000.0), colormap=None):
    transform = Affine(step[0], 0, corner[0], 0, -step[1], corner[1])
    return OrthoMap.open(write_raster(path, data, crs=crs, transform=transform, colormap=colormap))


def test_a_window_is_that_of_the_file(tmp_path):
    data = picture()
    found = map_colours(written(tmp_path / "m.tif", data), Window(20, 30, 64, 48), (48, 64))
    off = found.astype(int) - np.moveaxis(data[:, 30:78, 20:84], 0, -1)
    assert np.abs(off).max() <= 1  # of 256 levels, where the interpolation rounds
    assert (off != 0).mean() < 0.02


def test_half_the_size_is_the_mean_of_four(tmp_path):
    data = picture()
    found = map_colours(written(tmp_path / "m.tif", data), Window(0, 0, 160, 120), (60, 80))
    mean = np.moveaxis(data, 0, -1).reshape(60, 2, 80, 2, 3).mean(axis=(1, 3))
    assert np.abs(found[2:-2, 2:-2] - mean[2:-2, 2:-2]).max() <= 1.5


def test_a_map_in_degrees_is_shown_on_its_metric_grid(tmp_path):
    step = (0.5 / 94_000.0, 0.5 / 110_900.0)
    site = written(tmp_path / "m.tif", picture(), "EPSG:4326", step, (75.0, 33.0))
    window = Window(10, 10, site.width_px - 20, site.height_px - 20)
    found = map_colours(site, window, (window.height_px, window.width_px)).astype(float)
    # Where a place lies in the file by its latitude and longitude is what red and green say.
    for x, y in [(20, 20), (80, 60), (130, 100)]:
        lat_deg, lon_deg = (float(v) for v in site.geodetic_from_pixel(np.array([x, y], float)))
        expected = ((lon_deg - 75.0) / step[0] - 0.5, (33.0 - lat_deg) / step[1] - 0.5)
        assert found[y - 10, x - 10, :2] == pytest.approx(expected, abs=1.5)


def test_a_colour_table_is_shown_and_grey_has_no_colours(tmp_path):
    index = (np.arange(120 * 160).reshape(1, 120, 160) % 3).astype(np.uint8)
    table = {0: (255, 0, 0), 1: (0, 255, 0), 2: (0, 0, 255)}
    found = map_colours(written(tmp_path / "table.tif", index, colormap=table), Window(0, 0, 160, 120), (120, 160))
    assert (found == np.array([table[int(i)] for i in index.ravel()]).reshape(120, 160, 3)).all()
    assert map_colours(written(tmp_path / "grey.tif", picture()[:1]), Window(0, 0, 8, 8), (8, 8)) is None
    arrays = OrthoMap.from_arrays(picture()[0], [[0.5, 0, 5e5], [0, -0.5, 3.7e6]], "EPSG:32643")
    assert map_colours(arrays, Window(0, 0, 8, 8), (8, 8)) is None


def test_sixteen_bits_are_stretched(tmp_path):
    data = (picture().astype(np.uint16) + 300) * 20
    found = map_colours(written(tmp_path / "deep.tif", data), Window(0, 0, 160, 120), (120, 160))
    assert (found.dtype, found.min(), found.max()) == (np.uint8, 0, 255)
    assert (np.diff(found[60, :, 0].astype(int)) >= 0).all()
