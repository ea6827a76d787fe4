"""What a camera makes of what it sees: exposure and noise, motion while the shutter is open, the lens.

Convention:
    The stamp of a picture is the middle of the exposure of its middle row. During the milliseconds of a picture
    the vehicle moves and turns evenly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from engine.camera import Camera
from engine.errors import OptionError
from engine.geo import enu_from_body
from engine.sim.light import Array, Float32, Image
from engine.sim.render import World, render_frame
from engine.values import Attitude

GAIN_LIMITS = (0.25, 8.0)
"""What automatic exposure can do."""
MAX_VIEW = 4.0
"""Sides of the pinhole picture that a lens is drawn from, as a multiple of the camera's."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """How a camera turns light into grey levels.

    Attributes:
        gamma: exponent of the response.
        balance_rgb: gain of each channel.
        haze: grey levels added everywhere.
        vignette: share of light lost in the corners.
        exposure_sd: standard deviation of the exposure from picture to picture, as a share.
        blur_px: standard deviation of the lens's blur.
        noise_sd: standard deviation of the noise in grey levels.
    """

    gamma: float
    balance_rgb: tuple[float, float, float]
    haze: float
    vignette: float
    exposure_sd: float
    blur_px: float
    noise_sd: float

    def develop(self, seen: Image, rng: np.random.Generator) -> Image:
        """The picture (H, W, 3) that this sensor takes of an ideal one."""
        h, w = seen.shape[:2]
        y, x = np.ogrid[:h, :w]
        far = ((x - (w - 1) / 2) ** 2 + (y - (h - 1) / 2) ** 2) * (4.0 / (w**2 + h**2))
        gain = ((1.0 - self.vignette * far) * (1.0 + self.exposure_sd * rng.standard_normal())).astype(np.float32)
        response = (255.0 * (np.arange(256) / 255.0) ** self.gamma).astype(np.float32)
        picture: Any = cv2.GaussianBlur(response[seen], (0, 0), self.blur_px)
        picture *= gain[..., None] * np.array(self.balance_rgb, np.float32)
        picture += np.float32(self.noise_sd) * rng.standard_normal(picture.shape, np.float32) + np.float32(
            self.haze
        )
        return np.asarray(np.clip(np.rint(picture), 0, 255), dtype=np.uint8)


@dataclass(frozen=True, kw_only=True)
class Optics:
    """What else happens in a camera; by default nothing does.

    Attributes:
        exposure_ms: how long every row gathers light; motion meanwhile blurs it. 0 freezes it.
        readout_ms: from the first row to the last; each row sees another pose (rolling shutter). 0 is a global
            shutter.
        gain: multiplies light and noise alike.
        target_level: mean grey level that automatic exposure aims at, on top of the gain; None leaves it alone.
        looks: poses that a motion blur is averaged from.

    Raises:
        OptionError: a value is out of range.
    """

    exposure_ms: float = 0.0
    readout_ms: float = 0.0
    gain: float = 1.0
    target_level: float | None = None
    looks: int = 5

    def __post_init__(self) -> None:
        for item in fields(self):
            value, least = getattr(self, item.name), 0.0 if item.name.endswith("_ms") else 1e-3
            if value is not None and not least <= value < math.inf:
                raise OptionError(f"{item.name}: expected {least:g} or more, got {value}")

    @property
    def moves(self) -> bool:
        """Whether motion shows in the picture."""
        return self.exposure_ms > 0.0 or self.readout_ms > 0.0


@dataclass(frozen=True)
class ExposureMotion:
    """How the vehicle moves and turns while a picture is taken.

    Attributes:
        velocity_mps: east, north, up.
        turn_dps: change of roll, pitch and heading in degrees a second.
    """

    velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_dps: tuple[float, float, float] = (0.0, 0.0, 0.0)


def take_picture(
    world: World,
    camera: Camera,
    grid_m: tuple[float, float],
    up_m: float,
    attitude: Attitude,
    rng: np.random.Generator,
    *,
    sensor: Sensor,
    optics: Optics | None = None,
    sway: ExposureMotion | None = None,
) -> Image:
    """The picture (H, W, 3) RGB that a real camera delivers.

    One sharp pinhole picture, wide enough, is drawn from the pose of the stamp; what each row saw at each moment
    is looked up in it by way of the ground below. A roof of 20 m seen from 150 m is thereby misplaced by 13 % of
    what the vehicle flies during the picture: centimetres.

    Args:
        world: what is there.
        camera: intrinsics, lens and mount.
        grid_m: its (easting, northing) in the world's CRS at the stamp.
        up_m: above the world's height 0.
        attitude: of the body, about true north.
        rng: of the sensor's noise and exposure.
        sensor: how light becomes grey levels.
        optics: what else happens; None is nothing.
        sway: motion meanwhile; None is none.

    Raises:
        OptionError: the camera looks above the horizon, is not above the highest roof, or its lens sees farther
            to the side than a pinhole can show.
    """
    optics, sway = optics or Optics(), sway or ExposureMotion()
    if camera.distorts or (optics.moves and sway != ExposureMotion()):
        height_m = up_m - world.ground_at(grid_m)
        looks = _looks(camera, attitude, height_m, optics, sway)
        seen = _looked_up(world, camera, grid_m, up_m, attitude, looks)
    else:
        seen = render_frame(world, camera, grid_m, up_m, attitude)
    return _exposed(sensor, optics, seen).develop(seen, rng)


def _exposed(sensor: Sensor, optics: Optics, seen: Image) -> Sensor:
    """The sensor with its gain set, as automatic exposure sets it for what is seen."""
    gain = optics.gain
    if optics.target_level is not None:
        level = 255.0 * float(np.mean((seen / 255.0) ** sensor.gamma)) * gain
        gain *= float(np.clip(optics.target_level / max(level, 1e-3), *GAIN_LIMITS))
    if gain == 1.0:
        return sensor
    r, g, b = (gain * balance for balance in sensor.balance_rgb)
    return replace(sensor, balance_rgb=(r, g, b), noise_sd=sensor.noise_sd * max(gain, 1.0))


@lru_cache(maxsize=4)
def lens_rays(camera: Camera) -> Float32:
    """Optical rays (H, W, 3) with z = 1 of all pixels, with the lens's distortion taken out."""
    x, y = np.meshgrid(np.arange(camera.width_px, dtype=np.float64), np.arange(camera.height_px, dtype=np.float64))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    if camera.distortion_model in ("equidistant", "fisheye"):
        flat: Any = cv2.fisheye.undistortPoints(pixels, camera.matrix, camera.distortion)
    else:
        many = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
        flat = cv2.undistortPoints(pixels, camera.matrix, camera.distortion, criteria=many)
    return np.dstack([flat.reshape(camera.height_px, camera.width_px, 2), np.ones(x.shape)]).astype(np.float32)


