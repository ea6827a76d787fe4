"""A town that does not exist: streets, houses, parks and fields from one seed, with its map and surface model.

Convention:
    Town coordinates (u, v) are metres from the town's centre along and across its main streets, turned against
    the raster so that nothing is aligned with pixels. Everything is drawn twice as fine as the map.
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
from engine.sim.render import (
    LIGHTS,
    Array,
    Float32,
    Image,
    Light,
    Sensor,
    World,
    box_sides,
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

Colour = tuple[float, float, float]
GRASS, ASPHALT, PAVING, ROOF, CROP, WATER, CANOPY = range(7)
_MATERIALS: tuple[tuple[float, float, float], ...] = (
    # strength of texture at 0.3 m, 1.5 m and 12 m, as a share of the colour
    (0.10, 0.11, 0.13),
    (0.045, 0.05, 0.08),
    (0.07, 0.06, 0.05),
    (0.06, 0.06, 0.05),
    (0.08, 0.09, 0.09),
    (0.02, 0.03, 0.07),
    (0.16, 0.14, 0.05),
)
_ROOFS: tuple[Colour, ...] = (
    (150, 78, 58), (168, 92, 66), (128, 70, 58), (112, 84, 72), (96, 92, 92), (84, 88, 98), (142, 112, 88),
)  # fmt: skip
_FLATS: tuple[Colour, ...] = ((158, 156, 150), (128, 127, 124), (104, 103, 104), (176, 170, 158), (138, 128, 118))
_WALLS: tuple[Colour, ...] = ((212, 204, 186), (196, 178, 148), (186, 186, 184), (176, 140, 116), (206, 192, 160))
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


class _Canvas:
    """Colour, height, walls, materials and occupied ground of a town while it is drawn."""

    def __init__(self, rng: np.random.Generator, size: tuple[int, int], gsd: float, light: Light) -> None:
        self.rng, self.gsd, self.light = rng, gsd, light
        self.shape = size
        self.rgb: Image = np.full((*size, 3), (104, 116, 74), np.uint8)
        self.sides: Image = np.zeros((*size, 4), np.uint8)
        self.height: Float32 = np.zeros(size, np.float32)
        self.material: Image = np.full(size, GRASS, np.uint8)
        self.busy: Image = np.zeros(size, np.uint8)
        turn = math.radians(rng.uniform(11.0, 27.0))
        self.turn: Array = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        self.centre: Array = np.array([(size[1] - 1) / 2.0, (size[0] - 1) / 2.0])
        self.reach_m = gsd * math.hypot(*size) / 2.0 + 5.0

    def px(self, uv: Array) -> Array:
        """Raster pixels (N, 2) of town coordinates (N, 2)."""
        return self.centre + uv @ self.turn.T / self.gsd

    def corners(self, u: float, v: float, length: float, width: float, angle: float = 0.0) -> Array:
        """Town coordinates (4, 2) of a rectangle's corners; the angle is in radians from the u axis."""
        c, s = math.cos(angle) / 2.0, math.sin(angle) / 2.0
        along, across = np.array([c, s]) * length, np.array([-s, c]) * width
        uv: Array = np.array([u, v]) + np.array([-along - across, along - across, along + across, across - along])
        return uv

    def fill(self, uv: Array, rgb: Colour, material: int | None = None, busy: bool = False) -> None:
        """Paint a polygon of town coordinates."""
        points = np.rint(self.px(uv) * 16.0).astype(np.int32)
        cv2.fillPoly(self.rgb, [points], rgb, cv2.LINE_AA, 4)
        if material is not None:
            cv2.fillPoly(self.material, [points], (material,), cv2.LINE_8, 4)
        if busy:
            cv2.fillPoly(self.busy, [points], (255,), cv2.LINE_8, 4)

    def rect(
        self,
        u: float,
        v: float,
        length: float,
        width: float,
        rgb: Colour,
        angle: float = 0.0,
        material: int | None = None,
    ) -> None:
        """Paint a rectangle."""
        self.fill(self.corners(u, v, length, width, angle), rgb, material)

    def tint(self, rgb: Colour, spread: float = 9.0) -> Colour:
        """A colour near the given one."""
        r, g, b = (float(np.clip(c, 12, 244)) for c in np.array(rgb) + self.rng.normal(0, spread, 3) * 0.25
                   + self.rng.normal(0, spread))  # fmt: skip
        return r, g, b

    def pick(self, colours: tuple[Colour, ...]) -> Colour:
        """One of the colours, varied a little."""
        return self.tint(colours[int(self.rng.integers(len(colours)))])

    def patch(self, u: float, v: float, radius_m: float) -> tuple[tuple[slice, slice], Array, Array] | None:
        """Raster window about a place, with town offsets (u, v) of its pixels; None where it is cut off."""
        x, y = np.rint(self.px(np.array([[u, v]]))[0]).astype(int)
        r = math.ceil(radius_m / self.gsd) + 1
        if x < r or y < r or x + r >= self.shape[1] or y + r >= self.shape[0]:
            return None
        window = (slice(y - r, y + r + 1), slice(x - r, x + r + 1))
        exact = (np.mgrid[window].reshape(2, -1)[::-1].T - self.centre) * self.gsd @ self.turn - (u, v)
        return window, exact[:, 0].reshape(2 * r + 1, -1), exact[:, 1].reshape(2 * r + 1, -1)

    def texture(self) -> None:
        """Grain the painted colours by material, at three scales."""
        gain = np.ones(self.shape, np.float32)
        for scale, cell_m in enumerate((self.gsd, 1.5, 12.0)):
            cells = [max(2, math.ceil(n * self.gsd / cell_m)) for n in self.shape]
            noise = cv2.resize(
                self.rng.standard_normal(cells, np.float32), self.shape[::-1], interpolation=cv2.INTER_CUBIC
            )
            strength = np.array([m[scale] for m in _MATERIALS], np.float32)
            gain += strength[self.material] * noise
        for channel in range(3):
            self.rgb[..., channel] = np.clip(self.rgb[..., channel] * gain, 0, 255)


