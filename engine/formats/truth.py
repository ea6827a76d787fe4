"""truth.csv: where the vehicle really was, at fewer moments than there are frames or more."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from pathlib import Path

from engine.errors import TelemetryError
from engine.formats.telemetry import (
    ANY,
    HALF_TURN,
    HEADING,
    LONGITUDE,
    QUARTER_TURN,
    TelemetryRow,
    cell_text,
    check_increasing,
    known_columns,
    read_table,
    write_table,
)
from engine.geo import wrap_heading_deg
from engine.values import Truth

MAX_GAP_NS = 5_000_000_000
"""Neighbours further apart than this do not say where the vehicle was in between."""

_REQUIRED = ("timestamp_ns", "lat_deg", "lon_deg")
_OPTIONAL = {
    "alt_amsl_m": ANY,
    "height_agl_m": ANY,
    "roll_deg": HALF_TURN,
    "pitch_deg": QUARTER_TURN,
    "heading_deg": HEADING,
}
_DECIMALS = {"lat_deg": 9, "lon_deg": 9} | dict.fromkeys(("roll_deg", "pitch_deg", "heading_deg"), 5)


def read_truth(path: str | Path) -> list[Truth]:
    """Read truth.csv; headings come back in [0, 360).

    Raises:
        TelemetryError: the file cannot be read, has no rows, or a row is wrong: the message names the line,
            the column, what was expected and what came.
    """
    rows: list[Truth] = []
    for cells in read_table(path, _REQUIRED, tuple(_OPTIONAL)):
        stamp_ns = cells.stamp()
        check_increasing(cells, rows[-1].timestamp_ns if rows else None, stamp_ns)
        values = {name: cells.number(name, bounds) for name, bounds in _OPTIONAL.items()}
        if values["heading_deg"] is not None:
            values["heading_deg"] = wrap_heading_deg(values["heading_deg"])
        lat_deg, lon_deg = cells.known("lat_deg", QUARTER_TURN), cells.known("lon_deg", LONGITUDE)
        rows.append(Truth(timestamp_ns=stamp_ns, lat_deg=lat_deg, lon_deg=lon_deg, **values))
    if not rows:
        raise TelemetryError(f"{path}: expected rows of truth, got a header and no rows")
    return rows


def write_truth(path: str | Path, rows: Sequence[Truth]) -> None:
    """Write truth.csv with the columns that some row knows; 9 decimals of position, 5 of angles, 0.1 mm.

    Raises:
        TelemetryError: the file cannot be written.
    """
    columns = known_columns(rows, _REQUIRED, tuple(_OPTIONAL))
    table = ([cell_text(getattr(row, name), _DECIMALS.get(name, 4)) for name in columns] for row in rows)
    write_table(path, columns, table)


def truth_at(row: TelemetryRow, lat_deg: float, lon_deg: float, shift_ns: int = 0) -> Truth:
    """A row of telemetry as truth, at a place in degrees, with its stamp moved."""
    return Truth(
        timestamp_ns=row.timestamp_ns + shift_ns,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=row.alt_amsl_m,
        height_agl_m=row.height_agl_m,
        roll_deg=row.roll_deg,
        pitch_deg=row.pitch_deg,
        heading_deg=row.heading_deg,
    )


def interpolate_truth(rows: Sequence[Truth], timestamp_ns: int, max_gap_ns: int = MAX_GAP_NS) -> Truth | None:
    """Where the vehicle was at one moment, linear between the rows before and after it.

    Headings and longitudes take the short way round their circle.

    Args:
        rows: truth in the order of time.
        timestamp_ns: the moment, on the same clock.
        max_gap_ns: how far apart the two rows may be.

    Returns:
        The truth, without what either neighbour does not know; None before the first row, after the last
        and in a gap.
    """
    after = bisect.bisect_left(rows, timestamp_ns, key=lambda row: row.timestamp_ns)
    if after < len(rows) and rows[after].timestamp_ns == timestamp_ns:
        return rows[after]
    if after in (0, len(rows)):
        return None
    a, b = rows[after - 1], rows[after]
    gap_ns = b.timestamp_ns - a.timestamp_ns
    if gap_ns > max_gap_ns:
        return None
    share = (timestamp_ns - a.timestamp_ns) / gap_ns
    heading_deg = _turned(a.heading_deg, b.heading_deg, share)
    return Truth(
        timestamp_ns=timestamp_ns,
        lat_deg=a.lat_deg + share * (b.lat_deg - a.lat_deg),
        lon_deg=a.lon_deg + share * _short_way(b.lon_deg - a.lon_deg),
        alt_amsl_m=_between(a.alt_amsl_m, b.alt_amsl_m, share),
        height_agl_m=_between(a.height_agl_m, b.height_agl_m, share),
        roll_deg=_between(a.roll_deg, b.roll_deg, share),
        pitch_deg=_between(a.pitch_deg, b.pitch_deg, share),
        heading_deg=None if heading_deg is None else wrap_heading_deg(heading_deg),
    )


def _short_way(difference_deg: float) -> float:
    return (difference_deg + 180.0) % 360.0 - 180.0


def _between(a: float | None, b: float | None, share: float) -> float | None:
    return None if a is None or b is None else a + share * (b - a)


def _turned(a_deg: float | None, b_deg: float | None, share: float) -> float | None:
    return None if a_deg is None or b_deg is None else a_deg + share * _short_way(b_deg - a_deg)
