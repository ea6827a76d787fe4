"""The built-in flight: the paper's setting over a simulated town, frames with telemetry, and the truth.

Everything comes from one seed; nothing is read or written.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from engine.camera import NADIR_PITCH_DEG, Camera
from engine.errors import OptionError
from engine.geo import Array, LocalFrame
from engine.values import Attitude, Frame, Truth
from scenematch.simulator.light import Float32, Image
from scenematch.simulator.optics import Sensor, through_lens
from scenematch.simulator.render import transformer
from scenematch.simulator.town import Town, build_town, generator
from scenematch.simulator.vehicle import (
    START_NS,
    FlightStyle,
    Motion,
    SensorNoise,
    fly_waypoints,
    simulate_telemetry,
)

EDGE_M = 20.0
"""Distance of footprints from the map's edge while the camera looks straight down."""
DRONE_SENSOR = Sensor(
    gamma=1.1,
    balance_rgb=(0.96, 1.02, 1.09),
    haze=0.0,
    vignette=0.1,
    exposure_sd=0.015,
    blur_px=0.45,
    noise_sd=2.5,
)
"""The drone's camera: a cooler white balance and more contrast than the map's."""


def grid_at(town: Town, origin: LocalFrame, east_north_m: Array) -> tuple[float, float]:
    """Easting and northing of a position in the local frame.

    Args:
        town: provides the CRS.
        origin: of the local frame.
        east_north_m: (2,) or (3,) east and north in metres; further values are ignored.

    Returns:
        (easting, northing) in metres in the town's CRS.
    """
    lat, lon = origin.geodetic_from_enu(float(east_north_m[0]), float(east_north_m[1]))
    easting, northing = transformer(town.crs_epsg).transform(float(lon), float(lat))
    return easting, northing


def picture_at(
    town: Town,
    camera: Camera,
    origin: LocalFrame,
    east_north_up_m: Array,
    attitude: Attitude,
    rng: np.random.Generator,
    *,
    moments: Sequence[Float32] = (),
) -> Image:
    """The picture from a camera at a position.

    Args:
        town: the scene.
        camera: intrinsics and mount.
        origin: of the local east-north-up frame.
        east_north_up_m: (3,) the camera's position in it, up above the world's height 0.
        attitude: of the body, about true north.
        rng: of the sensor's noise and exposure.
        moments: of the exposure, see :func:`scenematch.simulator.optics.through_lens`.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        OptionError: the camera looks above the horizon, or is not above the highest roof.
    """
    grid, up = grid_at(town, origin, east_north_up_m), float(east_north_up_m[2])
    seen = through_lens(town.world, camera, grid, up, attitude, moments)
    return town.condition.sensor(DRONE_SENSOR).develop(seen, rng)


def truth_at(town: Town, origin: LocalFrame, timestamp_ns: int, position_m: Array, attitude: Attitude) -> Truth:
    """The true pose of a vehicle.

    Args:
        town: that it flies over.
        origin: of the local east-north-up frame.
        timestamp_ns: of the pose.
        position_m: (3,) east, north and up in that frame.
        attitude: of its body.

    Returns:
        Truth: with heights above the sea and above the ground below it.
    """
    east, north, up = (float(v) for v in position_m)
    lat, lon = origin.geodetic_from_enu(east, north)
    return Truth(
        timestamp_ns=timestamp_ns,
        lat_deg=float(lat),
        lon_deg=float(lon),
        alt_amsl_m=town.datum_amsl_m + up,
        height_agl_m=up - town.world.ground_at(grid_at(town, origin, position_m)),
        roll_deg=attitude.roll_deg,
        pitch_deg=attitude.pitch_deg,
        heading_deg=attitude.heading_deg,
    )


@dataclass(frozen=True)
class FlightPlan:
    """A flight before its pictures are rendered.

    Attributes:
        town: the ground flown over.
        camera: of the drone.
        origin: of the local east-north-up frame of its motions: the map's centre; up from the world's height 0.
        motion: the exact motion from take-off to landing.
        truth: the same, one entry per frame.
        telemetry: the motion as the sensors measure it.
        timestamps_ns: capture times.
        seed: of the camera's noise.
    """

    town: Town
    camera: Camera
    origin: LocalFrame
    motion: Motion
    truth: Motion
    telemetry: Motion
    timestamps_ns: tuple[int, ...]
    seed: int

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def iter_frames(self) -> Iterator[Frame]:
        """Render the frames one by one, each with its telemetry."""
        rng = generator(self.seed, 0xCA)
        for k in range(len(self)):
            yield self._frame(k, rng)

    def moments(self, k: int) -> Sequence[Float32]:
        """Moments of a picture's exposure; none freezes motion.

        Args:
            k: index of the frame.

        Returns:
            (H, W, 2) each, see :func:`scenematch.simulator.optics.through_lens`.
        """
        return ()

    def _frame(self, k: int, rng: np.random.Generator) -> Frame:
        telemetry, position_m = self.telemetry, self.truth.position_m[k]
        ground_m = self.town.world.ground_at(grid_at(self.town, self.origin, position_m))
        where = self.town, self.camera, self.origin, position_m, self.attitude(k), rng
        return Frame(
            picture_at(*where, moments=self.moments(k)),
            timestamp_ns=self.timestamps_ns[k],
            height_agl_m=float(telemetry.position_m[k, 2]) - ground_m,
            heading_deg=float(telemetry.heading_deg[k]),
            roll_deg=float(telemetry.roll_deg[k]),
            pitch_deg=float(telemetry.pitch_deg[k]),
            east_velocity_mps=float(telemetry.velocity_mps[k, 0]),
            north_velocity_mps=float(telemetry.velocity_mps[k, 1]),
        )

    def attitude(self, k: int) -> Attitude:
        """The true one at a frame."""
        truth = self.truth
        return Attitude(float(truth.roll_deg[k]), float(truth.pitch_deg[k]), float(truth.heading_deg[k]))

    def truth_rows(self) -> list[Truth]:
        """True poses of the camera, one row per frame."""
        return [
            truth_at(self.town, self.origin, stamp, self.truth.position_m[k], self.attitude(k))
            for k, stamp in enumerate(self.timestamps_ns)
        ]


