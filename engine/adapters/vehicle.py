"""The vehicle as every bridge knows it: what it said of the moment of a capture, and where its metres begin."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.values import Frame

ANGLES = (True, True, True)
"""Roll, pitch and heading, as :class:`RecentValues` takes them."""
ANGLE_VARIANCE = math.radians(10.0) ** 2
"""Square radians that an attitude is sent with: it is the vehicle's own, and nothing to learn from."""

_STALE_NS = 500_000_000  # further from its neighbour than this a capture is not described by it
_KEPT = 128  # samples of each series
_ARDUPILOT_M_PER_1E7_DEG = 0.011131884502145034
_PX4_EARTH_M = 6371000.0


@dataclass(frozen=True, slots=True)
class Origin:
    """Where the autopilot's NED begins."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """What the vehicle knew at one moment; None where it did not say.

    Attributes:
        height_agl_m: by the rangefinder, else the distance to the ground that the autopilot states, else the
            height above home.
        alt_amsl_m: height above mean sea level.
        down_m: below the autopilot's origin.
        up_velocity_mps: positive in a climb.
    """

    roll_deg: float | None = None
    pitch_deg: float | None = None
    heading_deg: float | None = None
    east_velocity_mps: float | None = None
    north_velocity_mps: float | None = None
    up_velocity_mps: float | None = None
    height_agl_m: float | None = None
    alt_amsl_m: float | None = None
    down_m: float | None = None

    def frame(self, image: NDArray[np.uint8], captured_ns: int) -> Frame:
        """The frame of a picture that was taken at this moment."""
        return Frame(
            image,
            captured_ns,
            self.height_agl_m,
            self.heading_deg,
            self.roll_deg,
            self.pitch_deg,
            self.east_velocity_mps,
            self.north_velocity_mps,
        )


class RecentValues:
    """Values over time, the newest few.

    Args:
        angles: which of the values are degrees and go the shorter way round; empty for none.
    """

    def __init__(self, angles: tuple[bool, ...] = ()) -> None:
        self._angles = angles
        self._samples: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=_KEPT)

    def add(self, time_ns: int, *values: float) -> None:
        """One more sample; dropped where it is not finite or not newer than the last."""
        newer = not self._samples or time_ns > self._samples[-1][0]
        if newer and all(map(math.isfinite, values)):
            self._samples.append((time_ns, values))

    @property
    def last_ns(self) -> int | None:
        """When the newest sample was taken; None where there is none."""
        return self._samples[-1][0] if self._samples else None

    def clear(self) -> None:
        """Forget everything."""
        self._samples.clear()

    def at(self, time_ns: int) -> tuple[float, ...] | None:
        """The values at a moment, interpolated; the nearest where one side is missing, None where it is stale."""
        before = next((s for s in reversed(self._samples) if s[0] <= time_ns), None)
        after = next((s for s in self._samples if s[0] >= time_ns), None)
        near = [s for s in (before, after) if s is not None and abs(s[0] - time_ns) <= _STALE_NS]
        if len(near) < 2 or near[0][0] == near[1][0]:
            return near[0][1] if near else None
        (t0, first), (t1, last) = near
        share = (time_ns - t0) / (t1 - t0)
        steps = [b - a for a, b in zip(first, last, strict=True)]
        steps = [math.remainder(d, 360.0) if i < len(self._angles) else d for i, d in enumerate(steps)]
        return tuple(a + share * d for a, d in zip(first, steps, strict=True))


def only(values: tuple[float, ...] | None) -> float | None:
    """The one value of a series at a moment."""
    return None if values is None else values[0]


def north_east_m(lat_deg: float, lon_deg: float, origin: Origin, firmware: str) -> tuple[float, float]:
    """North and east of the origin in the firmware's own projection, so that it finds the latitude again.

    ArduPilot scales degrees as on a sphere of 6,378.1 km, PX4 projects azimuthally from one of 6,371 km. WGS84
    is neither: a kilometre away its tangent plane is up to metres off what they make of it.
    """
    if firmware == "ardupilot":
        middle = math.radians(0.5 * (lat_deg + origin.lat_deg))
        north_1e7 = (lat_deg - origin.lat_deg) * 1e7
        east_1e7 = math.remainder(lon_deg - origin.lon_deg, 360.0) * 1e7
        east_m = east_1e7 * _ARDUPILOT_M_PER_1E7_DEG * max(math.cos(middle), 0.01)
        return north_1e7 * _ARDUPILOT_M_PER_1E7_DEG, east_m
    lat, lat0 = math.radians(lat_deg), math.radians(origin.lat_deg)
    turn = math.radians(lon_deg - origin.lon_deg)
    north = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(turn)
    east = math.cos(lat) * math.sin(turn)
    along = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(turn)
    sine = math.hypot(north, east)
    factor = math.atan2(sine, along) / sine if sine > 0.0 else 1.0
    return factor * north * _PX4_EARTH_M, factor * east * _PX4_EARTH_M
