"""Resampling: interpolate the time series of a flight log at the frames' capture times.

Convention:
    Stamps are nanoseconds on the log's clock. Between two samples a value is interpolated linearly, an angle along
    the shorter arc; no value is given between samples more than :data:`MAX_SAMPLE_GAP_NS` apart. Stamps from
    :data:`UTC_FROM_NS` on are UTC, earlier ones count from the start of the log.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.errors import TelemetryError
from engine.geo import wrap_difference_deg, wrap_heading_deg
from engine.values import Truth
from scenematch.files.telemetry import TelemetryRow, take_off_sigma_m
from scenematch.files.truth import truth_from_telemetry

MAX_SAMPLE_GAP_NS = 2_000_000_000
"""Largest interval between two samples that is interpolated."""
END_HOLD_NS = 100_000_000
"""How far the first and last sample are held, since frames' timestamps are rounded."""
UTC_FROM_NS = 10**18
"""Stamps from this value (September 2001) on count as UTC in nanoseconds since 1970."""
HEIGHT_SOURCES = ("rangefinder", "terrain", "take-off")
"""Sources of the height above ground, best first: measured, by a terrain model, above take-off."""
_ANGLES = ("heading_deg", "roll_deg", "lon_deg")
_COLUMNS = (
    "alt_amsl_m", "heading_deg", "heading_sigma_deg", "roll_deg", "pitch_deg", "tilt_sigma_deg",
    "east_velocity_mps", "north_velocity_mps", "velocity_sigma_mps",
)  # fmt: skip
_POSITION = ("lat_deg", "lon_deg", "sigma_m")

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TimeSeries:
    """One quantity over time.

    Attributes:
        stamps_ns: (N,) strictly increasing.
        values: (N,) finite.
    """

    stamps_ns: Stamps
    values: Floats


class FlightLog:
    """The contents of a flight log.

    Args:
        path: the file.
        series: time series by the column of telemetry.csv that they fill; None where the log has none.
        heights: height above ground in metres by source, see :data:`HEIGHT_SOURCES`, or None; the rangefinder's is
            along the body's down axis.
        captures_ns: (N,) times of camera triggers; empty if none were logged.
        utc_ns: offset that converts the log's clock to UTC; None if it is unknown.
        frame_numbers: numbers of a video's frames, the first is 1, over time; None except for a video's subtitles.

    Raises:
        TelemetryError: all series are None.
    """

    def __init__(
        self,
        path: Path,
        series: Mapping[str, TimeSeries | None],
        heights: Mapping[str, TimeSeries | None],
        captures_ns: ArrayLike = (),
        utc_ns: int | None = None,
        frame_numbers: TimeSeries | None = None,
    ) -> None:
        self.path, self.utc_ns, self.frame_numbers = path, utc_ns, frame_numbers
        self.series = {name: one for name, one in series.items() if one is not None}
        self.heights = {name: one for name, one in heights.items() if one is not None}
        self.captures_ns: Stamps = np.unique(np.asarray(captures_ns, np.int64))
        if not self.series and not self.heights:
            raise TelemetryError(
                f"{path}: expected attitude, height, velocity or position, got a log with none of them"
            )

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp of all series, in nanoseconds on the log's clock."""
        all_series = [*self.series.values(), *self.heights.values()]
        return int(min(s.stamps_ns[0] for s in all_series)), int(max(s.stamps_ns[-1] for s in all_series))

    def clock_shift_ns(self, stamp_ns: int) -> int:
        """Offset in nanoseconds from timestamps like ``stamp_ns``, UTC or not, to the log's clock.

        Raises:
            TelemetryError: the stamp is UTC, the log's stamps are not, and the log has no GPS time.
        """
        if stamp_ns < UTC_FROM_NS or self.span_ns[0] >= UTC_FROM_NS:
            return 0
        if self.utc_ns is None:
            raise TelemetryError(f"{self.path}: expected GPS time, since the frames' timestamps are UTC, got none")
        return -self.utc_ns


