"""CSV tables: the reader and writer that telemetry, truth and track share.

Convention:
    A blank cell is unknown; columns that were not requested are ignored. A byte order mark, either line ending,
    and semicolons or tabs instead of commas, with decimal commas, are accepted. A message names the file, the line
    in the file (the header is line 1), the column, what was expected and what came.
"""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TextIO

from engine.errors import TelemetryError
from engine.geo import wrap_heading_deg

_INTEGER = re.compile(r"[+-]?[0-9]{1,19}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_DECIMAL = re.compile(r"[+-]?[0-9]*([.,])[0-9]+([eE][+-]?[0-9]+)?")


@dataclass(frozen=True, slots=True)
class Bounds:
    """The range of a column, both ends included.

    Attributes:
        low: the smallest value.
        high: the largest value.
        text: the range in words, for messages.
    """

    low: float
    high: float
    text: str


ANY = Bounds(-math.inf, math.inf, "a finite number")
HEADING = Bounds(-360.0, 360.0, "degrees from -360 to 360")
"""Ranges of columns; others are given where the columns are."""


@dataclass(frozen=True, slots=True)
class CsvRow:
    """One row of a CSV table with its position in the file.

    Attributes:
        path: the file.
        line: line number in the file, from 1.
        values: stripped text by column; blank where the file lacks the column.
        header: all columns of the file.
    """

    path: Path
    line: int
    values: Mapping[str, str]
    header: Sequence[str]

    def error(self, column: str, expected: str) -> TelemetryError:
        """Create the error of one cell."""
        return TelemetryError(
            f"{self.path}: line {self.line}, {column}: expected {expected}, got {quoted(self.values[column])}"
        )

    def text(self, column: str) -> str:
        """The text of a cell that must not be blank."""
        if not self.values[column]:
            raise self.error(column, "a value")
        return self.values[column]

    def integer(self, column: str) -> int | None:
        """A 64-bit integer, or None if blank."""
        text = self.values[column]
        if not text:
            return None
        if not _INTEGER.fullmatch(text) or not -(2**63) <= int(text) < 2**63:
            raise self.error(column, "a whole number")
        return int(text)

    def number(self, column: str, bounds: Bounds = ANY) -> float | None:
        """A finite number within ``bounds``, or None if blank; a heading is normalised to [0, 360)."""
        text = self.values[column]
        if not text:
            return None
        # float() alone would accept "nan", "inf" and "1_000".
        value = float(text) if _NUMBER.fullmatch(text) else math.nan
        if not (math.isfinite(value) and bounds.low <= value <= bounds.high):
            raise self.error(column, bounds.text)
        return wrap_heading_deg(value) if bounds is HEADING else value

    def required(self, column: str, bounds: Bounds = ANY) -> float:
        """A finite number within ``bounds`` that must not be blank."""
        value = self.number(column, bounds)
        if value is None:
            raise self.error(column, bounds.text)
        return value


def cells_of(cls: type[Any], row: CsvRow, bounds: Mapping[str, Bounds] = {}) -> dict[str, Any]:
    """The cells of a row, each as the field of a dataclass that it fills.

    Args:
        cls: dataclass of texts and numbers; those that may be None are None if blank.
        row: has columns named after some of its fields.
        bounds: ranges by column.
    """
    readers: dict[str, Callable[[str], Any]] = {
        "str": row.text,
        "str | None": lambda name: row.values[name] or None,
        "int | None": row.integer,
        "bool | None": lambda name: {"true": True, "false": False}.get(row.values[name]),
        "float | None": lambda name: row.number(name, bounds.get(name, ANY)),
    }
    return {each.name: readers[str(each.type)](each.name) for each in fields(cls) if each.name in row.values}


def quoted(text: str) -> str:
    """Quote a piece of a file for a message: short, on one line."""
    return repr(text) if len(text) <= 40 else repr(text[:40]) + "..."


def read_table(
    path: str | Path,
    required: Sequence[str],
    optional: Sequence[str] = (),
    *,
    instead: Mapping[str, Sequence[str]] = {},
    names: Mapping[str, str] = {},
    hint: str = "",
) -> Iterator[CsvRow]:
    """Read the rows of a CSV file with a header.

    Args:
        path: the file.
        required: columns that the header must contain.
        optional: columns that it may contain.
        instead: for a required column, optional ones that can replace it.
        names: the file's column names, if they differ from ours.
        hint: what to add to the message about a missing required column.

    Yields:
        One :class:`CsvRow` per row that is not blank, with all of ``required`` and ``optional`` as keys.

    Raises:
        TelemetryError: the file is missing, empty, not UTF-8 or not CSV, lacks a required column, repeats
            one, or has a row of another length than its header.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            delimiter = _delimiter(file)
            reader = csv.reader(file, delimiter=delimiter)
            header = _names(path, reader, required)
            places = {column: _place(path, header, column, names) for column in (*required, *optional)}
            lacking = [c for c in required if all(places[name] is None for name in (c, *instead.get(c, ())))]
            if lacking:
                its = f"its columns are {quoted(','.join(header))}{hint}"
                raise TelemetryError(f"{path}: line 1: lacks the column {lacking[0]}; {its}")
            marks: dict[str, str] = {}
            for row in reader:
                if any(cell.strip() for cell in row):
                    _check_length(path, reader.line_num, row, len(header))
                    cells = {name: "" if i is None else row[i].strip() for name, i in places.items()}
                    if delimiter != ",":
                        cells = _pointed(path, reader.line_num, cells, marks)
                    yield CsvRow(path, reader.line_num, cells, header)
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


def _delimiter(file: TextIO) -> str:
    """The header's separator: the most common of comma, semicolon and tab."""
    line = file.readline()
    file.seek(0)
    return max((",", ";", "\t"), key=line.count)


def _names(path: Path, reader: Iterator[list[str]], required: Sequence[str]) -> list[str]:
    """The columns of the header; some programs quote it as one cell."""
    names = next(reader, [])
    names = [name.strip() for name in (names[0].split(",") if len(names) == 1 else names)]
    if not any(names):
        raise TelemetryError(f"{path}: expected a header with {', '.join(required)}, got an empty first line")
    return names


def _place(path: Path, header: Sequence[str], column: str, names: Mapping[str, str]) -> int | None:
    """The position of a column in a row; None if the file lacks it."""
    name = names.get(column, column)
    count = header.count(name)
    if count > 1:
        raise TelemetryError(f"{path}: line 1, {name}: expected the column once, got it {count} times")
    if not count and column in names:
        raise TelemetryError(
            f"{path}: line 1: lacks the column {name}, which the settings name as {column}; "
            f"its columns are {quoted(','.join(header))}"
        )
    return header.index(name) if count else None


def _pointed(path: Path, line: int, cells: Mapping[str, str], marks: dict[str, str]) -> dict[str, str]:
    """Cells with a decimal point in place of a comma; ``marks`` keeps the first number with each of the two."""
    for cell in cells.values():
        if found := _DECIMAL.fullmatch(cell):
            marks.setdefault(found[1], cell)
    if len(marks) > 1:
        raise TelemetryError(
            f"{path}: line {line}: expected one decimal mark, got {quoted(marks[','])} and {quoted(marks['.'])}"
        )
    return {name: cell.replace(",", ".") if _DECIMAL.fullmatch(cell) else cell for name, cell in cells.items()}


def _check_length(path: Path, line: int, row: Sequence[str], count: int) -> None:
    """Spreadsheets append commas to lines; a cell with content must have a column."""
    if len(row) < count or any(cell.strip() for cell in row[count:]):
        raise TelemetryError(f"{path}: line {line}: expected {count} cells as in the header, got {len(row)}")


def cell_text(value: object, decimals: int) -> str:
    """Format a value as a CSV cell: None is blank, a float has fixed decimals and no negative zero."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{round(value, decimals) + 0.0:.{decimals}f}"
    return str(value)


def write_known(
    path: str | Path,
    rows: Sequence[Any],
    required: Sequence[str],
    optional: Iterable[str],
    decimals: Mapping[str, int],
) -> None:
    """Write the required columns, and the optional ones that any row has.

    Args:
        path: the file.
        rows: with an attribute for each column; None is unknown.
        required: columns to write.
        optional: columns to write if at least one row has a value.
        decimals: of a number, by column; 4 for others.

    Raises:
        TelemetryError: the file cannot be written.
    """
    known = [name for name in optional if any(getattr(row, name) is not None for row in rows)]
    columns = [*required, *known]
    table = ([cell_text(getattr(row, name), decimals.get(name, 4)) for name in columns] for row in rows)
    write_table(path, columns, table)


def write_table(path: str | Path, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a header and rows as UTF-8 with line feeds, each at once.

    Raises:
        TelemetryError: the file cannot be written.
    """
    try:
        with Path(path).open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            for row in itertools.chain([columns], rows):
                writer.writerow(row)
                file.flush()
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be written: {error.strerror or error}") from None
