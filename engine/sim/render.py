"""What a world looks like: sun, shadows, and the picture that a camera takes of a height field.

Convention:
    A world is a raster seen from straight above: colour and height of the highest surface at every pixel.
    Heights are metres above flat ground at 0. Positions are metres in the raster's projected CRS; attitude is
    about true north, so grid convergence and point scale enter through the grid's local Jacobian.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import OptionError, ShapeError
from engine.geo import LocalFrame, enu_from_body
from engine.types import Attitude

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]

LAYER_M = 1.0
"""Height step of the search for the first surface that a ray meets; narrower things may be missed."""
FLOOR_M = 3.0
"""Height of one storey: the pitch of the rows of windows."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """A sun and a sky.

    Attributes:
        azimuth_deg: where the sun stands, clockwise from the raster's up direction.
        elevation_deg: above the horizon.
        sun_rgb: strength of the sun on a surface that faces it.
        sky_rgb: strength of the light that reaches shadows too.
    """

    azimuth_deg: float
    elevation_deg: float
    sun_rgb: tuple[float, float, float]
    sky_rgb: tuple[float, float, float]

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
"""The lights that a flight can be flown in."""


def light_by_name(name: str) -> Light:
    """The light of that name.

    Raises:
        OptionError: there is none.
    """
    if name not in LIGHTS:
        raise OptionError(f"light: expected one of {', '.join(LIGHTS)}, got {name!r}")
    return LIGHTS[name]


@dataclass(frozen=True)
class World:
    """A height field with colours, under one light.

    Attributes:
        rgb: (H, W, 3) colours as seen from above, light and shadows included.
        sides: (H, W, 4) colour of the vertical face next to a pixel; the fourth is 255 in columns of windows.
        height_m: (H, W) of the highest surface, 0 on the ground, never below.
        pixel_to_crs: (2, 3) affine from pixels (x, y), centres at integers, to the projected CRS.
        crs_epsg: code of that CRS.

    Raises:
        ShapeError: the rasters do not fit together.
    """

    rgb: Image
    sides: Image
    height_m: Float32
    pixel_to_crs: Array
    crs_epsg: int
    gsd_m_per_px: float = field(init=False)

    def __post_init__(self) -> None:
        size, rgb, sides = self.height_m.shape, self.rgb.shape, self.sides.shape
        if len(size) != 2 or rgb != (*size, 3) or sides != (*size, 4):
            raise ShapeError(f"world: expected (H, W, 3), (H, W, 4) and (H, W), got {rgb}, {sides} and {size}")
        if self.pixel_to_crs.shape != (2, 3):
            raise ShapeError(f"pixel_to_crs: expected (2, 3), got {self.pixel_to_crs.shape}")
        area = abs(float(np.linalg.det(self.pixel_to_crs[:, :2])))
        object.__setattr__(self, "gsd_m_per_px", math.sqrt(area))

    @cached_property
    def _coarse_height(self) -> tuple[Image, float]:
        """Heights in whole units of a byte, and that unit in metres: what the layer search reads."""
        unit = max(float(self.height_m.max()), 1e-3) / 254.0
        return np.ceil(self.height_m / np.float32(unit)).astype(np.uint8), unit


def sun_visibility(height_m: Float32, gsd_m_per_px: float, light: Light) -> Float32:
    """Share of the sun that reaches every pixel (H, W), in [0, 1].

    The raster is turned until light travels along its rows; the shadow's height is then a running maximum of
    the heights less the sun's descent, which one pass finds exactly for any length of shadow.
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
    # Half a metre of blur in height stands for the sun's disc and keeps roofs from shadowing themselves.
    return np.asarray(np.clip(1.3 - 2.0 * (shadow - height_m), 0.0, 1.0), dtype=np.float32)


def illuminate(albedo: Image, height_m: Float32, gsd_m_per_px: float, light: Light) -> Image:
    """Colours (H, W, 3) of a height field under a light: Lambert shading, cast shadows, sky."""
    step = 1.0 / (2.0 * gsd_m_per_px)
    kernel = np.array([[-step, 0.0, step]], np.float32)
    slope_x = np.clip(cv2.filter2D(height_m, cv2.CV_32F, kernel), -1.5, 1.5)
    slope_y = np.clip(cv2.filter2D(height_m, cv2.CV_32F, kernel.T), -1.5, 1.5)
    east, down, up = (np.float32(v) for v in light.towards_sun)
    facing = (up - east * slope_x - down * slope_y) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    sun = np.maximum(facing, np.float32(0.0)) * sun_visibility(height_m, gsd_m_per_px, light)
    lit = np.empty_like(albedo)
    for channel in range(3):
        strength = sun * np.float32(light.sun_rgb[channel]) + np.float32(light.sky_rgb[channel])
        lit[..., channel] = np.clip(albedo[..., channel] * strength, 0.0, 255.0)
    return lit


