"""The prepared map: what is cut from it is the same however it was prepared, in bounded memory."""

import numpy as np
import pytest
import torch

from engine import OrthoMap, Window
from engine.kernels.scores import enhance
from engine.maps import prepared, tiles
from engine.maps.prepared import PreparedMap, Region
from engine.ncc_fft import prepare
from tests.support.waiting import called_at_once

AFFINE = np.array([[0.5, 0.0, 500_000.0], [0.0, -0.5, 5_300_000.0]])
WINDOWS = [
    Window(0, 0, 200, 190), Window(100, 120, 150, 133), Window(127, 127, 2, 2), Window(301, 255, 99, 145),
    Window(250, 9, 300, 391), Window(523, 371, 27, 29),
]  # fmt: skip
CPU = torch.device("cpu")


def site_of(gray, valid=None):
    return OrthoMap.from_arrays(gray, AFFINE, "EPSG:32633", valid=valid)


@pytest.fixture(scope="module")
def gray():
    return np.random.default_rng(0).integers(0, 256, (400, 550), dtype=np.uint8)


@pytest.fixture(scope="module")
def holes():
    valid = np.ones((400, 550), bool)
    valid[150:220, 240:420] = False
    valid[:30] = False
    return valid


@pytest.fixture
def by_cells(monkeypatch):
    """Levels are prepared in cells of 128 pixels, none as a whole."""
    monkeypatch.setattr(prepared, "TILE_PX", 128)
    monkeypatch.setattr(tiles, "TILE_PX", 128)
    monkeypatch.setattr(tiles, "WHOLE_LEVEL_PX", 0)


def levels_of(search):
    while search is not None:
        yield search
        search = search.half


# A cell without nodata is smoothed in whole grey levels, which moves an enhanced pixel by some hundredths of its
# neighbourhood's deviation.


@pytest.mark.parametrize("masked", [False, True], ids=["whole", "nodata"])
@pytest.mark.parametrize("window", WINDOWS, ids=str)
def test_cells_join_without_a_seam(gray, holes, window, masked, monkeypatch, by_cells):
    site = site_of(gray, holes if masked else None)
    pieces = PreparedMap(site, CPU).cut(window, 0)
    monkeypatch.setattr(tiles, "WHOLE_LEVEL_PX", 1 << 23)
    whole = PreparedMap(site, CPU).cut(window, 0)
    assert pieces.window == whole.window
    tolerance = 0.05 if masked else 2e-5  # running sums in float32 begin elsewhere
    for part, full in zip(levels_of(pieces.search), levels_of(whole.search), strict=False):
        np.testing.assert_allclose(part.image, full.image, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(pieces.valid, whole.valid)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_cut_is_the_enhanced_level_from_the_multiple_of_eight_before_it(gray, level):
    site = site_of(gray)
    rows, columns = site.level_shape(level)
    picture = enhance(site.gray(Window(0, 0, columns, rows), level))
    maps = PreparedMap(site, CPU)
    for x, y, width, height in ((0, 0, columns, rows), (13, 31, 60, 50), (16, 24, 41, 33), (columns - 5, 7, 5, 5)):
        cut = maps.cut(Window(x, y, width, height), level)
        x0, y0 = x // 8 * 8, y // 8 * 8
        assert cut.window == Window(x0, y0, x + width - x0, y + height - y0)
        expected = picture[y0 : y0 + cut.window.height_px, x0 : x0 + cut.window.width_px]
        np.testing.assert_array_equal(cut.search.image, expected)
        assert cut.valid is None


def test_masks_are_cut_with_the_picture_and_left_out_where_all_is_map(gray, holes):
    maps = PreparedMap(site_of(gray, holes), CPU)
    assert maps.cut(Window(40, 240, 150, 100), 0).valid is None
    across = maps.cut(Window(203, 101, 160, 160), 0)
    x0, y0 = across.window.x0, across.window.y0
    expected = holes[y0 : y0 + across.window.height_px, x0 : x0 + across.window.width_px]
    np.testing.assert_array_equal(across.valid, expected)
    assert not across.search.image[~across.valid].any()


def test_nodata_does_not_reach_into_the_map(gray, holes):
    """The grey value under nodata is without meaning; no valid pixel may depend on it."""
    other = gray.copy()
    other[~holes] = 255 - other[~holes]
    cuts = [PreparedMap(site_of(g, holes), CPU).cut(Window(0, 0, 550, 400), 0) for g in (gray, other)]
    np.testing.assert_array_equal(cuts[0].search.image, cuts[1].search.image)


def test_memory_stays_within_its_bound_and_what_was_given_up_comes_back_the_same(gray, monkeypatch, by_cells):
    monkeypatch.setattr(prepared, "MAX_REGION_PX", 3 * 128 * 128)
    maps = PreparedMap(site_of(gray), CPU)
    first = maps.cut(Window(10, 10, 60, 60), 0)
    for y in range(0, 300, 50):
        for x in range(0, 450, 50):
            assert maps.cut(Window(x, y, 64, 64), 0).window.width_px >= 64
            kept = [part for part, _ in maps.regions]
            assert sum(part.area_px for part in kept) <= max(3 * 128 * 128, kept[-1].area_px)
    assert (Window(0, 0, 128, 128), 0) not in maps.regions
    np.testing.assert_array_equal(maps.cut(Window(10, 10, 60, 60), 0).search.image, first.search.image)


def test_a_level_that_is_small_is_prepared_once_and_kept(gray, monkeypatch):
    monkeypatch.setattr(prepared, "MAX_REGION_PX", 1)
    maps = PreparedMap(site_of(gray), CPU)
    for _ in range(2):
        for level in (0, 1, 2):
            maps.cut(Window(8, 8, 40, 40), level)
    assert sorted(level for _, level in maps.regions) == [0, 1, 2]
    parts = [maps.cut(Window(0, 0, side, side), 0).search.image for side in (9, 8)]
    assert np.shares_memory(*parts)


def test_several_threads_may_cut_at_once(gray, monkeypatch, by_cells):
    """The worker that a live flight left behind may still be at work beside the one that replaced it."""
    monkeypatch.setattr(prepared, "MAX_REGION_PX", 128 * 128)
    search = prepare(torch.zeros(400, 550))
    monkeypatch.setattr(PreparedMap, "_prepare", lambda _, window, level: Region(window, search, None))
    maps = PreparedMap(site_of(gray), CPU)
    places = np.random.default_rng(0).integers(0, 400 - 64, (4000, 2)).tolist()
    cuts = called_at_once(lambda place: maps.cut(Window(*place, 64, 64), 0), places)
    assert all(cut.window.x0 == x & -8 for cut, (x, _) in zip(cuts, places, strict=True))
    assert len(maps.regions.values()) <= 2
