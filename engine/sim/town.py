"""A town that does not exist: streets, houses, parks and fields from one seed, with its map and surface model.

Convention:
    Town coordinates (u, v) are those of :mod:`engine.sim.canvas`; a block is its centre and its sides du, dv.
    Everything is drawn twice as fine as the map.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError
from engine.sim.canvas import (
    ASPHALT,
    CROP,
    GRASS,
    PAVING,
    WATER,
    Canvas,
    Colour,
    building,
    grove,
    tree,
)
from engine.sim.render import (
    LIGHTS,
    Array,
    Float32,
    Image,
    Sensor,
    World,
    illuminate,
    light_by_name,
    transformer,
)

CRS_EPSG = 32633
"""UTM zone 33 north; the town lies 1.45 degrees east of its central meridian: convergence +1.08 degrees."""
CENTRE_LAT_DEG, CENTRE_LON_DEG = 48.25, 16.45
GROUND_AMSL_M = 155.0
"""The flat ground's height above mean sea level."""
MARGIN_M = 40.0
"""How far the drawn world reaches beyond the map, so that a tilted camera still sees a town."""
MAP_SENSOR = Sensor(
    gamma=0.92, balance_rgb=(0.97, 0.94, 0.88), haze=8.0, vignette=0.0, exposure_sd=0.0, blur_px=0.55, noise_sd=2.2
)
"""The camera of the map's survey: warmer and softer than the drone's."""
_CARS: tuple[Colour, ...] = (
    (236, 236, 236), (40, 42, 46), (150, 154, 158), (132, 44, 44), (58, 72, 104), (206, 206, 200), (90, 92, 96),
)  # fmt: skip


@dataclass(frozen=True)
class Town:
    """A map, its surface model, and the finer world from which frames are drawn.

    Attributes:
        ortho: (H, W, 3) RGB orthophoto, another photograph than any frame.
        surface_m: (H, W) metres above the flat ground.
        pixel_to_crs: (2, 3) affine of map pixels (x, y), centres at integers, to the CRS.
        crs_epsg: projected CRS.
        gsd_m_per_px: map pixel in grid metres.
        world: what a camera sees on the day of the flight.
    """

    ortho: Image
    surface_m: Float32
    pixel_to_crs: Array
    crs_epsg: int
    gsd_m_per_px: float
    world: World


def _streets(canvas: Canvas) -> tuple[list[float], list[float], list[tuple[Array, float]]]:
    """Draw the streets: edges of the blocks along u and v, and every street as (centre line, width)."""
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
            points = [np.rint(canvas.px(line) * 16).astype(np.int32)]
            thick = round((width + extra) / canvas.gsd)
            shade = canvas.tint(colour, 5.0)
            cv2.polylines(canvas.rgb, points, False, shade, thick, cv2.LINE_AA, 4)
            for raster, value in ((canvas.material, material), (canvas.busy, 255)):
                cv2.polylines(raster, points, False, (value,), thick, cv2.LINE_8, 4)
            if material == ASPHALT:
                one = np.zeros_like(crossings)
                cv2.polylines(one, points, False, (1,), thick + round(7 / canvas.gsd), cv2.LINE_8, 4)
                cv2.add(crossings, one, crossings)
    for line, width in roads:
        _markings(canvas, line, width, crossings)
    return edges[0], edges[1], roads


def _stations(line: Array, pitch_m: float) -> list[tuple[float, float, float]]:
    """Places (u, v) and directions in radians every ``pitch_m`` along a line."""
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


def _houses(canvas: Canvas, u: float, v: float, du: float, dv: float) -> None:
    """Detached houses with paths, sheds and trees."""
    rng = canvas.rng
    for row, turn in ((-dv / 2 + 10.5, 1), (dv / 2 - 10.5, -1)):
        at = -du / 2 + rng.uniform(8, 11)
        while at < du / 2 - 6:
            length, width = rng.uniform(9, 15), rng.uniform(8, 11)
            canvas.rect(u + at, v + row, 15.5, 19.0, canvas.tint((108, 122, 78), 11), material=GRASS)
            canvas.rect(
                u + at + length / 2 + 1.4,
                v + row - turn * 4,
                2.6,
                13,
                canvas.tint((156, 150, 142)),
                material=PAVING,
            )
            kind, angle = (
                str(rng.choice(["gable", "hip", "gable"])),
                rng.choice([0, math.pi / 2]) + rng.normal(0, 0.05),
            )
            building(
                canvas, u + at, v + row + rng.uniform(-1.5, 1.5), length, width, rng.uniform(5, 8), kind, angle
            )
            if rng.random() < 0.7:
                building(canvas, u + at + rng.uniform(-5, 5), v + row + turn * 12, 5.5, 3.5, 2.4, "flat")
            at += rng.uniform(15.5, 20)
    grove(canvas, u, v, du, dv, 170, (1.2, 3.4))


