"""Build a fictional town from one seed: streets, houses, parks and fields, with map and surface model.

Convention:
    Town coordinates (u, v) are those of :mod:`scenematch.simulator.canvas`. Everything is drawn at twice the map's
    resolution.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError
from engine.orthomap import OrthoMap
from scenematch.simulator.blocks import fill_blocks
from scenematch.simulator.canvas import ASPHALT, CANOPY, PAVING, WATER, Canvas, Colour
from scenematch.simulator.conditions import CONDITIONS, Condition, apply_season, condition_by_name
from scenematch.simulator.light import Array, Float32, Image, illuminate
from scenematch.simulator.optics import Sensor
from scenematch.simulator.render import Glint, World, transformer
from scenematch.simulator.terrain import draw_river, hills, raise_by_ground

CRS_EPSG = 32633
"""UTM zone 33 north; the town lies 1.45 degrees east of its central meridian: convergence +1.08 degrees."""
CENTRE_LAT_DEG, CENTRE_LON_DEG = 48.25, 16.45
EXACT = 1e-3
"""Georeferencing accuracy in metres and slope accuracy in degrees of a simulated map: exact, but above 0."""
GROUND_AMSL_M = 155.0
"""Height of the flat or lowest ground above mean sea level."""
MARGIN_M = 40.0
"""Margin of the drawn world beyond the map, so that a tilted camera still sees a town."""
MAP_SENSOR = Sensor(
    gamma=0.92, balance_rgb=(0.97, 0.94, 0.88), haze=8.0, vignette=0.0, exposure_sd=0.0, blur_px=0.55, noise_sd=2.2
)
"""The camera of the map's survey: a warmer white balance and less contrast than the drone's."""
LAMP_M = 6.0
"""Height of street lamps: they do not light anything higher."""
MAX_RELIEF_M = 80.0
_CARS: tuple[Colour, ...] = (
    (236, 236, 236), (40, 42, 46), (150, 154, 158), (132, 44, 44), (58, 72, 104), (206, 206, 200), (90, 92, 96),
)  # fmt: skip


@dataclass(frozen=True)
class Town:
    """A map, its surface model, and the finer world that frames are rendered from.

    Attributes:
        ortho: (H, W, 3) RGB orthophoto, a different photograph from every frame.
        surface_m: (H, W) metres above the world's height 0, which is the ground if it is flat.
        pixel_to_crs: (2, 3) affine of map pixels (x, y), centres at integers, to the CRS.
        crs_epsg: projected CRS.
        gsd_m_per_px: map pixel in grid metres.
        world: what a camera sees on the day of the flight.
        condition: that day's light, season and air, already in the world; its noise applies to the camera.
        datum_amsl_m: the world's height 0 above mean sea level.
    """

    ortho: Image
    surface_m: Float32
    pixel_to_crs: Array
    crs_epsg: int
    gsd_m_per_px: float
    world: World
    condition: Condition = CONDITIONS["noon"]
    datum_amsl_m: float = GROUND_AMSL_M

    def site(self) -> OrthoMap:
        """The town's map for the engine, with exact georeferencing and slope accuracy."""
        gray = np.asarray(cv2.cvtColor(self.ortho, cv2.COLOR_RGB2GRAY), np.uint8)
        return OrthoMap.from_arrays(
            gray,
            self.pixel_to_crs,
            f"EPSG:{self.crs_epsg}",
            surface_m=self.surface_m,
            georeference_sigma_m=EXACT,
            slope_sigma_deg=EXACT,
        )


