"""Ground whose tiles all look alike: no level of the map and no refined pose tells one from another."""

import math

import cv2
import numpy as np
import pytest

from engine import Fix, Frame, OrthoMap, Prior, SceneMatcher, Window

TILE_PX, TILES = 101, 8  # no multiple of the coarser levels' pixels, on which each tile is sampled differently
HEIGHT_M, HEADING_DEG = 140.0, 30.0


@pytest.fixture(scope="module")
def tiled(ground):
    tile = ground.flat_site.gray(Window(200, 180, TILE_PX, TILE_PX))
    to_crs = [[ground.gsd_m, 0.0, 500_000.0], [0.0, -ground.gsd_m, 5_344_000.0]]
    return OrthoMap.from_arrays(np.tile(tile, (TILES, TILES)), to_crs, f"EPSG:{ground.epsg}")


def above(tiled, camera, nadir_px, rng):
    """A level frame drawn from the map itself, with the noise of another exposure."""
    scale, turn = HEIGHT_M / camera.focal_px / tiled.gsd_m_per_px, math.radians(HEADING_DEG)
    turned = scale * np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    to_map = np.c_[turned, nadir_px - turned @ camera.matrix[:2, 2]]
    gray = tiled.gray(Window(0, 0, tiled.width_px, tiled.height_px))
    size = (camera.width_px, camera.height_px)
    seen = cv2.warpAffine(gray, to_map, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    noisy = np.clip(seen + rng.normal(0.0, 6.0, seen.shape), 0.0, 255.0).astype(np.uint8)
    told = {"height_agl_m": HEIGHT_M * rng.normal(1.0, 0.01), "heading_deg": HEADING_DEG + rng.normal(0.0, 1.0)}
    return Frame(noisy, 0, **told, roll_deg=rng.normal(0.0, 0.5), pitch_deg=rng.normal(0.0, 0.5))


@pytest.mark.parametrize("method", ["ncc", "sift", "auto"])
def test_no_tile_is_told_from_another(tiled, camera, ground, method):
    matcher, rng = SceneMatcher(tiled, camera, method, "cpu"), np.random.default_rng(4)
    for _ in range(12):
        nadir = rng.uniform(0.4, 0.6, 2) * TILES * TILE_PX
        east_m, north_m = tiled.enu_from_pixel(nadir + TILE_PX * rng.choice([-1.0, 0.0, 1.0], 2))
        prior = Prior(east_m=float(east_m), north_m=float(north_m), sigma_m=float(rng.choice([15.0, 30.0])))
        result = matcher.locate(above(tiled, camera, nadir, rng), prior)
        assert not isinstance(result, Fix), (result.stage, result.confidence)
