"""Arguments of runs: parse positions and numbers, check choices; messages name the argument."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from engine.budget import Budget
from engine.errors import OptionError
from engine.runtime import device as devices
from engine.values import MAX_SIGMA_M, Prior

START_SIGMA_M = 15.0
"""Uncertainty of a position given without one."""


def parse_position(name: str, text: str | None) -> Prior | None:
    """Read LAT,LON[,SIGMA_M]; None if nothing was given.

    Raises:
        OptionError: the text has another form, or a number is out of range.
    """
    if text is None:
        return None
    numbers = _numbers(name, text, "LAT,LON[,SIGMA_M]", (2, 3))
    sigma_m = numbers[2] if numbers[2:] else START_SIGMA_M
    if sigma_m > MAX_SIGMA_M:
        raise OptionError(f"{name}: expected a SIGMA_M of at most {MAX_SIGMA_M:g} m, got {sigma_m:g}")
    try:
        return Prior(lat_deg=numbers[0], lon_deg=numbers[1], sigma_m=sigma_m)
    except OptionError as error:
        raise OptionError(f"{name}: {error}") from None


def parse_place(name: str, text: str) -> tuple[float, float]:
    """Read LAT,LON.

    Raises:
        OptionError: the text has another form, such as a place's name, or a number is out of range.
    """
    is_name = any(part.strip()[:1].isalpha() for part in text.split(","))
    hint = "; place names are not looked up" if is_name else ""
    lat_deg, lon_deg = _numbers(name, text, "LAT,LON", (2,), "in degrees or a folder of photographs", hint)
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0):
        raise OptionError(f"{name}: expected a place on the Earth, got {text!r}")
    return lat_deg, lon_deg


def parse_circle(name: str, text: str | None) -> tuple[float, float, float] | None:
    """Read LAT,LON,RADIUS_M; None if nothing was given.

    Raises:
        OptionError: the text has another form, or a number is out of range.
    """
    if text is None:
        return None
    lat_deg, lon_deg, radius_m = _numbers(name, text, "LAT,LON,RADIUS_M", (3,))
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 360.0 and radius_m > 0.0):
        raise OptionError(f"{name}: expected a place on the Earth and a radius above 0 m, got {text!r}")
    return lat_deg, lon_deg, radius_m


def parse_bounds(name: str, text: str | None) -> tuple[float, float, float, float] | None:
    """Read W,S,E,N; None if nothing was given.

    Raises:
        OptionError: the text has another form, or a side is not before its opposite.
    """
    if text is None:
        return None
    west, south, east, north = _numbers(name, text, "W,S,E,N", (4,), "in degrees or in `map_crs`")
    if not (west < east and south < north):
        raise OptionError(f"{name}: expected west before east and south before north, got {text!r}")
    return west, south, east, north


def is_in_degrees(bounds: tuple[float, float, float, float]) -> bool:
    """Whether bounds may be degrees: no map in metres is so near its projection's origin."""
    west, south, east, north = bounds
    return west >= -180.0 and east <= 540.0 and south >= -90.0 and north <= 90.0


def _numbers(
    name: str, text: str, form: str, counts: Sequence[int], units: str = "in degrees and metres", hint: str = ""
) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        raise OptionError(f"{name}: expected {form} {units}, got {text!r}{hint}")
    return numbers


def parse_budget(name: str, budget_ms: float | None) -> Budget | None:
    """The budget of a frame; None if nothing was given. It does not apply to a search of the whole map.

    Raises:
        OptionError: it is not a finite number above 0.
    """
    if budget_ms is None:
        return None
    if not (math.isfinite(budget_ms) and budget_ms > 0):
        raise OptionError(f"{name}: expected milliseconds above 0, got {budget_ms:g}")
    return Budget(total_ms=budget_ms, search_ms=math.inf)


def check_above(name: str, value: float | None, low: float, most: float) -> None:
    """Refuse a number that is not above one limit and at most another; None means not given.

    Raises:
        OptionError: it is not.
    """
    if value is not None and not low < value <= most:  # NaN fails too
        raise OptionError(f"{name}: expected a number above {low:g} and at most {most:g}, got {value:g}")


def check_between(name: str, value: float | None, low: float, high: float) -> None:
    """Refuse a number outside of a range, whose ends belong to it; None means not given.

    Raises:
        OptionError: it is.
    """
    if value is not None and not low <= value <= high:  # NaN fails too
        raise OptionError(f"{name}: expected {low:g} to {high:g}, got {value:g}")


def check_every(every: int) -> None:
    """Refuse an invalid frame interval.

    Raises:
        OptionError: it is not a whole number of 1 or more.
    """
    if not (isinstance(every, int) and every >= 1):
        raise OptionError(f"every: expected a whole number of 1 or more, got {every}")


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Refuse a word that is not one of the choices.

    Raises:
        OptionError: it is not.
    """
    if value not in choices:
        raise OptionError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def check_unused(given: Mapping[str, object], other: str) -> None:
    """Refuse arguments that have no effect without another one.

    Args:
        given: values by argument; None if not given.
        other: the argument that they need.

    Raises:
        OptionError: one was given; the message names the first.
    """
    for name, value in given.items():
        if value is not None:
            raise OptionError(f"{name}: expected with `{other}` only")


def check_device(device: str) -> None:
    """Refuse a device that does not exist.

    Raises:
        OptionError, DeviceError: see :func:`engine.runtime.device.resolve`.
    """
    if device not in ("auto", "cpu"):  # these always exist, so torch is not loaded
        devices.resolve(device)
