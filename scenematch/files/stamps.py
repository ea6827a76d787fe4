"""Timestamps of a table: nanoseconds, microseconds, milliseconds, seconds or UTC dates, named or recognised.

Convention:
    A column's name states its unit: timestamp_ns, timestamp_us, timestamp_ms, timestamp_s, timestamp_utc. If
    timestamp_ns cannot be in nanoseconds, since no camera takes more than a thousand frames a second, the unit is
    recognised by the interval between rows and by the size of UTC numbers, and reported. An ambiguous unit is
    refused.
"""

from __future__ import annotations

import itertools
import re
import statistics
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal

from engine.errors import TelemetryError
from scenematch.files.tables import CsvRow

GPS_EPOCH_S, GPS_WEEK_S = 315_964_800 - 18, 604_800
"""UTC since 1970 at which GPS counts from 0, less today's leap seconds; and a week of it."""
STAMP_COLUMNS = ("timestamp_ns", "timestamp_us", "timestamp_ms", "timestamp_s", "timestamp_utc")
"""Columns that may contain a timestamp, in order of preference."""
OTHER_STAMPS = {STAMP_COLUMNS[0]: STAMP_COLUMNS[1:]}
"""Columns that may replace ``timestamp_ns``."""
_UNIT_NS = {"timestamp_ns": 1, "timestamp_us": 10**3, "timestamp_ms": 10**6, "timestamp_s": 10**9}
_WORDS = dict(zip(_UNIT_NS, ("nanoseconds", "microseconds", "milliseconds", "seconds"), strict=True))
_SHORTEST_NS = 10**6  # between two frames
_USUAL_NS = (5 * 10**6, 20 * 10**9)  # between two frames, if the unit is unknown
_UTC_NS = (10**18, 41 * 10**17)  # the years 2001 to 2099
_NUMBER = re.compile(r"[+-]?[0-9]{1,19}(\.[0-9]{0,30})?([eE]\+?[0-9]{1,2})?")
_DATE = re.compile(
    r"([0-9]{4}[-/][0-9]{2}[-/][0-9]{2})[T ]([0-9]{2}:[0-9]{2}:[0-9]{2})(?:[.,]([0-9]{1,12}))?"
    r" ?(Z|UTC|[+-][0-9]{2}:?[0-9]{2})?"
)


def read_stamps(rows: Sequence[CsvRow]) -> tuple[list[int], str | None]:
    """The stamps of rows.

    Args:
        rows: of a table with at least one of :data:`STAMP_COLUMNS`.

    Returns:
        Nanoseconds, one per row, strictly increasing; and how they were interpreted, None if the column's name
        says it.

    Raises:
        TelemetryError: a timestamp is blank or invalid, does not increase, or has an unrecognisable unit.
    """
    column = next((name for name in STAMP_COLUMNS if any(row.values[name] for row in rows)), STAMP_COLUMNS[0])
    dates = [_DATE.fullmatch(row.values[column]) for row in rows]
    if column == "timestamp_utc" or any(dates):
        return _dated(rows, column, dates)
    values = [_number(row, column) for row in rows]
    _check_increasing(rows, column, values)
    unit = column
    if len(values) > 1:
        spacing = statistics.median(later - earlier for earlier, later in itertools.pairwise(values))
        unit = _unit(rows[0], column, values, spacing)
    stamps_ns = [
        _whole(row, column, value * _UNIT_NS[unit], unit) for row, value in zip(rows, values, strict=True)
    ]
    _check_increasing(rows, column, stamps_ns)
    if unit == column:
        return stamps_ns, None
    said = f"{column} is taken as {_WORDS[unit]}: rows are {float(spacing):g} apart"
    return stamps_ns, f"{rows[0].path.name}: {said}"


def _dated(
    rows: Sequence[CsvRow], column: str, dates: Sequence[re.Match[str] | None]
) -> tuple[list[int], str | None]:
    stamps_ns = []
    for row, date in zip(rows, dates, strict=True):
        stamp_ns = None if date is None else _utc_ns(date)
        if stamp_ns is None:
            raise row.error(column, "a date in UTC such as 2026-05-01T12:00:00.250Z")
        stamps_ns.append(stamp_ns)
    _check_increasing(rows, column, stamps_ns)
    if all(date is not None and date[4] for date in dates) or column == "timestamp_utc":
        return stamps_ns, None
    return stamps_ns, f"{rows[0].path.name}: {column} holds dates without a time zone, taken as UTC"


def _utc_ns(date: re.Match[str]) -> int | None:
    """Nanoseconds since 1970 of a date; None if there is no such date."""
    zone = "+00:00" if date[4] in (None, "Z", "UTC") else date[4]
    is_leap = date[2].endswith(":60")  # the second that datetime does not have
    try:
        clock = date[2][:6] + ("59" if is_leap else date[2][6:])
        time = datetime.fromisoformat(f"{date[1].replace('/', '-')}T{clock}{zone}")
    except ValueError:
        return None
    stamp_ns = since_1970_ns(time, date[3] or "") + is_leap * 1_000_000_000
    return stamp_ns if 0 <= stamp_ns < 2**63 else None


def since_1970_ns(time: datetime, fraction: str) -> int:
    """Nanoseconds since 1970 of a time in whole seconds with a zone, and the decimals of its seconds."""
    since = time - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + int(fraction.ljust(9, "0")[:9])


def _number(row: CsvRow, column: str) -> Decimal:
    text = row.values[column]
    if not text or not _NUMBER.fullmatch(text):
        is_blank = column == "timestamp_ns" and not text
        raise row.error(column, "whole nanoseconds" if is_blank else "a number or a date in UTC")
    return Decimal(text)


def _whole(row: CsvRow, column: str, stamp_ns: Decimal, unit: str) -> int:
    if not -(2**63) <= stamp_ns < 2**63:
        raise row.error(column, "a whole number of 64 bits, in nanoseconds")
    if unit == "timestamp_ns" and stamp_ns != round(stamp_ns):
        raise row.error(column, "a whole number")
    return round(stamp_ns)


def _check_increasing(rows: Sequence[CsvRow], column: str, values: Sequence[Decimal] | Sequence[int]) -> None:
    for k in range(1, len(values)):
        if values[k] <= values[k - 1]:
            raise rows[k].error(column, f"a stamp later than the row before ({rows[k - 1].values[column]})")


def _unit(first: CsvRow, column: str, values: Sequence[Decimal], spacing: Decimal) -> str:
    """The column whose unit the values have."""
    found = [
        unit for unit, unit_ns in _UNIT_NS.items()
        if _USUAL_NS[0] <= spacing * unit_ns <= _USUAL_NS[1] and values[-1] * unit_ns < 2**63
    ]  # fmt: skip
    utc = [
        unit for unit in found if all(_UTC_NS[0] <= value * _UNIT_NS[unit] < _UTC_NS[1] for value in values)
    ]  # fmt: skip
    is_stated = column != "timestamp_ns" or not utc
    if spacing * _UNIT_NS[column] >= _SHORTEST_NS and is_stated:
        return column
    found = utc or found
    if column == "timestamp_ns" and len(found) == 1:
        return found[0]
    apart = f"{first.path}: {column}: expected {_WORDS[column]}, got rows {float(spacing):g} apart"
    if not found:
        raise TelemetryError(f"{apart}, which is no camera's frame interval in any unit")
    units = " or ".join(_WORDS[unit] for unit in found)
    raise TelemetryError(f"{apart}, which may be {units}: name the column {' or '.join(found)}")
