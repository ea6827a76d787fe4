"""Build a world from the user's map: an orthophoto, with or without a surface model, to render frames from."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from engine.errors import MapError
from engine.maps.grids import Grid, warp_between
from engine.maps.metric_copy import open_metric_copy
from engine.maps.rasters import GrayReader, Source, map_errors, open_source
from engine.maps.surface import read_surface
from engine.values import Window
from scenematch.simulator.canvas import ASPHALT, CANOPY, GRASS, ROOF
from scenematch.simulator.conditions import CONDITIONS, Condition, apply_season, condition_by_name
from scenematch.simulator.light import LIGHTS, Float32, Image, illuminate
from scenematch.simulator.render import World
from scenematch.simulator.town import Town, generator

LIMIT_PX = 100 * 2**20
"""Largest world; it takes about 20 bytes of memory per pixel."""
LIMIT_SIDE_PX = 32767
"""OpenCV's remap counts in 16 bits."""
BARE_CELL_M, BARE_REACH_M = 2.0, 40.0
"""Ground is the morphological opening of the surface by 40 m, on cells of 2 m."""
GREEN = 12.0
"""Grey levels by which green must exceed red and blue in foliage."""


def world_from_map(
    path: str | os.PathLike[str],
    surface: str | os.PathLike[str] | None = None,
    *,
    condition: str | Condition | None = None,
    seed: int = 1,
    cache_dir: str | os.PathLike[str] | None = None,
) -> Town:
    """A world from the user's rasters, used like a generated town; the rasters are also its map.

    Colours are those of the file if it has three uint8 bands on a north-up metric grid, else grey. Walls, which
    no orthophoto shows, have the darkened colour of the roof.

    Args:
        path: the orthophoto; for supported files see :meth:`engine.OrthoMap.open`.
        surface: heights in any grid and CRS; None is flat.
        condition: of the frames, applied to the photograph; None leaves it unchanged.
        seed: for snow patches and bare branches.
        cache_dir: folder for resampled maps.

    Raises:
        MapError: a file cannot be read, is too large, or its grid has no EPSG code.
        OptionError: there is no such condition.
    """
    day = None if condition is None else condition_by_name(condition)
    rgb, grid = _photograph(open_source(path), cache_dir)
    code = grid.crs.to_epsg()
    if code is None:
        raise MapError(f"map: expected a CRS with an EPSG code, got {grid.crs.name!r}")
    gsd = abs(float(grid.pixel_to_crs[0, 0]))
    heights, ground, lowest = _heights(surface, grid, gsd)
    seen, standing = (rgb, heights) if day is None else _on_another_day(rgb, heights, ground, day, gsd, seed)
    sides = np.dstack([cv2.blur(seen, (3, 3)) // 2, np.zeros(heights.shape, np.uint8)])
    air = None if day is None else day.air
    world = World(seen, sides, standing, grid.pixel_to_crs, code, ground_m=ground, air=air)
    return Town(rgb, heights, grid.pixel_to_crs, code, gsd, world, day or CONDITIONS["noon"], lowest)


def _photograph(source: Source, cache_dir: str | os.PathLike[str] | None) -> tuple[Image, Grid]:
    """RGB (H, W, 3) of a map on a metric grid, and that grid."""
    reader = GrayReader(source)
    if not source.grid.is_metric:
        source = open_metric_copy(source, reader, cache_dir)
        reader = GrayReader(source, find_collar=False)
    grid, dataset = source.grid, source.dataset
    if grid.width_px * grid.height_px > LIMIT_PX or max(grid.width_px, grid.height_px) > LIMIT_SIDE_PX:
        raise MapError(f"map: expected at most {LIMIT_PX} px to fly over, got {grid.width_px} x {grid.height_px}")
    if dataset.count >= 3 and dataset.dtypes[0] == "uint8":
        with map_errors("map", source.path):
            bands = dataset.read([1, 2, 3])
        return np.ascontiguousarray(np.moveaxis(bands, 0, -1)), grid
    gray, _ = reader.read(Window(0, 0, grid.width_px, grid.height_px))
    return np.repeat(gray[..., None], 3, axis=2), grid


def _heights(
    surface: str | os.PathLike[str] | None, grid: Grid, gsd: float
) -> tuple[Float32, Float32 | None, float]:
    """Surface and bare ground (H, W) above the lowest point, and its height; flat without a surface."""
    shape = (grid.height_px, grid.width_px)
    if surface is None:
        return np.zeros(shape, np.float32), None, 0.0
    raw, surface_grid = read_surface(open_source(surface, "surface"), grid)
    known = np.isfinite(raw)
    if not known.any():
        raise MapError(f"surface: expected known heights under the map, got none in {surface}")
    filled = np.where(known, raw, np.float32(np.percentile(raw[known], 20.0))).astype(np.float32)
    columns, rows = np.arange(shape[1], dtype=np.float64), np.arange(shape[0], dtype=np.float64)
    at = warp_between(grid, surface_grid)(np.stack(np.meshgrid(columns, rows), axis=-1)).astype(np.float32)
    heights: Any = cv2.remap(filled, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    lowest = float(heights.min())
    heights = np.asarray(heights - np.float32(lowest), dtype=np.float32)
    return heights, bare_ground(heights, gsd), lowest


def bare_ground(height_m: Float32, gsd_m_per_px: float) -> Float32:
    """The ground below roofs and crowns: the morphological opening of the surface by 40 m, smoothed.

    Args:
        height_m: (H, W) of the surface.
        gsd_m_per_px: pixel in metres.

    Returns:
        (H, W) heights, nowhere above the surface.
    """
    shape = height_m.shape
    cells = [max(1, round(n * gsd_m_per_px / BARE_CELL_M)) for n in shape]
    coarse = cv2.resize(height_m, cells[::-1], interpolation=cv2.INTER_AREA)
    across = 2 * round(0.5 * BARE_REACH_M / BARE_CELL_M) + 1
    cut = cv2.morphologyEx(coarse, cv2.MORPH_OPEN, np.ones((across, across), np.uint8))
    smooth = cv2.resize(cv2.GaussianBlur(cut, (0, 0), 3.0), shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.minimum(smooth, height_m), dtype=np.float32)


def _materials(rgb: Image, above_m: Float32) -> Image:
    """Materials (H, W) guessed from colour and height above the ground."""
    red, green, blue = (rgb[..., k].astype(np.float32) for k in range(3))
    foliage = green - 0.5 * (red + blue) > GREEN
    material = np.full(above_m.shape, ASPHALT, np.uint8)
    material[above_m > 2.5] = ROOF
    material[foliage] = GRASS
    material[foliage & (above_m > 1.5)] = CANOPY
    return material


def _on_another_day(
    rgb: Image, heights: Float32, ground: Float32 | None, day: Condition, gsd: float, seed: int
) -> tuple[Image, Float32]:
    """The photograph's colours and heights in another season, relit by the ratio of the day's light to noon's."""
    above = heights if ground is None else heights - ground
    dressed, standing = apply_season(rgb, heights, _materials(rgb, above), ground, day, gsd, generator(seed, 0x77))
    noon = LIGHTS["noon"]
    level = [s * noon.towards_sun[2] + k for s, k in zip(noon.sun_rgb, noon.sky_rgb, strict=True)]
    sun, sky = (np.divide(rgb, level).tolist() for rgb in (day.light.sun_rgb, day.light.sky_rgb))
    light = replace(day.light, sun_rgb=tuple(sun), sky_rgb=tuple(sky))
    return illuminate(dressed, standing, gsd, light, shade=day.shade), standing
