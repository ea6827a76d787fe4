"""telemetry.csv: the vehicle's own position, height, attitude and velocity at each frame.

Convention:
    One row per frame, in the order of capture; a blank cell is unknown. See :mod:`scenematch.files.tables`.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from engine.errors import TelemetryError
from engine.values import MAX_SIGMA_M, Prior
from scenematch.files.stamps import OTHER_STAMPS, STAMP_COLUMNS, read_stamps
from scenematch.files.tables import ANY, HEADING, Bounds, CsvRow, read_table, write_known

__all__ = [
    "COLUMNS", "DEFAULT_PRIOR_SIGMA_M", "TelemetryRow", "ground_amsl_m", "open_telemetry", "read_telemetry",
    "write_telemetry",
]  # fmt: skip

DEFAULT_PRIOR_SIGMA_M = 15.0
"""Standard deviation, per axis, of a prior whose ``sigma_m`` is blank: a poor single-frequency GPS position."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TelemetryRow:
    """Telemetry of one frame; what is unknown is None.

    Attributes:
        timestamp_ns: capture time on the vehicle's clock.
        frame: file name of the image, or for a video the index of the frame from 0.
        height_agl_m: height above the ground.
        height_sigma_m: standard deviation of it, if it is known.
        alt_amsl_m: height above mean sea level.
        heading_deg: clockwise from true north in [0, 360).
        heading_sigma_deg: standard deviation of it, if it is known.
        roll_deg: positive right side down.
        pitch_deg: positive nose up.
        tilt_sigma_deg: standard deviation of roll and of pitch, if it is known.
        east_velocity_mps: velocity over ground.
        north_velocity_mps: velocity over ground.
        velocity_sigma_mps: standard deviation of it, per axis, if it is known.
        lat_deg: WGS84 latitude of a prior.
        lon_deg: WGS84 longitude of the prior.
        sigma_m: standard deviation of the prior, per axis.
    """

    timestamp_ns: int
    frame: str
    height_agl_m: float | None = None
    height_sigma_m: float | None = None
    alt_amsl_m: float | None = None
    heading_deg: float | None = None
    heading_sigma_deg: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    tilt_sigma_deg: float | None = None
    east_velocity_mps: float | None = None
    north_velocity_mps: float | None = None
    velocity_sigma_mps: float | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    sigma_m: float | None = None

    @property
    def prior(self) -> Prior | None:
        """The position with its sigma (:data:`DEFAULT_PRIOR_SIGMA_M` if blank), or None without position."""
        if self.lat_deg is None or self.lon_deg is None:
            return None
        sigma_m = DEFAULT_PRIOR_SIGMA_M if self.sigma_m is None else self.sigma_m
        return Prior(lat_deg=self.lat_deg, lon_deg=self.lon_deg, sigma_m=sigma_m)


def take_off_sigma_m(height_m: float) -> float:
    """Standard deviation of a height above take-off used as height above ground, which lies at another level.

    Five metres for ground and barometer, plus a twentieth of the height: a barometer's error on a day 15 degrees
        off the standard atmosphere.
    """
    return math.hypot(_TAKE_OFF_M, _TAKE_OFF_SHARE * height_m)


_TAKE_OFF_M, _TAKE_OFF_SHARE = 5.0, 0.05
_ABOVE_0 = math.ulp(0.0)
_QUARTER_TURN = Bounds(-90.0, 90.0, "degrees from -90 to 90")
_SIGMA = Bounds(_ABOVE_0, MAX_SIGMA_M, f"a number above 0 and at most {MAX_SIGMA_M:g}")
BOUNDS = {
    "height_agl_m": Bounds(_ABOVE_0, math.inf, "a finite number above 0"),
    "height_sigma_m": _SIGMA,
    "alt_amsl_m": ANY,
    "heading_deg": HEADING,
    "heading_sigma_deg": _SIGMA,
    "roll_deg": Bounds(-180.0, 180.0, "degrees from -180 to 180"),
    "pitch_deg": _QUARTER_TURN,
    "tilt_sigma_deg": _SIGMA,
    "east_velocity_mps": ANY,
    "north_velocity_mps": ANY,
    "velocity_sigma_mps": _SIGMA,
    "lat_deg": _QUARTER_TURN,
    "lon_deg": Bounds(-180.0, 360.0, "degrees from -180 to 360"),
    "sigma_m": Bounds(0.0, MAX_SIGMA_M, f"a number from 0 to {MAX_SIGMA_M:g}"),
}
_DECIMALS = {"lat_deg": 9, "lon_deg": 9} | dict.fromkeys(
    ("height_agl_m", "height_sigma_m", "alt_amsl_m", "sigma_m"), 3
)
_REQUIRED = ("timestamp_ns", "frame")
COLUMNS = (*STAMP_COLUMNS, "frame", *BOUNDS)
"""All columns that telemetry.csv may have."""
_HINT = "; [telemetry_columns] of the settings names those that are ours"


