"""Intersect the rays of a picture with planes at any height, and find where they end in the sky.

Convention:
    World pixels (x, y) have their centres at integers. Angles are from the vertical: 0 looks straight down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from engine.camera import Camera
from engine.errors import OptionError
from engine.values import Attitude
from scenematch.simulator.light import Array, Float32

FADE_DEG, FAR_DEG = 80.0, 84.0
"""Angles between which the ground fades into the sky; beyond them only sky is visible."""
MAX_AXIS_DEG = 75.0
"""Largest angle of the optical axis."""
_STRAIGHT_DEG, _MAX_STRETCH = 30.0, 2.0  # rays in a pixel cost time


@dataclass(frozen=True)
class Rays:
    """Where the rays of a picture meet the plane at height z: nadir + (camera - z) * reach / ahead, world pixels.

    Attributes:
        reach: (2, 3) world pixels that a ray travels, linear in its pixel (x, y, 1).
        ahead: (3,) metres that it descends meanwhile, linear in the same.
        aside: (2, 3) metres east and north that it travels meanwhile, linear in the same.
        nadir_px: (2,) world pixel below the camera.
        camera_m: height of the camera.
        size: width and height of the picture.
    """

    reach: Array
    ahead: Array
    aside: Array
    nadir_px: Array
    camera_m: float
    size: tuple[int, int]

    @classmethod
    def cast(
        cls, camera: Camera, attitude: Attitude, px_from_enu: Array, nadir_px: Array, camera_m: float, fine: int
    ) -> Rays:
        """Rays through ``fine`` x ``fine`` points in every pixel of the camera.

        Args:
            camera: intrinsics and mount.
            attitude: of the body.
            px_from_enu: (2, 2) world pixels per metre east and north.
            nadir_px: (2,) world pixel below the camera.
            camera_m: its height.
            fine: points in a pixel along each axis.

        Returns:
            Rays: of width and height times ``fine``.

        Raises:
            OptionError: the optical axis is more than 75 degrees off the vertical.
        """
        offset = 0.5 / fine - 0.5
        sample = np.array([[1 / fine, 0, offset], [0, 1 / fine, offset], [0, 0, 1.0]])
        if _axis_deg(camera, attitude) > MAX_AXIS_DEG:
            raise OptionError(f"attitude: expected a camera that looks at the ground, got {attitude}")
        rays = camera.enu_from_camera(attitude) @ np.linalg.inv(camera.matrix) @ sample
        size = (camera.width_px * fine, camera.height_px * fine)
        return cls(px_from_enu @ rays[:2], -rays[2], rays[:2], nadir_px, camera_m, size)

    def homography(self, z_m: float) -> Array:
        """The homography of the plane at a height.

        Args:
            z_m: height of the plane.

        Returns:
            (3, 3) from picture to world pixels.
        """
        flat = (self.camera_m - z_m) * self.reach + np.outer(self.nadir_px, self.ahead)
        return np.vstack([flat, self.ahead])

    def per_metre(self) -> tuple[Float32, Float32]:
        """World pixels (x, y) that each ray travels per metre of height, on the picture's raster.

        A ray into the sky counts as one at the angle where the sky begins.

        Returns:
            Right and down, (H, W) each.
        """
        fall = self._at(self.ahead)
        if self.sees_sky:
            fall = np.maximum(fall, np.maximum(self._away / math.tan(math.radians(FAR_DEG)), 1e-9))
        scale = 1.0 / fall
        right, down = (self._at(row) * scale for row in self.reach)
        return right.astype(np.float32), down.astype(np.float32)

    def sky_share(self) -> Float32:
        """Share of the sky in what each ray sees.

        Returns:
            (H, W) in [0, 1].
        """
        angle_deg = np.degrees(np.arctan2(self._away, self._at(self.ahead)))
        return np.asarray(np.clip((angle_deg - FADE_DEG) / (FAR_DEG - FADE_DEG), 0.0, 1.0), np.float32)

    @cached_property
    def steepness(self) -> float:
        """Largest tangent of a ray's angle; inf if one does not meet the ground."""
        x, y = (np.array([-0.5, n - 0.5]) for n in self.size)
        corners = np.stack([*np.meshgrid(x, y), np.ones((2, 2))]).reshape(3, 4)
        fall = self.ahead @ corners
        return math.inf if fall.min() <= 0.0 else float((np.hypot(*(self.aside @ corners)) / fall).max())

    @property
    def sees_sky(self) -> bool:
        """Whether any ray comes near the horizon."""
        return self.steepness > math.tan(math.radians(FADE_DEG))

    @property
    def rows_of_sky(self) -> int:
        """How many rows at the top of the picture show only sky."""
        if not self.sees_sky:
            return 0
        ground = (self.sky_share() < 1.0).any(axis=1)
        return int(ground.argmax()) if ground.any() else 0

    @property
    def _away(self) -> Array:
        return np.asarray(np.hypot(*(self._at(row) for row in self.aside)))

    def _at(self, row: Array) -> Array:
        """(H, W) values of a linear function of the pixel."""
        x, y = np.arange(self.size[0]), np.arange(self.size[1])[:, None]
        return np.asarray(row[0] * x + row[1] * y + row[2])


def stretch(camera: Camera, attitude: Attitude) -> float:
    """How many times larger the central pixel's footprint is than straight below.

    Args:
        camera: intrinsics and mount.
        attitude: of the body.

    Returns:
        1 up to 30 degrees off the vertical, and at most 2: pictures are not rendered more finely than that.
    """
    angle_deg = _axis_deg(camera, attitude)
    return 1.0 if angle_deg <= _STRAIGHT_DEG else min(math.cos(math.radians(angle_deg)) ** -2, _MAX_STRETCH)


def _axis_deg(camera: Camera, attitude: Attitude) -> float:
    """Angle of the ray through the picture's centre."""
    ray = camera.enu_from_camera(attitude) @ camera.frame_rays[4]
    return math.degrees(math.atan2(math.hypot(ray[0], ray[1]), -ray[2]))