def _bars(canvas: Canvas, u: float, v: float, du: float, dv: float) -> None:
    """Blocks of flats, 12 to 25 m high, on lawns with paths."""
    rng = canvas.rng
    for _ in range(2):
        canvas.rect(
            u + rng.uniform(-0.4, 0.4) * du, v, 2.5, dv, canvas.tint((168, 160, 146)), rng.normal(0, 0.2), PAVING
        )
    for at in np.arange(-du / 2 + 14, du / 2 - 8, rng.uniform(25, 31)):
        length = (dv - 9) * rng.uniform(0.5, 0.95)
        building(canvas, u + at, v, rng.uniform(11, 15), length, rng.uniform(12, 25), "flat", rng.normal(0, 0.03))
    grove(canvas, u, v, du, dv, 130, (1.8, 4.2))


def _perimeter(canvas: Canvas, u: float, v: float, du: float, dv: float) -> None:
    """Old town houses wall to wall around a court."""
    rng = canvas.rng
    canvas.rect(u, v, du - 6, dv - 6, canvas.tint((150, 142, 130)), material=PAVING)
    for across, room, turn in ((dv, du, 0.0), (du, dv - 30, math.pi / 2)):
        for side in (-1, 1):
            at = -room / 2 + 2
            while at < room / 2 - 8:
                length = min(rng.uniform(11, 20), room / 2 - at - 1)
                place = np.array([at + length / 2, side * (across / 2 - 8.5)])
                uv = (u + place[0], v + place[1]) if not turn else (u + place[1], v + place[0])
                kind = "flat" if rng.random() < 0.2 else "gable"
                # Neighbours share a wall: the gap that keeps houses apart is a metre and a half of alley here.
                building(canvas, *uv, length - 1.3, rng.uniform(11, 13), rng.uniform(9, 17), kind, turn)
                at += length
    grove(canvas, u, v, 0.6 * du, 0.6 * dv, 160, (1.5, 3.5))


def _commerce(canvas: Canvas, u: float, v: float, du: float, dv: float) -> None:
    """A hall with a car park: bays in white."""
    rng = canvas.rng
    canvas.rect(u, v, du, dv, canvas.tint((112, 112, 114), 7), material=ASPHALT)
    for row in np.arange(-dv / 2 + 6, dv / 2 - 4, 15.0):
        for at in np.arange(-du / 2 + 3, du * 0.1, 2.7):
            canvas.rect(u + at, v + row, 0.2, 5.0, (206, 206, 202))
    building(canvas, u + du * 0.28, v, du * 0.38, dv - 8, rng.uniform(6, 11), "flat")
    building(canvas, u - du * 0.2, v + dv * 0.32, du * 0.3, dv * 0.22, rng.uniform(5, 8), "flat")


def _park(canvas: Canvas, u: float, v: float, du: float, dv: float) -> None:
    """Lawns, winding paths, a pond, trees."""
    rng = canvas.rng
    canvas.rect(u, v, du + 2, dv + 2, canvas.tint((100, 120, 66), 8), material=GRASS)
    t = np.linspace(-0.5, 0.5, 40)
    for swing in (1, -1):
        wave = 0.22 * np.sin(t * rng.uniform(5, 9) + rng.uniform(0, 6)) + swing * t * 0.6
        line = canvas.px(np.column_stack([u + t * du, v + wave * dv]))
        points = [np.rint(line * 16).astype(np.int32)]
        cv2.polylines(
            canvas.rgb, points, False, canvas.tint((188, 172, 142)), round(2.6 / canvas.gsd), cv2.LINE_AA, 4
        )
    around = np.linspace(0, 2 * math.pi, 60)
    radius = dv * 0.19 * (1 + 0.2 * np.sin(2 * around + rng.uniform(0, 6)) + 0.1 * np.sin(5 * around))
    shore = np.column_stack([u + du * 0.2 + 1.5 * radius * np.cos(around), v + radius * np.sin(around)])
    canvas.fill(shore, (62, 82, 84), WATER, busy=True)
    grove(canvas, u, v, du, dv, 75, (1.5, 5.0))