def read_telemetry(
    path: str | Path, frames: Container[str] | None = None, description: str = "a frame that is there"
) -> list[TelemetryRow]:
    """The rows of :func:`open_telemetry`."""
    return open_telemetry(path, frames, description)[0]


def open_telemetry(
    path: str | Path,
    frames: Container[str] | None = None,
    description: str = "a frame that is there",
    names: Mapping[str, str] = {},
) -> tuple[list[TelemetryRow], list[str]]:
    """Read telemetry.csv; headings are normalised to [0, 360).

    Args:
        path: the file.
        frames: the frame names that are allowed, or None for any.
        description: those names in words, for messages.
        names: the file's column names, by our names in :data:`COLUMNS`; other columns keep our names.

    Returns:
        One row per frame, and what was inferred rather than stated by the file, one sentence each.

    Raises:
        TelemetryError: the file cannot be read, has no rows, or a row is invalid: the message has line and column.
    """
    optional = (*STAMP_COLUMNS[1:], *BOUNDS)
    csv_rows = list(read_table(path, _REQUIRED, optional, instead=OTHER_STAMPS, names=names, hint=_HINT))
    stamps_ns, remark = read_stamps(csv_rows)
    rows: list[TelemetryRow] = []
    line_of_frame: dict[str, int] = {}
    for csv_row, stamp_ns in zip(csv_rows, stamps_ns, strict=True):
        row = _telemetry_row(csv_row, stamp_ns)
        if frames is not None and row.frame not in frames:
            raise csv_row.error("frame", description)
        if row.frame in line_of_frame:
            raise csv_row.error("frame", f"each frame once (it is also in line {line_of_frame[row.frame]})")
        line_of_frame[row.frame] = csv_row.line
        rows.append(row)
    if not rows:
        raise TelemetryError(f"{path}: expected one row per frame, got a header and no rows")
    read = {names.get(ours, ours) for ours in COLUMNS}
    unread = ", ".join(name for name in csv_rows[0].header if name and name not in read)
    remarks = [remark, unread and f"{Path(path).name}: columns that are not read: {unread}{_HINT}"]
    return rows, [each for each in remarks if each]


def _telemetry_row(csv_row: CsvRow, stamp_ns: int) -> TelemetryRow:
    values = {name: csv_row.number(name, bounds) for name, bounds in BOUNDS.items()}
    for name, other in (("lat_deg", "lon_deg"), ("lon_deg", "lat_deg")):
        if values[name] is None and values[other] is not None:
            raise csv_row.error(name, f"a value, as {other} has one")
    return TelemetryRow(timestamp_ns=stamp_ns, frame=csv_row.text("frame"), **values)


def write_telemetry(path: str | Path, rows: Sequence[TelemetryRow]) -> None:
    """Write telemetry.csv with the columns that any row has; positions to 1e-9 degrees, metres to 1 mm.

    Raises:
        TelemetryError: the file cannot be written.
    """
    write_known(path, rows, _REQUIRED, BOUNDS, _DECIMALS)


def ground_amsl_m(rows: Sequence[TelemetryRow]) -> float | None:
    """Height of the ground above mean sea level, the median of ``alt_amsl_m - height_agl_m``; None if unknown."""
    pairs = ((row.alt_amsl_m, row.height_agl_m) for row in rows)
    differences = [alt - height for alt, height in pairs if alt is not None and height is not None]
    return statistics.median(differences) if differences else None
