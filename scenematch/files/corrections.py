"""Correct telemetry that is wrong in a known way: units, signs, swapped columns, offsets, a clock."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from engine.errors import OptionError, TelemetryError
from engine.geo import wrap_heading_deg
from scenematch.files.telemetry import TelemetryRow

_ANGLES = ("roll_deg", "pitch_deg", "heading_deg")
_NUMBERS = tuple(f.name for f in fields(TelemetryRow) if f.name != "frame")
_NUMBER = r"[0-9]+(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?"
_RULE = re.compile(rf"(\w+)=([+-]?)(?:({_NUMBER})\*)?([A-Za-z]\w*)([+-]{_NUMBER})?")
_OFFSETS = {"heading_offset_deg": 360.0, "height_offset_m": 1e4, "offset_s": 1e5}
_MAX_RADIANS = 2.0 * math.pi + 1e-3  # of a heading; a larger one was negative before wrapping
_INTERPOLATED = (
    *_ANGLES, "height_agl_m", "alt_amsl_m", "east_velocity_mps", "north_velocity_mps", "lat_deg", "lon_deg",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Corrections:
    """Corrections of every telemetry row, in this order.

    Attributes:
        angles: unit of roll, pitch and heading, "degrees" or "radians".
        columns: "NAME=[-][FACTOR*]NAME[+OFFSET]", each computed from the original row: "roll_deg=-pitch_deg",
            "height_agl_m=0.3048*height_agl_m".
        heading_offset_deg: added to the heading.
        height_offset_m: added to the height above ground.
        offset_s: added to the telemetry's times, but not to the pictures'.

    Raises:
        OptionError: a value is invalid.
    """

    angles: str = "degrees"
    columns: tuple[str, ...] = ()
    heading_offset_deg: float = 0.0
    height_offset_m: float = 0.0
    offset_s: float = 0.0

    def __post_init__(self) -> None:
        if self.angles not in ("degrees", "radians"):
            raise OptionError(f"angles: expected degrees or radians, got {self.angles!r}")
        for name, most in _OFFSETS.items():
            value = getattr(self, name)
            if not abs(value) <= most:  # NaN fails too
                raise OptionError(f"{name}: expected {-most:g} to {most:g}, got {value:g}")
        targets = [_rule(text)[0] for text in self.columns]
        if len(set(targets)) < len(targets):
            raise OptionError(f"columns: expected each name once, got {', '.join(targets)}")

    @property
    def changes_nothing(self) -> bool:
        """Whether these are the defaults."""
        return self == Corrections()

    @classmethod
    def from_texts(cls, texts: Sequence[str]) -> Corrections:
        """From NAME=VALUE each: a field by its name, or one of the columns.

        Raises:
            OptionError: a text is none of these.
        """
        values: dict[str, Any] = {}
        columns = []
        for text in texts:
            name, _, value = text.partition("=")
            if name == "angles":
                values[name] = value
            elif name in _OFFSETS:
                try:
                    values[name] = float(value)
                except ValueError:
                    raise OptionError(f"{name}: expected a number, got {value!r}") from None
            else:
                columns.append(text)
        return cls(columns=tuple(columns), **values)

    def applied(self, rows: Sequence[TelemetryRow]) -> list[TelemetryRow]:
        """The corrected rows.

        Raises:
            TelemetryError: a corrected value is impossible; a height that is not above 0 becomes unknown.
        """
        rules = [_rule(text) for text in self.columns]
        out = [self._corrected(row, rules) for row in rows]
        return _shifted(out, self.offset_s) if self.offset_s else out

    def _corrected(self, row: TelemetryRow, rules: Sequence[tuple[str, float, str, float]]) -> TelemetryRow:
        if self.angles == "radians":
            turned: dict[str, Any] = {name: _scaled(row, name, 180.0 / math.pi, 0.0) for name in _ANGLES}
            row = replace(row, **turned)
        changed: dict[str, Any] = {
            name: _scaled(row, source, factor, offset) for name, factor, source, offset in rules
        }
        if "timestamp_ns" in changed:
            changed["timestamp_ns"] = round(changed["timestamp_ns"])
        row = replace(row, **changed)
        heading, height = row.heading_deg, _scaled(row, "height_agl_m", 1.0, self.height_offset_m)
        row = replace(
            row,
            heading_deg=None if heading is None else wrap_heading_deg(heading + self.heading_offset_deg),
            height_agl_m=height if height is None or height > 0.0 else None,  # on the ground
        )
        for name in _NUMBERS:
            value = getattr(row, name)
            low, high = _LIMITS.get(name, (-math.inf, math.inf))
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise TelemetryError(
                    f"frame {row.frame}: expected {name} of {low:g} to {high:g}, got {value:g} after correction"
                )
        return row


_LIMITS = {
    "pitch_deg": (-90.0, 90.0), "timestamp_ns": (-(2.0**63), 2.0**63),
    **dict.fromkeys(("height_sigma_m", "heading_sigma_deg", "tilt_sigma_deg"), (1e-9, 1e6)),
}  # fmt: skip


def _rule(text: str) -> tuple[str, float, str, float]:
    """Target, factor, source and offset of a column."""
    match = _RULE.fullmatch(text.replace(" ", ""))
    if match is None:
        raise OptionError(f"columns: expected NAME=[-][FACTOR*]NAME[+OFFSET], got {text!r}")
    target, sign, factor, source, offset = match.groups()
    for name in (target, source):
        if name not in _NUMBERS:
            raise OptionError(f"columns: expected one of {', '.join(_NUMBERS)}, got {name!r}")
    if "timestamp_ns" in (target, source) and target != source:
        raise OptionError(f"columns: expected timestamp_ns of itself only, got {text!r}")
    return target, (-1.0 if sign == "-" else 1.0) * float(factor or 1.0), source, float(offset or 0.0)


def _scaled(row: TelemetryRow, name: str, factor: float, offset: float) -> float | None:
    """A column scaled and shifted; restores the sign that reading removed from a heading in radians."""
    value: float | None = getattr(row, name)
    if value is None or (factor == 1.0 and offset == 0.0):
        return value
    if name == "heading_deg" and abs(factor) > 1.0 and value > _MAX_RADIANS:
        value -= 360.0
    return factor * value + offset


def _shifted(rows: Sequence[TelemetryRow], offset_s: float) -> list[TelemetryRow]:
    """The telemetry shifted in time to match the pictures; values are held constant at its ends."""
    time_s = np.array([row.timestamp_ns * 1e-9 for row in rows])
    columns: dict[str, Any] = {}
    for name in _INTERPOLATED:
        values = np.array([np.nan if (v := getattr(row, name)) is None else v for row in rows], np.float64)
        known = np.isfinite(values)
        if known.sum() < 2:
            continue
        series = values[known]
        if name == "heading_deg":
            series = np.degrees(np.unwrap(np.radians(series)))
        there = np.interp(time_s - offset_s, time_s[known], series)
        if name == "heading_deg":
            there = there % 360.0
        columns[name] = [float(v) if k else None for v, k in zip(there, known, strict=True)]
    return [replace(row, **{name: column[k] for name, column in columns.items()}) for k, row in enumerate(rows)]
