"""PX4's ULog (.ulg): its attitude, heights, velocity, positions and camera messages.

Convention:
    The clock is microseconds since the autopilot started; ``timestamp_sample`` is preferred to ``timestamp``. If a
    topic has several instances, the first is read. An estimator's topic replaces the vehicle's if a log lacks it,
    and ``sensor_gps`` replaces ``vehicle_gps_position``.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError, require
from scenematch.files.resampling import FlightLog, TimeSeries, make_position_series, make_series

HEAD = b"ULog\x01\x12\x35"
"""The first bytes of a ULog file."""
_FALLBACKS = {  # topics with the same fields, for logs with few topics or several estimators
    "vehicle_attitude": "estimator_attitude",
    "vehicle_local_position": "estimator_local_position",
    "vehicle_global_position": "estimator_global_position",
    "vehicle_gps_position": "sensor_gps",
}
_OTHER_TOPICS = ("distance_sensor", "home_position", "camera_capture", "camera_trigger")
_DOWN, _FIX_3D = 25, 3
_MAX_ENDS = 16  # reads at the end of the file; after more the parser is in a loop

Columns = Mapping[str, NDArray[Any]]


def read_ulog(path: Path) -> FlightLog:
    """Read a ULog.

    Raises:
        MissingExtraError: pyulog is not installed.
        TelemetryError: the file is not a ULog, or has no usable series.
    """
    with path.open("rb") as file:
        head = file.read(len(HEAD))
    if head != HEAD:
        raise TelemetryError(f"{path}: expected a ULog, which begins with 'ULog' 01 12 35, got {head.hex(' ')}")
    topics = _topics(path)
    try:
        with np.errstate(all="ignore"):  # corrupt files may hold any numbers, signalling NaNs included
            series = _attitude(topics) | _velocity(topics) | _position(topics)
            cameras = (topics[name] for name in ("camera_capture", "camera_trigger") if name in topics)
            captures = next(map(_stamps_ns, cameras), ())
            return FlightLog(path, series, _heights(topics), captures, _utc_ns(topics))
    except KeyError as error:
        raise TelemetryError(f"{path}: expected a PX4 topic with the field {error}, got one without") from None


class _LoopGuard(io.BufferedReader):
    """A file for pyulog, which on some corrupt files seeks back and forth across the end forever."""

    _ends = 0

    def read(self, size: int | None = -1, /) -> bytes:
        """Read; raises EOFError once the end of the file has been reached too often."""
        data = super().read(size)
        self._ends += size is not None and len(data) < size
        if self._ends > _MAX_ENDS:
            raise EOFError("its definitions are damaged")
        return data


def _topics(path: Path) -> dict[str, Columns]:
    """(N,) values by topic and field."""
    pyulog = require("pyulog", "logs")
    # The parser prints what it skips, and raises various errors on corrupt files.
    quiet = contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO())
    with _LoopGuard(io.FileIO(path)) as file, quiet[0], quiet[1]:
        try:
            log: Any = pyulog.ULog(file, [*_FALLBACKS, *_FALLBACKS.values(), *_OTHER_TOPICS])
        except Exception as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise TelemetryError(f"{path}: expected a ULog that can be read: {reason}") from None
    found = {topic.name: topic.data for topic in reversed(log.data_list) if _has_integers(topic.data, "timestamp")}
    return {name: found[other] for name, other in _FALLBACKS.items() if other in found} | found


def _has_integers(topic: Columns, field: str) -> bool:
    """Whether a field exists with integer type and at least one value."""
    return field in topic and topic[field].size > 0 and topic[field].dtype.kind in "iu"


def _stamps_ns(topic: Columns) -> NDArray[np.int64]:
    sampled = _has_integers(topic, "timestamp_sample") and topic["timestamp_sample"].all()
    stamps_us = topic["timestamp_sample" if sampled else "timestamp"]
    return stamps_us.astype(np.int64) * 1000


def _attitude(topics: Mapping[str, Columns]) -> dict[str, TimeSeries | None]:
    """Roll, pitch and heading of the quaternion from body (forward, right, down) to north, east, down."""
    if "vehicle_attitude" not in topics:
        return {}
    attitude = topics["vehicle_attitude"]
    stamps_ns = _stamps_ns(attitude)
    w, x, y, z = (attitude[f"q[{i}]"].astype(np.float64) for i in range(4))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    unit = np.abs(w * w + x * x + y * y + z * z - 1.0) < 0.01  # zeros until the estimator has started
    return {
        "roll_deg": make_series(stamps_ns, np.rad2deg(roll), unit),
        "pitch_deg": make_series(stamps_ns, np.rad2deg(pitch), unit),
        "heading_deg": make_series(stamps_ns, np.rad2deg(heading), unit),
    }


def _velocity(topics: Mapping[str, Columns]) -> dict[str, TimeSeries | None]:
    if "vehicle_local_position" not in topics:
        return {}
    local = topics["vehicle_local_position"]
    stamps_ns, valid = _stamps_ns(local), local.get("v_xy_valid", True)
    return {
        "north_velocity_mps": make_series(stamps_ns, local["vx"], valid),
        "east_velocity_mps": make_series(stamps_ns, local["vy"], valid),
    }


def _position(topics: Mapping[str, Columns]) -> dict[str, TimeSeries | None]:
    """The estimator's position, else the receiver's."""
    if "vehicle_global_position" in topics:
        place = topics["vehicle_global_position"]
        stamps_ns, valid = _stamps_ns(place), place.get("lat_lon_valid", True)
        lat_deg, lon_deg, alt_m = place["lat"], place["lon"], place["alt"]
    elif "vehicle_gps_position" in topics:
        place = topics["vehicle_gps_position"]
        stamps_ns, valid = _stamps_ns(place), place["fix_type"] >= _FIX_3D
        if "latitude_deg" in place:
            lat_deg, lon_deg, alt_m = place["latitude_deg"], place["longitude_deg"], place["altitude_msl_m"]
        else:  # before PX4 1.15: integers of 1e-7 degrees and of millimetres
            lat_deg, lon_deg, alt_m = place["lat"] / 1e7, place["lon"] / 1e7, place["alt"] / 1e3
    else:
        return {}
    series = make_position_series(stamps_ns, lat_deg, lon_deg, valid)
    series["alt_amsl_m"] = make_series(stamps_ns, alt_m, valid)
    if "eph" in place:
        series["sigma_m"] = make_series(stamps_ns, place["eph"], valid)
    return series


def _heights(topics: Mapping[str, Columns]) -> dict[str, TimeSeries | None]:
    heights: dict[str, TimeSeries | None] = {}
    if "distance_sensor" in topics:
        sensor = topics["distance_sensor"]
        distance_m = sensor["current_distance"]
        in_range = (distance_m >= sensor["min_distance"]) & (distance_m <= sensor["max_distance"])
        is_good = sensor.get("signal_quality", np.int8(-1)) != 0
        valid = in_range & is_good & (sensor["orientation"] == _DOWN)
        heights["rangefinder"] = make_series(_stamps_ns(sensor), distance_m, valid)
    local = topics.get("vehicle_local_position", {})
    if "dist_bottom" in local:
        valid = local["dist_bottom_valid"]
        heights["terrain"] = make_series(_stamps_ns(local), local["dist_bottom"], valid)
    if "vehicle_global_position" in topics and "home_position" in topics:
        place, home_m = topics["vehicle_global_position"], float(topics["home_position"]["alt"][-1])
        heights["take-off"] = make_series(_stamps_ns(place), place["alt"] - home_m)
    elif "z" in local:  # down from the estimator's start
        heights["take-off"] = make_series(_stamps_ns(local), -local["z"], local.get("z_valid", True))
    return heights


def _utc_ns(topics: Mapping[str, Columns]) -> int | None:
    """Offset that converts the log's clock to UTC in nanoseconds: the median over the GPS messages."""
    gps = topics.get("vehicle_gps_position", {})
    if not _has_integers(gps, "time_utc_usec"):
        return None
    utc_us = gps["time_utc_usec"].astype(np.int64)
    differences = np.sort((utc_us * 1000 - gps["timestamp"].astype(np.int64) * 1000)[utc_us > 0])
    return int(differences[len(differences) // 2]) if differences.size else None
