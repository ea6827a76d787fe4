"""Conditions: light, season and air of a day, and their effect on the appearance of the ground.

Snow, foliage and lamps change the drawn colours by the material of each pixel, before lighting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from engine.errors import OptionError
from engine.values import check
from scenematch.simulator.canvas import CANOPY, CROP, GRASS
from scenematch.simulator.light import LIGHTS, Array, Float32, Image, Light
from scenematch.simulator.optics import Sensor
from scenematch.simulator.render import Atmosphere

_SNOW: tuple[float, ...] = (0.92, 0.18, 0.45, 0.72, 0.92, 0.0, 0.35)
"""Share of each material, in the canvas's order, hidden by a full snow cover; streets are cleared."""
_SNOW_RGB, _STRAW_RGB, _LITTER_RGB, _BARK_RGB = (214, 220, 230), (148, 134, 92), (98, 88, 68), (110, 98, 86)
_TURNED: tuple[tuple[int, int, int], ...] = ((164, 118, 46), (150, 78, 38), (120, 112, 52), (110, 70, 44))


@dataclass(frozen=True, kw_only=True)
class Condition:
    """Light, season and air of a day; the defaults are a clear summer day.

    Attributes:
        light: sun and sky, as exposed.
        shade: share of the sky's light lost between high walls and under crowns, in [0, 1].
        snow: 0 none to 1 a full cover on roofs and lawns, with streets cleared.
        leaves: density of the trees' crowns; the rest shows the ground between branches.
        turned: share of the foliage in autumn colours.
        dry: 0 green to 1 withered lawns and crops.
        air: between camera and ground; None is perfectly clear.
        lamps: strength of the street lamps.
        noise: the sensor's noise as a multiple of its own.

    Raises:
        OptionError: a value is out of range.
    """

    light: Light
    shade: float = 0.0
    snow: float = 0.0
    leaves: float = 1.0
    turned: float = 0.0
    dry: float = 0.0
    air: Atmosphere | None = None
    lamps: float = 0.0
    noise: float = 1.0

    def __post_init__(self) -> None:
        for name in ("shade", "snow", "leaves", "turned", "dry", "lamps"):
            check(self, name, "0 to 1", lambda share: 0.0 <= share <= 1.0)
        check(self, "noise", "above 0", lambda factor: factor > 0.0)

    def sensor(self, sensor: Sensor) -> Sensor:
        """The camera's sensor on this day."""
        return sensor if self.noise == 1.0 else replace(sensor, noise_sd=self.noise * sensor.noise_sd)


def _light(azimuth_deg: float, elevation_deg: float, sun: Array, sky: Array) -> Light:
    colours = {"sun_rgb": tuple(sun.tolist()), "sky_rgb": tuple(sky.tolist())}
    return Light(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, **colours)


_WARM, _PALE = np.array([1.0, 0.86, 0.66]), np.array([1.0, 0.96, 0.9])
_BLUE, _GREY = np.array([0.82, 0.9, 1.06]), np.array([0.97, 1.0, 1.03])

CONDITIONS = {
    "noon": Condition(light=LIGHTS["noon"]),
    "evening": Condition(light=LIGHTS["evening"]),
    "morning": Condition(
        light=_light(96.0, 19.0, 1.45 * _WARM, 0.33 * _BLUE), shade=0.4, air=Atmosphere(4000.0)
    ),
    "overcast": Condition(light=_light(180.0, 50.0, 0.0 * _GREY, 0.84 * _GREY), shade=0.75),
    "haze": Condition(
        light=_light(170.0, 50.0, 0.5 * _PALE, 0.5 * _GREY), shade=0.4, air=Atmosphere(900.0, (188, 194, 202))
    ),
    "autumn": Condition(
        light=_light(205.0, 29.0, 1.25 * _PALE, 0.38 * _BLUE), shade=0.4, leaves=0.8, turned=0.85, dry=0.4
    ),
    "winter": Condition(
        light=_light(195.0, 19.0, 1.25 * _PALE, 0.48 * _BLUE), shade=0.4, snow=0.75, leaves=0.22, dry=0.8
    ),
    "dusk": Condition(
        light=_light(290.0, 20.0, 0.0 * _WARM, 0.36 * _BLUE), shade=0.6, lamps=0.9, noise=3.0,
    ),
}  # fmt: skip
"""Days by name. ``noon`` and ``evening`` are those of the published flights."""


def condition_by_name(condition: str | Condition) -> Condition:
    """The condition with this name, or the given condition.

    Raises:
        OptionError: there is no such condition.
    """
    if isinstance(condition, Condition):
        return condition
    if condition not in CONDITIONS:
        raise OptionError(f"condition: expected one of {', '.join(CONDITIONS)}, got {condition!r}")
    return CONDITIONS[condition]


