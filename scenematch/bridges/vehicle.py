"""The vehicle state that all bridges share, interpolated at capture times, and the firmwares' projections."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyproj import Proj

from engine.errors import OptionError
from engine.values import Attitude, Fix, Frame

__all__ = ["NedOrigin", "VehicleState", "north_east_m"]

ANGLES = (True, True, True)
"""Roll, pitch and heading are all angles, see :class:`RecentValues`."""
ANGLE_VARIANCE = math.radians(10.0) ** 2
"""Variance in rad^2 of the vehicle's own attitude if it is sent back: large, so that it has little weight."""
MOUNT_VARIANCE = math.radians(1.0) ** 2
"""Variance of each angle between camera and autopilot, which a fix does not measure; added to its attitude's."""

STALE_NS = 500_000_000
"""Largest time between a sample and a capture that it describes."""
_MAX_SAMPLES = 128  # of each quantity
_ARDUPILOT_M_PER_1E7_DEG = 0.011131884502145034
_PX4_EARTH_M = 6371000.0


@dataclass(frozen=True, slots=True)
class NedOrigin:
    """Origin of the autopilot's north-east-down frame, in WGS84 degrees and metres above mean sea level."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """State of the vehicle at one time; what is not known is None.

    Attributes:
        roll_deg: positive right side down.
        pitch_deg: positive nose up.
        heading_deg: clockwise from true north in [0, 360).
        east_velocity_mps: velocity over ground.
        north_velocity_mps: velocity over ground.
        up_velocity_mps: positive in a climb.
        velocity_sigma_mps: standard deviation of the velocity, per axis, if its source states one.
        height_agl_m: height above the ground by the rangefinder, else the clearance that the autopilot reports,
            else the height above home.
        alt_amsl_m: height above mean sea level.
        down_m: distance below the autopilot's origin.
        holder: attitude of the body that the camera's mount refers to, if it is behind a gimbal; None is the
            vehicle's own attitude.
    """

    roll_deg: float | None = None
    pitch_deg: float | None = None
    heading_deg: float | None = None
    east_velocity_mps: float | None = None
    north_velocity_mps: float | None = None
    up_velocity_mps: float | None = None
    velocity_sigma_mps: float | None = None
    height_agl_m: float | None = None
    alt_amsl_m: float | None = None
    down_m: float | None = None
    holder: Attitude | None = None

    @property
    def attitude(self) -> Attitude | None:
        """The vehicle's own attitude; None if an angle of it is unknown."""
        if self.roll_deg is None or self.pitch_deg is None or self.heading_deg is None:
            return None
        return Attitude(self.roll_deg, self.pitch_deg, self.heading_deg)

    def frame(self, image: NDArray[np.uint8], captured_ns: int) -> Frame:
        """The frame for an image (H, W, 3) or (H, W) uint8 captured at this time."""
        body = self.holder or self
        return Frame(
            image,
            captured_ns,
            self.height_agl_m,
            body.heading_deg,
            body.roll_deg,
            body.pitch_deg,
            self.east_velocity_mps,
            self.north_velocity_mps,
            velocity_sigma_mps=self.velocity_sigma_mps,
        )


