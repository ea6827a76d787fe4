"""Tile caches: z/x/y.png is the picture that it was cut from, opened by its names alone, or one clear line."""

import io
import re

import cv2
import numpy as np
import pytest
from affine import Affine
from PIL import Image

from engine import OrthoMap
from engine.errors import MapError
from engine.maps.rasters import open_source, stored_levels
from engine.values import Window
from tests.support.rasters import write_raster
from tests.support.refusals import refusal

ZOOM, TILE = 18, 64
FIRST = (143_000, 90_500)  # column and row, from the north, of the first tile: near Vienna
COLUMNS, ROWS = 5, 4
GAPS = ((1, 2), (4, 3))
STEP_M = 156543.03392804097 * 256 / TILE / 2**ZOOM
WHOLE = Window(0, 0, COLUMNS * TILE, ROWS * TILE)
WINDOWS = [WHOLE, Window(60, 50, 77, 91), Window(63, 63, 2, 2), Window(250, 130, 70, 20)]
TMS = """<?xml version="1.0" encoding="utf-8"?>
<TileMap version="1.0.0" tilemapservice="http://tms.osgeo.org/1.0.0">
  <SRS>{srs}</SRS><TileSets profile="{profile}"></TileSets>
</TileMap>"""


@pytest.fixture(scope="module")
def picture():
    """(H, W, 3) without pure black or white; what is smooth in it survives a JPEG."""
    noise = np.random.default_rng(0).integers(0, 256, (ROWS * TILE, COLUMNS * TILE, 3)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0).astype(np.float32)
    return np.clip(smooth * 4.0 - 384.0, 2, 253).astype(np.uint8)