def _building(
    canvas: _Canvas, u: float, v: float, length: float, width: float, eave: float, kind: str, angle: float = 0.0
) -> bool:
    """Put up a building where the ground is free; ``kind`` is "gable", "hip" or "flat"."""
    found = canvas.patch(u, v, math.hypot(length, width) / 2 + 1.0)
    if found is None:
        return False
    window, du, dv = found
    a, b = du * math.cos(angle) + dv * math.sin(angle), dv * math.cos(angle) - du * math.sin(angle)
    gap_a, gap_b = length / 2 - np.abs(a), width / 2 - np.abs(b)
    inside = (gap_a > 0) & (gap_b > 0)
    if canvas.busy[window][inside].any():
        return False
    canvas.busy[window][(gap_a > -1.2) & (gap_b > -1.2)] = 255
    canvas.material[window][inside] = ROOF
    draw = _flat_roof if kind == "flat" else _pitched_roof
    rgb, rise = draw(canvas, a, b, np.minimum(gap_a, gap_b) if kind != "gable" else gap_b, length, width)
    canvas.rgb[window][inside] = np.clip(rgb[inside], 0, 255)
    canvas.height[window][inside] = (eave + rise)[inside]
    canvas.sides[window][inside] = box_sides(
        (a, b),
        (length, width),
        canvas.turn @ (math.cos(angle), math.sin(angle)),
        canvas.pick(_WALLS),
        canvas.light,
    )[inside]
    return True


def _pitched_roof(
    canvas: _Canvas, a: Array, b: Array, gap: Array, length: float, width: float
) -> tuple[Array, Array]:
    """Tiles in rows, a light ridge, skylights, a chimney: colours and rise above the eave."""
    rng = canvas.rng
    slope = rng.uniform(0.45, 0.8)
    rise = np.maximum(gap, 0.0) * slope
    rgb = np.array(canvas.pick(_ROOFS)) * (1.0 + 0.05 * np.sign(np.sin(b * 2 * math.pi / 1.1)))[..., None]
    rgb[gap > width / 2 - 0.3] *= 1.25
    for _ in range(int(rng.integers(0, 2 + int(length / 7)))):
        at_a, at_b = rng.uniform(-0.42, 0.42) * length, rng.choice([-1, 1]) * rng.uniform(0.14, 0.34) * width
        light = (np.abs(a - at_a) < 0.55) & (np.abs(b - at_b) < 0.75)
        rgb[light] = (70, 84, 104) if rng.random() < 0.6 else (196, 204, 210)
    if rng.random() < 0.3:
        panels = (np.abs(a - rng.uniform(-0.2, 0.2) * length) < length * 0.2) & (b > 0.8) & (b < width * 0.4)
        rgb[panels] = (36, 44, 70)
    chimney = (np.abs(a - rng.uniform(-0.3, 0.3) * length) < 0.5) & (np.abs(b - 0.12 * width) < 0.5)
    rgb[chimney] = (92, 74, 66)
    return rgb, rise + 1.3 * chimney


