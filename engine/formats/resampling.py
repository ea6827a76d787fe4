"""Resampling: the quantities of a flight log, each on its own stamps, brought to the frames' moments.

Convention:
    Stamps are nanoseconds on the log's own clock. Between two samples a value is linear, an angle takes the
    short way round its circle; samples more than :data:`MAX_GAP_NS` apart say nothing of the time between.
    Stamps from :data:`EPOCH_NS` on are UTC, earlier ones a clock that began with the log.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.errors import TelemetryError
from engine.formats.telemetry import TelemetryRow
from engine.formats.truth import truth_at
from engine.geo import wrap_heading_deg
from engine.values import Truth

MAX_GAP_NS = 2_000_000_000
"""Neighbouring samples further apart than this say nothing of the time between them."""
HOLD_NS = 100_000_000
"""How long the first and last sample hold beyond the ends: a frame's own stamp is rounded."""
EPOCH_NS = 10**18
"""Stamps from here on (September 2001) are taken as nanoseconds of UTC since 1970."""
HEIGHTS = ("rangefinder", "terrain", "take-off")
"""What a height may be above, the best first: measured, by a terrain model, above the place of take-off."""
_ANGLES = ("heading_deg", "roll_deg", "lon_deg")
_COLUMNS = ("alt_amsl_m", "heading_deg", "roll_deg", "pitch_deg", "east_velocity_mps", "north_velocity_mps")
_POSITION = ("lat_deg", "lon_deg", "sigma_m")

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Series:
    """One quantity over time.

    Attributes:
        stamps_ns: (N,) strictly increasing.
        values: (N,) finite.
    """

    stamps_ns: Stamps
    values: Floats


