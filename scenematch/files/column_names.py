"""Map other programs' telemetry columns to ours, by the settings or by a guess that the user must confirm."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from scenematch.files.stamps import STAMP_COLUMNS

TABLE = "telemetry_columns"
"""The table of a settings file that names columns."""
_LIKELY = {
    "frame": (
        "image", "img", "picture", "photo", "file", "filename", "file_name", "image_name", "image_file",
        "img_name", "frame_name", "frame_id", "frame_number", "name",
    ),
    "height_agl_m": (
        "height", "agl", "height_agl", "alt_agl", "altitude_agl", "agl_altitude", "rel_alt", "relative_alt",
        "relative_altitude", "rangefinder", "height_above_ground", "h",
    ),
    "alt_amsl_m": ("alt", "altitude", "amsl", "msl", "alt_amsl", "alt_msl", "altitude_amsl", "altitude_msl"),
    "heading_deg": ("heading", "yaw", "hdg", "compass", "compass_heading", "azimuth"),
    "roll_deg": ("roll",),
    "pitch_deg": ("pitch",),
    "east_velocity_mps": ("east_velocity", "velocity_east", "vel_east", "vel_e", "v_east", "ve", "east_speed"),
    "north_velocity_mps": (
        "north_velocity", "velocity_north", "vel_north", "vel_n", "v_north", "vn", "north_speed",
    ),
    "lat_deg": ("lat", "latitude", "gps_lat", "gps_latitude"),
    "lon_deg": ("lon", "lng", "long", "longitude", "gps_lon", "gps_lng", "gps_longitude"),
}  # fmt: skip
_TIMES = (
    "timestamp", "time", "stamp", "t", "utc", "date", "datetime", "date_time", "time_utc", "timestamp_utc",
    "utc_time", "gps_time", "unix_time", "time_unix", "epoch", "time_boot", "capture_time", "iso", "time_iso",
)  # fmt: skip
_UNITS = {"m", "meter", "meters", "metre", "metres", "deg", "degree", "degrees", "mps"}
_TIME_UNITS = {
    "ns": "timestamp_ns", "nsec": "timestamp_ns", "us": "timestamp_us", "usec": "timestamp_us",
    "ms": "timestamp_ms", "msec": "timestamp_ms", "s": "timestamp_s", "sec": "timestamp_s",
    "seconds": "timestamp_s", "utc": "timestamp_utc", "iso": "timestamp_utc", "date": "timestamp_utc",
    "datetime": "timestamp_utc",
}  # fmt: skip


def advice(missing: str, header: Sequence[str]) -> str:
    """Ask about a missing required column; blank if no column of the file is likely.

    Args:
        missing: the column, "timestamp_ns" or "frame".
        header: the file's columns.
    """
    for name in header:
        ours = likely(name)
        if ours == missing or (missing == STAMP_COLUMNS[0] and ours in STAMP_COLUMNS):
            return f': is it {name!r}? If so, add to the settings, [{TABLE}] {ours} = "{name}"'
    return ""


def question(header: Sequence[str], names: Mapping[str, str], columns: Sequence[str]) -> str | None:
    """Ask about unused columns that are likely to be ours; None if there are none.

    Args:
        header: the file's columns.
        names: the file's column names, if given.
        columns: our columns that may be read.
    """
    known = {ours for ours in columns if names.get(ours, ours) in header}
    read = {names.get(ours, ours) for ours in columns}
    asked: dict[str, str] = {}
    for name in header:
        ours = likely(name)
        if ours is not None and name not in read and ours in columns and ours not in known:
            asked.setdefault(ours, name)
    if not asked:
        return None
    texts = ", ".join(f'{ours} = "{name}"' for ours, name in asked.items())
    return f"unused columns; are they these? If so, add to the settings, [{TABLE}]: {texts}"


def likely(name: str) -> str | None:
    """Our column that the file's column probably is; None if none is, or its unit differs."""
    words = [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word]
    found = "_".join(word for word in words if word not in _UNITS)
    ours = next((column for column, others in _LIKELY.items() if found in others), None)
    if ours is not None or not words:
        return ours
    unit = _TIME_UNITS.get(words[-1], STAMP_COLUMNS[0])
    stem = "_".join(words[:-1]) if words[-1] in _TIME_UNITS else "_".join(words)
    return unit if stem in _TIMES or "_".join(words) in _TIMES else None