def _fields(canvas: Canvas, u: float, v: float, du: float, dv: float) -> None:
    """Allotments: strips of different crops in rows."""
    rng, at = canvas.rng, -du / 2
    while at < du / 2 - 4:
        wide = min(rng.uniform(7, 19), du / 2 - at)
        colour = canvas.tint(
            ((122, 132, 70), (150, 132, 92), (92, 112, 58), (172, 160, 104))[int(rng.integers(4))]
        )
        canvas.rect(u + at + wide / 2, v, wide - 0.8, dv, colour, material=CROP)
        for row in np.arange(at + 1.0, at + wide - 1.0, 1.7 if rng.random() < 0.6 else 3.4):
            dark = (colour[0] * 0.8, colour[1] * 0.82, colour[2] * 0.8)
            canvas.rect(u + row, v + rng.uniform(-1, 1), 0.6, dv * rng.uniform(0.86, 1.0), dark)
        if rng.random() < 0.5:
            building(canvas, u + at + wide / 2, v + rng.uniform(-0.4, 0.4) * dv, 5.0, 4.0, 2.8, "gable")
        at += wide


def _square(canvas: Canvas, u: float, v: float, du: float, dv: float) -> None:
    """An open square: paving in a pattern, a fountain, a tower, rows of trees."""
    rng = canvas.rng
    canvas.rect(u, v, du, dv, (176, 166, 150), material=PAVING)
    for at in np.arange(-0.5, 0.45, 0.125):
        canvas.rect(u + at * du, v, 1.2, dv, canvas.tint((146, 134, 122), 5))
        canvas.rect(u, v + at * dv, du, 0.8, canvas.tint((152, 142, 130), 5))
    ring = np.linspace(0, 2 * math.pi, 40)
    for radius, colour in ((8.0, (132, 116, 104)), (6.0, (204, 198, 186)), (5.0, (74, 108, 118))):
        canvas.fill(np.column_stack([u - du * 0.15 + radius * np.cos(ring), v + radius * np.sin(ring)]), colour)
    building(canvas, u + du * 0.3, v + dv * 0.1, 9, 9, 25.0, "hip")
    building(canvas, u + du * 0.3, v - dv * 0.25, 24, 13, 12.0, "gable")
    for at in np.arange(-0.44, 0.45, 0.09):
        tree(canvas, u + at * du, v + dv * 0.44, rng.uniform(2.2, 2.8))


def _pitch(canvas: Canvas, u: float, v: float, du: float, dv: float) -> None:
    """A football pitch, a hard court and a gymnasium."""
    long, wide = du * 0.62, dv * 0.74
    u0 = u - du * 0.14
    canvas.rect(u0, v, long + 8, wide + 8, (164, 92, 70), material=PAVING)
    for k in range(10):
        green = (88, 124, 58) if k % 2 else (100, 138, 68)
        canvas.rect(u0 + (k - 4.5) * long / 10, v, long / 10, wide, green, material=GRASS)
    lines = [(0.0, 0.5 * side, 1.0, 0.0) for side in (-1, 1)] + [
        (0.5 * side, 0.0, 0.0, 1.0) for side in (-1, 0, 1)
    ]
    lines += [(0.42 * end, 0.2 * side, 0.16, 0.0) for end in (-1, 1) for side in (-1, 1)]
    for x, y, dx, dy in lines:
        canvas.rect(u0 + x * long, v + y * wide, dx * long + 0.3, dy * wide + 0.3, (228, 230, 224))
    canvas.rect(u + du * 0.36, v - dv * 0.24, du * 0.2, dv * 0.4, (52, 98, 122), material=PAVING)
    building(canvas, u + du * 0.36, v + dv * 0.25, du * 0.2, dv * 0.36, 9.0, "flat")


_KINDS = (_houses, _bars, _perimeter, _commerce, _park, _fields, _square, _pitch)
_SHARES = np.array([0.31, 0.17, 0.22, 0.13, 0.09, 0.05, 0.01, 0.02])


