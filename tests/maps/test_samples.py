"""Samples of the map: where large levels end."""

import itertools

import numpy as np
import pytest

from engine import OrthoMap, Window
from engine.maps import tiles
from engine.maps.samples import BLOCK_PX, SampleMap
from engine.maps.tiles import TILE_PX

AFFINE = np.array([[0.5, 0.0, 500_000.0], [0.0, -0.5, 5_300_000.0]])


@pytest.mark.parametrize("more_px", [0, 1, 2, 3, 4, 5])
def test_a_level_may_end_anywhere_beyond_a_cell(more_px, monkeypatch):
    """The last cells may be narrower than a block, at the right edge, at the bottom and in the corner."""
    monkeypatch.setattr(tiles, "WHOLE_LEVEL_PX", 0)  # no level is small enough to be taken as a whole
    width_px, height_px = TILE_PX + more_px, TILE_PX + BLOCK_PX + 1 - more_px % BLOCK_PX
    gray = np.random.default_rng(1).integers(0, 256, (height_px, width_px), dtype=np.uint8)
    site = OrthoMap.from_arrays(gray, AFFINE, "EPSG:32633", surface_m=np.zeros(gray.shape, np.float32))
    window = Window(width_px - 40, height_px - 30, 40, 30)
    xy = site.pixel_from_enu(SampleMap(site).find(window, 0).points_m[:, :2])
    blocks = np.rint(xy).astype(int) // BLOCK_PX
    columns = range((width_px - 40) // BLOCK_PX, width_px // BLOCK_PX)
    rows = range((height_px - 30) // BLOCK_PX, height_px // BLOCK_PX)
    assert sorted(map(tuple, blocks.tolist())) == list(itertools.product(columns, rows))
