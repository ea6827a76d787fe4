"""What the autopilot says: MAVLink messages in, and what the vehicle knew at the moment of a capture out.

Radians, NED, centidegrees and millimetres end here. Times are ``time.monotonic_ns``, the clock of the captures.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.adapters.vehicle import ANGLES, Origin, RecentValues, Vehicle, only

FIRMWARES = {"ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, "px4": mavlink.MAV_AUTOPILOT_PX4}
STREAMS_HZ = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 10,
    mavlink.MAVLINK_MSG_ID_ALTITUDE: 10,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: 10,
    mavlink.MAVLINK_MSG_ID_RANGEFINDER: 10,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1,
}
"""What the bridge asks the autopilot to send, and how often."""
WANTED = frozenset(
    {
        *STREAMS_HZ,
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_TIMESYNC,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    }
)
"""Numbers of the messages that are understood."""

_CLOCK_SAMPLES = 64
_CLOCK_JUMP_NS = 1_000_000_000  # beyond which the autopilot has started again
_STALE_IN_A_ROW = 20  # stamps that far back, after which the same is taken to be so
_UNKNOWN_BELOW_M = -1000.0  # of ALTITUDE, by MAVLink's definition
_UNIX_USEC = (1_420_070_400_000_000, 4_102_444_800_000_000)  # 2015 to 2100; others mean that it has no date
_DOWN = mavlink.MAV_SENSOR_ROTATION_PITCH_270


class Clock:
    """Translates the autopilot's time since boot to ours.

    By TIMESYNC where it is answered, by the quickest message otherwise: none arrives before it was sent.
    """

    def __init__(self) -> None:
        self._by_arrival: deque[int] = deque(maxlen=_CLOCK_SAMPLES)
        self._by_sync: deque[tuple[int, int]] = deque(maxlen=_CLOCK_SAMPLES)  # round trip, offset
        self._asked: deque[int] = deque(maxlen=8)

    @property
    def offset_ns(self) -> int | None:
        """The autopilot's clock less ours."""
        if self._by_sync:
            return min(self._by_sync)[1]
        return max(self._by_arrival, default=None)

    def asked(self, now_ns: int) -> None:
        """A TIMESYNC request with this stamp was sent."""
        self._asked.append(now_ns)

    def answered(self, stamp_ns: int, theirs_ns: int, now_ns: int) -> bool:
        """Take an answer; one that nobody asked for is ignored.

        Returns:
            False where it is another clock than in the answers before: the autopilot has started again.
        """
        if stamp_ns not in self._asked:
            return True
        self._asked.remove(stamp_ns)
        trip_ns, offset_ns = now_ns - stamp_ns, theirs_ns - (stamp_ns + now_ns) // 2
        if self._by_sync and abs(offset_ns - min(self._by_sync)[1]) > _CLOCK_JUMP_NS + trip_ns // 2:
            return False
        self._by_sync.append((trip_ns, offset_ns))
        return True

    def ours_ns(self, theirs_ns: int, arrival_ns: int) -> int | None:
        """When it was on our clock, never after it arrived; None where that lies a second or more back."""
        self._by_arrival.append(theirs_ns - arrival_ns)
        offset_ns = self.offset_ns
        assert offset_ns is not None  # one was just added
        ours_ns = min(theirs_ns - offset_ns, arrival_ns)
        return ours_ns if arrival_ns - ours_ns < _CLOCK_JUMP_NS else None


