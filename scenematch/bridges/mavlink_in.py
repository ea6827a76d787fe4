"""The autopilot's telemetry: turn MAVLink messages into the vehicle state at the time of a capture.

Radians, NED, centidegrees and millimetres are converted here. Times are on ``time.monotonic_ns``, like those of
captures.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.geo import wrap_heading_deg
from engine.values import Attitude
from scenematch.bridges.gimbal import body_behind, from_device, from_mount
from scenematch.bridges.packets import BRIDGE_COMPONENT
from scenematch.bridges.vehicle import (
    ANGLES,
    STALE_NS,
    NedOrigin,
    RecentValues,
    VehicleState,
    height_above_ground_m,
    scalar,
)
from scenematch.bridges.vision_in import has_failed, is_by_camera, vision_velocity

MAV_AUTOPILOTS = {"ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, "px4": mavlink.MAV_AUTOPILOT_PX4}
"""MAV_AUTOPILOT of each firmware, as its heartbeat states it."""
_COMMON_RATES_HZ = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 10,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: 10,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1,
}
_COMMON_GIMBAL_RATES_HZ = {mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: 50}
GIMBAL_RATES_HZ = {
    "ardupilot": _COMMON_GIMBAL_RATES_HZ,
    "px4": _COMMON_GIMBAL_RATES_HZ | {mavlink.MAVLINK_MSG_ID_MOUNT_ORIENTATION: 50},
}
"""The same for messages needed only with a gimbal."""
REQUESTED_RATES_HZ = {
    # Each firmware lacks some of the other's messages, and complains to the pilot if asked for them.
    "ardupilot": _COMMON_RATES_HZ
    | {mavlink.MAVLINK_MSG_ID_RANGEFINDER: 10, mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 5},
    "px4": _COMMON_RATES_HZ | {mavlink.MAVLINK_MSG_ID_ALTITUDE: 10, mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 5},
}
"""Messages that the bridge requests from each firmware, and their rates."""
HANDLED_MESSAGES = frozenset(
    {
        *(number for rates in REQUESTED_RATES_HZ.values() for number in rates),
        *GIMBAL_RATES_HZ["px4"],
        mavlink.MAVLINK_MSG_ID_VISION_SPEED_ESTIMATE,
        mavlink.MAVLINK_MSG_ID_ODOMETRY,
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_TIMESYNC,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    }
)
"""Ids of the messages that are handled."""

_CLOCK_SAMPLES = 64
_CLOCK_JUMP_NS = 1_000_000_000  # beyond which the autopilot must have rebooted
_CLOCK_SLIP_NS = 10_000_000  # more than two round trips explain: the clock was set, since crystals drift less
_MAX_STALE_STAMPS = 20  # consecutive stamps that far back also mean a reboot

_UNIX_RANGE_US = (1_420_070_400_000_000, 4_102_444_800_000_000)  # 2015 to 2100: outside it the date is unknown
_DOWN = mavlink.MAV_SENSOR_ROTATION_PITCH_270
# ESTIMATOR_STATUS of PX4 has the same bits as EKF_STATUS_REPORT of ArduPilot.
_VELOCITY_KNOWN, _CONSTANT_POSITION = mavlink.EKF_VELOCITY_HORIZ, mavlink.EKF_CONST_POS_MODE
_SUPPORT_NS = 2_000_000_000  # of fixes: before, an estimator that aligned in the air guesses its velocity
_MIN_GNSS_SIGMA_M, _DEFAULT_GNSS_SIGMA_M = 0.5, 5.0  # the latter if the receiver states no accuracy


@dataclass(frozen=True, slots=True)
class GnssFix:
    """A position from the autopilot's own receiver, in WGS84 degrees, with one standard deviation per axis."""

    lat_deg: float
    lon_deg: float
    sigma_m: float
    time_ns: int


