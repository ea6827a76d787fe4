"""Output folders and files: checked before any work is done, and replaced only on request."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

from engine.errors import OptionError

StrPath: TypeAlias = str | Path
"""A path as callers give it."""


def check_folder(out: Path, force: bool) -> None:
    """Refuse an existing output folder before any work is done.

    Raises:
        OptionError: it exists and ``force`` was not given, or it or one of its parents is a file.
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
    """Refuse an existing output file.

    Raises:
        OptionError: it exists and ``force`` was not given, or it is a folder.
    """
    if out.is_dir():
        raise OptionError(f"out: expected a file, but {out} is a folder")
    if out.exists() and not force:
        raise OptionError(f"out: {out} exists; choose another file, or add `force` to replace it")


def prepare_folder(out: Path, force: bool, owned: Sequence[str]) -> None:
    """Create the output folder; with ``force``, delete the results of an older run and nothing else.

    Args:
        out: the folder.
        force: whether it may already exist.
        owned: patterns of files that a run writes, relative to the folder.

    Raises:
        OptionError: see :func:`check_folder`.
    """
    check_folder(out, force)
    out.mkdir(parents=True, exist_ok=True)
    for pattern in owned:
        for file in out.glob(pattern):
            file.unlink()


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write values as JSON for programs and people."""
    path.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
