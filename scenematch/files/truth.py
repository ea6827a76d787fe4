"""truth.csv: the true position, height and attitude of the vehicle, with its own timestamps."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from engine.errors import TelemetryError
from engine.geo import wrap_difference_deg, wrap_heading_deg
from engine.values import Truth
from scenematch.files.stamps import OTHER_STAMPS, STAMP_COLUMNS, read_stamps
from scenematch.files.tables import ANY, read_table, write_known
from scenematch.files.telemetry import BOUNDS, TelemetryRow

__all__ = ["Truth", "interpolate_truth", "read_truth", "write_truth"]

MAX_TRUTH_GAP_NS = 5_000_000_000
"""Largest interval between two rows that is interpolated."""

_REQUIRED = ("timestamp_ns", "lat_deg", "lon_deg")
_OPTIONAL = {
    name: BOUNDS[name] for name in ("alt_amsl_m", "height_agl_m", "roll_deg", "pitch_deg", "heading_deg")
} | {"height_agl_m": ANY}
_WRAPPED = ("lon_deg", "heading_deg")
_DECIMALS = {"lat_deg": 9, "lon_deg": 9} | dict.fromkeys(("roll_deg", "pitch_deg", "heading_deg"), 5)


def read_truth(path: str | Path) -> list[Truth]:
    """Read truth.csv; headings are normalised to [0, 360).

    Raises:
        TelemetryError: the file cannot be read, has no rows, or a row is invalid: the message has line and column.
    """
    rows: list[Truth] = []
    csv_rows = list(read_table(path, _REQUIRED, (*STAMP_COLUMNS[1:], *_OPTIONAL), instead=OTHER_STAMPS))
    for csv_row, stamp_ns in zip(csv_rows, read_stamps(csv_rows)[0], strict=True):
        values = {name: csv_row.number(name, bounds) for name, bounds in _OPTIONAL.items()}
        lat_deg, lon_deg = (csv_row.required(name, BOUNDS[name]) for name in ("lat_deg", "lon_deg"))
        rows.append(Truth(timestamp_ns=stamp_ns, lat_deg=lat_deg, lon_deg=lon_deg, **values))
    if not rows:
        raise TelemetryError(f"{path}: expected rows of truth, got a header and no rows")
    return rows


def write_truth(path: str | Path, rows: Sequence[Truth]) -> None:
    """Write truth.csv with the columns that any row has: positions to 1e-9 degrees, angles to 1e-5.

    Raises:
        TelemetryError: the file cannot be written.
    """
    write_known(path, rows, _REQUIRED, _OPTIONAL, _DECIMALS)


def truth_from_telemetry(row: TelemetryRow, lat_deg: float, lon_deg: float, shift_ns: int = 0) -> Truth:
    """A row of telemetry as truth, with another position and its stamp shifted by ``shift_ns``."""
    rest = {name: getattr(row, name) for name in _OPTIONAL}
    return Truth(timestamp_ns=row.timestamp_ns + shift_ns, lat_deg=lat_deg, lon_deg=lon_deg, **rest)


def interpolate_truth(rows: Sequence[Truth], timestamp_ns: int) -> Truth | None:
    """Interpolate truth linearly at a time; headings and longitudes along the shorter arc.

    Args:
        rows: truth in the order of time.
        timestamp_ns: the time, on the same clock.

    Returns:
        The truth, with None for values that either neighbour lacks; None outside the rows and in gaps.
    """
    after = bisect.bisect_left(rows, timestamp_ns, key=lambda row: row.timestamp_ns)
    if after < len(rows) and rows[after].timestamp_ns == timestamp_ns:
        return rows[after]
    if after in (0, len(rows)):
        return None
    a, b = rows[after - 1], rows[after]
    gap_ns = b.timestamp_ns - a.timestamp_ns
    if gap_ns > MAX_TRUTH_GAP_NS:
        return None
    fraction = (timestamp_ns - a.timestamp_ns) / gap_ns
    values: dict[str, Any] = {}
    for name in ("lat_deg", "lon_deg", *_OPTIONAL):
        begin, end = getattr(a, name), getattr(b, name)
        if begin is not None and end is not None:
            step = wrap_difference_deg(end - begin) if name in _WRAPPED else end - begin
            values[name] = begin + fraction * step
    if "heading_deg" in values:
        values["heading_deg"] = wrap_heading_deg(values["heading_deg"])
    return Truth(timestamp_ns=timestamp_ns, **values)
