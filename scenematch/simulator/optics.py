"""The camera's image formation: exposure, noise, motion while the shutter is open, and the lens.

Convention:
    A picture's timestamp is the middle of the exposure of its middle row. During these milliseconds the vehicle
    moves and turns uniformly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from engine.camera import Camera
from engine.errors import OptionError
from engine.geo import enu_from_body
from engine.values import Attitude
from scenematch.simulator.light import Array, Float32, Image
from scenematch.simulator.render import World, render_frame

MAX_VIEW = 4.0
"""Size of the pinhole picture that the lens is resampled from, as a multiple of the camera's."""


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
        """The ideal picture as this sensor records it.

        Args:
            seen: (H, W, 3) uint8 RGB.
            rng: of noise and exposure.

        Returns:
            (H, W, 3) uint8 RGB.
        """
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
    """Exposure time and shutter of a camera; the defaults are an ideal one.

    Attributes:
        exposure_ms: exposure of each row; motion during it blurs the row. 0 freezes motion.
        readout_ms: from the first row to the last; each row sees another pose (rolling shutter). 0 is a global
            shutter.
        exposure_samples: number of poses averaged for motion blur.

    Raises:
        OptionError: a value is out of range.
    """

    exposure_ms: float = 0.0
    readout_ms: float = 0.0
    exposure_samples: int = 5

    def __post_init__(self) -> None:
        for item in fields(self):
            value, minimum = getattr(self, item.name), 0.0 if item.name.endswith("_ms") else 1e-3
            if not minimum <= value < math.inf:
                raise OptionError(f"{item.name}: expected {minimum:g} or more, got {value}")

    @property
    def moves(self) -> bool:
        """Whether motion shows in the picture."""
        return self.exposure_ms > 0.0 or self.readout_ms > 0.0


@dataclass(frozen=True)
class ExposureMotion:
    """Motion and rotation of the vehicle during a picture.

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
    """The picture that a real camera delivers.

    What each row sees at each time is resampled from one sharp pinhole picture via the ground plane. This
    misplaces a 20 m roof seen from 150 m by 13 % of the distance flown meanwhile: centimetres.

    Args:
        world: what is seen.
        camera: intrinsics, lens and mount.
        grid_m: its (easting, northing) in the world's CRS at the stamp.
        up_m: above the world's height 0.
        attitude: of the body, about true north.
        rng: of noise and exposure.
        sensor: how light becomes grey levels.
        optics: exposure and shutter; None is an ideal camera.
        sway: motion during the picture; None for none.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        OptionError: the camera looks above the horizon, is too low, or its lens is too wide for a pinhole picture.
    """
    optics, sway, view = optics or Optics(), sway or ExposureMotion(), (world, camera, grid_m, up_m, attitude)
    if camera.distorts or (optics.moves and sway != ExposureMotion()):
        seen = _resampled(*view, _row_rays(camera, attitude, up_m - world.ground_at(grid_m), optics, sway))
    else:
        seen = render_frame(*view)
    return sensor.develop(seen, rng)


@lru_cache(maxsize=4)
def lens_rays(camera: Camera) -> Float32:
    """Optical rays of all pixels, undistorted.

    Args:
        camera: intrinsics and distortion.

    Returns:
        (H, W, 3) float32 x right, y down, z = 1.
    """
    x, y = np.meshgrid(np.arange(camera.width_px, dtype=np.float64), np.arange(camera.height_px, dtype=np.float64))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    if camera.distortion_model in ("equidistant", "fisheye"):
        flat: Any = cv2.fisheye.undistortPoints(pixels, camera.matrix, camera.distortion)
    else:
        many = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
        flat = cv2.undistortPoints(pixels, camera.matrix, camera.distortion, criteria=many)
    return np.dstack([flat.reshape(camera.height_px, camera.width_px, 2), np.ones(x.shape)]).astype(np.float32)


def _row_rays(
    camera: Camera, attitude: Attitude, height_m: float, optics: Optics, sway: ExposureMotion
) -> list[Float32]:
    """For each time of the exposure, the rays (H, W, 2), x / z and y / z, in the pose at the timestamp.

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
    count = optics.exposure_samples if optics.exposure_ms > 0.0 and sway != ExposureMotion() else 1
    times_s = ((np.arange(count) + 0.5) / count - 0.5) * optics.exposure_ms * 1e-3
    found = []
    for time_s in times_s.tolist():
        # A readout lasts tens of milliseconds, so matrices change linearly from its first to its last row.
        first, last = (seen_after(time_s + end_s) for end_s in (-half_s, half_s))
        rows = (first + share * (last - first)).astype(np.float32)
        seen = rays @ rows.transpose(0, 2, 1)
        found.append(seen[..., :2] / seen[..., 2:])
    return found


def _resampled(
    world: World, camera: Camera, grid_m: tuple[float, float], up_m: float, attitude: Attitude, rays: list[Float32]
) -> Image:
    """The mean of the pictures along all rays, resampled from one sharp pinhole picture that contains them all."""
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    pixels = [ray * np.array([fx, fy], np.float32) for ray in rays]
    low = np.floor(np.min([p.min(axis=(0, 1)) for p in pixels], axis=0)) - 2.0
    high = np.ceil(np.max([p.max(axis=(0, 1)) for p in pixels], axis=0)) + 2.0
    size = (high - low + 1.0).astype(int)
    if not (size <= MAX_VIEW * max(camera.width_px, camera.height_px)).all():
        raise OptionError(f"camera: expected a lens that fits a flat picture, got one that needs {size} px")
    matrix = np.array([[fx, 0.0, -low[0]], [0.0, fy, -low[1]], [0.0, 0.0, 1.0]])
    wide = Camera(int(size[0]), int(size[1]), matrix, mount=camera.mount)
    sharp = render_frame(world, wide, grid_m, up_m, attitude)
    total = np.zeros((camera.height_px, camera.width_px, 3), np.float32)
    for at in pixels:
        x, y = (np.ascontiguousarray(at[..., k] - np.float32(low[k])) for k in (0, 1))
        total += cv2.remap(sharp, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.rint(total / len(pixels)), dtype=np.uint8)
