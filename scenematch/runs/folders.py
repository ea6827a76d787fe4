"""Output folders and files: checked before any work is done for them, and never replaced unless asked to."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from engine.errors import OptionError

StrPath: TypeAlias = str | Path
"""A path as callers give it."""


def check_folder(out: Path, force: bool) -> None:
    """Refuse an output folder that is there already, before any work is done for it.

    Raises:
        OptionError: it is there and ``force`` was not given, or it or a parent of it is a file.
    """
    if out.is_dir():
        if not force:
            raise OptionError(f"out: {out} exists; choose another folder, or add `force` to replace its results")
        return
    for path in (out, *out.parents):
        if path.exists():
            if not path.is_dir():
                raise OptionError(f"out: expected a folder, but {path} is a file")
            return


def check_file(out: Path, force: bool) -> None:
    """Refuse an output file that is there already.

    Raises:
        OptionError: it is there and ``force`` was not given, or it is a folder.
    """
    if out.is_dir():
        raise OptionError(f"out: expected a file, but {out} is a folder")
    if out.exists() and not force:
        raise OptionError(f"out: {out} exists; choose another file, or add `force` to replace it")


def prepare_folder(out: Path, force: bool, owned: Sequence[str]) -> None:
    """Create the output folder; with ``force`` the results of an older run leave it, and nothing else does.

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
