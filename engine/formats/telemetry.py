"""telemetry.csv: what the vehicle knew at each frame; and the one reader of CSV tables that the formats share.

Convention:
    One row a frame, in the order of capture. A blank cell is unknown; columns that nobody asked for are
    ignored. A byte order mark and either line ending are accepted. A message names the file, the line in
    the file (the header is line 1), the column, what was expected and what came.
"""

from __future__ import annotations

import csv
import math
import re
import statistics
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.errors import TelemetryError
from engine.geo import wrap_heading_deg
from engine.values import MAX_SIGMA_M, Prior

DEFAULT_PRIOR_SIGMA_M = 15.0
"""Standard deviation, per axis, of a prior whose ``sigma_m`` is blank: a poor single-frequency GPS position."""

_STAMP = re.compile(r"[+-]?[0-9]{1,19}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True, slots=True)
class Bounds:
    """The values that a column takes, both ends included.

    Attributes:
        low: the smallest value.
        high: the largest value.
        text: the same in words, for the message.
    """

    low: float
    high: float
    text: str


ANY = Bounds(-math.inf, math.inf, "a finite number")
HEADING = Bounds(-360.0, 360.0, "degrees from -360 to 360")
HALF_TURN = Bounds(-180.0, 180.0, "degrees from -180 to 180")
QUARTER_TURN = Bounds(-90.0, 90.0, "degrees from -90 to 90")
LONGITUDE = Bounds(-180.0, 360.0, "degrees from -180 to 360")
POSITIVE = Bounds(math.ulp(0.0), math.inf, "a finite number above 0")
NOT_NEGATIVE = Bounds(0.0, math.inf, "a finite number of 0 or more")
SIGMA = Bounds(0.0, MAX_SIGMA_M, f"a number from 0 to {MAX_SIGMA_M:g}")


@dataclass(frozen=True, slots=True)
class Cells:
    """One row of a CSV table, and where it stands.

    Attributes:
        path: the file.
        line: the row's line in the file, from 1.
        values: text by column, stripped; blank where the file lacks the column.
    """

    path: Path
    line: int
    values: Mapping[str, str]

    def error(self, column: str, expected: str) -> TelemetryError:
        """The refusal of one cell, ready to raise."""
        return TelemetryError(
            f"{self.path}: line {self.line}, {column}: expected {expected}, got {shown(self.values[column])}"
        )

    def text(self, column: str) -> str:
        """A cell that must not be blank."""
        if not self.values[column]:
            raise self.error(column, "a value")
        return self.values[column]

    def integer(self, column: str) -> int | None:
        """A whole number of at most 64 bits, or None where blank."""
        text = self.values[column]
        if not text:
            return None
        if not _STAMP.fullmatch(text) or not -(2**63) <= int(text) < 2**63:
            raise self.error(column, "a whole number")
        return int(text)

    def stamp(self, column: str = "timestamp_ns") -> int:
        """A time in nanoseconds that must not be blank."""
        value = self.integer(column)
        if value is None:
            raise self.error(column, "whole nanoseconds")
        return value

    def number(self, column: str, bounds: Bounds = ANY) -> float | None:
        """A finite number inside ``bounds``, or None where blank."""
        text = self.values[column]
        if not text:
            return None
        # float() alone would take "nan", "inf" and "1_000".
        value = float(text) if _NUMBER.fullmatch(text) else math.nan
        if not (math.isfinite(value) and bounds.low <= value <= bounds.high):
            raise self.error(column, bounds.text)
        return value

    def known(self, column: str, bounds: Bounds = ANY) -> float:
        """The same, where blank is not allowed."""
        value = self.number(column, bounds)
        if value is None:
            raise self.error(column, bounds.text)
        return value


def shown(text: str) -> str:
    """A piece of a file as a message may hold it: quoted, on one line, short."""
    return repr(text) if len(text) <= 40 else repr(text[:40]) + "..."


def read_table(path: str | Path, required: Sequence[str], optional: Sequence[str] = ()) -> Iterator[Cells]:
    """The rows of a CSV file with a header.

    Args:
        path: the file.
        required: columns that the header must name.
        optional: columns that it may name.

    Yields:
        One :class:`Cells` a row that is not blank, with all of ``required`` and ``optional`` as keys.

    Raises:
        TelemetryError: the file is missing, empty, not UTF-8 or not CSV, lacks a required column, names one
            twice, or has a row of another length than its header.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            columns = _header(path, reader, required, optional)
            for row in reader:
                if any(cell.strip() for cell in row):
                    yield _cells(path, reader.line_num, row, columns)
    except FileNotFoundError:
        raise TelemetryError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise TelemetryError(
            f"{path}: expected UTF-8 text, got the byte {error.object[error.start]:#04x}"
        ) from None
    except csv.Error as error:
        raise TelemetryError(f"{path}: line {reader.line_num}: expected comma-separated text: {error}") from None
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be read: {error.strerror or error}") from None


@dataclass(frozen=True, slots=True)
class _Columns:
    count: int
    index: Mapping[str, int | None]


def _header(path: Path, reader: Iterator[list[str]], required: Sequence[str], optional: Sequence[str]) -> _Columns:
    names = [name.strip() for name in next(reader, [])]
    if not any(names):
        raise TelemetryError(f"{path}: expected a header with {', '.join(required)}, got an empty first line")
    for column in (*required, *optional):
        if names.count(column) > 1:
            raise TelemetryError(
                f"{path}: line 1, {column}: expected the column once, got it {names.count(column)} times"
            )
    for column in required:
        if column not in names:
            raise TelemetryError(
                f"{path}: line 1: lacks the column {column}; its columns are {shown(','.join(names))}"
            )
    index = {column: names.index(column) if column in names else None for column in (*required, *optional)}
    return _Columns(len(names), index)


def _cells(path: Path, line: int, row: list[str], columns: _Columns) -> Cells:
    # A spreadsheet may leave commas at the end of a line; cells that say something must have a column.
    if len(row) < columns.count or any(cell.strip() for cell in row[columns.count :]):
        raise TelemetryError(
            f"{path}: line {line}: expected {columns.count} cells as in the header, got {len(row)}"
        )
    return Cells(path, line, {name: "" if i is None else row[i].strip() for name, i in columns.index.items()})


def check_increasing(cells: Cells, previous_ns: int | None, stamp_ns: int) -> None:
    """Refuse a row whose stamp is not later than that of the row before.

    Raises:
        TelemetryError: the stamp repeats or goes back.
    """
    if previous_ns is not None and stamp_ns <= previous_ns:
        raise cells.error("timestamp_ns", f"a stamp later than the row before ({previous_ns})")


def known_columns(rows: Sequence[Any], required: Sequence[str], optional: Sequence[str]) -> list[str]:
    """The required columns, and those of the optional ones in which some row knows a value."""
    return [*required, *(name for name in optional if any(getattr(row, name) is not None for row in rows))]


def cell_text(value: object, decimals: int) -> str:
    """How a value stands in a CSV cell: None is blank, a number has fixed decimals and no negative zero."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{round(value, decimals) + 0.0:.{decimals}f}"
    return str(value)


def write_table(path: str | Path, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a header and rows as UTF-8 with plain line feeds.

    Raises:
        TelemetryError: the file cannot be written.
    """
    try:
        with Path(path).open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(rows)
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be written: {error.strerror or error}") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class TelemetryRow:
    """What the vehicle knew when one frame was taken; what is unknown is None.

    Attributes:
        timestamp_ns: capture time on the vehicle's clock.
        frame: file name of the picture, or for a video the index of the frame from 0.
        height_agl_m: height above the ground.
        alt_amsl_m: height above mean sea level.
        heading_deg: clockwise from true north in [0, 360).
        roll_deg: positive right side down.
        pitch_deg: positive nose up.
        east_velocity_mps: velocity over ground.
        north_velocity_mps: velocity over ground.
        lat_deg: WGS84 latitude of a prior.
        lon_deg: WGS84 longitude of the same.
        sigma_m: standard deviation of the prior, per axis.
    """

    timestamp_ns: int
    frame: str
    height_agl_m: float | None = None
    alt_amsl_m: float | None = None
    heading_deg: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    east_velocity_mps: float | None = None
    north_velocity_mps: float | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    sigma_m: float | None = None

    @property
    def prior(self) -> Prior | None:
        """The position of the row with its sigma (:data:`DEFAULT_PRIOR_SIGMA_M` where blank), or None."""
        if self.lat_deg is None or self.lon_deg is None:
            return None
        sigma_m = DEFAULT_PRIOR_SIGMA_M if self.sigma_m is None else self.sigma_m
        return Prior(lat_deg=self.lat_deg, lon_deg=self.lon_deg, sigma_m=sigma_m)


_BOUNDS = {
    "height_agl_m": POSITIVE,
    "alt_amsl_m": ANY,
    "heading_deg": HEADING,
    "roll_deg": HALF_TURN,
    "pitch_deg": QUARTER_TURN,
    "east_velocity_mps": ANY,
    "north_velocity_mps": ANY,
    "lat_deg": QUARTER_TURN,
    "lon_deg": LONGITUDE,
    "sigma_m": SIGMA,
}
_DECIMALS = {"lat_deg": 9, "lon_deg": 9} | dict.fromkeys(("height_agl_m", "alt_amsl_m", "sigma_m"), 3)
_REQUIRED = ("timestamp_ns", "frame")


def read_telemetry(
    path: str | Path, frames: Container[str] | None = None, described: str = "a frame that is there"
) -> list[TelemetryRow]:
    """Read telemetry.csv; headings come back in [0, 360).

    Args:
        path: the file.
        frames: the names that a row may give, or None to take any.
        described: those names in words, for the message.

    Raises:
        TelemetryError: the file cannot be read, has no rows, or a row is wrong (see the module's convention).
    """
    rows: list[TelemetryRow] = []
    line_of_frame: dict[str, int] = {}
    for cells in read_table(path, _REQUIRED, tuple(_BOUNDS)):
        row = _telemetry_row(cells)
        check_increasing(cells, rows[-1].timestamp_ns if rows else None, row.timestamp_ns)
        if frames is not None and row.frame not in frames:
            raise cells.error("frame", described)
        if row.frame in line_of_frame:
            raise cells.error("frame", f"each frame once (it stands in line {line_of_frame[row.frame]} too)")
        line_of_frame[row.frame] = cells.line
        rows.append(row)
    if not rows:
        raise TelemetryError(f"{path}: expected one row a frame, got a header and no rows")
    return rows


def _telemetry_row(cells: Cells) -> TelemetryRow:
    values = {name: cells.number(name, bounds) for name, bounds in _BOUNDS.items()}
    for name, other in (("lat_deg", "lon_deg"), ("lon_deg", "lat_deg")):
        if values[name] is None and values[other] is not None:
            raise cells.error(name, f"a value, as {other} has one")
    if values["heading_deg"] is not None:
        values["heading_deg"] = wrap_heading_deg(values["heading_deg"])
    return TelemetryRow(timestamp_ns=cells.stamp(), frame=cells.text("frame"), **values)


def write_telemetry(path: str | Path, rows: Sequence[TelemetryRow]) -> None:
    """Write telemetry.csv with the columns that some row knows; 9 decimals of a degree of position, 1 mm, 0.0001.

    Raises:
        TelemetryError: the file cannot be written.
    """
    columns = known_columns(rows, _REQUIRED, tuple(_BOUNDS))
    table = ([cell_text(getattr(row, name), _DECIMALS.get(name, 4)) for name in columns] for row in rows)
    write_table(path, columns, table)


def ground_amsl_m(rows: Sequence[TelemetryRow]) -> float | None:
    """Height of the ground above mean sea level: the median of ``alt_amsl_m - height_agl_m``, or None."""
    pairs = ((row.alt_amsl_m, row.height_agl_m) for row in rows)
    differences = [alt - height for alt, height in pairs if alt is not None and height is not None]
    return statistics.median(differences) if differences else None