def _streets(canvas: Canvas) -> tuple[list[float], list[float], list[tuple[Array, float]]]:
    """Draw the streets; returns block edges along u and v, and every street as (centre line, width)."""
    rng, reach = canvas.rng, canvas.reach_m
    edges: list[list[float]] = []
    for low, high in ((62.0, 112.0), (48.0, 88.0)):
        at = [-reach + rng.uniform(0, 40)]
        while at[-1] < reach:
            at.append(at[-1] + rng.uniform(low, high))
        edges.append(at)
    roads = [(np.array([(u, -reach), (u, reach)]), float(rng.choice([7.5, 8.5, 12.5]))) for u in edges[0]]
    roads += [(np.array([(-reach, v), (reach, v)]), float(rng.choice([7.0, 8.0, 11.0]))) for v in edges[1]]
    along = np.linspace(-reach, reach, 120)
    bend = (
        0.45 * along + 42.0 * np.sin(along / rng.uniform(75.0, 105.0) + rng.uniform(0, 6)) + rng.uniform(-40, 40)
    )
    roads.append((np.column_stack([bend, along]), 15.0))
    crossings = np.zeros(canvas.shape, np.uint8)
    for extra, colour, material in ((5.0, (148, 145, 138), PAVING), (0.0, (92, 93, 96), ASPHALT)):
        for line, width in roads:
            canvas.stroke(canvas.rgb, line, canvas.tint(colour, 5.0), width + extra, cv2.LINE_AA)
            canvas.stroke(canvas.material, line, (material,), width + extra)
            canvas.stroke(canvas.busy, line, (255,), width + extra)
            if material == ASPHALT:
                one = np.zeros_like(crossings)
                reach_px = round(width / canvas.gsd) + round(7 / canvas.gsd)
                canvas.stroke(one, line, (1,), reach_px * canvas.gsd)
                cv2.add(crossings, one, crossings)
    for line, width in roads:
        _markings(canvas, line, width, crossings)
    return edges[0], edges[1], roads


def _stations(line: Array, pitch_m: float) -> list[tuple[float, float, float]]:
    """Positions (u, v) and directions in radians every ``pitch_m`` along a line."""
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.arange(pitch_m / 2, run[-1], pitch_m)
    u, v = (np.interp(at, run, line[:, k]) for k in (0, 1))
    angle = np.arctan2(np.gradient(v), np.gradient(u))
    return list(zip(u.tolist(), v.tolist(), angle.tolist(), strict=True))


def _markings(canvas: Canvas, line: Array, width: float, crossings: Image) -> None:
    """A dashed centre line, zebra crossings where streets meet, and patches of newer asphalt."""
    white, last = (214, 214, 208), 1.0
    for u, v, angle in _stations(line, 3.0):
        count = canvas.value(crossings, u, v)
        along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
        if count == 1 and round((u * along[0] + v * along[1]) / 3.0) % 2:
            canvas.rect(u, v, 3.0, 0.22, white, angle)
        if count > 1 and last == 1 and canvas.rng.random() < 0.75:
            for stripe in np.arange(-width / 2 + 0.7, width / 2 - 0.3, 1.1):
                canvas.rect(u + across[0] * stripe, v + across[1] * stripe, 3.2, 0.55, white, angle)
        if count >= 1 and canvas.rng.random() < 0.05:
            side = canvas.rng.uniform(-0.3, 0.3) * width
            size = canvas.rng.uniform(2, 9), canvas.rng.uniform(1.0, 3.5)
            canvas.rect(u + across[0] * side, v + across[1] * side, *size, canvas.tint((84, 85, 88), 14), angle)
        last = count


def _park_cars(canvas: Canvas, roads: list[tuple[Array, float]]) -> tuple[Image, Image]:
    """Colours on the day of the map and on the day of the flight: a third of the cars have moved."""
    rng = canvas.rng
    slots = []
    for line, width in roads:
        for u, v, angle in _stations(line, 6.2):
            for side in (-1, 1):
                offset = side * (width / 2 - 1.1)
                slots.append((u - math.sin(angle) * offset, v + math.cos(angle) * offset, angle))
    days = (canvas.rgb, canvas.rgb.copy())
    for u, v, angle in slots:
        parked, stays, other = rng.random(), rng.random() < 0.67, rng.random()
        colour, angle = canvas.pick(_CARS), angle + rng.normal(0, 0.02)
        if canvas.value(canvas.height, u, v) != 0.0 or canvas.value(canvas.material, u, v) != ASPHALT:
            continue
        for rgb, there in zip(days, (parked < 0.3, (parked if stays else other) < 0.3), strict=True):
            if there:
                canvas.rgb = rgb
                canvas.rect(u + 0.35, v + 0.35, 4.5, 1.9, (58, 58, 60), angle)
                canvas.rect(u, v, 4.3, 1.75, colour, angle)
                canvas.rect(u + 0.5 * math.cos(angle), v + 0.5 * math.sin(angle), 1.0, 1.5, (44, 50, 58), angle)
    return days


