"""What the commands share in reading their arguments and preparing their output folder."""

from __future__ import annotations

from pathlib import Path

from engine.errors import OptionError
from engine.types import Prior

START_SIGMA_M = 15.0
"""Uncertainty of a position that was given without one."""


def parse_position(name: str, text: str) -> Prior:
    """Read LAT,LON[,SIGMA_M].

    Raises:
        OptionError: the text is of another form, or a number is out of range.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise OptionError(f"{name}: expected LAT,LON[,SIGMA_M], got {text!r}")
    return Prior(lat_deg=numbers[0], lon_deg=numbers[1], sigma_m=numbers[2] if numbers[2:] else START_SIGMA_M)


def prepare_folder(out: Path, force: bool) -> None:
    """Make the output folder.

    Raises:
        OptionError: it is there already and ``force`` was not given, or it is a file.
    """
    if out.exists() and not out.is_dir():
        raise OptionError(f"--out: {out} is a file, not a folder")
    if out.exists() and not force:
        raise OptionError(f"--out: {out} exists; choose another folder, or add --force to write into it")
    out.mkdir(parents=True, exist_ok=True)
