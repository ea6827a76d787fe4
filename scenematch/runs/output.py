"""Where the output of a run goes: folders and files, and messages and progress for the caller to show.

Folders and files are checked before any work is done, and replaced only on request.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

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


T = TypeVar("T")


class Progress:
    """Shows nothing; subclasses override what to show. Runs call it from the caller's thread."""

    def message(self, text: str) -> None:
        """Show one line to a person."""

    def update(self, description: str, done: int, total: int) -> None:
        """Show how far a task is.

        Args:
            description: of the task, the same each time.
            done: units of work, from 0 up to ``total``.
            total: units of work.
        """

    def finish(self, description: str) -> None:
        """Called when a task has ended or was interrupted, even if it was never updated."""

    def track(self, items: Iterable[T], total: int, description: str) -> Iterator[T]:
        """The same items; each is counted when the consumer asks for the next."""
        self.update(description, 0, total)
        try:
            for done, item in enumerate(items, 1):
                yield item
                self.update(description, done, total)
        finally:
            self.finish(description)

    @contextmanager
    def task(self, description: str) -> Iterator[Callable[[int, int], None]]:
        """A function that takes ``done`` and ``total`` of a task; the task ends with the context."""
        try:
            yield lambda done, total: self.update(description, done, total)
        finally:
            self.finish(description)


SILENT = Progress()
"""Shows nothing."""
