"""What the commands share in reading their arguments and preparing their output folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from engine.budget import Budget
from engine.errors import OptionError
from engine.types import Prior

START_SIGMA_M = 15.0
"""Uncertainty of a position that was given without one."""


def parse_position(name: str, text: str | None) -> Prior | None:
    """Read LAT,LON[,SIGMA_M]; None where nothing was given.

    Raises:
        OptionError: the text is of another form, or a number is out of range.
    """
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        raise OptionError(f"{name}: expected LAT,LON[,SIGMA_M] in degrees and metres, got {text!r}")
    try:
        return Prior(lat_deg=numbers[0], lon_deg=numbers[1], sigma_m=numbers[2] if numbers[2:] else START_SIGMA_M)
    except OptionError as error:
        raise OptionError(f"{name}: {error}") from None


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
