"""The built-in flight: the paper's setting over a simulated town, frames with telemetry, and the truth.

Everything comes from one seed; nothing is read or written.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import OptionError
from engine.geo import LocalFrame
from engine.sim.render import Sensor, render_frame, transformer
from engine.sim.town import GROUND_AMSL_M, Town, build_town, generator
from engine.sim.vehicle import FlightStyle, Motion, SensorNoise, fly, measure
from engine.types import Attitude, Frame, Truth

Array = NDArray[np.float64]

START_NS = 1_000_000_000
EDGE_M = 20.0
"""Distance that footprints keep from the map's edge when the camera hangs level."""
DRONE_SENSOR = Sensor(
    gamma=1.1,
    balance_rgb=(0.96, 1.02, 1.09),
    haze=0.0,
    vignette=0.1,
    exposure_sd=0.015,
    blur_px=0.45,
    noise_sd=2.5,
)
"""The drone's camera: cooler and harder than the map's."""


@dataclass(frozen=True)
class Plan:
    """A flight before its pictures are drawn.

    Attributes:
        town: what it flies over.
        camera: what it looks through.
        origin: of the local east-north-up frame of its motions: the map's centre.
        truth: the exact motion, one entry a frame.
        telemetry: the same as the sensors have it.
        timestamps_ns: capture times.
        seed: of the camera's noise.
    """

    town: Town
    camera: Camera
    origin: LocalFrame
    truth: Motion
    telemetry: Motion
    timestamps_ns: tuple[int, ...]
    seed: int

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def iter_frames(self) -> Iterator[Frame]:
        """Draw the frames one after the other."""
        rng = generator(self.seed, 0xCA)
        for k in range(len(self)):
            yield self._frame(k, rng)

    def _frame(self, k: int, rng: np.random.Generator) -> Frame:
        truth, told = self.truth, self.telemetry
        east, north, up = truth.position_m[k]
        lat, lon = self.origin.geodetic_from_enu(east, north)
        grid = transformer(self.town.crs_epsg).transform(float(lon), float(lat))
        attitude = Attitude(float(truth.roll_deg[k]), float(truth.pitch_deg[k]), float(truth.heading_deg[k]))
        seen = render_frame(self.town.world, self.camera, grid, float(up), attitude)
        return Frame(
            DRONE_SENSOR.develop(seen, rng),
            timestamp_ns=self.timestamps_ns[k],
            height_agl_m=float(told.position_m[k, 2]),
            heading_deg=float(told.heading_deg[k]),
            roll_deg=float(told.roll_deg[k]),
            pitch_deg=float(told.pitch_deg[k]),
            east_velocity_mps=float(told.velocity_mps[k, 0]),
            north_velocity_mps=float(told.velocity_mps[k, 1]),
        )

    def truth_rows(self) -> list[Truth]:
        """Where the camera really was, one row a frame."""
        motion = self.truth
        lat, lon = self.origin.geodetic_from_enu(motion.position_m[:, 0], motion.position_m[:, 1])
        return [
            Truth(
                timestamp_ns=stamp,
                lat_deg=float(lat[k]),
                lon_deg=float(lon[k]),
                alt_amsl_m=GROUND_AMSL_M + float(motion.position_m[k, 2]),
                height_agl_m=float(motion.position_m[k, 2]),
                roll_deg=float(motion.roll_deg[k]),
                pitch_deg=float(motion.pitch_deg[k]),
                heading_deg=float(motion.heading_deg[k]),
            )
            for k, stamp in enumerate(self.timestamps_ns)
        ]


@dataclass(frozen=True)
class SimulatedFlight:
    """A flight with its pictures drawn.

    Attributes:
        town: map, surface model and world.
        camera: what the frames were taken with.
        frames: pictures with noisy telemetry in them.
        truth: the exact poses, row for row with the frames.
        names: file names for the frames.
        description: one sentence for people.
    """

    town: Town
    camera: Camera
    frames: list[Frame]
    truth: list[Truth]
    names: list[str]
    description: str