def box_sides(
    ab_m: tuple[Array, Array], size_m: tuple[float, float], axis: Array, wall: Sequence[float], light: Light
) -> Image:
    """Colours (H, W, 4) of a box's walls as :attr:`World.sides` has them, each given to the pixels nearest it.

    Args:
        ab_m: offsets (H, W) of the pixels from the box's centre along its length and its width.
        size_m: length and width.
        axis: (2,) direction of the length in raster axes.
        wall: (3,) RGB of the plaster.
        light: what falls on it; walls in the shadow of others are not darkened.
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


@lru_cache(maxsize=8)
def transformer(crs_epsg: int) -> Any:
    """The transformer from WGS84 (longitude, latitude) in degrees to the CRS."""
    from pyproj import Transformer

    return Transformer.from_crs(4326, crs_epsg, always_xy=True)


def grid_from_enu(crs_epsg: int, grid_m: tuple[float, float]) -> Array:
    """Jacobian (2, 2) at a grid position: grid metres per metre of true east and north.

    Its rotation is the grid's convergence, its length the point scale, both as the projection has them.
    """
    to_grid = transformer(crs_epsg)
    lon, lat = to_grid.transform(*grid_m, direction="INVERSE")
    step = np.array([50.0, -50.0, 0.0, 0.0])
    lats, lons = LocalFrame(lat, lon).geodetic_from_enu(step, step[::-1])
    x, y = to_grid.transform(lons, lats)
    return np.array([[x[0] - x[1], x[3] - x[2]], [y[0] - y[1], y[3] - y[2]]]) / 100.0


@dataclass(frozen=True)
class _Rays:
    """Where the rays of a picture meet the plane at height z, in world pixels: nadir + (camera - z) * reach."""

    reach: Array
    ahead: Array
    nadir_px: Array
    camera_m: float
    size: tuple[int, int]

    @classmethod
    def cast(
        cls,
        world: World,
        camera: Camera,
        grid_m: tuple[float, float],
        camera_m: float,
        attitude: Attitude,
        fine: int,
    ) -> _Rays:
        """Rays through ``fine`` x ``fine`` points in every pixel of the camera."""
        offset = 0.5 / fine - 0.5
        sample = np.array([[1 / fine, 0, offset], [0, 1 / fine, offset], [0, 0, 1.0]])
        enu_from_cam = enu_from_body(attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg) @ camera.mount
        rays = enu_from_cam @ np.linalg.inv(camera.matrix) @ sample
        size = (camera.width_px * fine, camera.height_px * fine)
        corners = np.array([[0, size[0], 0, size[0]], [0, 0, size[1], size[1]], [1, 1, 1, 1.0]])
        if float((rays[2] @ corners).max()) > -0.1:
            raise OptionError(f"attitude: expected a camera that looks at the ground, got {attitude}")
        px_from_grid = np.linalg.inv(world.pixel_to_crs[:, :2])
        nadir = px_from_grid @ (np.asarray(grid_m) - world.pixel_to_crs[:, 2])
        reach = px_from_grid @ grid_from_enu(world.crs_epsg, grid_m) @ rays[:2]
        return cls(reach, -rays[2], nadir, camera_m, size)

    def homography(self, z_m: float) -> Array:
        """(3, 3) from picture to world pixels for the plane at height z."""
        flat = (self.camera_m - z_m) * self.reach + np.outer(self.nadir_px, self.ahead)
        return np.vstack([flat, self.ahead])

    def per_metre(self) -> tuple[Float32, Float32]:
        """World pixels (x, y) that each ray travels per metre of height, on the picture's raster."""
        x, y = np.arange(self.size[0]), np.arange(self.size[1])[:, None]
        scale = 1.0 / (self.ahead[0] * x + self.ahead[1] * y + self.ahead[2])
        right, down = ((row[0] * x + row[1] * y + row[2]) * scale for row in self.reach)
        return right.astype(np.float32), down.astype(np.float32)


def _first_layer(world: World, rays: _Rays) -> tuple[Image, Float32]:
    """For every ray the first layer from the top that lies inside something, and the layers' heights.

    Returns:
        Layers (H, W), 0 for none, and heights by layer, index 0 the ground, rising.
    """
    coarse, unit = world._coarse_height
    top = float(world.height_m.max())
    count = int(np.clip(math.ceil(top / LAYER_M), 1, 254))
    heights = np.linspace(0.0, top, count + 1).astype(np.float32)
    found = np.zeros(rays.size[::-1], np.uint8)
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    for layer in range(1, count):
        seen = cv2.warpPerspective(coarse, rays.homography(float(heights[layer])), rays.size, flags=flags)
        _, inside = cv2.threshold(seen, math.floor(heights[layer] / unit), layer, cv2.THRESH_BINARY)
        cv2.max(found, inside, found)
    return found, heights


