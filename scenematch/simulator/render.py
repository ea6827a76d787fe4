"""Render an ideal camera's picture of a world: rays against a height field, with air and water.

Convention:
    A world is a raster seen from straight above: colour and height of the highest surface at every pixel.
    Heights are metres above flat ground at 0. Positions are metres in the raster's projected CRS; attitude is
    about true north, so grid convergence and point scale enter through the grid's local Jacobian. Beyond its edge
    the world is mirrored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import OptionError
from engine.geo import LocalFrame
from engine.values import Attitude, check_positive
from scenematch.simulator.light import Array, Float32, Image, Light
from scenematch.simulator.rays import Rays, stretch

LAYER_M = 1.0
"""Height step in the search for a ray's first surface; thinner structures may be missed."""
SLOPE_VARIANCE, GLINT = 0.02, 0.9
"""Variance of the slopes of ripples in a light breeze, and the sun's brightness if all facets mirror it."""
SKY_RGB = (200.0, 208.0, 218.0)
"""The sky if the air has no colour of its own."""
_GRAZING = 1.2  # tangent of the angle from the vertical beyond which surfaces are searched more finely
FLOOR_M = 3.0
"""Height of one storey: the pitch of the rows of windows."""


@dataclass(frozen=True)
class Atmosphere:
    """Air between camera and ground: a contrast fades by exp(-3.912 d / visibility) (Koschmieder).

    Attributes:
        visibility_m: distance at which 2 % of a contrast is left.
        rgb: the air's own colour in grey levels.

    Raises:
        OptionError: the visibility is not above 0.
    """

    visibility_m: float
    rgb: tuple[float, float, float] = (196.0, 202.0, 210.0)

    def __post_init__(self) -> None:
        check_positive(self, "visibility_m")


@dataclass(frozen=True, eq=False)
class Glint:
    """The sun on water: facets of ripples that reflect it to the lens (Cox and Munk's Gaussian slopes).

    Attributes:
        light: with the sun to reflect.
        water: (H, W) uint8, above 0 where there is water.
    """

    light: Light
    water: Image


@dataclass(frozen=True)
class World:
    """A height field with colours, under one light.

    Attributes:
        rgb: (H, W, 3) colours as seen from above, light and shadows included.
        sides: (H, W, 4) colour of the vertical face next to a pixel; the fourth is 255 in columns of windows.
        height_m: (H, W) of the highest surface above the world's height 0, never negative; 0 on flat ground.
        pixel_to_crs: (2, 3) affine from pixels (x, y), centres at integers, to the projected CRS.
        crs_epsg: code of that CRS.
        ground_m: (H, W) of the bare ground if it is not flat at 0.
        air: between camera and ground; None if perfectly clear.
        glint: the sun on water; None for none.
    """

    rgb: Image
    sides: Image
    height_m: Float32
    pixel_to_crs: Array
    crs_epsg: int
    ground_m: Float32 | None = None
    air: Atmosphere | None = None
    glint: Glint | None = None

    @cached_property
    def gsd_m_per_px(self) -> float:
        """A pixel in grid metres."""
        return math.sqrt(abs(float(np.linalg.det(self.pixel_to_crs[:, :2]))))

    def ground_at(self, grid_m: tuple[float, float]) -> float:
        """Height of the bare ground at (easting, northing), from the nearest pixel."""
        if self.ground_m is None:
            return 0.0
        xy = np.linalg.inv(self.pixel_to_crs[:, :2]) @ (np.asarray(grid_m) - self.pixel_to_crs[:, 2])
        x, y = xy.astype(np.float32)[:, None]
        return float(_nearest(self.ground_m, x, y)[0])

    @cached_property
    def _coarse_height(self) -> tuple[Image, float]:
        """Heights (H, W) quantised to bytes, rounded up, and the unit in metres; the layer search reads them."""
        unit = max(float(self.height_m.max()), 1e-3) / 254.0
        return np.ceil(self.height_m / np.float32(unit)).astype(np.uint8), unit


@lru_cache(maxsize=8)
def transformer(crs_epsg: int) -> Any:
    """The transformer from WGS84 (longitude, latitude) in degrees to the CRS."""
    from pyproj import Transformer

    return Transformer.from_crs(4326, crs_epsg, always_xy=True)


