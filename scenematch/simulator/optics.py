"""The camera's image formation: response, noise and the lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from engine.camera import Camera
from engine.errors import OptionError
from engine.values import Attitude
from scenematch.simulator.light import Float32, Image
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


def through_lens(
    world: World,
    camera: Camera,
    grid_m: tuple[float, float],
    up_m: float,
    attitude: Attitude,
    moments: Sequence[Float32] = (),
) -> Image:
    """What a real lens shows its sensor during an exposure.

    What each row sees at each time is resampled from one sharp pinhole picture via the ground plane. This
    misplaces a 20 m roof seen from 150 m by 13 % of the distance flown meanwhile: centimetres.

    Args:
        world: what is seen.
        camera: intrinsics, lens and mount.
        grid_m: its (easting, northing) in the world's CRS at the stamp.
        up_m: above the world's height 0.
        attitude: of the body, about true north.
        moments: of the exposure, each as the rays (H, W, 2), x / z and y / z in the pose at the stamp, that the
            pixels then see; the picture is their mean. None freezes motion.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        OptionError: the camera looks above the horizon, is too low, or its lens is too wide for a pinhole picture.
    """
    if not moments and not camera.distorts:
        return render_frame(world, camera, grid_m, up_m, attitude)
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    pixels = [ray * np.array([fx, fy], np.float32) for ray in moments or [lens_rays(camera)[..., :2]]]
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


@lru_cache(maxsize=4)
def lens_rays(camera: Camera) -> Float32:
    """Optical rays of all pixels, undistorted.

    Args:
        camera: intrinsics and distortion.

    Returns:
        (H, W, 3) float32 x right, y down, z = 1.
    """
    x, y = np.meshgrid(np.arange(camera.width_px, dtype=np.float64), np.arange(camera.height_px, dtype=np.float64))
    flat = camera.undistort_points(np.column_stack([x.ravel(), y.ravel()]))
    return np.dstack([flat.reshape(camera.height_px, camera.width_px, 2), np.ones(x.shape)]).astype(np.float32)