def make_series(stamps_ns: ArrayLike, values: ArrayLike, valid: ArrayLike = True) -> TimeSeries | None:
    """Create a series in the order of time, of finite valid samples; keeps the first of equal timestamps.

    Args:
        stamps_ns: (N,) nanoseconds.
        values: (N,) numbers.
        valid: (N,) or one boolean.

    Returns:
        The series, or None if no sample is left.
    """
    with np.errstate(invalid="ignore"):  # damaged files may hold signalling NaNs
        stamps, numbers = np.asarray(stamps_ns, np.int64), np.asarray(values, np.float64)
    keep = np.isfinite(numbers) & np.asarray(valid, bool)
    stamps, first = np.unique(stamps[keep], return_index=True)
    return TimeSeries(stamps, numbers[keep][first]) if stamps.size else None


def make_position_series(
    stamps_ns: ArrayLike, lat_deg: ArrayLike, lon_deg: ArrayLike, valid: ArrayLike = True
) -> dict[str, TimeSeries | None]:
    """Create the series of latitude and longitude, without values out of range and (0, 0), which means no fix.

    Args:
        stamps_ns: (N,) nanoseconds.
        lat_deg: (N,) WGS84 latitude.
        lon_deg: (N,) WGS84 longitude.
        valid: (N,) or one boolean.

    Returns:
        ``lat_deg`` and ``lon_deg``; None if no sample is left.
    """
    lat, lon = np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)
    in_range = (np.abs(lat) <= 90.0) & (np.abs(lon) <= 180.0) & ((lat != 0.0) | (lon != 0.0))
    keep = in_range & np.asarray(valid, bool)
    return {"lat_deg": make_series(stamps_ns, lat, keep), "lon_deg": make_series(stamps_ns, lon, keep)}


def interpolate(series: TimeSeries, stamps_ns: Stamps, *, is_angle: bool = False) -> Floats:
    """Interpolate a series at other times.

    Args:
        series: the samples.
        stamps_ns: (N,) times on the same clock, in nanoseconds.
        is_angle: whether the values are angles in degrees; results are then in [-180, 180).

    Returns:
        (N,) values; NaN outside the series and in its gaps.
    """
    at, values = series.stamps_ns, np.rad2deg(np.unwrap(np.deg2rad(series.values))) if is_angle else series.values
    # Relative to the first stamp: nanoseconds since 1970 exceed the precision of a float.
    result = np.interp((stamps_ns - at[0]).astype(np.float64), (at - at[0]).astype(np.float64), values)
    after = np.clip(np.searchsorted(at, stamps_ns), 1, max(len(at) - 1, 1))
    gap_ns = at[np.minimum(after, len(at) - 1)] - at[after - 1]
    inside = (stamps_ns >= at[0]) & (stamps_ns <= at[-1])
    near_end = (stamps_ns >= at[0] - END_HOLD_NS) & (stamps_ns <= at[-1] + END_HOLD_NS)
    known = np.isin(stamps_ns, at) | np.where(inside, gap_ns <= MAX_SAMPLE_GAP_NS, near_end)
    if is_angle:
        result = wrap_difference_deg(result)
    return np.where(known, result, np.nan)


