"""The map's features, found once: the same by tile, by window, from a file and from the whole level at once."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from engine import OrthoMap, Window
from engine.features import sift
from engine.maps import landmark_cache, landmarks
from engine.maps.landmarks import CELL_PX, MAX_PER_CELL, LandmarkMap, as_picture
from engine.maps.tiles import TILE_PX
from engine.runtime.device import CPU
from tests.support.ground import Ground
from tests.support.rasters import from_corner, whole, write_raster


@pytest.fixture(scope="module")
def site():
    """More than two tiles a side, with ground that rises to the east."""
    ground = Ground(size=(560, 600))
    return ground.map_of(surface_m=np.tile(np.linspace(10.0, 40.0, 600, dtype=np.float32), (560, 1)))


@pytest.fixture(scope="module")
def marks(site):
    return LandmarkMap(site, CPU)


def in_order(rows):
    return rows[np.lexsort(rows.T[:4])]


def table(found):
    """(N, 135) every value of the landmarks, in an order of their own."""
    f = found.features
    parts = (f.xy_px[0], f.scale_px[0, :, None], f.angle_deg[0, :, None], f.descriptors[0])
    return in_order(np.concatenate([*parts, found.points_m], axis=1))


def nearest(xy, others):
    """The distance from each place to the nearest of others, and which one that is."""
    return KDTree(others).query(xy)


# Where they are


@pytest.mark.parametrize("upright", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_tiles_join_as_if_the_level_had_been_described_in_one_piece(site, monkeypatch, upright):
    monkeypatch.setattr(landmarks, "MAX_PER_CELL", 255)
    once = sift(as_picture(site.gray(whole(site)), CPU), max_keypoints=20_000, upright=upright, spread=1)
    kept = once.valid[0] & (once.scale_px[0] < 5.0)  # the descriptors of larger ones see beyond the halo
    xy, described = once.xy_px[0, kept], once.descriptors[0, kept]
    found = LandmarkMap(site, CPU).find(whole(site), 0, upright=upright).features
    apart_px, index = nearest(xy, found.xy_px[0])
    same = (apart_px < 0.02) & ((described * found.descriptors[0, index]).sum(axis=1) > 0.99)
    assert len(xy) > 500
    assert same.mean() > 0.98
    seam = (np.abs(xy - TILE_PX) < 20).any(axis=1)
    assert seam.sum() > 50
    assert same[seam].mean() > 0.98


def test_a_window_holds_what_its_parts_hold_and_nothing_outside(site, marks):
    window = Window(150, 90, 300, 400)
    parts = [Window(150, 90, 107, 400), Window(257, 90, 193, 211), Window(257, 301, 193, 189)]
    found = marks.find(window, 0, upright=True)
    xy = found.features.xy_px[0]
    assert ((xy >= [149.5, 89.5]) & (xy < [449.5, 489.5])).all()
    joined = np.concatenate([table(marks.find(part, 0, upright=True)) for part in parts])
    np.testing.assert_array_equal(in_order(joined), table(found))


@pytest.mark.parametrize("level", [0, 1, 2])
def test_landmarks_lie_on_the_surface_above_their_pixel(site, marks, level):
    found = marks.find(whole(site, level), level, upright=True)
    map_px = site.full_from_level(found.features.xy_px[0], level)
    np.testing.assert_allclose(found.points_m[:, :2], site.enu_from_pixel(map_px), atol=1e-6)
    rising = 10.0 + 30.0 * np.clip(map_px[:, 0], 0, 599) / 599
    np.testing.assert_allclose(found.points_m[:, 2], rising, atol=0.01)


def test_upright_landmarks_have_the_angle_of_the_maps_x_axis(marks, site):
    assert not marks.find(whole(site), 0, upright=True).features.angle_deg.any()
    assert marks.find(whole(site), 0, upright=False).features.angle_deg.std() > 30


def test_no_landmark_lies_on_nodata():
    ground = Ground(size=(300, 400))
    valid = np.zeros(ground.gray.shape, bool)
    valid[40:220, 100:310] = True
    site = ground.map_of(np.where(valid, ground.gray, 255).astype(np.uint8), valid=valid)
    marks = LandmarkMap(site, CPU)
    x, y = marks.find(whole(site), 0, upright=True).features.xy_px[0].round().astype(int).T
    assert len(x) > 100
    assert valid[y, x].all()
    assert marks.find(Window(320, 230, 60, 60), 0, upright=True).points_m.shape == (0, 3)


@pytest.mark.parametrize("per_px", [0.0005, 0.003, np.inf])
def test_no_cell_is_denser_than_asked_and_the_strongest_stay(site, marks, per_px):
    found = marks.find(whole(site), 0, upright=True, per_px=per_px)
    cells = np.rint(found.features.xy_px[0]).astype(int) // CELL_PX
    _, counts = np.unique(cells, axis=0, return_counts=True)
    assert counts.max() <= np.ceil(min(per_px * CELL_PX**2, MAX_PER_CELL))
    everything = {tuple(row) for row in table(marks.find(whole(site), 0, upright=True)).tolist()}
    assert {tuple(row) for row in table(found).tolist()} <= everything
    if per_px < 0.001:  # the strongest of the whole picture is the strongest of its cell
        strongest = sift(as_picture(site.gray(whole(site)), CPU), max_keypoints=1, upright=True, spread=1)
        assert nearest(strongest.xy_px[0], found.features.xy_px[0])[0] < 0.02


# What is kept


def test_memory_is_bounded_and_what_was_given_up_comes_back_the_same(site, marks, monkeypatch):
    monkeypatch.setattr(landmarks, "MAX_LANDMARKS", 700)
    small = LandmarkMap(site, CPU)
    windows = [Window(x, y, 80, 80) for y in (20, 300, 470) for x in (20, 300, 510)]
    for window in [*windows, *windows]:
        np.testing.assert_array_equal(*(table(one.find(window, 0, upright=True)) for one in (small, marks)))
        kept = [len(tile["rank"]) for tile in small.tiles.values()]
        assert sum(kept) <= 700 or len(kept) == len(small._keys(window, 0, True))


@pytest.fixture
def stored(tmp_path, monkeypatch):
    """A map in a file, with a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    ground = Ground(size=(280, 300))
    return write_map(tmp_path / "map.tif", ground, ground.gray), tmp_path / "cache" / "scenematch"


