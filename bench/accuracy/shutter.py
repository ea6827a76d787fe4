"""A simulated flight whose camera's shutter takes time: motion blur and rolling shutter.

Convention:
    A picture's timestamp is the middle of the exposure of its middle row. During these milliseconds the vehicle
    moves and turns uniformly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from engine import Attitude, Camera
from engine.geo import Array, enu_from_body, wrap_difference_deg
from scenematch.simulator import FlightPlan
from scenematch.simulator.flight import grid_at
from scenematch.simulator.light import Float32
from scenematch.simulator.optics import lens_rays
from scenematch.simulator.vehicle import COURSE_STEP_S, START_NS


@dataclass(frozen=True, kw_only=True)
class Shutter:
    """Exposure time and shutter of a camera.

    Attributes:
        exposure_ms: exposure of each row; motion during it blurs the row. 0 freezes motion.
        readout_ms: from the first row to the last; each row sees another pose (rolling shutter). 0 is a global
            shutter.
        exposure_samples: number of poses averaged for motion blur.
    """

    exposure_ms: float = 0.0
    readout_ms: float = 0.0
    exposure_samples: int = 5


@dataclass(frozen=True)
class ShutterFlight(FlightPlan):
    """A flight by a camera with such a shutter."""

    shutter: Shutter = field(kw_only=True)

    @classmethod
    def of(cls, plan: FlightPlan, shutter: Shutter) -> ShutterFlight:
        """The flight of a plan."""
        return cls(**{each.name: getattr(plan, each.name) for each in fields(plan)}, shutter=shutter)

    def sway(self, k: int) -> tuple[Array, Array]:
        """(3,) velocity and (3,) change of roll, pitch and heading in degrees a second at a frame."""
        time_s = np.array([1e-9 * (self.timestamps_ns[k] - START_NS)])
        before, now, after = (self.motion.at(time_s + step) for step in (-COURSE_STEP_S, 0.0, COURSE_STEP_S))
        angles = ("roll_deg", "pitch_deg", "heading_deg")
        ways = np.array([getattr(after, name)[0] - getattr(before, name)[0] for name in angles])
        return now.velocity_mps[0], wrap_difference_deg(ways) / (2.0 * COURSE_STEP_S)

    def moments(self, k: int) -> Sequence[Float32]:
        """What the rows see at each time of the exposure."""
        position_m = self.truth.position_m[k]
        height_m = float(position_m[2]) - self.town.world.ground_at(grid_at(self.town, self.origin, position_m))
        return row_rays(self.camera, self.attitude(k), height_m, self.shutter, *self.sway(k))


def row_rays(
    camera: Camera, attitude: Attitude, height_m: float, shutter: Shutter, velocity_mps: Array, turn_dps: Array
) -> list[Float32]:
    """For each time of the exposure, the rays (H, W, 2), x / z and y / z, in the pose at the timestamp.

    A ray d of a camera displaced by s meets the ground where d - s d_z / h of the undisplaced one does.
    """
    start = np.array([attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg])
    cam_from_enu = camera.enu_from_camera(attitude).T

    def seen_after(time_s: float) -> Array:
        shear = np.eye(3)
        shear[:, 2] -= time_s * np.asarray(velocity_mps) / height_m
        return cam_from_enu @ shear @ enu_from_body(*(start + time_s * np.asarray(turn_dps))) @ camera.mount

    rays, half_s = lens_rays(camera), 0.5e-3 * shutter.readout_ms
    share = np.linspace(0.0, 1.0, camera.height_px)[:, None, None]
    count = shutter.exposure_samples if shutter.exposure_ms > 0.0 else 1
    times_s = ((np.arange(count) + 0.5) / count - 0.5) * shutter.exposure_ms * 1e-3
    found = []
    for time_s in times_s.tolist():
        # A readout lasts tens of milliseconds, so matrices change linearly from its first to its last row.
        first, last = (seen_after(time_s + end_s) for end_s in (-half_s, half_s))
        rows = (first + share * (last - first)).astype(np.float32)
        seen = rays @ rows.transpose(0, 2, 1)
        found.append(seen[..., :2] / seen[..., 2:])
    return found