def _nearest(raster: NDArray[Any], x: Float32, y: Float32) -> NDArray[Any]:
    rows = np.clip(np.rint(y).astype(np.int32), 0, raster.shape[0] - 1)
    return raster[rows, np.clip(np.rint(x).astype(np.int32), 0, raster.shape[1] - 1)]


def _refine(world: World, rays: _Rays, x: Float32, y: Float32, low: Float32, step: float) -> tuple[Any, Any]:
    """Height at which rays meet the surface, and whether they meet it from the side.

    Bisects between the layer inside and the free layer above it; a surface that rises above the free end is a
    wall, any other a roof, whose own height then places the texture exactly.
    """
    nadir_x, nadir_y = (np.float32(v) for v in rays.nadir_px)
    camera_m = np.float32(rays.camera_m)
    inside, free = low.copy(), low + np.float32(step)
    surface = _nearest(world.height_m, nadir_x + (camera_m - inside) * x, nadir_y + (camera_m - inside) * y)
    for _ in range(3):
        middle = np.float32(0.5) * (inside + free)
        at = _nearest(world.height_m, nadir_x + (camera_m - middle) * x, nadir_y + (camera_m - middle) * y)
        hit = at >= middle
        inside, free = np.where(hit, middle, inside), np.where(hit, free, middle)
        surface = np.where(hit, at, surface)
    wall = surface > free + np.float32(0.2)
    return np.where(wall, inside, surface), wall


def _wall_colours(world: World, x: Float32, y: Float32, z_m: Float32) -> Image:
    """Colours (N, 3) of points on vertical faces: plaster darkening towards the street, rows of windows."""
    sides = _nearest(world.sides, x, y)
    storey = np.mod(z_m, np.float32(FLOOR_M))
    window = (sides[:, 3] > 0) & (storey > 0.9) & (storey < 2.3)
    shade = np.where(window, np.float32(0.45), np.float32(0.78) + np.minimum(z_m, 8.0) * np.float32(0.0275))
    return (sides[:, :3] * shade[:, None]).astype(np.uint8)


def _check_view(world: World, camera: Camera, height_agl_m: float) -> None:
    if camera.distorts:
        raise OptionError(f"camera: expected a pinhole without distortion, got {camera.distortion_model}")
    if not height_agl_m > float(world.height_m.max()):
        raise OptionError(
            f"height_agl_m: expected above the highest surface, {world.height_m.max():.1f} m, got {height_agl_m}"
        )


def render_frame(
    world: World,
    camera: Camera,
    grid_m: tuple[float, float],
    height_agl_m: float,
    attitude: Attitude,
    *,
    supersample: int | None = None,
) -> Image:
    """The picture (H, W, 3) RGB that a pinhole camera takes of a world, without the sensor's faults.

    Args:
        world: what is there; beyond its edge lies its outermost pixel on flat ground.
        camera: intrinsics and mount, without distortion.
        grid_m: the camera's (easting, northing) in the world's CRS.
        height_agl_m: above the flat ground, and above everything that stands on it.
        attitude: of the body, about true north.
        supersample: rays per pixel and axis; None takes as many as the world's raster deserves (1 to 4).

    Raises:
        OptionError: the camera distorts, looks above the horizon, or is not above the highest roof.
    """
    _check_view(world, camera, height_agl_m)
    if supersample is None:
        supersample = int(np.clip(round(height_agl_m / camera.focal_px / world.gsd_m_per_px), 1, 4))
    rays = _Rays.cast(world, camera, grid_m, height_agl_m, attitude, supersample)
    found, heights = _first_layer(world, rays)
    x, y = rays.per_metre()
    where = np.flatnonzero(found)
    far_x, far_y = x.ravel()[where], y.ravel()[where]
    z_m, wall = _refine(world, rays, far_x, far_y, heights[found.ravel()[where]], float(heights[1]))
    drop = np.full(found.shape, height_agl_m, np.float32)
    drop.reshape(-1)[where] -= z_m
    x, y = x * drop + np.float32(rays.nadir_px[0]), y * drop + np.float32(rays.nadir_px[1])
    picture = cv2.remap(world.rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    walls = where[wall]
    picture.reshape(-1, 3)[walls] = _wall_colours(world, x.ravel()[walls], y.ravel()[walls], z_m[wall])
    size = (camera.width_px, camera.height_px)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