def grid_from_enu(crs_epsg: int, grid_m: tuple[float, float]) -> Array:
    """Jacobian at a grid position: grid metres per metre of true east and north.

    Its rotation is the meridian convergence of the projection, its scale the point scale.

    Args:
        crs_epsg: code of the projected CRS.
        grid_m: (easting, northing).

    Returns:
        (2, 2) d(easting, northing) / d(east, north).
    """
    to_grid = transformer(crs_epsg)
    lon, lat = to_grid.transform(*grid_m, direction="INVERSE")
    step = np.array([50.0, -50.0, 0.0, 0.0])
    lats, lons = LocalFrame(lat, lon).geodetic_from_enu(step, step[::-1])
    x, y = to_grid.transform(lons, lats)
    return np.array([[x[0] - x[1], x[3] - x[2]], [y[0] - y[1], y[3] - y[2]]]) / 100.0


def _first_layer(world: World, rays: Rays) -> tuple[Image, Float32]:
    """For every ray, the first layer from the top that is inside something, and the layers' heights.

    Returns:
        Layers (H, W), 0 for none, and heights by layer, index 0 the ground, rising.
    """
    coarse, unit = world._coarse_height
    top = float(world.height_m.max())
    count = int(np.clip(math.ceil(top / LAYER_M), 1, 254))
    heights = np.linspace(0.0, top, count + 1).astype(np.float32)
    every = np.zeros(rays.size[::-1], np.uint8)
    first = rays.rows_of_sky
    found, below = every[first:], np.array([[1.0, 0, 0], [0, 1.0, first], [0, 0, 1.0]])
    flags, mirrored = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP, cv2.BORDER_REFLECT
    for layer in range(1, count):
        homography = rays.homography(float(heights[layer])) @ below
        seen = cv2.warpPerspective(coarse, homography, found.shape[::-1], flags=flags, borderMode=mirrored)
        _, inside = cv2.threshold(seen, math.floor(heights[layer] / unit), layer, cv2.THRESH_BINARY)
        cv2.max(found, inside, found)
    return every, heights


def _nearest(raster: NDArray[Any], x: Float32, y: Float32) -> NDArray[Any]:
    return raster[_mirrored(y, raster.shape[0]), _mirrored(x, raster.shape[1])]


def _mirrored(place: Float32, size: int) -> NDArray[np.int32]:
    """Integer indices along an axis that is mirrored at its ends."""
    index = np.rint(place).astype(np.int32)
    if index.size and (index.min() < 0 or index.max() >= size):
        index = np.mod(index, 2 * size)
        index = np.minimum(index, 2 * size - 1 - index)
    return index


def _intersect(world: World, rays: Rays, x: Float32, y: Float32, low: Float32, step: float) -> tuple[Any, Any]:
    """Height at which rays meet the surface, and whether from the side.

    Bisects between the layer inside and the free layer above it; a surface above the free end is a wall; any other
    is a roof, and its own height places the texture exactly.
    """
    nadir_x, nadir_y = (np.float32(v) for v in rays.nadir_px)
    camera_m = np.float32(rays.camera_m)
    inside, free = low.copy(), low + np.float32(step)
    surface = _nearest(world.height_m, nadir_x + (camera_m - inside) * x, nadir_y + (camera_m - inside) * y)
    for _ in range(3 if rays.steepness < _GRAZING else 6):
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
    if world.ground_m is not None:
        z_m = np.maximum(z_m - _nearest(world.ground_m, x, y), np.float32(0.0))
    storey = np.mod(z_m, np.float32(FLOOR_M))
    window = (sides[:, 3] > 0) & (storey > 0.9) & (storey < 2.3)
    shade = np.where(window, np.float32(0.45), np.float32(0.78) + np.minimum(z_m, 8.0) * np.float32(0.0275))
    return (sides[:, :3] * shade[:, None]).astype(np.uint8)


