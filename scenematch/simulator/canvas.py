"""A canvas of colour, height and material for drawing a town with buildings and trees.

Convention:
    Town coordinates (u, v) are metres from the town's centre along and across its main streets, rotated from the
    raster so that nothing is aligned with pixels.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from scenematch.simulator.light import Array, Float32, Image, Light, box_sides

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


class Canvas:
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
        """Raster pixels of town coordinates.

        Args:
            uv: (N, 2) metres.

        Returns:
            (N, 2) pixels (x, y).
        """
        return self.centre + uv @ self.turn.T / self.gsd

    def corners(self, u: float, v: float, length: float, width: float, angle: float = 0.0) -> Array:
        """Corners of a rectangle.

        Args:
            u: of its centre, in metres.
            v: of its centre, in metres.
            length: in metres.
            width: in metres.
            angle: of its length from the u axis, in radians.

        Returns:
            (4, 2) town coordinates in order.
        """
        c, s = math.cos(angle) / 2.0, math.sin(angle) / 2.0
        along, across = np.array([c, s]) * length, np.array([-s, c]) * width
        uv: Array = np.array([u, v]) + np.array([-along - across, along - across, along + across, across - along])
        return uv

    def fill(self, uv: Array, rgb: Colour, material: int | None = None, busy: bool = False) -> None:
        """Paint a polygon.

        Args:
            uv: (N, 2) town coordinates of its corners.
            rgb: colour.
            material: None leaves the material as it is.
            busy: whether nothing may be built there.
        """
        points = np.rint(self.px(uv) * 16.0).astype(np.int32)
        cv2.fillPoly(self.rgb, [points], rgb, cv2.LINE_AA, 4)
        if material is not None:
            cv2.fillPoly(self.material, [points], (material,), cv2.LINE_8, 4)
        if busy:
            cv2.fillPoly(self.busy, [points], (255,), cv2.LINE_8, 4)

    def stroke(
        self, raster: Image, uv: Array, value: Colour | tuple[int], width_m: float, edges: int = cv2.LINE_8
    ) -> None:
        """Draw a line.

        Args:
            raster: (H, W, 3) colours, or (H, W) of something else.
            uv: (N, 2) town coordinates along it.
            value: what the raster holds on it.
            width_m: of the line.
            edges: how OpenCV draws its edges.
        """
        points = np.rint(self.px(uv) * 16.0).astype(np.int32)
        cv2.polylines(raster, [points], False, value, round(width_m / self.gsd), edges, 4)

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
        """The raster window about a position.

        Args:
            u: of its centre, in metres.
            v: of its centre, in metres.
            radius_m: half of its side.

        Returns:
            Slices of rows and columns, and offsets (h, w) of the pixels from the centre in u and in v, in metres;
            None if the window leaves the canvas.
        """
        x, y = np.rint(self.px(np.array([[u, v]]))[0]).astype(int)
        r = math.ceil(radius_m / self.gsd) + 1
        if x < r or y < r or x + r >= self.shape[1] or y + r >= self.shape[0]:
            return None
        window = (slice(y - r, y + r + 1), slice(x - r, x + r + 1))
        exact = (np.mgrid[window].reshape(2, -1)[::-1].T - self.centre) * self.gsd @ self.turn - (u, v)
        return window, exact[:, 0].reshape(2 * r + 1, -1), exact[:, 1].reshape(2 * r + 1, -1)

    def value(self, raster: NDArray[np.generic], u: float, v: float) -> float:
        """A raster's value at a position.

        Args:
            raster: (H, W).
            u: town coordinate in metres.
            v: town coordinate in metres.

        Returns:
            The value of the nearest pixel, -1 outside.
        """
        x, y = np.rint(self.px(np.array([[u, v]]))[0]).astype(int)
        return float(raster[y, x]) if 0 <= x < raster.shape[1] and 0 <= y < raster.shape[0] else -1.0

    def texture(self) -> None:
        """Add texture to the painted colours by material, at three scales."""
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


def building(
    canvas: Canvas, u: float, v: float, length: float, width: float, eave: float, kind: str, angle: float = 0.0
) -> bool:
    """Draw a building ("gable", "hip" or "flat") if the ground is free, and return whether it was drawn."""
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
    canvas: Canvas, a: Array, b: Array, gap: Array, length: float, width: float
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


def _flat_roof(canvas: Canvas, a: Array, b: Array, gap: Array, length: float, width: float) -> tuple[Array, Array]:
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


def tree(canvas: Canvas, u: float, v: float, radius: float) -> None:
    """Draw a crown except on roads and houses."""
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


def grove(
    canvas: Canvas, u: float, v: float, du: float, dv: float, per_m2: float, radius: tuple[float, float]
) -> None:
    """Draw trees at random positions in a block."""
    rng = canvas.rng
    for _ in range(int(du * dv / per_m2)):
        tree(canvas, u + rng.uniform(-0.5, 0.5) * du, v + rng.uniform(-0.5, 0.5) * dv, rng.uniform(*radius))