def _blocks(canvas: Canvas, edges_u: list[float], edges_v: list[float]) -> None:
    """Fill the blocks between the streets; those near the centre hold one of the rarer kinds each."""
    rng, road, before = canvas.rng, canvas.busy > 0, (canvas.rgb.copy(), canvas.material.copy())
    cells = [
        ((a + b) / 2, (c + d) / 2, b - a - 18.5, d - c - 17.0)
        for a, b in itertools.pairwise(edges_u) for c, d in itertools.pairwise(edges_v)
    ]  # fmt: skip
    cells.sort(key=lambda cell: math.hypot(cell[0], cell[1]))
    first = [int(k) for k in rng.permutation([6, 4, 2, 7, 1, 0, 3, 5, 2, 0])]
    for index, cell in enumerate(cells):
        kind = first[index] if index < len(first) else int(rng.choice(len(_KINDS), p=_SHARES))
        if math.hypot(cell[0], cell[1]) < canvas.reach_m + 40:
            _KINDS[kind](canvas, *cell)
    # The winding road cuts through blocks: give it back what they painted over, but for crowns above it.
    road &= canvas.height == 0.0
    canvas.rgb[road], canvas.material[road] = before[0][road], before[1][road]


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
    """The raster's means over squares of so many pixels."""
    size = (raster.shape[1] // times, raster.shape[0] // times)
    return np.asarray(cv2.resize(raster, size, interpolation=cv2.INTER_AREA))


def _georeference(width_px: int, height_px: int, gsd: float) -> Array:
    """Affine (2, 3) of a north-up map about the town's centre, its first pixel on a whole metre of the grid."""
    easting, northing = transformer(CRS_EPSG).transform(CENTRE_LON_DEG, CENTRE_LAT_DEG)
    corner = (round(easting - width_px * gsd / 2), round(northing + height_px * gsd / 2))
    return np.array([[gsd, 0.0, corner[0]], [0.0, -gsd, corner[1]]], dtype=np.float64)


def _check_size(width_px: int, height_px: int, gsd: float) -> None:
    if width_px < 16 or height_px < 16 or not 0.1 <= gsd <= 5.0:
        got = f"{width_px} x {height_px} at {gsd}"
        raise OptionError(f"town: expected 16 px or more at 0.1 to 5 m/px, got {got}")


def build_town(
    seed: int = 1,
    *,
    width_px: int = 900,
    height_px: int = 1000,
    gsd_m_per_px: float = 0.53,
    light: str = "noon",
) -> Town:
    """A town from a seed; the same seed gives the same bytes.

    Args:
        seed: of everything random in it.
        width_px: columns of the map.
        height_px: rows of the map.
        gsd_m_per_px: a map pixel in metres on the grid.
        light: a name of :data:`LIGHTS`, for the frames; the map's is noon.

    Raises:
        OptionError: an argument is out of range.
    """
    _check_size(width_px, height_px, gsd_m_per_px)
    flight_light, rng = light_by_name(light), generator(seed, 0x70)
    fine = max(1, round(gsd_m_per_px / 0.265))
    margin = math.ceil(MARGIN_M / gsd_m_per_px)
    size = ((height_px + 2 * margin) * fine, (width_px + 2 * margin) * fine)
    canvas = Canvas(rng, size, gsd_m_per_px / fine, flight_light)
    edges_u, edges_v, roads = _streets(canvas)
    _blocks(canvas, edges_u, edges_v)
    canvas.texture()
    then, today = _park_cars(canvas, roads)
    inner = (slice(margin * fine, -margin * fine),) * 2
    then = illuminate(then, canvas.height, canvas.gsd, LIGHTS["noon"])[inner]
    ortho, surface = MAP_SENSOR.develop(_shrink(then, fine), rng), _shrink(canvas.height[inner], fine)
    to_crs = _georeference(width_px, height_px, gsd_m_per_px)
    first = -margin - 0.5 + 0.5 / fine
    fine_to_crs = np.column_stack([to_crs[:, :2] / fine, to_crs @ (first, first, 1.0)])
    seen = illuminate(today, canvas.height, canvas.gsd, flight_light)
    world = World(seen, canvas.sides, canvas.height, fine_to_crs, CRS_EPSG)
    return Town(ortho, surface, to_crs, CRS_EPSG, gsd_m_per_px, world)
