"""What the commands share in reading their arguments, opening the map and preparing their output folder."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from engine import device as devices
from engine.budget import Budget
from engine.cli import console
from engine.errors import EngineError, OptionError
from engine.orthomap import OrthoMap
from engine.values import MAX_SIGMA_M, Prior

START_SIGMA_M = 15.0
"""Uncertainty of a position that was given without one."""


def parse_position(name: str, text: str | None) -> Prior | None:
    """Read LAT,LON[,SIGMA_M]; None where nothing was given.

    Raises:
        OptionError: the text is of another form, or a number is out of range.
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


def parse_circle(name: str, text: str | None) -> tuple[float, float, float] | None:
    """Read LAT,LON,RADIUS_M; None where nothing was given.

    Raises:
        OptionError: the text is of another form, or a number is out of range.
    """
    if text is None:
        return None
    lat, lon, radius_m = _numbers(name, text, "LAT,LON,RADIUS_M", (3,))
    if not (abs(lat) <= 90.0 and abs(lon) <= 360.0 and radius_m > 0.0):
        raise OptionError(f"{name}: expected a place on the Earth and a radius above 0 m, got {text!r}")
    return lat, lon, radius_m


def _numbers(name: str, text: str, form: str, counts: Sequence[int]) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        raise OptionError(f"{name}: expected {form} in degrees and metres, got {text!r}")
    return numbers


def parse_budget(name: str, budget_ms: float | None) -> Budget | None:
    """The budget of a frame; None where nothing was given. A search of the whole map is not held to it.

    Raises:
        OptionError: it is not a finite number above 0.
    """
    if budget_ms is None:
        return None
    if not (math.isfinite(budget_ms) and budget_ms > 0):
        raise OptionError(f"{name}: expected milliseconds above 0, got {budget_ms:g}")
    return Budget(total_ms=budget_ms, search_ms=math.inf)


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Refuse a word that is not one of the choices.

    Raises:
        OptionError: it is not.
    """
    if value not in choices:
        raise OptionError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def refuse_given(given: Mapping[str, object], expected: str) -> None:
    """Refuse options that would say nothing in this run.

    Args:
        given: values by option; None where it was not given.
        expected: with what they would be taken.

    Raises:
        OptionError: names the first that was given.
    """
    for name, value in given.items():
        if value is not None:
            raise OptionError(f"{name}: expected with {expected} only")


@contextmanager
def named_as_typed(**options: str) -> Iterator[None]:
    """Within it, what the engine says of a field is said of the option that was typed.

    Args:
        options: option by field.
    """
    try:
        yield
    except EngineError as error:
        field, colon, rest = str(error).partition(":")
        if not colon or field not in options:
            raise
        raise type(error)(f"{options[field]}:{rest}") from None


def check_device(name: str, device: str) -> None:
    """Refuse a device that is not there.

    Raises:
        OptionError, DeviceError: see :func:`engine.device.resolve`.
    """
    with named_as_typed(device=name):
        devices.resolve(device)


def open_map(
    path: str | os.PathLike[str], surface: str | os.PathLike[str] | None = None, sigma_m: float | None = None
) -> OrthoMap:
    """The map, with a bar on a terminal while it is copied into the cache.

    Args:
        path: see :meth:`engine.OrthoMap.open`.
        surface: heights.
        sigma_m: how well the map lies; None for what it says.

    Raises:
        OptionError: the last is not above 0, or wider than any map.
    """
    if sigma_m is not None and not 0.0 < sigma_m <= MAX_SIGMA_M:
        raise OptionError(f"--map-sigma-m: expected a number above 0 and at most {MAX_SIGMA_M:g}, got {sigma_m:g}")
    with console.progress_callback("copying the map into the cache") as tell:
        return OrthoMap.open(path, surface=surface, georeference_sigma_m=sigma_m, on_copy=tell)


def check_folder(out: Path, force: bool) -> None:
    """Refuse an output folder that is there already, before any work is done for it.

    Raises:
        OptionError: it is there and ``force`` was not given, or it or a parent of it is a file.
    """
    if out.is_dir():
        if not force:
            raise OptionError(f"--out: {out} exists; choose another folder, or add --force to replace its results")
        return
    for path in (out, *out.parents):
        if path.exists():
            if not path.is_dir():
                raise OptionError(f"--out: expected a folder, but {path} is a file")
            return


def prepare_folder(out: Path, force: bool, owned: Sequence[str]) -> None:
    """Make the output folder; with ``force`` the results of an older run leave it, and nothing else does.

    Args:
        out: the folder.
        force: whether it may be there already.
        owned: patterns of the files that a run writes, relative to the folder.

    Raises:
        OptionError: see :func:`check_folder`.
    """
    check_folder(out, force)
    out.mkdir(parents=True, exist_ok=True)
    for pattern in owned:
        for file in out.glob(pattern):
            file.unlink()
