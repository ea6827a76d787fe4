"""The blocks between a town's streets: houses, flats, courts, halls, parks, fields, a square, a sports ground.

Convention:
    Town coordinates (u, v) are those of :mod:`scenematch.simulator.canvas`; a block is its centre and its sides
    du, dv.
"""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np

from scenematch.simulator.canvas import ASPHALT, CROP, GRASS, PAVING, WATER, Canvas, building, grove, tree


def _houses(canvas: Canvas, u: float, v: float, du: float, dv: float) -> None:
    """Detached houses with paths, sheds and trees."""
    rng = canvas.rng
    for row, turn in ((-dv / 2 + 10.5, 1), (dv / 2 - 10.5, -1)):
        at = -du / 2 + rng.uniform(8, 11)
        while at < du / 2 - 6:
            length, width = rng.uniform(9, 15), rng.uniform(8, 11)
            canvas.rect(u + at, v + row, 15.5, 19.0, canvas.tint((108, 122, 78), 11), material=GRASS)
            path = canvas.tint((156, 150, 142))
            canvas.rect(u + at + length / 2 + 1.4, v + row - turn * 4, 2.6, 13, path, material=PAVING)
            kind = str(rng.choice(["gable", "hip", "gable"]))
            angle = rng.choice([0, math.pi / 2]) + rng.normal(0, 0.05)
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
                offset = np.array([at + length / 2, side * (across / 2 - 8.5)])
                uv = (u + offset[0], v + offset[1]) if not turn else (u + offset[1], v + offset[0])
                kind = "flat" if rng.random() < 0.2 else "gable"
                # Neighbours share a wall: the usual gap between houses would leave an alley of a metre and a half.
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
        path = np.column_stack([u + t * du, v + wave * dv])
        canvas.stroke(canvas.rgb, path, canvas.tint((188, 172, 142)), 2.6, cv2.LINE_AA)
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


def fill_blocks(canvas: Canvas, edges_u: list[float], edges_v: list[float]) -> None:
    """Fill the blocks between the streets; each block near the centre is of one of the rarer kinds."""
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
    # The winding road cuts through blocks: restore it, except for crowns above it.
    road &= canvas.height == 0.0
    canvas.rgb[road], canvas.material[road] = before[0][road], before[1][road]