@dataclass(frozen=True)
class Log:
    """What a flight log knows.

    Attributes:
        path: the file.
        series: by the column of telemetry.csv that they fill; none is empty.
        heights: height above ground by its source, one of :data:`HEIGHTS`; the rangefinder's is along the
            body's down axis.
        captures_ns: (N,) when the camera took a picture, where the log says so.
        utc_ns: what takes the log's clock to UTC, where the log says so.
    """

    path: Path
    series: Mapping[str, Series]
    heights: Mapping[str, Series] = field(default_factory=dict)
    captures_ns: Stamps = field(default_factory=lambda: np.empty(0, np.int64))
    utc_ns: int | None = None

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp of all quantities."""
        every = [*self.series.values(), *self.heights.values()]
        return int(min(s.stamps_ns[0] for s in every)), int(max(s.stamps_ns[-1] for s in every))

    def clock_shift_ns(self, stamp_ns: int) -> int:
        """What is added to stamps of the kind of ``stamp_ns`` to bring them to the log's clock.

        Raises:
            TelemetryError: the stamps are UTC, the log's are not, and the log has no GPS time.
        """
        if stamp_ns < EPOCH_NS or self.span_ns[0] >= EPOCH_NS:
            return 0
        if self.utc_ns is None:
            raise TelemetryError(f"{self.path}: expected GPS time, as the frames' stamps are UTC, got none")
        return -self.utc_ns


def make_log(
    path: Path,
    series: Mapping[str, Series | None],
    heights: Mapping[str, Series | None],
    captures_ns: ArrayLike = (),
    utc_ns: int | None = None,
) -> Log:
    """A log of the quantities that there are.

    Raises:
        TelemetryError: there are none.
    """
    known = {name: values for name, values in series.items() if values is not None}
    above = {name: values for name, values in heights.items() if values is not None}
    if not known and not above:
        raise TelemetryError(
            f"{path}: expected attitude, height, velocity or position, got a log with none of them"
        )
    return Log(path, known, above, np.unique(np.asarray(captures_ns, np.int64)), utc_ns)


def make_series(stamps_ns: ArrayLike, values: ArrayLike, valid: ArrayLike = True) -> Series | None:
    """A series in the order of time, without samples that are invalid or not finite; of equal stamps the first.

    Args:
        stamps_ns: (N,) nanoseconds.
        values: (N,) numbers.
        valid: (N,) or one truth value.

    Returns:
        The series, or None where no sample is left.
    """
    with np.errstate(invalid="ignore"):  # damage may make a signalling NaN
        stamps, numbers = np.asarray(stamps_ns, np.int64), np.asarray(values, np.float64)
    keep = np.isfinite(numbers) & np.asarray(valid, bool)
    stamps, first = np.unique(stamps[keep], return_index=True)
    return Series(stamps, numbers[keep][first]) if stamps.size else None


def make_position(
    stamps_ns: ArrayLike, lat_deg: ArrayLike, lon_deg: ArrayLike, valid: ArrayLike = True
) -> dict[str, Series | None]:
    """Latitude and longitude as series, without zeros (a receiver without a fix) and without impossible places."""
    lat, lon = np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)
    real = (np.abs(lat) <= 90.0) & (np.abs(lon) <= 180.0) & ((lat != 0.0) | (lon != 0.0))
    keep = real & np.asarray(valid, bool)
    return {"lat_deg": make_series(stamps_ns, lat, keep), "lon_deg": make_series(stamps_ns, lon, keep)}


def interpolate(series: Series, stamps_ns: Stamps, *, turning: bool = False) -> Floats:
    """Values at other moments; NaN outside the series and in its gaps.

    Args:
        series: the samples.
        stamps_ns: (N,) moments on the same clock.
        turning: the values are degrees on a circle; results are in [-180, 180).

    Returns:
        (N,) values.
    """
    at, values = series.stamps_ns, np.rad2deg(np.unwrap(np.deg2rad(series.values))) if turning else series.values
    # Differences to the first stamp: nanoseconds since 1970 have more digits than a float.
    result = np.interp((stamps_ns - at[0]).astype(np.float64), (at - at[0]).astype(np.float64), values)
    after = np.clip(np.searchsorted(at, stamps_ns), 1, max(len(at) - 1, 1))
    gap_ns = at[np.minimum(after, len(at) - 1)] - at[after - 1]
    inside = (stamps_ns >= at[0]) & (stamps_ns <= at[-1])
    held = (stamps_ns >= at[0] - HOLD_NS) & (stamps_ns <= at[-1] + HOLD_NS)
    known = np.isin(stamps_ns, at) | np.where(inside, gap_ns <= MAX_GAP_NS, held)
    if turning:
        result = (result + 180.0) % 360.0 - 180.0
    return np.where(known, result, np.nan)


def telemetry_at(
    log: Log, stamps_ns: Sequence[int], names: Sequence[str]
) -> tuple[list[TelemetryRow], dict[str, int]]:
    """What a log says of each frame.

    Args:
        log: the log.
        stamps_ns: when each frame was taken, on the log's clock or in UTC; strictly increasing.
        names: the frames.

    Returns:
        One row a frame, with its stamp as given; and how many frames have their height from which source.

    Raises:
        TelemetryError: no frame was taken while the log ran, or UTC cannot be brought to the log's clock.
    """
    moments = np.asarray(stamps_ns, np.int64) + log.clock_shift_ns(int(stamps_ns[0]))
    begin, end = log.span_ns
    if not ((moments >= begin - HOLD_NS) & (moments <= end + HOLD_NS)).any():
        raise TelemetryError(
            f"{log.path}: expected frames taken from {begin / 1e9:.3f} to {end / 1e9:.3f} s of the log, got "
            f"frames from {moments[0] / 1e9:.3f} to {moments[-1] / 1e9:.3f} s; `log_offset_s` moves them"
        )
    columns = {name: _column(log, name, moments) for name in (*_COLUMNS, *_POSITION)}
    columns["height_agl_m"], sources = _height(log, moments, columns["roll_deg"], columns["pitch_deg"])
    columns["sigma_m"][columns["sigma_m"] < 0.0] = np.nan
    lost = np.isnan(columns["lat_deg"]) | np.isnan(columns["lon_deg"])
    for name in _POSITION:
        columns[name] = np.where(lost, np.nan, columns[name])
    values = [{name: _known(name, column[i]) for name, column in columns.items()} for i in range(len(names))]
    rows = [
        TelemetryRow(timestamp_ns=int(stamp_ns), frame=name, **row)
        for stamp_ns, name, row in zip(stamps_ns, names, values, strict=True)
    ]
    return rows, dict(Counter(source for source in sources if source))


def _column(log: Log, name: str, moments: Stamps) -> Floats:
    if name not in log.series:
        return np.full(len(moments), np.nan)
    return interpolate(log.series[name], moments, turning=name in _ANGLES)


def _height(log: Log, moments: Stamps, roll_deg: Floats, pitch_deg: Floats) -> tuple[Floats, list[str]]:
    """(N,) heights above ground, each from the best source that knows one above 0, and the sources' names."""
    height_m, sources = np.full(len(moments), np.nan), [""] * len(moments)
    for source in HEIGHTS:
        if source not in log.heights:
            continue
        found_m = interpolate(log.heights[source], moments)
        if source == "rangefinder":  # its beam leans with the body
            lean = np.cos(np.deg2rad(roll_deg)) * np.cos(np.deg2rad(pitch_deg))
            found_m = found_m * np.where(np.isnan(lean), 1.0, lean)
        for i in np.flatnonzero(np.isnan(height_m) & (found_m > 0.0)):
            height_m[i], sources[i] = found_m[i], source
    return height_m, sources


def _known(name: str, value: float) -> float | None:
    if np.isnan(value):
        return None
    return wrap_heading_deg(float(value)) if name == "heading_deg" else float(value)


def truth_of(log: Log, *, utc: bool) -> list[Truth]:
    """The log's own positions as truth, with height and attitude where it knows them at those moments.

    Args:
        log: the log.
        utc: whether the stamps are to be UTC, as those of the frames are; else the log's own clock.

    Raises:
        TelemetryError: the log has no position, or no GPS time where ``utc`` is asked for.
    """
    if "lat_deg" not in log.series:
        raise TelemetryError(f"{log.path}: expected positions to serve as truth, got a log without any")
    moments = log.series["lat_deg"].stamps_ns
    shift_ns = -log.clock_shift_ns(EPOCH_NS) if utc else 0
    names = [str(i) for i in range(len(moments))]
    rows, _ = telemetry_at(log, [int(stamp_ns) for stamp_ns in moments], names)
    return [
        truth_at(row, row.lat_deg, row.lon_deg, shift_ns)
        for row in rows
        if row.lat_deg is not None and row.lon_deg is not None
    ]
