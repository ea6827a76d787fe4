"""Terrain: smooth hills under a town, with level roofs and ponds, and a river.

Heights are metres above the lowest ground; none is below 0.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from scenematch.simulator.canvas import ROOF, WATER, Canvas
from scenematch.simulator.light import Array, Float32, Image

HILL_M = 260.0
"""Approximate distance between hills."""
BANK_M = 130.0
"""Hills begin this far from a river."""


def hills(shape: tuple[int, int], gsd_m_per_px: float, relief_m: float, rng: np.random.Generator) -> Float32:
    """Smooth hills.

    Args:
        shape: (H, W) in pixels.
        gsd_m_per_px: pixel in metres.
        relief_m: height from the lowest to the highest ground.
        rng: of the hills.

    Returns:
        (H, W) heights in metres between 0 and ``relief_m``.
    """
    cells = [max(4, math.ceil(n * gsd_m_per_px / HILL_M) + 2) for n in shape]
    coarse = cv2.resize(rng.standard_normal(cells, np.float32), None, fx=16, fy=16, interpolation=cv2.INTER_CUBIC)
    ground = cv2.resize(cv2.GaussianBlur(coarse, (0, 0), 6.0), shape[::-1], interpolation=cv2.INTER_CUBIC)
    low, high = float(ground.min()), float(ground.max())
    return np.asarray((ground - low) * np.float32(relief_m / (high - low)), dtype=np.float32)


def raise_by_ground(canvas: Canvas, ground_m: Float32, river: Image | None) -> Float32:
    """Raise everything on a canvas by the ground below it, in place.

    A river's bed and banks are at 0. Every house stands on the mean of its ground, and ponds are level.

    Args:
        canvas: to raise.
        ground_m: (H, W) of the hills.
        river: (H, W) uint8, above 0 in its water; None without a river.

    Returns:
        (H, W) float32 heights of the ground, levelled under houses and ponds.
    """
    if river is not None:
        away: Array = cv2.distanceTransform(255 - river, cv2.DIST_L2, 3) * canvas.gsd
        share = np.clip(away / BANK_M, 0.0, 1.0)
        ground_m = (ground_m * (share * share * (3.0 - 2.0 * share))).astype(np.float32)
    level = ground_m.copy()
    for material in (ROOF, WATER):
        inside = canvas.material == material
        count, labels = cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)
        size = np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
        mean = np.bincount(labels.ravel(), weights=ground_m.ravel(), minlength=count) / size
        level[inside] = mean[labels[inside]]
    canvas.height += level
    return level


def draw_river(canvas: Canvas, rng: np.random.Generator) -> Image:
    """Draw a river across the town with a path on each bank.

    Args:
        canvas: to draw on.
        rng: for its course and width.

    Returns:
        (H, W) uint8, 255 in its water.
    """
    along = np.linspace(-canvas.reach_m, canvas.reach_m, 160)
    width = rng.uniform(22.0, 30.0)
    swing = rng.uniform(26.0, 44.0) * np.sin(along / rng.uniform(70.0, 110.0) + rng.uniform(0, 6))
    # It keeps away from the centre, where the square and the park are.
    line = np.column_stack([along, swing + 0.12 * along + rng.choice([-1, 1]) * rng.uniform(45.0, 95.0)])
    water = np.zeros(canvas.shape, np.uint8)
    bank, path, shore, deep = (104, 118, 72), (172, 160, 136), (120, 112, 94), (58, 76, 76)
    for extra, colour in ((13.0, bank), (6.0, path), (2.0, shore), (0.0, deep)):
        canvas.stroke(canvas.rgb, line, canvas.tint(colour, 4.0), width + extra, cv2.LINE_AA)
    canvas.stroke(canvas.busy, line, (255,), width + 9.0)
    canvas.stroke(water, line, (255,), width)
    canvas.material[water > 0] = WATER
    # Shallows along the banks are lighter than the middle.
    depth = np.clip(cv2.distanceTransform(water, cv2.DIST_L2, 3) * canvas.gsd / 7.0, 0.0, 1.0)
    inside = water > 0
    canvas.rgb[inside] = np.clip(canvas.rgb[inside] * (1.28 - 0.4 * depth[inside][:, None]), 0, 255)
    return water