def _looks(
    camera: Camera, attitude: Attitude, height_m: float, optics: Optics, sway: ExposureMotion
) -> list[Float32]:
    """For each moment of the exposure the rays (H, W, 2), x / z and y / z, of the pose of the stamp.

    A ray d of a camera displaced by s meets the ground where d - s d_z / h of the undisplaced one does.
    """
    start = np.array([attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg])
    cam_from_enu = (enu_from_body(*start) @ camera.mount).T

    def seen_after(time_s: float) -> Array:
        shear = np.eye(3)
        shear[:, 2] -= time_s * np.array(sway.velocity_mps) / height_m
        return cam_from_enu @ shear @ enu_from_body(*(start + time_s * np.array(sway.turn_dps))) @ camera.mount

    rays, half_s = lens_rays(camera), 0.5e-3 * optics.readout_ms
    share = np.linspace(0.0, 1.0, camera.height_px)[:, None, None]
    count = optics.looks if optics.exposure_ms > 0.0 and sway != ExposureMotion() else 1
    moments_s = ((np.arange(count) + 0.5) / count - 0.5) * optics.exposure_ms * 1e-3
    found = []
    for moment_s in moments_s.tolist():
        # A readout lasts tens of milliseconds: between its first and its last row matrices change evenly.
        first, last = (seen_after(moment_s + end_s) for end_s in (-half_s, half_s))
        rows = (first + share * (last - first)).astype(np.float32)
        seen = rays @ rows.transpose(0, 2, 1)
        found.append(seen[..., :2] / seen[..., 2:])
    return found


def _looked_up(
    world: World,
    camera: Camera,
    grid_m: tuple[float, float],
    up_m: float,
    attitude: Attitude,
    looks: list[Float32],
) -> Image:
    """The mean of the looks into one sharp pinhole picture that holds them all."""
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    pixels = [look * np.array([fx, fy], np.float32) for look in looks]
    low = np.floor(np.min([p.min(axis=(0, 1)) for p in pixels], axis=0)) - 2.0
    high = np.ceil(np.max([p.max(axis=(0, 1)) for p in pixels], axis=0)) + 2.0
    size = (high - low + 1.0).astype(int)
    if not (size <= MAX_VIEW * max(camera.width_px, camera.height_px)).all():
        raise OptionError(f"camera: expected a lens that a flat picture can hold, got one of {size} px in all")
    matrix = np.array([[fx, 0.0, -low[0]], [0.0, fy, -low[1]], [0.0, 0.0, 1.0]])
    wide = Camera(int(size[0]), int(size[1]), matrix, mount=camera.mount)
    sharp = render_frame(world, wide, grid_m, up_m, attitude)
    total = np.zeros((camera.height_px, camera.width_px, 3), np.float32)
    for at in pixels:
        x, y = (np.ascontiguousarray(at[..., k] - np.float32(low[k])) for k in (0, 1))
        total += cv2.remap(sharp, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.rint(total / len(pixels)), dtype=np.uint8)
