"""track.csv: what a run made of every frame, one row a frame, written as the run goes."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import TracebackType
from typing import TextIO

from engine.errors import TelemetryError
from engine.formats.telemetry import LONGITUDE, NOT_NEGATIVE, QUARTER_TURN, Cells, cell_text, read_table
from engine.values import Fix, NoFix, Reason


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackRow:
    """One row of track.csv; what is unknown is None. The fields are the columns, in their order.

    Attributes:
        timestamp_ns: capture time of the frame.
        frame: name of the frame.
        status: "fix" or "no_fix".
        reason: value of :class:`engine.values.Reason` where refused.
        lat_deg: WGS84 latitude of the camera.
        lon_deg: WGS84 longitude of the camera.
        east_m: east of the map's origin.
        north_m: north of the map's origin.
        up_m: height in the surface model's datum.
        sigma_east_m: standard deviation east.
        sigma_north_m: standard deviation north.
        covariance_en_m2: covariance of east and north.
        score: NCC, or the share of matches that agree with the pose.
        method: "ncc" or "sift".
        window_width_px: columns of the map that were searched.
        window_height_px: rows of the map that were searched.
        latency_ms: from the frame's arrival to its result.
        deadline_met: whether the result came inside the budget; None where there was none.
    """

    timestamp_ns: int | None
    frame: str
    status: str
    reason: str | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    east_m: float | None = None
    north_m: float | None = None
    up_m: float | None = None
    sigma_east_m: float | None = None
    sigma_north_m: float | None = None
    covariance_en_m2: float | None = None
    score: float | None = None
    method: str | None = None
    window_width_px: int | None = None
    window_height_px: int | None = None
    latency_ms: float | None = None
    deadline_met: bool | None = None

    @property
    def fixed(self) -> bool:
        """Whether the frame gave a position."""
        return self.status == "fix"


COLUMNS = tuple(f.name for f in fields(TrackRow))
"""The header of track.csv."""
_POSITION = ("lat_deg", "lon_deg", "east_m", "north_m", "sigma_east_m", "sigma_north_m", "covariance_en_m2")
_DECIMALS = {"lat_deg": 9, "lon_deg": 9, "covariance_en_m2": 6} | dict.fromkeys(
    ("east_m", "north_m", "up_m", "latency_ms"), 3
)


def track_row(name: str, result: Fix | NoFix, *, latency_ms: float | None, deadline_met: bool | None) -> TrackRow:
    """The row of one frame's result.

    Args:
        name: the frame's name.
        result: the fix or the refusal.
        latency_ms: from the frame's arrival to its result.
        deadline_met: whether that was inside the budget; None where there was none.
    """
    window = result.window
    row = TrackRow(
        timestamp_ns=result.timestamp_ns,
        frame=name,
        status="no_fix" if isinstance(result, NoFix) else "fix",
        score=None if result.score is None else float(result.score),
        method=result.method,
        window_width_px=None if window is None else window.width_px,
        window_height_px=None if window is None else window.height_px,
        latency_ms=latency_ms,
        deadline_met=deadline_met,
    )
    if isinstance(result, NoFix):
        return replace(row, reason=result.reason.value)
    covariance = result.covariance_m2
    return replace(
        row,
        lat_deg=float(result.lat_deg),
        lon_deg=float(result.lon_deg),
        east_m=float(result.east_m),
        north_m=float(result.north_m),
        up_m=None if result.up_m is None else float(result.up_m),
        sigma_east_m=math.sqrt(covariance[0, 0]),
        sigma_north_m=math.sqrt(covariance[1, 1]),
        covariance_en_m2=float(covariance[0, 1]),
    )


class TrackWriter:
    """Appends rows to a track.csv and flushes each, so that an interrupted run keeps what it has.

    Example:
        >>> with TrackWriter("out/track.csv") as track:  # doctest: +SKIP
        ...     track.write(track_row(name, result, latency_ms=12.0, deadline_met=True))

    Raises:
        TelemetryError: the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self._file: TextIO = self.path.open("w", encoding="utf-8", newline="")
        except OSError as error:
            raise TelemetryError(f"{path}: cannot be written: {error.strerror or error}") from None
        self._csv = csv.writer(self._file, lineterminator="\n")
        self._append(COLUMNS)

    def write(self, row: TrackRow) -> None:
        """Append one row."""
        self._append([cell_text(getattr(row, name), _DECIMALS.get(name, 4)) for name in COLUMNS])

    def _append(self, cells: Iterable[str]) -> None:
        try:
            self._csv.writerow(cells)
            self._file.flush()
        except OSError as error:
            raise TelemetryError(f"{self.path}: cannot be written: {error.strerror or error}") from None

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()

    def __enter__(self) -> TrackWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def write_track(path: str | Path, rows: Iterable[TrackRow]) -> None:
    """Write a whole track.csv: 9 decimals of a degree, 1 mm, sigmas and scores to 4 decimals.

    Raises:
        TelemetryError: the file cannot be written.
    """
    with TrackWriter(path) as writer:
        for row in rows:
            writer.write(row)


def read_track(path: str | Path) -> list[TrackRow]:
    """Read track.csv; a run that was interrupted before its first frame gives no rows.

    Raises:
        TelemetryError: the file cannot be read, or a row is wrong: the message names the line, the column,
            what was expected and what came.
    """
    return [_row(cells) for cells in read_table(path, COLUMNS)]


def _row(cells: Cells) -> TrackRow:
    status, reason = cells.text("status"), cells.values["reason"] or None
    if status not in ("fix", "no_fix"):
        raise cells.error("status", "fix or no_fix")
    if reason is not None and reason not in {known.value for known in Reason}:
        raise cells.error("reason", "a known reason or nothing")
    if cells.values["deadline_met"] not in ("", "true", "false"):
        raise cells.error("deadline_met", "true, false or nothing")
    for column in _POSITION:
        if status == "fix" and not cells.values[column]:
            raise cells.error(column, "a number, as the row is a fix")
    met = {"true": True, "false": False}.get(cells.values["deadline_met"])
    return TrackRow(
        timestamp_ns=cells.integer("timestamp_ns"),
        frame=cells.text("frame"),
        status=status,
        reason=reason,
        lat_deg=cells.number("lat_deg", QUARTER_TURN),
        lon_deg=cells.number("lon_deg", LONGITUDE),
        east_m=cells.number("east_m"),
        north_m=cells.number("north_m"),
        up_m=cells.number("up_m"),
        sigma_east_m=cells.number("sigma_east_m", NOT_NEGATIVE),
        sigma_north_m=cells.number("sigma_north_m", NOT_NEGATIVE),
        covariance_en_m2=cells.number("covariance_en_m2"),
        score=cells.number("score"),
        method=cells.values["method"] or None,
        window_width_px=cells.integer("window_width_px"),
        window_height_px=cells.integer("window_height_px"),
        latency_ms=cells.number("latency_ms", NOT_NEGATIVE),
        deadline_met=met,
    )
