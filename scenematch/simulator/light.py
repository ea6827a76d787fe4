"""Light on a height field: the sun and the sky, cast shadows, walls.

Convention:
    Raster axes are right, down the picture, up; azimuths are clockwise from the raster's up direction. Strengths
    of light are shares of full scale that a white surface reaches at the camera's exposure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Light:
    """A sun and a sky.

    Attributes:
        azimuth_deg: of the sun, clockwise from the raster's up direction.
        elevation_deg: above the horizon.
        sun_rgb: strength of the sun on a surface facing it.
        sky_rgb: strength of the diffuse light, which reaches shadows too.
    """

    azimuth_deg: float
    elevation_deg: float
    sun_rgb: tuple[float, ...]
    sky_rgb: tuple[float, ...]

    @property
    def towards_sun(self) -> tuple[float, float, float]:
        """Unit vector to the sun in raster axes: right, down the picture, up."""
        azimuth, elevation = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        flat = math.cos(elevation)
        return flat * math.sin(azimuth), -flat * math.cos(azimuth), math.sin(elevation)


LIGHTS = {
    "noon": Light(azimuth_deg=158.0, elevation_deg=52.0, sun_rgb=(0.80, 0.78, 0.74), sky_rgb=(0.34, 0.37, 0.42)),
    "evening": Light(
        azimuth_deg=262.0, elevation_deg=17.0, sun_rgb=(1.05, 0.76, 0.46), sky_rgb=(0.25, 0.28, 0.36)
    ),
}
"""Lights of the published flights, by name."""


def sun_visibility(height_m: Float32, gsd_m_per_px: float, light: Light) -> Float32:
    """Share of the sun's light that reaches every pixel.

    The raster is turned until light travels along its rows; the shadow's height is then a running maximum of
    the heights less the sun's descent, which one pass computes exactly for any length of shadow.

    Args:
        height_m: (H, W) of the highest surface.
        gsd_m_per_px: pixel in metres.
        light: direction of the sun.

    Returns:
        (H, W) in [0, 1].
    """
    h, w = height_m.shape
    east, down, up = light.towards_sun
    flat = math.hypot(east, down)
    along = np.array([-east / flat, -down / flat])
    turn = np.array([along, [-along[1], along[0]]])
    corners = turn @ np.array([[0, w, 0, w], [0, 0, h, h]], float)
    low = corners.min(axis=1)
    size = np.ceil(corners.max(axis=1) - low).astype(int) + 1
    matrix = np.hstack([turn, -low[:, None]])
    turned: Any = cv2.warpAffine(height_m, matrix, (int(size[0]), int(size[1])), flags=cv2.INTER_NEAREST)
    descent = np.arange(size[0], dtype=np.float32) * np.float32(gsd_m_per_px * up / flat)
    turned += descent
    np.maximum.accumulate(turned, axis=1, out=turned)
    turned -= descent
    shadow: Any = cv2.warpAffine(turned, matrix, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    # Blurring heights by half a metre imitates the sun's disc and keeps roofs from shadowing themselves.
    return np.asarray(np.clip(1.3 - 2.0 * (shadow - height_m), 0.0, 1.0), dtype=np.float32)


LAMP_RGB = (0.95, 0.72, 0.42)
"""Light directly below a street lamp."""
SHADE_REACH_M = 7.0
"""Distance within which a wall blocks light from the sky."""


def sky_share(height_m: Float32, gsd_m_per_px: float, shade: float) -> Float32:
    """Share of the sky that is visible beside walls and between crowns: 1 on roofs and open ground.

    Approximated by a pixel's depth below the mean height around it.

    Args:
        height_m: (H, W) of the highest surface.
        gsd_m_per_px: pixel in metres.
        shade: share lost at the foot of high walls, in [0, 1].

    Returns:
        (H, W) in [0, 1].
    """
    around = cv2.GaussianBlur(height_m, (0, 0), SHADE_REACH_M / gsd_m_per_px)
    sunk = np.clip((around - height_m) / np.float32(SHADE_REACH_M), 0.0, 1.0)
    return np.asarray(1.0 - np.float32(shade) * np.sqrt(sunk) * np.float32(0.8), dtype=np.float32)


def illuminate(
    albedo: Image,
    height_m: Float32,
    gsd_m_per_px: float,
    light: Light,
    *,
    shade: float = 0.0,
    lamps: Float32 | None = None,
) -> Image:
    """Colours of a height field under a light: Lambert shading, cast shadows, sky, street lamps.

    Args:
        albedo: (H, W, 3) colours in even white light.
        height_m: (H, W).
        gsd_m_per_px: pixel in metres.
        light: sun and sky.
        shade: share of the sky lost at the foot of high walls.
        lamps: (H, W) light of lamps in [0, 1].

    Returns:
        (H, W, 3) uint8 RGB.
    """
    step = 1.0 / (2.0 * gsd_m_per_px)
    kernel = np.array([[-step, 0.0, step]], np.float32)
    slope_x = np.clip(cv2.filter2D(height_m, cv2.CV_32F, kernel), -1.5, 1.5)
    slope_y = np.clip(cv2.filter2D(height_m, cv2.CV_32F, kernel.T), -1.5, 1.5)
    east, down, up = (np.float32(v) for v in light.towards_sun)
    facing = (up - east * slope_x - down * slope_y) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    sun = np.maximum(facing, np.float32(0.0)) * sun_visibility(height_m, gsd_m_per_px, light)
    sky = sky_share(height_m, gsd_m_per_px, shade) if shade else np.float32(1.0)
    lit = np.empty_like(albedo)
    for channel in range(3):
        strength = sun * np.float32(light.sun_rgb[channel]) + np.float32(light.sky_rgb[channel]) * sky
        if lamps is not None:
            strength = strength + lamps * np.float32(LAMP_RGB[channel])
        lit[..., channel] = np.clip(albedo[..., channel] * strength, 0.0, 255.0)
    return lit


def box_sides(
    ab_m: tuple[Array, Array], size_m: tuple[float, float], axis: Array, wall: Sequence[float], light: Light
) -> Image:
    """Colours of a box's walls for :attr:`World.sides`, each for its nearest pixels.

    Args:
        ab_m: offsets (H, W) of the pixels from the box's centre along its length and its width.
        size_m: length and width.
        axis: (2,) direction of the length in raster axes.
        wall: (3,) RGB of the plaster.
        light: on the box; shadows of other walls are ignored.

    Returns:
        (H, W, 4) uint8 RGB, and 255 in columns of windows.
    """
    a, b = ab_m
    end = size_m[0] / 2 - np.abs(a) < size_m[1] / 2 - np.abs(b)
    side = np.where(end, np.where(a > 0, 0, 2), np.where(b > 0, 1, 3))
    across = np.array([-axis[1], axis[0]])
    facing = np.maximum(np.array([axis, across, -axis, -across]) @ light.towards_sun[:2], 0.0)
    strength = facing[:, None] * np.array(light.sun_rgb) + 0.9 * np.array(light.sky_rgb)
    shades = np.column_stack([np.minimum(np.asarray(wall) * strength, 250.0), np.zeros(4)])
    sides = shades[side].astype(np.uint8)
    sides[..., 3] = np.where(np.mod(np.where(end, b, a), 2.6) < 1.3, 255, 0)
    return sides