def _noise(rng: np.random.Generator, shape: tuple[int, ...], cell_px: float) -> Float32:
    """Smooth noise (H, W) of about unit variance and a wavelength of about ``cell_px``."""
    cells = [max(4, math.ceil(n / cell_px)) for n in shape]
    raised = cv2.resize(rng.standard_normal(cells, np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(raised * np.float32(1.25), dtype=np.float32)


def _mix(rgb: Float32, colour: Array | Float32, share: Float32) -> None:
    """Blend a colour (3,) or (..., 3) into (..., 3) colours, in place."""
    rgb += (colour - rgb) * share[..., None]


def apply_season(
    albedo: Image,
    height_m: Float32,
    material: Image,
    ground_m: Float32 | None,
    condition: Condition,
    gsd_m_per_px: float,
    rng: np.random.Generator,
) -> tuple[Image, Float32]:
    """Colours and heights of the ground in a season; unchanged if the condition has none.

    Args:
        albedo: (H, W, 3) drawn colours of summer.
        height_m: (H, W) of the highest surface.
        material: (H, W) indices of the materials of :mod:`scenematch.simulator.canvas`.
        ground_m: (H, W) of the bare ground, None if it is flat at 0.
        condition: of the day.
        gsd_m_per_px: pixel in metres.
        rng: for snow patches and bare branches.

    Returns:
        (H, W, 3) uint8 colours and (H, W) heights.
    """
    if not (condition.snow or condition.leaves < 1.0 or condition.turned or condition.dry):
        return albedo, height_m
    ground = np.zeros_like(height_m) if ground_m is None else ground_m
    rgb, height, kind = albedo.astype(np.float32), height_m.copy(), material.copy()
    large, small = (_noise(rng, kind.shape, m / gsd_m_per_px) for m in (14.0, 1.4))
    grain = _noise(rng, kind.shape, 0.45 / gsd_m_per_px)
    _wither(rgb, kind, condition, large, rng, gsd_m_per_px)
    _shed(rgb, height, kind, ground, condition.leaves, grain, small)
    if condition.snow:
        _cover_with_snow(rgb, kind, condition.snow, large, small)
    return np.clip(rgb, 0, 255).astype(np.uint8), height


def _shed(
    rgb: Float32, height: Float32, kind: Image, ground: Float32, leaves: float, grain: Float32, small: Float32
) -> None:
    """Open the crowns of trees by their share of leaves: bare ground between branches, in place."""
    bare = (kind == CANOPY) & (0.5 + 0.29 * grain + 0.12 * small > leaves)
    if leaves < 0.5:  # a bare tree shows only wood
        wood = ((kind == CANOPY) & ~bare).astype(np.float32) * np.float32(0.85 * (1.0 - leaves))
        _mix(rgb, np.array(_BARK_RGB, np.float32), wood)
        height[wood > 0] = ground[wood > 0] + np.float32(0.65) * (height - ground)[wood > 0]
    rgb[bare] = np.array(_LITTER_RGB, np.float32) * (1.0 + 0.08 * small[bare][:, None])
    height[bare] = ground[bare]
    kind[bare] = GRASS


def _cover_with_snow(rgb: Float32, kind: Image, snow: float, large: Float32, small: Float32) -> None:
    """Blend in snow by material, in patches, in place; the ground shows through a thin cover."""
    cover = np.array(_SNOW, np.float32)[kind] * np.float32(snow * 1.2)
    share = np.clip(2.2 * (cover - 0.5) + 0.5 + 0.22 * large + 0.1 * small, 0.0, 1.0) * (cover > 0)
    grey = rgb.mean(axis=2, keepdims=True) / np.float32(110.0)
    _mix(rgb, np.array(_SNOW_RGB, np.float32) * (0.86 + 0.14 * np.clip(grey, 0.3, 1.7)), share * 0.94)


def _wither(
    rgb: Float32, kind: Image, condition: Condition, large: Float32, rng: np.random.Generator, gsd: float
) -> None:
    """Straw for lawns and crops, autumn colours for crowns; each tree changes colour on its own day."""
    if condition.dry:
        field = ((kind == GRASS) | (kind == CROP)) * np.clip(condition.dry + 0.15 * large, 0.0, 0.9)
        shade = rgb.mean(axis=2, keepdims=True) / np.float32(105.0)
        _mix(rgb, np.array(_STRAW_RGB, np.float32) * np.clip(shade, 0.4, 1.6), field.astype(np.float32))
    if condition.turned:
        pick, late = _noise(rng, kind.shape, 6.0 / gsd), _noise(rng, kind.shape, 4.5 / gsd)
        colours = np.array(_TURNED, np.float32)[np.clip((pick + 2.0).astype(int), 0, len(_TURNED) - 1)]
        share = (kind == CANOPY) * np.clip(condition.turned + 0.3 * late, 0.0, 0.95)
        shade = rgb.mean(axis=2, keepdims=True) / np.float32(70.0)
        _mix(rgb, colours * np.clip(shade, 0.5, 1.5), share.astype(np.float32))