def _flat_roof(
    canvas: _Canvas, a: Array, b: Array, gap: Array, length: float, width: float
) -> tuple[Array, Array]:
    """A parapet, sheets of roofing, machines, skylights in rows: colours and rise above the roof."""
    rng = canvas.rng
    base = np.array(canvas.pick(_FLATS))
    rgb = np.broadcast_to(base, (*a.shape, 3)).copy()
    cut_a, cut_b = rng.uniform(-0.35, 0.35) * length, rng.uniform(-0.35, 0.35) * width
    rgb[(a > cut_a) & (b > cut_b)] *= rng.uniform(0.72, 0.92)
    rgb[(a < cut_a) & (b < cut_b)] *= rng.uniform(0.9, 1.12)
    rgb *= (1.0 - 0.06 * (np.mod(a, 3.0) < 0.3))[..., None]
    rise = np.where(gap < 0.45, 0.5, 0.0)
    rgb[gap < 0.45] = np.minimum(base * 1.22, 235)
    if length * width > 260 and rng.random() < 0.6:
        row = (np.mod(a, 5.5) < 1.7) & (np.abs(b - rng.uniform(-0.2, 0.2) * width) < 1.1) & (gap > 2.5)
        rgb[row] = (188, 198, 206)
    for _ in range(int(rng.integers(1, 4 + int(length * width / 160)))):
        at_a, at_b = rng.uniform(-0.4, 0.4) * length, rng.uniform(-0.36, 0.36) * width
        half_a, half_b = rng.uniform(0.6, 2.0), rng.uniform(0.6, 1.5)
        box = (np.abs(a - at_a) < half_a) & (np.abs(b - at_b) < half_b) & (gap > 0.8)
        rgb[box] = canvas.tint((178, 178, 176), 22)
        rise[box] = rng.uniform(1.0, 2.6)
    return rgb, rise


def _tree(canvas: _Canvas, u: float, v: float, radius: float) -> None:
    """A crown, where neither road nor house stands."""
    found = canvas.patch(u, v, radius)
    if found is None:
        return
    window, du, dv = found
    centre = du.shape[0] // 2
    if canvas.busy[window][centre, centre]:
        return
    ripple = 1.0 + 0.13 * np.sin(5 * np.arctan2(dv, du) + u) + 0.09 * np.sin(9 * np.arctan2(dv, du) + v)
    share = 1.0 - (du**2 + dv**2) / (radius * ripple) ** 2
    top = radius * canvas.rng.uniform(1.7, 2.3)
    crown = top * (0.4 + 0.6 * np.sqrt(np.maximum(share, 0.0)))
    crown += canvas.rng.uniform(-0.5, 0.5, crown.shape)
    inside = (share > 0) & (crown > canvas.height[window]) & (canvas.material[window] != ROOF)
    green = np.array(canvas.tint((68, 88, 44), 13))
    canvas.rgb[window][inside] = np.clip(green, 10, 200)
    canvas.height[window][inside] = crown[inside]
    canvas.material[window][inside] = CANOPY
    canvas.sides[window][inside] = (*(green * 0.5).astype(int), 0)


def _grove(
    canvas: _Canvas, u: float, v: float, du: float, dv: float, per_m2: float, radius: tuple[float, float]
) -> None:
    """Trees anywhere in a block."""
    rng = canvas.rng
    for _ in range(int(du * dv / per_m2)):
        _tree(canvas, u + rng.uniform(-0.5, 0.5) * du, v + rng.uniform(-0.5, 0.5) * dv, rng.uniform(*radius))


def _streets(canvas: _Canvas) -> tuple[list[float], list[float], list[tuple[Array, float]]]:
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


def _at(canvas: _Canvas, raster: NDArray[np.generic], u: float, v: float) -> float:
    """The raster's value at a place, -1 outside."""
    x, y = np.rint(canvas.px(np.array([[u, v]]))[0]).astype(int)
    return float(raster[y, x]) if 0 <= x < raster.shape[1] and 0 <= y < raster.shape[0] else -1.0


def _markings(canvas: _Canvas, line: Array, width: float, crossings: Image) -> None:
    """A dashed centre line, zebra crossings where streets meet, and patches of newer asphalt."""
    white, last = (214, 214, 208), 1.0
    for u, v, angle in _stations(line, 3.0):
        count = _at(canvas, crossings, u, v)
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


def _houses(canvas: _Canvas, u: float, v: float, du: float, dv: float) -> None:
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
            _building(
                canvas, u + at, v + row + rng.uniform(-1.5, 1.5), length, width, rng.uniform(5, 8), kind, angle
            )
            if rng.random() < 0.7:
                _building(canvas, u + at + rng.uniform(-5, 5), v + row + turn * 12, 5.5, 3.5, 2.4, "flat")
            at += rng.uniform(15.5, 20)
    _grove(canvas, u, v, du, dv, 170, (1.2, 3.4))