class AutopilotClock:
    """Maps the autopilot's time since boot to the local monotonic clock.

    The offset is from the TIMESYNC exchange with the shortest round trip. Without TIMESYNC, the message with the
        shortest delay bounds it, since none arrives before it was sent. If a new exchange contradicts the offset
            by less than a reboot would, it replaces it: the clock was set, and the old offset is wrong by that
                much.
    """

    def __init__(self) -> None:
        self._by_arrival: deque[int] = deque(maxlen=_CLOCK_SAMPLES)
        self._by_sync: deque[tuple[int, int]] = deque(maxlen=_CLOCK_SAMPLES)  # round trip, offset
        self._requests: deque[int] = deque(maxlen=8)

    @property
    def offset_ns(self) -> int | None:
        """The autopilot's clock minus the local one, in nanoseconds; None before the first message."""
        if self._by_sync:
            return min(self._by_sync)[1]
        return max(self._by_arrival, default=None)

    def add_request(self, now_ns: int) -> None:
        """Remember the stamp of a TIMESYNC request that was sent."""
        self._requests.append(now_ns)

    def accept_response(self, stamp_ns: int, remote_ns: int, now_ns: int) -> bool:
        """Use the response to a TIMESYNC request; unsolicited ones are ignored.

        Args:
            stamp_ns: stamp of the request.
            remote_ns: the autopilot's time in the response.
            now_ns: local time of arrival.

        Returns:
            False if the offset jumped from earlier responses: the autopilot has rebooted.
        """
        if stamp_ns not in self._requests:
            return True
        self._requests.remove(stamp_ns)
        round_trip_ns, offset_ns = now_ns - stamp_ns, remote_ns - (stamp_ns + now_ns) // 2
        if self._by_sync:
            best_trip_ns, best_ns = min(self._by_sync)
            apart_ns = abs(offset_ns - best_ns)
            if apart_ns > _CLOCK_JUMP_NS + round_trip_ns // 2:
                return False
            if apart_ns > (best_trip_ns + round_trip_ns) // 2 + _CLOCK_SLIP_NS:
                self._by_sync.clear()
        self._by_sync.append((round_trip_ns, offset_ns))
        return True

    def local_ns(self, remote_ns: int, arrival_ns: int) -> int | None:
        """Local time of a remote stamp, never after its arrival; None if it is a second old or more."""
        self._by_arrival.append(remote_ns - arrival_ns)
        offset_ns = self.offset_ns
        assert offset_ns is not None  # one was just added
        local_ns = min(remote_ns - offset_ns, arrival_ns)
        return local_ns if arrival_ns - local_ns < _CLOCK_JUMP_NS else None