class Telemetry:
    """What one autopilot said lately. May be read from another thread than the one that fills it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._clock = Clock()
        self._attitude, self._velocity = RecentValues(ANGLES), RecentValues()
        self._range, self._clearance, self._relative = RecentValues(), RecentValues(), RecentValues()
        self._alt_amsl, self._down = RecentValues(), RecentValues()
        self._unix_offset_ns: int | None = None
        self._stale_stamps = 0
        self.origin: Origin | None = None
        self.firmware: int | None = None
        self.heard_ns: int | None = None

    def update(self, message: Any, arrival_ns: int) -> None:
        """Take one message."""
        with self._lock:
            self._update(message, arrival_ns)

    def forget(self) -> None:
        """Forget everything but the last heartbeat: the autopilot may have started again."""
        with self._lock:
            self._start_again()

    def sync_asked(self, now_ns: int) -> None:
        """A TIMESYNC request with this stamp is being sent."""
        with self._lock:
            self._clock.asked(now_ns)

    def unix_offset_ns(self) -> int | None:
        """Nanoseconds since 1970 less our clock, as the autopilot has it; None where it does not know."""
        return self._unix_offset_ns

    def vehicle(self, time_ns: int) -> Vehicle:
        """What the vehicle knew at a moment."""
        with self._lock:
            attitude, velocity = self._attitude.at(time_ns), self._velocity.at(time_ns)
            roll, pitch, heading = attitude or (None, None, None)
            east, north, up = velocity or (None, None, None)
            return Vehicle(
                roll_deg=roll,
                pitch_deg=pitch,
                heading_deg=None if heading is None else heading % 360.0 % 360.0,
                east_velocity_mps=east,
                north_velocity_mps=north,
                up_velocity_mps=up,
                height_agl_m=self._height_agl_m(time_ns, roll or 0.0, pitch or 0.0),
                alt_amsl_m=only(self._alt_amsl.at(time_ns)),
                down_m=only(self._down.at(time_ns)),
            )

    def _height_agl_m(self, time_ns: int, roll_deg: float, pitch_deg: float) -> float | None:
        slant_m = only(self._range.at(time_ns))
        if slant_m is not None:  # the beam is fixed to the body
            slant_m *= math.cos(math.radians(roll_deg)) * math.cos(math.radians(pitch_deg))
        heights = (slant_m, only(self._clearance.at(time_ns)), only(self._relative.at(time_ns)))
        return next((height for height in heights if height is not None and height > 0.0), None)

    def _update(self, message: Any, arrival_ns: int) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            if message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                self.firmware, self.heard_ns = message.autopilot, arrival_ns
        elif kind == "TIMESYNC":
            if message.tc1 != 0 and not self._clock.answered(message.ts1, message.tc1, arrival_ns):
                self._start_again()
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._set_origin(message)
        elif kind == "RANGEFINDER":  # has no stamp
            self._range_m(arrival_ns, message.distance)
        elif kind == "ALTITUDE":
            self._sample(message, self._time_ns(message.time_usec * 1000, arrival_ns))
        else:
            self._sample(message, self._time_ns(message.time_boot_ms * 1_000_000, arrival_ns))

    def _time_ns(self, theirs_ns: int, arrival_ns: int) -> int | None:
        """When a sample was taken; an autopilot whose clock went back has started again."""
        time_ns = self._clock.ours_ns(theirs_ns, arrival_ns)
        self._stale_stamps = 0 if time_ns is not None else self._stale_stamps + 1
        if self._stale_stamps > _STALE_IN_A_ROW:
            self._start_again()
            time_ns = self._clock.ours_ns(theirs_ns, arrival_ns)
        return time_ns

    def _start_again(self) -> None:
        self._clock = Clock()
        self.origin, self._unix_offset_ns, self._stale_stamps = None, None, 0
        for series in (self._attitude, self._velocity, self._range, self._clearance, self._relative):
            series.clear()
        self._alt_amsl.clear()
        self._down.clear()

    def _sample(self, message: Any, time_ns: int | None) -> None:
        if time_ns is None:
            return
        kind = message.get_type()
        if kind == "ATTITUDE":
            self._attitude.add(time_ns, *(math.degrees(v) for v in (message.roll, message.pitch, message.yaw)))
        elif kind == "GLOBAL_POSITION_INT":
            self._alt_amsl.add(time_ns, message.alt * 1e-3)
            self._relative.add(time_ns, message.relative_alt * 1e-3)
            self._velocity.add(time_ns, message.vy * 1e-2, message.vx * 1e-2, -message.vz * 1e-2)
        elif kind == "LOCAL_POSITION_NED":
            self._down.add(time_ns, message.z)
            self._velocity.add(time_ns, message.vy, message.vx, -message.vz)
        elif kind == "ALTITUDE":
            known = [v for v in (message.bottom_clearance, message.altitude_terrain) if v > _UNKNOWN_BELOW_M]
            positive = [v for v in known if v > 0.0]
            if positive:
                self._clearance.add(time_ns, positive[0])
        elif kind == "DISTANCE_SENSOR":
            valid = message.min_distance < message.current_distance < message.max_distance
            if message.orientation == _DOWN and valid:
                self._range_m(time_ns, message.current_distance * 1e-2)
        elif kind == "SYSTEM_TIME":
            dated = _UNIX_USEC[0] < message.time_unix_usec < _UNIX_USEC[1]
            if dated and self._unix_offset_ns is None:
                self._unix_offset_ns = message.time_unix_usec * 1000 - time_ns

    def _range_m(self, time_ns: int, range_m: float) -> None:
        if range_m > 0.0:
            self._range.add(time_ns, range_m)

    def _set_origin(self, message: Any) -> None:
        """Take the autopilot's origin; all zeros mean that it has none."""
        lat_deg, lon_deg = message.latitude * 1e-7, message.longitude * 1e-7
        if (message.latitude, message.longitude) != (0, 0) and abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0:
            self.origin = Origin(lat_deg, lon_deg, message.altitude * 1e-3)
