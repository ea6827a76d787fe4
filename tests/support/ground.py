"""Ground whose pictures are drawn ray by ray.

Its pictures share no line with the engine: rays are turned vector by vector, places on the Earth go through PROJ's
own topocentric frame, and grey levels come from a spline, for the map and for the frames alike.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from pyproj import Transformer
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from engine import Camera, Fix, Frame, OrthoMap, Prior

CAMERA = Camera.from_fov(300, 300, 60.0)
"""The paper's: straight down."""

LATTICE_M = 0.5


def body_axes(roll_deg, pitch_deg, heading_deg):
    """Forward, right and down of the body in east-north-up: the nose turned, then lifted, then a wing dropped."""
    r, p, h = map(math.radians, (roll_deg, pitch_deg, heading_deg))
    forward = np.array([math.sin(h), math.cos(h), 0.0])
    right = np.array([math.cos(h), -math.sin(h), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    forward, down = math.cos(p) * forward - math.sin(p) * down, math.cos(p) * down + math.sin(p) * forward
    right, down = math.cos(r) * right + math.sin(r) * down, math.cos(r) * down - math.sin(r) * right
    return forward, right, down


def rays_of(camera, xy_px, *, roll_deg=0.0, pitch_deg=0.0, heading_deg=0.0):
    """Rays (..., 3) of pixels (..., 2) in east-north-up.

    The camera hangs below the body and its picture's top points to the nose: right in the picture is right of
    the body, down in the picture is to the tail, into the picture is down.
    """
    forward, right, down = body_axes(roll_deg, pitch_deg, heading_deg)
    x = (np.asarray(xy_px, float)[..., 0] - camera.matrix[0, 2]) / camera.matrix[0, 0]
    y = (np.asarray(xy_px, float)[..., 1] - camera.matrix[1, 2]) / camera.matrix[1, 1]
    return down + x[..., None] * right - y[..., None] * forward


def pixels_of(rows, columns):
    """(H, W, 2) x and y of every pixel."""
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)


@lru_cache(maxsize=8)
def texture_of(seed, count):
    """Spline coefficients (N, N) of grey levels: grounds that differ in their place alone have one texture."""
    rng = np.random.default_rng(seed)
    fine = gaussian_filter(rng.standard_normal((count, count)), 2.0)
    broad = gaussian_filter(rng.standard_normal((count, count)), 6.0)
    mixed = fine / fine.std() + broad / broad.std()
    return spline_filter(128.0 + 40.0 * mixed / mixed.std(), order=3)


@dataclass(frozen=True)
class Ground:
    """Flat ground with a random smooth texture, its map, and pictures of it from anywhere.

    The texture is a function of true east and north about the map's centre, so that the map's projection
    enters only where PROJ puts it.
    """

    epsg: int = 32633
    lat_deg: float = 48.25
    lon_deg: float = 15.0
    gsd_m: float = 0.5
    size: tuple[int, int] = (600, 640)
    seed: int = 5

    @property
    def _texture(self):
        return texture_of(self.seed, int(2.2 * max(self.size) * self.gsd_m / LATTICE_M))

    def levels(self, east_m, north_m):
        """Grey level, unrounded, at true east and north."""
        middle = (self._texture.shape[0] - 1) / 2
        at = np.stack([middle - north_m / LATTICE_M, middle + east_m / LATTICE_M])
        return map_coordinates(self._texture, at, order=3, mode="mirror", prefilter=False)

    @cached_property
    def _grid(self):
        return Transformer.from_crs(4326, self.epsg, always_xy=True)

    @cached_property
    def pixel_to_crs(self):
        """(2, 3): the map's middle lies on the ground's latitude and longitude."""
        x, y = self._grid.transform(self.lon_deg, self.lat_deg)
        rows, columns = self.size
        left, top = x - self.gsd_m * (columns - 1) / 2, y + self.gsd_m * (rows - 1) / 2
        return np.array([[self.gsd_m, 0.0, left], [0.0, -self.gsd_m, top]])

    @cached_property
    def _topocentric(self):
        place = f"+lat_0={self.lat_deg} +lon_0={self.lon_deg} +ellps=WGS84"
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f"+step +proj=cart +ellps=WGS84 +step +proj=topocentric {place}"
        )

    def enu_from_pixel(self, xy_px):
        """True east and north (..., 2) about the map's centre, by PROJ."""
        grid = np.asarray(xy_px, float) @ self.pixel_to_crs[:, :2].T + self.pixel_to_crs[:, 2]
        lon, lat = self._grid.transform(grid[..., 0], grid[..., 1], direction="INVERSE")
        east, north, _ = self._topocentric.transform(lon, lat, np.zeros_like(lon))
        return np.stack([east, north], axis=-1)

    @cached_property
    def gray(self):
        return self.seen_at(self.enu_from_pixel(pixels_of(*self.size)))

    def map_of(self, gray=None, **more):
        """Its map, or one of another picture in its place, with what more there is of it."""
        gray = self.gray if gray is None else gray
        return OrthoMap.from_arrays(gray, self.pixel_to_crs, f"EPSG:{self.epsg}", **more)

    @cached_property
    def site(self):
        return self.map_of()

    @cached_property
    def flat_site(self):
        """With a surface model that says how flat it is: only then is a pose refined."""
        return self.map_of(surface_m=np.zeros(self.size, np.float32))

    def seen_at(self, enu_m):
        """A picture (H, W) of the places (H, W, 2) that its pixels show."""
        return np.clip(np.rint(self.levels(enu_m[..., 0], enu_m[..., 1])), 0, 255).astype(np.uint8)

    def picture(self, camera, nadir_px, height_m, **attitude):
        """What the camera sees above a map pixel (x, y)."""
        return self.picture_from(camera, self.enu_from_pixel(nadir_px), height_m, **attitude)

    def picture_from(self, camera, place_m, height_m, **attitude):
        """What the camera sees above true east and north: one ray a pixel, onto flat ground."""
        rays = rays_of(camera, pixels_of(camera.height_px, camera.width_px), **attitude)
        return self.seen_at(place_m + rays[..., :2] * (height_m / -rays[..., 2:]))

    def frame(self, camera, nadir_px, height_m=150.0, *, timestamp_ns=0, **attitude):
        """The picture with the telemetry that is true of it."""
        stated = {"roll_deg": 0.0, "pitch_deg": 0.0, "heading_deg": 0.0, **attitude}
        image = self.picture(camera, nadir_px, height_m, **attitude)
        return Frame(image, timestamp_ns=timestamp_ns, height_agl_m=height_m, **stated)

    def prior(self, nadir_px, sigma_m=8.0, off_m=(5.0, -4.0)):
        """A prior some metres off a map pixel."""
        east, north = self.enu_from_pixel(nadir_px) + off_m
        return Prior(east_m=float(east), north_m=float(north), sigma_m=sigma_m)

    def off_m(self, fix, nadir_px):
        """(2,) metres east and north of a map pixel."""
        assert isinstance(fix, Fix), fix
        return np.array([fix.east_m, fix.north_m]) - self.enu_from_pixel(nadir_px)

    def chi_square(self, fix, nadir_px):
        """The squared error of a fix in sigmas of its own, of two degrees of freedom."""
        off_m = self.off_m(fix, nadir_px)
        return float(off_m @ np.linalg.solve(fix.covariance_m2[:2, :2], off_m))