def cut(folder, picture, zoom=ZOOM, *, gaps=GAPS, south_up=False, save=None):
    """Tiles of a picture whose first one is FIRST on level ZOOM, or the one above that on a coarser level."""
    coarser = ZOOM - zoom
    left, top = (v << (ZOOM - zoom) for v in (FIRST[0] >> coarser, FIRST[1] >> coarser))
    x0, y0 = (FIRST[0] - left) * TILE >> coarser, (FIRST[1] - top) * TILE >> coarser
    rows, columns = (-(-(n + v) // TILE) for n, v in zip(picture.shape[:2], (y0, x0), strict=True))
    canvas = np.zeros((rows * TILE, columns * TILE, 3), np.uint8)
    canvas[y0 : y0 + picture.shape[0], x0 : x0 + picture.shape[1]] = picture
    for column in range(columns):
        for row in range(rows):
            if coarser or (column, row) not in gaps:
                x, y = (FIRST[0] >> coarser) + column, (FIRST[1] >> coarser) + row
                path = folder / str(zoom) / str(x) / f"{2**zoom - 1 - y if south_up else y}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                tile = canvas[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
                (save or (lambda tile, path: Image.fromarray(tile).save(path)))(tile, path)
    if south_up:
        (folder / "tilemapresource.xml").write_text(TMS.format(srs="EPSG:900913", profile="mercator"))
    return folder


def tile_path(folder, column=0, row=0, zoom=ZOOM):
    return folder / str(zoom) / str((FIRST[0] >> ZOOM - zoom) + column) / f"{(FIRST[1] >> ZOOM - zoom) + row}.png"


@pytest.fixture(scope="module")
def plain(tmp_path_factory, picture):
    """The same as one GeoTIFF."""
    half = 20037508.342789244
    at = Affine(STEP_M, 0.0, FIRST[0] * TILE * STEP_M - half, 0.0, -STEP_M, half - FIRST[1] * TILE * STEP_M)
    path = tmp_path_factory.mktemp("plain") / "map.tif"
    return write_raster(path, np.moveaxis(picture, -1, 0), crs="EPSG:3857", transform=at)


@pytest.fixture
def own(picture, tmp_path):
    """A cache that a test may change."""
    return cut(tmp_path / "tiles", picture)


@pytest.fixture
def tiny_limits(monkeypatch):
    """A map of a few tiles is too large for memory."""
    monkeypatch.setattr("engine.maps.rasters.MEMORY_LIMIT_PX", 20_000)
    monkeypatch.setattr("engine.maps.pyramid.COARSE_LIMIT_PX", 20_000)


def there():
    known = np.ones((WHOLE.height_px, WHOLE.width_px), np.bool_)
    for column, row in GAPS:
        known[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE] = False
    return known


@pytest.mark.parametrize("south_up", [False, True], ids=["XYZ", "TMS"])
def test_a_tile_cache_is_the_picture_that_it_was_cut_from_and_a_gap_is_nodata(tmp_path, plain, picture, south_up):
    folder = cut(tmp_path / "tiles", picture, south_up=south_up)
    whole, cached = OrthoMap.open(plain), OrthoMap.open(folder)
    assert (cached.width_px, cached.height_px) == (WHOLE.width_px, WHOLE.height_px)
    assert cached.bounds_deg == pytest.approx(whole.bounds_deg, abs=1e-10)
    for window in WINDOWS:
        part = np.s_[window.y0 : window.y0 + window.height_px, window.x0 : window.x0 + window.width_px]
        known = there()[part]
        np.testing.assert_array_equal(cached.valid(window), known)
        np.testing.assert_array_equal(cached.gray(window)[known], whole.gray(window)[known])
    assert cached.info()["driver"] == "WMS"
    assert cached.crs.to_epsg() == 3857


def test_what_a_tile_is_its_content_says(tmp_path, picture, plain):
    """Grey with alpha, a colour table, JPEG and WebP under the name of a PNG."""
    forms = {
        0: lambda image, path: image.save(path, "WEBP", lossless=True),
        1: lambda image, path: image.save(path, "JPEG", quality=95),
        2: lambda image, path: image.convert("L").convert("LA").save(path),
        3: lambda image, path: image.quantize(256).save(path),
        4: lambda image, path: image.convert("RGBA").save(path),
    }

    def save(tile, path):
        forms[int(path.parent.name) - FIRST[0]](Image.fromarray(tile), path)

    cached = OrthoMap.open(cut(tmp_path / "tiles", picture, gaps=(), save=save))
    apart = cached.gray(WHOLE).astype(float) - OrthoMap.open(plain).gray(WHOLE)
    assert cached.valid(WHOLE).all()
    for column, most in enumerate((0.5, 2.0, 1.0, 8.0, 0.5)):
        assert np.abs(apart[:, column * TILE : (column + 1) * TILE]).mean() < most


def test_what_is_no_tile_is_passed_over(own):
    before = OrthoMap.open(own)
    (own / "preview.png").write_bytes(tile_path(own).read_bytes())
    (own / "leaflet.html").write_text("a viewer")
    for name in ("007.png", "7.txt", "7", "_7.png"):
        (tile_path(own).parent / name).write_text("no tile")
    (own / "19" / "5").mkdir(parents=True)  # a deeper level without a tile
    after = OrthoMap.open(own)
    np.testing.assert_array_equal(after.gray(WHOLE), before.gray(WHOLE))
    assert before.valid(WHOLE).sum() == there().sum()


def test_an_empty_file_is_a_gap(own):
    for place in ((0, 0), (2, 2)):
        tile_path(own, *place).write_bytes(b"")
    site = OrthoMap.open(own)
    assert not site.valid(Window(0, 0, TILE, TILE)).any()
    assert site.valid(WHOLE).sum() == there().sum() - 2 * TILE**2


# ------------------------------------------------------------------------------------- many tiles, and levels


@pytest.mark.parametrize(("south_up", "gaps", "levels"), [(False, (), 3), (False, GAPS, 1), (True, (), 1)])
def test_complete_coarser_levels_are_overviews(tmp_path, picture, tiny_limits, south_up, gaps, levels):
    """Counted from the south they are not, and a large map is copied."""
    folder = cut(tmp_path / "tiles", picture, gaps=gaps, south_up=south_up)
    for zoom in (17, 16):
        coarse = cv2.resize(picture, None, fx=2.0 ** (zoom - ZOOM), fy=2.0 ** (zoom - ZOOM))
        cut(folder, coarse, zoom, south_up=south_up)
    assert stored_levels(open_source(folder)) == tuple(range(levels))


@pytest.mark.parametrize("level", [1, 2])
def test_a_coarser_zoom_level_is_an_overview_at_the_same_place(tmp_path, picture, tiny_limits, level):
    folder = cut(tmp_path / "tiles", picture, gaps=())
    smaller = [np.zeros_like(picture)[:: 1 << k, :: 1 << k] for k in (1, 2)]
    for k, coarse in enumerate(smaller, 1):
        coarse[...] = np.add.outer(np.arange(coarse.shape[0]) % 7 * 10, np.arange(coarse.shape[1]) + k)[..., None]
        cut(folder, coarse, ZOOM - k)
    site = OrthoMap.open(folder)
    rows, columns = site.level_shape(level)
    lat, lon = OrthoMap.open(cut(tmp_path / "same", picture, gaps=())).geodetic_from_pixel([-0.5, -0.5])
    x, y = (int(v) for v in np.round((site.pixel_from_geodetic(lat, lon) + 0.5) / (1 << level)))
    np.testing.assert_array_equal(
        site.gray(Window(0, 0, columns, rows), level)[y:, x:], smaller[level - 1][..., 0]
    )


def test_a_coarser_level_with_gaps_of_its_own_is_none(tmp_path, picture, tiny_limits):
    folder = cut(cut(tmp_path / "tiles", picture, gaps=()), np.full_like(picture, 9)[::2, ::2], 17)
    tile_path(folder, 1, 1, 17).unlink()
    assert stored_levels(open_source(folder)) == (0,)


def test_a_large_cache_without_coarser_levels_is_copied_once_and_again_when_a_tile_changes(
    own, plain, tmp_path, tiny_limits
):
    stated = []

    def opened():
        stated.clear()
        site = OrthoMap.open(own, cache_dir=tmp_path / "copies", on_copy=lambda *pixels: stated.append(pixels))
        return site.gray(WHOLE), site.valid(WHOLE)

    gray, valid = opened()
    assert stated
    assert stated[-1] == (WHOLE.area_px, WHOLE.area_px)
    np.testing.assert_array_equal(valid, there())
    np.testing.assert_array_equal(gray[valid], OrthoMap.open(plain).gray(WHOLE)[valid])
    opened()
    assert stated == []
    Image.new("RGB", (TILE, TILE), (77, 77, 77)).save(tile_path(own))
    assert (opened()[0][:TILE, :TILE] == 77).all()
    assert stated


# ------------------------------------------------------------------------------------------------- refusals


def png(mode, size=(TILE, TILE)):
    file = io.BytesIO()
    Image.new(mode, size).save(file, "PNG")
    return file.getvalue()


@pytest.mark.parametrize(
    ("row", "spoilt", "words"),
    [
        (0, lambda _: png("I;16"), "expected square tiles of 8 bits, got 64 x 64 px of mode I;16 in "),
        (0, lambda _: png("RGB", (64, 32)), "expected square tiles of 8 bits, got 64 x 32 px of mode RGB in "),
        (2, lambda whole: whole[:-300], "cannot read "),
        (2, lambda _: b"<html>403 Forbidden</html>", "cannot read "),
    ],
    ids=["depth", "shape", "cut", "no picture"],
)
def test_a_tile_that_is_none_is_refused_by_name(own, row, spoilt, words):
    path = tile_path(own, row, row)
    path.write_bytes(spoilt(path.read_bytes()))
    assert re.match(rf"map: {words}.*9050{row}\.png", refusal(OrthoMap.open, own, error=MapError))


def spoil_ending(folder):
    tile_path(folder, 2, 2).rename(tile_path(folder, 2, 2).with_suffix(".jpg"))
    return "expected tiles of one ending, got jpg and png in "


def spoil_all(folder):
    for path in folder.rglob("*.png"):
        path.write_bytes(b"")
    return "expected tiles with a picture in .*, got empty files only"


def spoil_order(folder):
    (folder / "18" / "300000").mkdir()
    (folder / "18" / "300000" / "5.png").write_bytes(b"")
    return r"expected columns and rows below 262144 on zoom level 18, as z/x/y, got .*18/300000/5\.png"


def spoil_extent(folder):
    (folder / "18" / "3").mkdir()
    (folder / "18" / "3" / "5.png").write_bytes(tile_path(folder).read_bytes())
    return "expected tiles of one region, at most 1,000,000 px a side, got 9,152,128 px"


def spoil_projection(folder):
    (folder / "tilemapresource.xml").write_text(TMS.format(srs="EPSG:4326", profile="geodetic"))
    return r"expected tiles in Web Mercator \(EPSG:3857\), got 'EPSG:4326' in .*tilemapresource\.xml"


def spoil_description(folder):
    (folder / "tilemapresource.xml").write_text("<TileMap>")
    return r"cannot read .*tilemapresource\.xml"


@pytest.mark.parametrize(
    "spoil",
    [spoil_all, spoil_ending, spoil_order, spoil_extent, spoil_projection, spoil_description],
    ids=lambda spoil: spoil.__name__,
)
def test_tiles_that_are_no_map_are_refused_in_one_line(own, spoil):
    words = spoil(own)
    assert re.match(f"map: {words}", refusal(OrthoMap.open, own, error=MapError))


def test_photographs_by_date_are_no_tiles(tmp_path):
    (tmp_path / "2024" / "11").mkdir(parents=True)
    Image.new("RGB", (TILE, TILE)).save(tmp_path / "2024" / "11" / "12.jpg")
    words = r"expected raster files in the folder .*, or tiles as z/x/y.png below it, found none"
    with pytest.raises(MapError, match=words):
        OrthoMap.open(tmp_path)