class MavlinkTelemetry:
    """Recent telemetry of one autopilot. May be read and updated from different threads.

    Args:
        gimbal_mount: (3, 3) mount of a camera on a gimbal; None for one fixed to the vehicle.
        bridge_component: component id of the bridge itself.

    Attributes:
        origin: NED origin of the autopilot; None if it has reported none.
        firmware: MAV_AUTOPILOT of its last heartbeat; None before the first.
        armed: whether its motors are armed.
        has_receiver: whether a GNSS receiver is connected to it; None if not reported.
        uptime_ms: how long it has run; None if not reported.
        gnss: the last three-dimensional fix of that receiver; None before the first.
        heard_ns: arrival of its last heartbeat on ``time.monotonic_ns``; None before the first.
    """

    def __init__(
        self, gimbal_mount: NDArray[np.float64] | None = None, bridge_component: int = BRIDGE_COMPONENT
    ) -> None:
        self._bridge_component, self._gimbal_mount = bridge_component, gimbal_mount
        self._lock = threading.RLock()
        self.armed = False
        self.firmware: int | None = None
        self.heard_ns: int | None = None
        self.reset()

    def reset(self) -> None:
        """Discard everything but the last heartbeat: the autopilot may have rebooted."""
        with self._lock:
            self._clock, self._stale_stamps = AutopilotClock(), 0
            self._attitude, self._holder = RecentValues(ANGLES), RecentValues(ANGLES)
            self._velocity, self._vision, self._down = RecentValues(), RecentValues(), RecentValues()
            self._range, self._clearance, self._relative = RecentValues(), RecentValues(), RecentValues()
            self._alt_amsl = RecentValues()
            self._unix_offset_ns: int | None = None
            self._has_velocity, self._owed_ns, self._sent_ns = True, 0, 0
            self._home_down_m = 0.0  # how far its home is below its origin
            self.origin: NedOrigin | None = None
            self.has_receiver: bool | None = None
            self.uptime_ms: int | None = None
            self.gnss: GnssFix | None = None

    def update(self, message: Any, arrival_ns: int) -> None:
        """Process one message."""
        with self._lock:
            self._update(message, arrival_ns)

    def add_timesync_request(self, now_ns: int) -> None:
        """Remember the stamp of a TIMESYNC request that is about to be sent."""
        with self._lock:
            self._clock.add_request(now_ns)

    def add_sent(self, captured_ns: int) -> None:
        """Count a fix that was sent towards those that an estimator needs to know its velocity."""
        with self._lock:
            since_ns = min(max(captured_ns - self._sent_ns, 0), STALE_NS)
            self._owed_ns, self._sent_ns = max(self._owed_ns - since_ns, 0), captured_ns

    def unix_ns(self, time_ns: int) -> int:
        """Nanoseconds since 1970 of a local time, by the autopilot's UTC or, if it has none, this machine's."""
        offset_ns = self._unix_offset_ns
        return time_ns + (time.time_ns() - time.monotonic_ns() if offset_ns is None else offset_ns)

    def vehicle(self, time_ns: int, *, own_velocity: bool = True) -> VehicleState:
        """The vehicle state at a local time; what is not known is None.

        Args:
            time_ns: on ``time.monotonic_ns``.
            own_velocity: whether to use the autopilot's velocity if no other camera's odometry states one.
        """
        with self._lock:
            held = self._holder.at(time_ns)
            roll, pitch, heading = self._attitude.at(time_ns) or (None, None, None)
            is_known = self._has_velocity and self._owed_ns == 0
            own = self._velocity.at(time_ns) if is_known and own_velocity else None
            # From another camera's odometry, if there is one: it does not depend on the fixes.
            east, north, up, *_ = self._vision.at(time_ns) or own or (None, None, None)
            *_, sigma = self._vision.nearest(time_ns) or (0.0,)  # 0 means not stated: nothing to interpolate
            slant_m, *others_m = (scalar(s.at(time_ns)) for s in (self._range, self._clearance, self._relative))
            return VehicleState(
                roll_deg=roll,
                pitch_deg=pitch,
                heading_deg=None if heading is None else wrap_heading_deg(heading),
                east_velocity_mps=east,
                north_velocity_mps=north,
                up_velocity_mps=up,
                velocity_sigma_mps=sigma or None,
                height_agl_m=height_above_ground_m(slant_m, roll, pitch, *others_m),
                alt_amsl_m=scalar(self._alt_amsl.at(time_ns)),
                down_m=self._down_m(time_ns),
                holder=None if held is None else Attitude(held[0], held[1], wrap_heading_deg(held[2])),
            )

    def _down_m(self, time_ns: int) -> float | None:
        """Distance below the origin; without a position ArduPilot states only the height above home.

        ArduPilot is then waiting for a fix; requiring a position would mean that none is ever sent.
        """
        down_m, relative_m = scalar(self._down.at(time_ns)), scalar(self._relative.at(time_ns))
        if down_m is not None or relative_m is None:
            return down_m
        return self._home_down_m - relative_m

    def _update(self, message: Any, arrival_ns: int) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            if message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                self.firmware, self.heard_ns = message.autopilot, arrival_ns
                self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        elif kind == "TIMESYNC":
            if message.tc1 != 0 and not self._clock.accept_response(message.ts1, message.tc1, arrival_ns):
                self.reset()
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._set_origin(message)
        elif kind == "RANGEFINDER":  # has no stamp
            self._add_range(arrival_ns, message.distance)
        elif kind in ("VISION_SPEED_ESTIMATE", "ODOMETRY"):  # stamped by a clock that no other message uses
            if is_by_camera(message, self._bridge_component):
                self._add_vision(message, arrival_ns)
        elif kind in ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS"):
            # If it knows no velocity, it still reports one, of zero.
            has_velocity = bool(message.flags & _VELOCITY_KNOWN) and not message.flags & _CONSTANT_POSITION
            if self.armed and has_velocity and not self._has_velocity:
                self._owed_ns, self._sent_ns = _SUPPORT_NS, arrival_ns
            self._has_velocity = has_velocity
        elif kind == "GPS_RAW_INT":
            self._set_gnss(message, arrival_ns)
        elif kind == "ALTITUDE":
            self._add_sample(message, self._time_ns(message.time_usec * 1000, arrival_ns))
        else:
            self.uptime_ms = message.time_boot_ms
            self._add_sample(message, self._time_ns(message.time_boot_ms * 1_000_000, arrival_ns))

    def _time_ns(self, remote_ns: int, arrival_ns: int) -> int | None:
        """Local time of a sample; an autopilot whose clock went back has rebooted."""
        time_ns = self._clock.local_ns(remote_ns, arrival_ns)
        self._stale_stamps = 0 if time_ns is not None else self._stale_stamps + 1
        if self._stale_stamps > _MAX_STALE_STAMPS:
            self.reset()
            time_ns = self._clock.local_ns(remote_ns, arrival_ns)
        return time_ns

    def _add_sample(self, message: Any, time_ns: int | None) -> None:
        if time_ns is None:
            return
        kind = message.get_type()
        if kind == "ATTITUDE":
            self._attitude.add(time_ns, *(math.degrees(v) for v in (message.roll, message.pitch, message.yaw)))
        elif kind == "GLOBAL_POSITION_INT":
            self._alt_amsl.add(time_ns, message.alt * 1e-3)
            self._relative.add(time_ns, message.relative_alt * 1e-3)
            down_m = scalar(self._down.at(time_ns))
            if down_m is not None:
                self._home_down_m = down_m + message.relative_alt * 1e-3
            self._velocity.add(time_ns, message.vy * 1e-2, message.vx * 1e-2, -message.vz * 1e-2)
        elif kind == "LOCAL_POSITION_NED":
            self._down.add(time_ns, message.z)
            self._velocity.add(time_ns, message.vy, message.vx, -message.vz)
        elif kind == "ALTITUDE":
            # A value that the autopilot does not know is far below 0.
            heights_m = [v for v in (message.bottom_clearance, message.altitude_terrain) if v > 0.0]
            if heights_m:
                self._clearance.add(time_ns, heights_m[0])
        elif kind == "DISTANCE_SENSOR":
            valid = message.min_distance < message.current_distance < message.max_distance
            if message.orientation == _DOWN and valid:
                self._add_range(time_ns, message.current_distance * 1e-2)
        elif kind in ("GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_ORIENTATION"):
            self._add_gimbal(message, time_ns)
        elif kind == "SYSTEM_TIME":
            dated = _UNIX_RANGE_US[0] < message.time_unix_usec < _UNIX_RANGE_US[1]
            if dated and self._unix_offset_ns is None:
                self._unix_offset_ns = message.time_unix_usec * 1000 - time_ns

    def _add_gimbal(self, message: Any, time_ns: int) -> None:
        attitude = self._attitude.at(time_ns)
        if self._gimbal_mount is None or attitude is None:
            return
        if message.get_type() == "MOUNT_ORIENTATION":
            rotation = from_mount(message.roll, message.pitch, message.yaw, attitude[2])
        else:
            rotation = from_device(message.q, message.flags, attitude[2])
        if rotation is not None:
            held = body_behind(rotation, self._gimbal_mount)
            self._holder.add(time_ns, held.roll_deg, held.pitch_deg, held.heading_deg)

    def _add_vision(self, message: Any, arrival_ns: int) -> None:
        if has_failed(message):
            self._vision.clear()
        elif (seen := vision_velocity(message, self._attitude.at(arrival_ns))) is not None:
            self._vision.add(arrival_ns, *seen)

    def _add_range(self, time_ns: int, range_m: float) -> None:
        if range_m > 0.0:
            self._range.add(time_ns, range_m)

    def _set_gnss(self, message: Any, arrival_ns: int) -> None:
        """Store the receiver's position; its stamp shares no clock with the others."""
        self.has_receiver = message.fix_type != mavlink.GPS_FIX_TYPE_NO_GPS
        if message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
            stated_m = message.h_acc * 1e-3
            sigma_m = max(stated_m, _MIN_GNSS_SIGMA_M) if stated_m > 0.0 else _DEFAULT_GNSS_SIGMA_M
            self.gnss = GnssFix(message.lat * 1e-7, message.lon * 1e-7, sigma_m, arrival_ns)

    def _set_origin(self, message: Any) -> None:
        """Store the autopilot's origin; zero latitude and longitude mean that it has none."""
        lat_deg, lon_deg = message.latitude * 1e-7, message.longitude * 1e-7
        if (message.latitude, message.longitude) != (0, 0) and abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0:
            self.origin = NedOrigin(lat_deg, lon_deg, message.altitude * 1e-3)