def paper_camera(pitch_deg: float = NADIR_PITCH_DEG) -> Camera:
    """The paper's camera, 300 x 300 px with 60 degrees.

    Args:
        pitch_deg: of its axis from the body's horizontal, as gimbals state it: -90 looks straight down, -45
            halfway up towards the nose.
    """
    camera = Camera.from_fov(300, 300, 60.0)
    up = math.radians(pitch_deg - NADIR_PITCH_DEG)
    turn = np.array([[math.cos(up), 0.0, math.sin(up)], [0.0, 1.0, 0.0], [-math.sin(up), 0.0, math.cos(up)]])
    return camera if pitch_deg == NADIR_PITCH_DEG else replace(camera, mount=turn @ camera.mount)


def reach_m(camera: Camera, height_m: float) -> float:
    """How far a level camera sees in metres: to the corners of a nadir picture, to the centre of an oblique one.

    Args:
        camera: intrinsics and mount.
        height_m: above the ground.
    """
    corner = np.linalg.inv(camera.matrix) @ (camera.width_px - 0.5, camera.height_px - 0.5, 1.0)
    axis = camera.mount[:, 2]
    return height_m * max(math.hypot(corner[0], corner[1]), math.hypot(axis[0], axis[1]) / float(axis[2]))


def _waypoints(town: Town, camera: Camera, height_m: float, rng: np.random.Generator) -> Array:
    """Corners (5, 2) of the largest rectangle whose level footprints lie on the map, jittered.

    For an oblique camera, the centre of the footprint counts.
    """
    half_w, half_h = (0.5 * n * town.gsd_m_per_px for n in (town.ortho.shape[1], town.ortho.shape[0]))
    reach = reach_m(camera, height_m) + EDGE_M
    if min(half_w, half_h) - reach < 20.0:
        raise OptionError(
            f"town: expected a map larger than {2 * reach + 40:.0f} m for footprints seen from {height_m:.0f} m, "
            f"got {2 * half_w:.0f} x {2 * half_h:.0f} m"
        )
    square = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1], [-0.95, -0.9]]) * (half_w - reach, half_h - reach)
    return np.asarray(square - np.sign(square) * rng.uniform(0.0, 6.0, square.shape))


def plan_flight(
    seed: int = 1,
    *,
    frames: int | None = None,
    rate_hz: float = 1.12,
    noise: SensorNoise | None = None,
    style: FlightStyle | None = None,
    town: Town | None = None,
    camera: Camera | None = None,
    **town_options: Any,
) -> FlightPlan:
    """Plan the paper's flight: 150 m up, 7 m/s, four legs round the map with a stop at every corner.

    Args:
        seed: of town, path, sensors and camera.
        frames: how many, from take-off on; None flies to the end (about 150).
        rate_hz: frames per second.
        noise: of the telemetry; None uses the defaults, also for the style.
        style: of flying.
        town: to fly over; None builds the seed's by ``town_options``.
        camera: None uses the paper's, 300 x 300 px with 60 degrees.
        **town_options: of the town, see :func:`scenematch.simulator.build_town`; ignored if a town is given. Over
            hills the flight keeps its height above the ground at its start.

    Raises:
        OptionError: an argument is out of range, or the map is too small for the height.
    """
    if frames is not None and frames < 1:
        raise OptionError(f"frames: expected 1 or more, got {frames}")
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise OptionError(f"rate_hz: expected above 0, got {rate_hz}")
    style, camera = style or FlightStyle(), camera or paper_camera()
    town = town or build_town(seed, **town_options)
    motion, origin = _fly_over(town, camera, style, generator(seed, 0xF1))
    count = int(motion.time_s[-1] * rate_hz) + 1
    stamps_ns = np.rint(np.arange(min(count, frames or count)) * 1e9 / rate_hz).astype(np.int64)
    time_s = np.asarray(stamps_ns * 1e-9, np.float64)
    truth = motion.at(time_s)
    telemetry = simulate_telemetry(truth, noise or SensorNoise(), generator(seed, 0x5E))
    stamps = tuple((START_NS + stamps_ns).tolist())
    return FlightPlan(town, camera, origin, motion, truth, telemetry, stamps, seed)


def _fly_over(
    town: Town, camera: Camera, style: FlightStyle, rng: np.random.Generator
) -> tuple[Motion, LocalFrame]:
    """The motion round the map, up from the world's height 0, and the local frame at the map's centre."""
    middle = town.pixel_to_crs @ ((town.ortho.shape[1] - 1) / 2, (town.ortho.shape[0] - 1) / 2, 1.0)
    lon, lat = transformer(town.crs_epsg).transform(*middle, direction="INVERSE")
    origin = LocalFrame(lat, lon)
    motion = fly_waypoints(_waypoints(town, camera, style.height_agl_m, rng), style, rng)
    motion.position_m[:, 2] += town.world.ground_at(grid_at(town, origin, motion.position_m[0]))
    return motion, origin