def generator(seed: int, stream: int) -> np.random.Generator:
    """One of the independent random streams of a seed."""
    if seed < 0:
        raise OptionError(f"seed: expected 0 or more, got {seed}")
    return np.random.default_rng([seed, stream])


def _shrink(raster: NDArray[Any], times: int) -> NDArray[Any]:
    """The raster's means over squares of pixels."""
    size = (raster.shape[1] // times, raster.shape[0] // times)
    return np.asarray(cv2.resize(raster, size, interpolation=cv2.INTER_AREA))


def _georeference(width_px: int, height_px: int, gsd: float) -> Array:
    """Affine (2, 3) of a north-up map about the town's centre, its first pixel on a whole metre of the grid."""
    easting, northing = transformer(CRS_EPSG).transform(CENTRE_LON_DEG, CENTRE_LAT_DEG)
    corner = (round(easting - width_px * gsd / 2), round(northing + height_px * gsd / 2))
    return np.array([[gsd, 0.0, corner[0]], [0.0, -gsd, corner[1]]], dtype=np.float64)


def _lamp_light(canvas: Canvas, roads: list[tuple[Array, float]]) -> Float32:
    """Light (H, W) in [0, 1] of lamps every 27 m on alternating sides, on everything lower than a lamp."""
    pools = np.zeros(canvas.shape, np.float32)
    for line, width in roads:
        for k, (u, v, angle) in enumerate(_stations(line, 27.0)):
            aside = (width / 2 + 0.5) * (1 if k % 2 else -1)
            x, y = np.rint(canvas.px(np.array([[u - math.sin(angle) * aside, v + math.cos(angle) * aside]]))[0])
            if 0 <= x < pools.shape[1] and 0 <= y < pools.shape[0]:
                pools[int(y), int(x)] = 1.0
    sigma = 4.5 / canvas.gsd
    pools = np.asarray(cv2.GaussianBlur(pools, (0, 0), sigma) * np.float32(2.0 * math.pi * sigma**2))
    return np.minimum(pools, np.float32(1.0))


@dataclass(frozen=True)
class Day:
    """Drawn colours (H, W, 3), heights and materials (H, W) of a town on one day."""

    rgb: Image
    height_m: Float32
    material: Image


@dataclass(frozen=True)
class Drawn:
    """A finished canvas, on the day of the map and on that of the flight.

    Attributes:
        canvas: all that was drawn.
        then: on the day of the map.
        today: on the day of the flight.
        ground_m: (H, W) of the bare ground if it is not flat at 0.
        lamps: (H, W) light of the street lamps.
    """

    canvas: Canvas
    then: Day
    today: Day
    ground_m: Float32 | None
    lamps: Float32


def _draw(
    canvas: Canvas, relief_m: float, river_rng: np.random.Generator | None, hill_rng: np.random.Generator
) -> Drawn:
    """Streets, blocks and cars on a canvas, and the hills below them."""
    river = None if river_rng is None else draw_river(canvas, river_rng)
    edges_u, edges_v, roads = _streets(canvas)
    fill_blocks(canvas, edges_u, edges_v)
    canvas.texture()
    then, today = _park_cars(canvas, roads)
    lamps = _lamp_light(canvas, roads) * (canvas.height < LAMP_M)
    ground = None
    if relief_m:
        ground = raise_by_ground(canvas, hills(canvas.shape, canvas.gsd, relief_m, hill_rng), river)
    height, material = canvas.height, canvas.material
    return Drawn(canvas, Day(then, height, material), Day(today, height, material), ground, lamps)


def _lit(drawn: Drawn, day: Day, condition: Condition, rng: np.random.Generator) -> tuple[Image, Float32]:
    """Colours and heights of a town on one day."""
    gsd = drawn.canvas.gsd
    dressed, height = apply_season(day.rgb, day.height_m, day.material, drawn.ground_m, condition, gsd, rng)
    lamps = drawn.lamps * np.float32(condition.lamps) if condition.lamps else None
    return illuminate(dressed, height, gsd, condition.light, shade=condition.shade, lamps=lamps), height


def _world(drawn: Drawn, condition: Condition, pixel_to_crs: Array, rng: np.random.Generator) -> World:
    """The world that a camera sees on one day."""
    seen, height = _lit(drawn, drawn.today, condition, rng)
    sides, material = drawn.canvas.sides, drawn.today.material
    if condition.shade:  # crowns are drawn as at noon; the first two lights stay as published
        crowns = material == CANOPY
        sides[crowns, :3] = seen[crowns] // 2
    glint = Glint(condition.light, (material == WATER).astype(np.uint8)) if condition.shade else None
    return World(
        seen, sides, height, pixel_to_crs, CRS_EPSG, ground_m=drawn.ground_m, air=condition.air, glint=glint
    )


def build_town(
    seed: int = 1,
    *,
    width_px: int = 900,
    height_px: int = 1000,
    gsd_m_per_px: float = 0.53,
    condition: str | Condition = "noon",
    map_condition: str | Condition = "noon",
    relief_m: float = 0.0,
    river: bool = False,
    rebuild: Callable[[Drawn], Drawn] | None = None,
) -> Town:
    """A town from a seed; the same seed gives the same bytes.

    Args:
        seed: of all randomness in it.
        width_px: columns of the map.
        height_px: rows of the map.
        gsd_m_per_px: a map pixel in metres on the grid.
        condition: day of the frames: a name of :data:`scenematch.simulator.CONDITIONS`, or one of your own.
        map_condition: day of the map, an independent photograph even for the same condition.
        relief_m: height of the hills under the town, from the lowest ground to the highest; 0 is flat.
        river: whether a river crosses the town.
        rebuild: what happened to the town between the map and the flight; None is nothing.

    Raises:
        OptionError: an argument is out of range.
    """
    if width_px < 16 or height_px < 16 or not 0.1 <= gsd_m_per_px <= 5.0:
        got = f"{width_px} x {height_px} at {gsd_m_per_px}"
        raise OptionError(f"town: expected 16 px or more at 0.1 to 5 m/px, got {got}")
    if not 0.0 <= relief_m <= MAX_RELIEF_M:
        raise OptionError(f"relief_m: expected 0 to {MAX_RELIEF_M:g}, got {relief_m}")
    today, surveyed = condition_by_name(condition), condition_by_name(map_condition)
    fine = max(1, round(gsd_m_per_px / 0.265))
    margin = math.ceil(MARGIN_M / gsd_m_per_px)
    size = ((height_px + 2 * margin) * fine, (width_px + 2 * margin) * fine)
    rng, water_rng = generator(seed, 0x70), generator(seed, 0x71) if river else None
    canvas = Canvas(rng, size, gsd_m_per_px / fine, today.light)
    drawn = _draw(canvas, relief_m, water_rng, generator(seed, 0x72))
    if rebuild is not None:
        drawn = rebuild(drawn)
    inner = (slice(margin * fine, -margin * fine),) * 2
    then, heights = _lit(drawn, drawn.then, surveyed, generator(seed, 0x73))
    ortho, surface = MAP_SENSOR.develop(_shrink(then[inner], fine), rng), _shrink(heights[inner], fine)
    to_crs = _georeference(width_px, height_px, gsd_m_per_px)
    first = -margin - 0.5 + 0.5 / fine
    fine_to_crs = np.column_stack([to_crs[:, :2] / fine, to_crs @ (first, first, 1.0)])
    world = _world(drawn, today, fine_to_crs, generator(seed, 0x74))
    return Town(ortho, surface, to_crs, CRS_EPSG, gsd_m_per_px, world, today)