def write_map(path, ground, gray):
    return write_raster(path, gray, crs=f"EPSG:{ground.epsg}", transform=from_corner(ground.pixel_to_crs))


def prepared(path, upright=True, backend="auto"):
    site = OrthoMap.open(path)
    marks = LandmarkMap(site, CPU, backend)
    marks.prepare([0])
    return table(marks.find(whole(site), 0, upright=upright))


@pytest.mark.parametrize("upright", [True, False])
def test_a_prepared_map_is_read_back_as_it_was_found(stored, monkeypatch, upright):
    first = prepared(stored[0], upright)
    assert len(first) > 100
    monkeypatch.setattr(landmarks, "sift", lambda *_, **__: pytest.fail("described anew"))
    np.testing.assert_array_equal(prepared(stored[0], upright), first)


OTHER_BYTES = {
    "cut short": lambda whole: whole[: len(whole) // 2],
    "a bit turned": lambda whole: whole[:5000] + bytes([whole[5000] ^ 255]) + whole[5001:],
    "something else": lambda _: b"PK\3\4 but no archive",
    "empty": lambda _: b"",
}


@pytest.mark.slow
@pytest.mark.parametrize("how", OTHER_BYTES)
def test_a_damaged_file_is_made_anew(stored, how):
    first = prepared(stored[0])
    for path in stored[1].iterdir():
        path.write_bytes(OTHER_BYTES[how](path.read_bytes()))
    np.testing.assert_array_equal(prepared(stored[0]), first)
    for path in stored[1].iterdir():
        assert landmark_cache.load_arrays(path) is not None


def test_another_map_detector_or_backend_has_another_file(stored, monkeypatch):
    path, cache = stored
    ground = Ground(size=(120, 130))
    changed = ground.gray.copy()
    changed[60, 65] ^= 1
    write_map(path, ground, ground.gray)
    first = prepared(path)
    assert len(list(cache.iterdir())) == 2  # upright and not
    other = prepared(path, backend="kornia")
    assert len(list(cache.iterdir())) == 4
    assert other.shape != first.shape or not np.array_equal(other, first)
    np.testing.assert_array_equal(prepared(path, backend="compiled"), first)  # which is auto's on a CPU
    assert len(list(cache.iterdir())) == 4
    write_map(path, ground, changed)
    prepared(path)
    assert len(list(cache.iterdir())) == 6
    monkeypatch.setattr(landmarks, "DETECTOR_VERSION", 999)
    prepared(path)
    assert len(list(cache.iterdir())) == 8


def test_a_folder_that_cannot_be_written_is_no_error(stored, tmp_path, monkeypatch):
    first = prepared(stored[0])
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    np.testing.assert_array_equal(prepared(stored[0]), first)


def test_a_broken_write_leaves_nothing_behind(stored, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    prepared(stored[0])
    assert list(stored[1].iterdir()) == []


def test_a_map_without_a_file_leaves_no_file(site, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    LandmarkMap(site, CPU).prepare([1])
    assert list(Path(tmp_path).rglob("*")) == []


def test_levels_are_prepared_from_the_coarsest_as_far_as_the_bound_goes(site, monkeypatch):
    monkeypatch.setattr(landmarks, "PREPARED_PX", 300 * 280 + 150 * 140 + 100_00)
    marks = LandmarkMap(site, CPU)
    marks.prepare()
    assert {level for level, *_ in marks.tiles} == set(range(1, site.levels))


def test_what_was_prepared_is_not_given_up_in_flight(site, monkeypatch):
    monkeypatch.setattr(landmarks, "MAX_LANDMARKS", 300)
    marks = LandmarkMap(site, CPU)
    marks.prepare()
    made = marks.tiles.created
    for level in reversed(range(site.levels)):
        for upright in (False, True):
            for window in (Window(0, 0, 60, 60), whole(site, level)):
                marks.find(window, level, upright=upright)
    assert sum(len(tile["rank"]) for tile in marks.tiles.values()) > 300
    assert marks.tiles.created == made