def rows_and_sources_at(
    log: FlightLog, stamps_ns: Sequence[int], names: Sequence[str]
) -> tuple[list[TelemetryRow], list[str]]:
    """Interpolate a log at the frames' capture times.

    Args:
        log: the log.
        stamps_ns: (N,) capture times on the log's clock or in UTC; strictly increasing.
        names: (N,) names of the frames.

    Returns:
        One row per frame with its stamp as given, and the source of each row's height; empty if it is unknown.

    Raises:
        TelemetryError: no frame lies within the log, or UTC cannot be converted to the log's clock.
    """
    times_ns = np.asarray(stamps_ns, np.int64) + log.clock_shift_ns(int(stamps_ns[0]))
    start_ns, end_ns = log.span_ns
    if not ((times_ns >= start_ns - END_HOLD_NS) & (times_ns <= end_ns + END_HOLD_NS)).any():
        raise TelemetryError(
            f"{log.path}: expected frames taken from {start_ns / 1e9:.3f} to {end_ns / 1e9:.3f} s of the log, got "
            f"frames from {times_ns[0] / 1e9:.3f} to {times_ns[-1] / 1e9:.3f} s; `log_offset_s` moves them"
        )
    columns = {name: _column(log, name, times_ns) for name in (*_COLUMNS, *_POSITION)}
    columns["height_agl_m"], sources = _height(log, times_ns, columns["roll_deg"], columns["pitch_deg"])
    above_take_off = np.array([source == "take-off" for source in sources])
    vague_m = np.array([take_off_sigma_m(height_m) for height_m in columns["height_agl_m"]])
    columns["height_sigma_m"] = np.where(above_take_off, vague_m, np.nan)
    columns["sigma_m"][columns["sigma_m"] < 0.0] = np.nan
    unknown = np.isnan(columns["lat_deg"]) | np.isnan(columns["lon_deg"])
    for name in _POSITION:
        columns[name] = np.where(unknown, np.nan, columns[name])
    values = [{name: _known(name, column[i]) for name, column in columns.items()} for i in range(len(names))]
    rows = [
        TelemetryRow(timestamp_ns=int(stamp_ns), frame=name, **row)
        for stamp_ns, name, row in zip(stamps_ns, names, values, strict=True)
    ]
    return rows, sources


def _column(log: FlightLog, name: str, times_ns: Stamps) -> Floats:
    if name not in log.series:
        return np.full(len(times_ns), np.nan)
    return interpolate(log.series[name], times_ns, is_angle=name in _ANGLES)


def _height(log: FlightLog, times_ns: Stamps, roll_deg: Floats, pitch_deg: Floats) -> tuple[Floats, list[str]]:
    """(N,) heights above ground in metres, each from the best source with a positive value, and the sources."""
    height_m, sources = np.full(len(times_ns), np.nan), [""] * len(times_ns)
    for source in HEIGHT_SOURCES:
        if source not in log.heights:
            continue
        found_m = interpolate(log.heights[source], times_ns)
        if source == "rangefinder":  # its beam tilts with the body
            cos_tilt = np.cos(np.deg2rad(roll_deg)) * np.cos(np.deg2rad(pitch_deg))
            found_m = found_m * np.where(np.isnan(cos_tilt), 1.0, cos_tilt)
        for i in np.flatnonzero(np.isnan(height_m) & (found_m > 0.0)):
            height_m[i], sources[i] = found_m[i], source
    return height_m, sources


def _known(name: str, value: float) -> float | None:
    if np.isnan(value):
        return None
    return wrap_heading_deg(float(value)) if name == "heading_deg" else float(value)


def truth_from_log(log: FlightLog, *, utc: bool) -> list[Truth]:
    """The positions of a log as truth, with its height and attitude at those times.

    Args:
        log: the log.
        utc: whether stamps are converted to UTC; else they stay on the log's clock.

    Raises:
        TelemetryError: the log has no position, or no GPS time although ``utc`` is requested.
    """
    if "lat_deg" not in log.series:
        raise TelemetryError(f"{log.path}: expected positions to serve as truth, got a log without any")
    times_ns = log.series["lat_deg"].stamps_ns
    shift_ns = -log.clock_shift_ns(UTC_FROM_NS) if utc else 0
    names = [str(i) for i in range(len(times_ns))]
    rows, _ = rows_and_sources_at(log, [int(stamp_ns) for stamp_ns in times_ns], names)
    return [
        truth_from_telemetry(row, row.lat_deg, row.lon_deg, shift_ns)
        for row in rows
        if row.lat_deg is not None and row.lon_deg is not None
    ]
