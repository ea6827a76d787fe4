"""Progress of a run: messages and completed work, for the caller to show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

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