def _add_glint(picture: Image, glint: Glint, x: Float32, y: Float32, toward: tuple[Float32, Float32]) -> None:
    """Add the sun's glint on water, in place.

    Args:
        picture: (H, W, 3), changed in place.
        glint: sun and water.
        x: (H, W) visible columns of the world.
        y: (H, W) visible rows.
        toward: metres (H, W) right and down that each ray travels per metre of height, seen from the lens.
    """
    where = _nearest(glint.water, x, y) > 0
    if not where.any():
        return
    right, down = (component[where] for component in toward)
    length = np.sqrt(right**2 + down**2 + np.float32(1.0))
    # The normal of the reflecting facet is halfway between both directions.
    half = [-right / length, -down / length, 1.0 / length]
    half = [part + np.float32(sun) for part, sun in zip(half, glint.light.towards_sun, strict=True)]
    slope = (half[0] ** 2 + half[1] ** 2) / half[2] ** 2
    flash = np.exp(-slope / np.float32(SLOPE_VARIANCE)) * np.float32(GLINT)
    lit = picture[where] + flash[:, None] * np.array(glint.light.sun_rgb, np.float32) * np.float32(255.0)
    picture[where] = np.minimum(lit, 255.0).astype(np.uint8)


def _after_light(
    world: World, picture: Image, at: tuple[Float32, Float32], per_metre: tuple[Float32, Float32], drop: Float32
) -> Image:
    """The picture with the glint of water, then the air between surface and lens."""
    if world.glint is None and world.air is None:
        return picture
    right, down = (pixels * np.float32(world.gsd_m_per_px) for pixels in per_metre)
    if world.glint is not None:
        _add_glint(picture, world.glint, *at, (right, down))
    if world.air is not None:
        slant_m = drop * np.sqrt(1.0 + right**2 + down**2)
        left = np.exp(np.float32(-3.912 / world.air.visibility_m) * slant_m)[..., None]
        mixed: Float32 = picture * left + np.array(world.air.rgb, np.float32) * (np.float32(1.0) - left)
        picture = mixed.astype(np.uint8)
    return picture


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
    """Render a pinhole camera's picture of a world, without noise and exposure.

    Args:
        world: what is seen; mirrored beyond its edge, and sky from 84 degrees off the vertical.
        camera: intrinsics and mount, without distortion.
        grid_m: the camera's (easting, northing) in the world's CRS.
        height_agl_m: above the world's height 0 (the flat ground), and above its highest surface.
        attitude: of the body, about true north.
        supersample: rays per pixel and axis; None depends on the world's resolution (1 to 4).

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        OptionError: the camera distorts, its axis is more than 75 degrees off the vertical, or it is not above the
            highest roof.
    """
    _check_view(world, camera, height_agl_m)
    px_from_grid = np.linalg.inv(world.pixel_to_crs[:, :2])
    nadir_px = px_from_grid @ (np.asarray(grid_m) - world.pixel_to_crs[:, 2])
    pose = px_from_grid @ grid_from_enu(world.crs_epsg, grid_m), nadir_px, height_agl_m
    if supersample is None:
        pixel_m = height_agl_m / camera.focal_px * stretch(camera, attitude)
        supersample = int(np.clip(round(pixel_m / world.gsd_m_per_px), 1, 4))
    rays = Rays.cast(camera, attitude, *pose, supersample)
    size = (camera.width_px, camera.height_px)
    return np.asarray(cv2.resize(_trace(world, rays), size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _trace(world: World, rays: Rays) -> Image:
    """Colours (H, W, 3) along all rays, supersampled."""
    found, heights = _first_layer(world, rays)
    per_metre = x, y = rays.per_metre()
    # On flat ground, a ray that met no layer ends at 0; on hills, each ray is intersected with the ground below
    # it.
    where = np.flatnonzero(found) if world.ground_m is None else np.arange(found.size)
    far_x, far_y = x.ravel()[where], y.ravel()[where]
    z_m, wall = _intersect(world, rays, far_x, far_y, heights[found.ravel()[where]], float(heights[1]))
    drop = np.full(found.shape, rays.camera_m, np.float32)
    drop.reshape(-1)[where] -= z_m
    x, y = x * drop + np.float32(rays.nadir_px[0]), y * drop + np.float32(rays.nadir_px[1])
    picture: Any = cv2.remap(world.rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    walls = where[wall]
    picture.reshape(-1, 3)[walls] = _wall_colours(world, x.ravel()[walls], y.ravel()[walls], z_m[wall])
    return _below_sky(world, rays, _after_light(world, picture, (x, y), per_metre, drop))


def _below_sky(world: World, rays: Rays, picture: Image) -> Image:
    """The picture (H, W, 3) with its far field faded into the sky."""
    if not rays.sees_sky:
        return picture
    sky = np.array(SKY_RGB if world.air is None else world.air.rgb, np.float32)
    return np.asarray(picture + (sky - picture) * rays.sky_share()[..., None]).astype(np.uint8)
