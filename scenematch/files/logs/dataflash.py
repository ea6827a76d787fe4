"""ArduPilot's DataFlash logs (.BIN): their attitude, heights, velocity, positions and camera messages.

Convention:
    The clock is TimeUS, microseconds since the autopilot started. Position and altitude are the EKF's (POS),
    or the receiver's (GPS) if there is no POS; velocity is that of XKF1 or NKF1, else of GPS.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError
from scenematch.files.resampling import FlightLog, TimeSeries, make_position_series, make_series
from scenematch.files.stamps import GPS_EPOCH_S, GPS_WEEK_S

_HEAD, _FMT = b"\xa3\x95", 0x80  # the first two bytes of each message; the type that defines the others
_MAX_US = 1e13  # a third of a year: a larger stamp is corrupt
_DTYPES = {  # by format character
    "b": "<i1", "h": "<i2", "i": "<i4", "q": "<i8", "g": "<f2", "f": "<f4", "d": "<f8",
    "B": "<u1", "H": "<u2", "I": "<u4", "Q": "<u8", "M": "<u1",
    "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4",
    "n": "S4", "N": "S16", "Z": "S64", "a": "V64",
}  # fmt: skip
_DIVISORS = dict.fromkeys("cCeE", 100.0) | {"L": 1e7}  # of the characters that stand for a scaled number
_FIELDS = {
    "ATT": ("Roll", "Pitch", "Yaw"),
    "POS": ("Lat", "Lng", "Alt", "RelHomeAlt"),
    "GPS": ("I", "Status", "GMS", "GWk", "Lat", "Lng", "Alt", "Spd", "GCrs"),
    "GPA": ("I", "HAcc"),
    "XKF1": ("C", "VN", "VE"),
    "NKF1": ("C", "VN", "VE"),
    "RFND": ("Instance", "Dist", "Stat", "Orient"),
    "TERR": ("Status", "CHeight"),
    "CAM": (),
    "TRIG": (),
}
_LAST_WEEK = 10_000
_FIX_3D, _RANGE_GOOD, _DOWN, _TERRAIN_OK = 3, 4, 25, 2

Columns = Mapping[str, NDArray[np.float64]]


def read_dataflash(path: Path) -> FlightLog:
    """Read a DataFlash log.

    Raises:
        TelemetryError: the file is not a DataFlash log, or has no usable series.
    """
    data = path.read_bytes()
    if not data.startswith(_HEAD + bytes([_FMT])):
        got = data[:3].hex(" ")
        raise TelemetryError(f"{path}: expected a DataFlash log, which begins with A3 95 80, got {got}")
    with np.errstate(all="ignore"):  # corrupt files may hold any numbers, signalling NaNs included
        return _log(path, {name: columns for name, columns in _messages(data).items() if columns})


def _log(path: Path, found: Mapping[str, Columns]) -> FlightLog:
    stamps = {name: _stamps_ns(columns) for name, columns in found.items()}
    position = "POS" if "POS" in found else "GPS"
    series: dict[str, TimeSeries | None] = {
        "roll_deg": _series(found, "ATT", "Roll"),
        "pitch_deg": _series(found, "ATT", "Pitch"),
        "heading_deg": _series(found, "ATT", "Yaw"),
        "alt_amsl_m": _series(found, position, "Alt"),
        "sigma_m": _series(found, "GPA", "HAcc"),
        **_velocity(found),
    }
    if position in found:
        at = found[position]
        fixed = at["Status"] >= _FIX_3D if position == "GPS" else True
        series |= make_position_series(stamps[position], at["Lat"], at["Lng"], fixed)
    captures = next((stamps[name] for name in ("CAM", "TRIG") if name in found), ())
    return FlightLog(path, series, _heights(found), captures, _utc_ns(found.get("GPS")))


def _messages(data: bytes) -> dict[str, Columns]:
    """(N,) values by message and field, of first instances only; a field that the log lacks is NaN.

    A log is a sequence of messages, each with a header of two bytes and its type. Corrupt data is skipped up to
    the next header; a message that is truncated at the end is omitted.
    """
    formats = {_FMT: _Format("FMT", 89, "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))}
    bodies: dict[str, list[bytes]] = {name: [] for name in _FIELDS}
    at = 0
    while (at := data.find(_HEAD, at)) >= 0 and at + 3 <= len(data):
        known = formats.get(data[at + 2])
        if known is None or at + known.length > len(data):
            at += 1
            continue
        body = data[at + 3 : at + known.length]
        if known.name == "FMT":
            defined = _parse_format(body)
            if defined is not None:  # a type is defined only once; a second definition is corrupt
                formats.setdefault(body[0], defined)
        elif known.name in bodies:
            bodies[known.name].append(body)
        at += known.length
    by_name = {known.name: known for known in reversed(formats.values())}
    return {name: _columns(by_name[name], rows) for name, rows in bodies.items() if rows}


@dataclass(frozen=True, slots=True)
class _Format:
    """Layout of one message type; ``length`` includes the three bytes of its header."""

    name: str
    length: int
    kinds: str
    columns: tuple[str, ...]

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype([(name, _DTYPES[kind]) for name, kind in zip(self.columns, self.kinds, strict=True)])


def _parse_format(body: bytes) -> _Format | None:
    """The format that a FMT message defines, or None if it is inconsistent."""
    _, length, *texts = struct.unpack("<BB4s16s64s", body)
    name, kinds, columns = (text.split(b"\0")[0].decode("ascii", "replace") for text in texts)
    defined = _Format(name, length, kinds, tuple(columns.split(",")) if columns else ())
    names = set(defined.columns)
    if not len(defined.columns) == len(names) == len(kinds) or "" in names or not set(kinds) <= set(_DTYPES):
        return None
    return defined if defined.dtype.itemsize + 3 == length else None


def _columns(known: _Format, rows: list[bytes]) -> Columns:
    size = known.dtype.itemsize
    table = np.frombuffer(b"".join(row for row in rows if len(row) == size), known.dtype)
    columns = {field: np.full(len(table), np.nan) for field in ("TimeUS", *_FIELDS[known.name])}
    for field, kind in zip(known.columns, known.kinds, strict=True):
        if field in columns and table[field].dtype.kind in "iuf":
            columns[field] = table[field].astype(np.float64) / _DIVISORS.get(kind, 1.0)
    keep = np.isfinite(columns["TimeUS"]) & (np.abs(columns["TimeUS"]) < _MAX_US)
    for field in ("I", "C", "Instance"):  # older logs have no instances
        if field in columns:
            keep &= ~(columns[field] > 0)
    return {field: column[keep] for field, column in columns.items() if keep.any()}


def _stamps_ns(columns: Columns) -> NDArray[np.int64]:
    return np.rint(columns["TimeUS"]).astype(np.int64) * 1000


def _series(found: Mapping[str, Columns], name: str, field: str, valid: Any = True) -> TimeSeries | None:
    return make_series(_stamps_ns(found[name]), found[name][field], valid) if name in found else None


def _velocity(found: Mapping[str, Columns]) -> dict[str, TimeSeries | None]:
    for name in ("XKF1", "NKF1"):
        if name in found:
            return {
                "east_velocity_mps": _series(found, name, "VE"),
                "north_velocity_mps": _series(found, name, "VN"),
            }
    if "GPS" not in found:
        return {}
    gps, course = found["GPS"], np.deg2rad(found["GPS"]["GCrs"])
    stamps_ns, fixed = _stamps_ns(gps), gps["Status"] >= _FIX_3D
    return {
        "east_velocity_mps": make_series(stamps_ns, gps["Spd"] * np.sin(course), fixed),
        "north_velocity_mps": make_series(stamps_ns, gps["Spd"] * np.cos(course), fixed),
    }


def _heights(found: Mapping[str, Columns]) -> dict[str, TimeSeries | None]:
    heights = {"take-off": _series(found, "POS", "RelHomeAlt")}
    if "RFND" in found:
        down = (found["RFND"]["Stat"] == _RANGE_GOOD) & (found["RFND"]["Orient"] == _DOWN)
        heights["rangefinder"] = _series(found, "RFND", "Dist", down)
    if "TERR" in found:
        heights["terrain"] = _series(found, "TERR", "CHeight", found["TERR"]["Status"] == _TERRAIN_OK)
    return heights


def _utc_ns(gps: Columns | None) -> int | None:
    """Offset that converts TimeUS to UTC in nanoseconds: the median over GPS fixes of GPS time minus log time."""
    if gps is None:
        return None
    known = (gps["Status"] >= _FIX_3D) & (gps["GWk"] > 0) & (gps["GWk"] < _LAST_WEEK) & (gps["GMS"] >= 0)
    known &= gps["GMS"] < GPS_WEEK_S * 1000
    if not known.any():
        return None
    since_epoch_s = gps["GWk"][known].astype(np.int64) * GPS_WEEK_S + GPS_EPOCH_S
    utc_ns = since_epoch_s * 1_000_000_000 + gps["GMS"][known].astype(np.int64) * 1_000_000
    differences = np.sort(utc_ns - _stamps_ns(gps)[known])
    return int(differences[len(differences) // 2])