class RecentValues:
    """Ring buffer of the newest samples of one quantity, interpolated in time: the attitude at an exposure.

    ::

        vehicle = RecentValues((True, True, True))  # the first three values are angles
        vehicle.add(time_ns, roll_deg, pitch_deg, heading_deg, height_agl_m)  # as the autopilot reports them
        roll_deg, pitch_deg, heading_deg, height_agl_m = vehicle.at(exposure_ns)

    Args:
        angles: which of the values are angles in degrees, interpolated along the shorter arc, so that a heading
            may exceed 360; the values beyond these are none.
    """

    def __init__(self, angles: tuple[bool, ...] = ()) -> None:
        self._angles = angles
        self._samples: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=_MAX_SAMPLES)

    def add(self, time_ns: int, *values: float) -> None:
        """Add a sample; it is dropped if it is not finite or not newer than the last.

        Raises:
            OptionError: it has another number of values than the last.
        """
        if self._samples and len(values) != len(self._samples[-1][1]):
            raise OptionError(f"values: expected {len(self._samples[-1][1])}, as before, got {len(values)}")
        newer = not self._samples or time_ns > self._samples[-1][0]
        if newer and all(map(math.isfinite, values)):
            self._samples.append((time_ns, values))

    @property
    def last_ns(self) -> int | None:
        """Time of the newest sample; None if there is none."""
        return self._samples[-1][0] if self._samples else None

    def clear(self) -> None:
        """Discard all samples."""
        self._samples.clear()

    def nearest(self, time_ns: int) -> tuple[float, ...] | None:
        """Values of the sample nearest to a time; None beyond 0.5 s."""
        near = min(self._samples, key=lambda s: abs(s[0] - time_ns), default=None)
        return near[1] if near is not None and abs(near[0] - time_ns) <= STALE_NS else None

    def at(self, time_ns: int) -> tuple[float, ...] | None:
        """Values interpolated at a time; the nearest sample if one side is missing, None beyond 0.5 s."""
        before = next((s for s in reversed(self._samples) if s[0] <= time_ns), None)
        after = next((s for s in self._samples if s[0] >= time_ns), None)
        near = [s for s in (before, after) if s is not None and abs(s[0] - time_ns) <= STALE_NS]
        if len(near) < 2 or near[0][0] == near[1][0]:
            return near[0][1] if near else None
        (t0, first), (t1, last) = near
        share = (time_ns - t0) / (t1 - t0)
        steps = [b - a for a, b in zip(first, last, strict=True)]
        steps = [math.remainder(d, 360.0) if any(self._angles[i : i + 1]) else d for i, d in enumerate(steps)]
        return tuple(a + share * d for a, d in zip(first, steps, strict=True))


def scalar(values: tuple[float, ...] | None) -> float | None:
    """The value of a one-dimensional sample; None stays None."""
    return None if values is None else values[0]


def height_above_ground_m(
    slant_m: float | None, roll_deg: float | None, pitch_deg: float | None, *others_m: float | None
) -> float | None:
    """The first height above 0: the rangefinder's, else the others in order.

    Args:
        slant_m: distance along the rangefinder's beam, which is fixed to the body and tilts with it.
        roll_deg: of the body; unknown counts as level.
        pitch_deg: of the body; likewise.
        others_m: other heights, best first.
    """
    if slant_m is not None:
        slant_m *= math.cos(math.radians(roll_deg or 0.0)) * math.cos(math.radians(pitch_deg or 0.0))
    return next((height_m for height_m in (slant_m, *others_m) if height_m is not None and height_m > 0.0), None)


def is_finite(fix: Fix) -> bool:
    """Whether the position and covariance of a fix are finite."""
    angles = fix.attitude_sigma_deg or ()
    numbers = (fix.lat_deg, fix.lon_deg, fix.east_m, fix.north_m, *fix.covariance_m2.ravel(), *angles)
    return all(map(math.isfinite, numbers))


def north_east_m(lat_deg: float, lon_deg: float, origin: NedOrigin, firmware: str) -> tuple[float, float]:
    """Project a position as the firmware does, so that the firmware's inverse projection recovers it.

    ArduPilot scales degrees by a sphere of 6,378.1 km; PX4 uses the azimuthal equidistant projection of a sphere
    of 6,371 km. At 1 km either differs from the WGS84 tangent plane by up to metres.

    Args:
        lat_deg: WGS84 latitude.
        lon_deg: WGS84 longitude.
        origin: origin of the autopilot's NED frame.
        firmware: ardupilot or px4.

    Returns:
        North and east of the origin in metres.
    """
    if firmware == "ardupilot":
        middle = math.radians(0.5 * (lat_deg + origin.lat_deg))
        north_1e7 = (lat_deg - origin.lat_deg) * 1e7
        east_1e7 = math.remainder(lon_deg - origin.lon_deg, 360.0) * 1e7
        east_m = east_1e7 * _ARDUPILOT_M_PER_1E7_DEG * max(math.cos(middle), 0.01)
        return north_1e7 * _ARDUPILOT_M_PER_1E7_DEG, east_m
    plane = Proj(proj="aeqd", lat_0=origin.lat_deg, lon_0=origin.lon_deg, R=_PX4_EARTH_M)
    east_m, north_m = plane(lon_deg, lat_deg)
    return north_m, east_m