def _bars(canvas: _Canvas, u: float, v: float, du: float, dv: float) -> None:
    """Blocks of flats, 12 to 25 m high, on lawns with paths."""
    rng = canvas.rng
    for _ in range(2):
        canvas.rect(
            u + rng.uniform(-0.4, 0.4) * du, v, 2.5, dv, canvas.tint((168, 160, 146)), rng.normal(0, 0.2), PAVING
        )
    for at in np.arange(-du / 2 + 14, du / 2 - 8, rng.uniform(25, 31)):
        length = (dv - 9) * rng.uniform(0.5, 0.95)
        _building(canvas, u + at, v, rng.uniform(11, 15), length, rng.uniform(12, 25), "flat", rng.normal(0, 0.03))
    _grove(canvas, u, v, du, dv, 130, (1.8, 4.2))


def _perimeter(canvas: _Canvas, u: float, v: float, du: float, dv: float) -> None:
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
                _building(canvas, *uv, length - 1.3, rng.uniform(11, 13), rng.uniform(9, 17), kind, turn)
                at += length
    _grove(canvas, u, v, 0.6 * du, 0.6 * dv, 160, (1.5, 3.5))


def _commerce(canvas: _Canvas, u: float, v: float, du: float, dv: float) -> None:
    """A hall with a car park: bays in white."""
    rng = canvas.rng
    canvas.rect(u, v, du, dv, canvas.tint((112, 112, 114), 7), material=ASPHALT)
    for row in np.arange(-dv / 2 + 6, dv / 2 - 4, 15.0):
        for at in np.arange(-du / 2 + 3, du * 0.1, 2.7):
            canvas.rect(u + at, v + row, 0.2, 5.0, (206, 206, 202))
    _building(canvas, u + du * 0.28, v, du * 0.38, dv - 8, rng.uniform(6, 11), "flat")
    _building(canvas, u - du * 0.2, v + dv * 0.32, du * 0.3, dv * 0.22, rng.uniform(5, 8), "flat")


def _park(canvas: _Canvas, u: float, v: float, du: float, dv: float) -> None:
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
    _grove(canvas, u, v, du, dv, 75, (1.5, 5.0))


def _fields(canvas: _Canvas, u: float, v: float, du: float, dv: float) -> None:
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
            _building(canvas, u + at + wide / 2, v + rng.uniform(-0.4, 0.4) * dv, 5.0, 4.0, 2.8, "gable")
        at += wide


def _square(canvas: _Canvas, u: float, v: float, du: float, dv: float) -> None:
    """An open square: paving in a pattern, a fountain, a tower, rows of trees."""
    rng = canvas.rng
    canvas.rect(u, v, du, dv, (176, 166, 150), material=PAVING)
    for at in np.arange(-0.5, 0.45, 0.125):
        canvas.rect(u + at * du, v, 1.2, dv, canvas.tint((146, 134, 122), 5))
        canvas.rect(u, v + at * dv, du, 0.8, canvas.tint((152, 142, 130), 5))
    ring = np.linspace(0, 2 * math.pi, 40)
    for radius, colour in ((8.0, (132, 116, 104)), (6.0, (204, 198, 186)), (5.0, (74, 108, 118))):
        canvas.fill(np.column_stack([u - du * 0.15 + radius * np.cos(ring), v + radius * np.sin(ring)]), colour)
    _building(canvas, u + du * 0.3, v + dv * 0.1, 9, 9, 25.0, "hip")
    _building(canvas, u + du * 0.3, v - dv * 0.25, 24, 13, 12.0, "gable")
    for at in np.arange(-0.44, 0.45, 0.09):
        _tree(canvas, u + at * du, v + dv * 0.44, rng.uniform(2.2, 2.8))


def _pitch(canvas: _Canvas, u: float, v: float, du: float, dv: float) -> None:
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
    _building(canvas, u + du * 0.36, v + dv * 0.25, du * 0.2, dv * 0.36, 9.0, "flat")


_KINDS = (_houses, _bars, _perimeter, _commerce, _park, _fields, _square, _pitch)
_SHARES = np.array([0.31, 0.17, 0.22, 0.13, 0.09, 0.05, 0.01, 0.02])


def _blocks(canvas: _Canvas, edges_u: list[float], edges_v: list[float]) -> None:
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


def _park_cars(canvas: _Canvas, roads: list[tuple[Array, float]]) -> tuple[Image, Image]:
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
        if _at(canvas, canvas.height, u, v) != 0.0 or _at(canvas, canvas.material, u, v) != ASPHALT:
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
    canvas = _Canvas(rng, size, gsd_m_per_px / fine, flight_light)
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