def _waypoints(town: Town, camera: Camera, height_m: float, rng: np.random.Generator) -> Array:
    """Corners (5, 2) of the largest rectangle on which level footprints stay on the map, moved a little."""
    half_w, half_h = (0.5 * n * town.gsd_m_per_px for n in (town.ortho.shape[1], town.ortho.shape[0]))
    corner = np.linalg.inv(camera.matrix) @ (camera.width_px - 0.5, camera.height_px - 0.5, 1.0)
    reach = height_m * math.hypot(corner[0], corner[1]) + EDGE_M
    if min(half_w, half_h) - reach < 20.0:
        raise OptionError(
            f"town: expected a map larger than {2 * reach + 40:.0f} m for footprints seen from {height_m:.0f} m, "
            f"got {2 * half_w:.0f} x {2 * half_h:.0f} m"
        )
    square = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1], [-0.95, -0.9]]) * (half_w - reach, half_h - reach)
    return np.asarray(square - np.sign(square) * rng.uniform(0.0, 6.0, square.shape))


def _check_frames(frames: int | None, rate_hz: float) -> None:
    if frames is not None and frames < 1:
        raise OptionError(f"frames: expected 1 or more, got {frames}")
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise OptionError(f"rate_hz: expected above 0, got {rate_hz}")


def plan_flight(
    seed: int = 1,
    *,
    frames: int | None = None,
    rate_hz: float = 1.12,
    light: str = "noon",
    noise: SensorNoise | None = None,
    style: FlightStyle | None = None,
    town: Town | None = None,
    camera: Camera | None = None,
) -> Plan:
    """Plan the paper's flight: 150 m up, 7 m/s, four legs round the map with a stop at every corner.

    Args:
        seed: of town, path, sensors and camera.
        frames: how many, from take-off on; None flies to the end (about 150).
        rate_hz: frames per second.
        light: of the frames, "noon" or "evening"; ignored where a town is given.
        noise: of the telemetry; None takes the defaults, as for the style.
        style: of flying.
        town: to fly over; None builds the seed's.
        camera: None takes the paper's, 300 x 300 px with 60 degrees.

    Raises:
        OptionError: an argument is out of range, or the map is too small for the height.
    """
    _check_frames(frames, rate_hz)
    style, camera = style or FlightStyle(), camera or Camera.from_fov(300, 300, 60.0)
    town = town or build_town(seed, light=light)
    rng = generator(seed, 0xF1)
    motion = fly(_waypoints(town, camera, style.height_agl_m, rng), style, rng)
    count = int(motion.time_s[-1] * rate_hz) + 1
    stamps = np.rint(np.arange(min(count, frames or count)) * 1e9 / rate_hz).astype(np.int64)
    truth = motion.at(stamps * 1e-9)
    middle = town.pixel_to_crs @ ((town.ortho.shape[1] - 1) / 2, (town.ortho.shape[0] - 1) / 2, 1.0)
    lon, lat = transformer(town.crs_epsg).transform(*middle, direction="INVERSE")
    told = measure(truth, noise or SensorNoise(), generator(seed, 0x5E))
    return Plan(town, camera, LocalFrame(lat, lon), truth, told, tuple((START_NS + stamps).tolist()), seed)


def paper_flight(
    seed: int = 1,
    *,
    frames: int | None = None,
    rate_hz: float = 1.12,
    light: str = "noon",
    noise: SensorNoise | None = None,
    style: FlightStyle | None = None,
    town: Town | None = None,
    camera: Camera | None = None,
) -> SimulatedFlight:
    """Fly the paper's flight and draw it; the arguments and errors are those of :func:`plan_flight`."""
    plan = plan_flight(
        seed, frames=frames, rate_hz=rate_hz, light=light, noise=noise, style=style, town=town, camera=camera
    )
    names = [f"frame_{k:06d}.png" for k in range(len(plan))]
    height = (style or FlightStyle()).height_agl_m
    description = (
        f"Simulated town (seed {seed}, {light}): "
        f"{len(plan)} frames at {rate_hz:g} Hz from {height:g} m above ground"
    )
    return SimulatedFlight(plan.town, plan.camera, list(plan.iter_frames()), plan.truth_rows(), names, description)
