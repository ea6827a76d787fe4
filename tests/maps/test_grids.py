"""Transforms between grids: a whole window at once is where its pixels are one by one."""

import numpy as np
import pytest
from pyproj import CRS

from engine.maps.grids import Grid, pixels_between, transformed_window
from engine.values import Window

UTM = Grid(3000, 2000, np.array([[10.0, 0.0, 5e5], [0.0, -10.0, 8.9e6]]), CRS.from_epsg(32633))


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857", "EPSG:32634", "EPSG:32633"])
@pytest.mark.parametrize("window", [Window(0, 0, 3000, 40), Window(2977, 1990, 23, 10), Window(64, 96, 1, 1)])
def test_a_window_is_transformed_as_its_pixels_are(crs, window):
    lonlat = UTM.pixels_of(CRS.from_user_input(crs))[0](UTM.lattice())
    low, size = lonlat.min(axis=0), np.ptp(lonlat, axis=0)
    matrix = np.column_stack([np.diag(size / [3000, -2000]), [low[0], low[1] + size[1]]])
    transform = pixels_between(UTM, Grid(3000, 2000, matrix, CRS.from_user_input(crs)))
    found = transformed_window(transform, window)
    columns, rows = np.arange(window.x0, window.x1), np.arange(window.y0, window.y1)
    exact = transform(np.stack(np.meshgrid(columns, rows), axis=-1).astype(np.float64))
    np.testing.assert_allclose(found, exact, atol=0.002)


def test_what_has_no_place_in_the_other_grid_lies_far_outside():
    def beyond(xy):
        return np.where(xy[..., :1] > 40.0, np.inf, xy)

    found = transformed_window(beyond, Window(0, 0, 100, 3))
    np.testing.assert_allclose(found[:, :33, 0], np.broadcast_to(np.arange(33.0), (3, 33)))
    assert (found[:, 33:, 0] < -1e5).all()
