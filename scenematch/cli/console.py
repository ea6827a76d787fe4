"""Print results: tables for people on a terminal, JSON for programs. Everything but results goes to stderr.

rich is imported only to draw with it: help and piped JSON do not need it.
"""

from __future__ import annotations

import json
import math
import shlex
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenematch.cli.argument_names import as_typed
from scenematch.runs.output import Progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bars
    from rich.table import Table

AS_JSON: ContextVar[bool] = ContextVar("as_json", default=False)
"""Of the command that runs: whether its results go to a program."""
_DRAWN_EVERY_S = 0.1
_PIPE_WIDTH = 500  # without a terminal nothing is folded


def say(text: str) -> None:
    """Print one line for a person on standard error, never folded."""
    line = " ".join(part.strip() for part in text.splitlines())  # inner spaces stay: a path may have them
    print(line.strip(), file=sys.stderr, flush=True)


def next_step(command: str, *, hint: str = "") -> None:
    """Suggest the next command to a person, on standard error; never to a program.

    Args:
        command: without the program's name; what the user must still choose is in capitals.
        hint: what to do before it, such as a file to open, or what to repeat.
    """
    if not AS_JSON.get():
        say(f"next: {f'{hint}; ' if hint else ''}scenematch {command}")


def quoted(value: object) -> str:
    """Quote a value so that a shell takes it as one word."""
    return shlex.quote(str(value))


def after_track(out: Path, fixes: float) -> None:
    """Suggest what follows a track: its export, or a check if it has no fix."""
    command = f"export {quoted(out)} --format geojson" if fixes else "check"
    hint = f"open {quoted(out / 'report.html')}" + ("" if fixes else "; with the same files")
    next_step(command, hint=hint)


@cache
def _errors() -> Console:
    from rich.console import Console

    return Console(stderr=True, highlight=False)


class _ConsoleProgress(Progress):
    """Messages on standard error, and on a terminal a bar for each task."""

    def __init__(self) -> None:
        self._bars: dict[str, Bars] = {}
        self._drawn_s = -math.inf

    def message(self, text: str) -> None:
        say(as_typed(text))

    def update(self, description: str, done: int, total: int) -> None:
        if not _errors().is_terminal:
            return
        bars = self._bars.get(description)
        if bars is None:
            from rich.progress import Progress as Bars

            # No drawing thread: workers are not forked while other threads run (engine.runtime.workers).
            bars = self._bars[description] = Bars(console=_errors(), transient=True, auto_refresh=False)
            bars.add_task(description)
            bars.start()
        is_due = time.monotonic() - self._drawn_s > _DRAWN_EVERY_S
        if is_due:
            self._drawn_s = time.monotonic()
        bars.update(bars.task_ids[0], completed=done, total=total, refresh=is_due)

    def finish(self, description: str) -> None:
        bars = self._bars.pop(description, None)
        if bars is not None:
            bars.stop()


PROGRESS = _ConsoleProgress()
"""What runs report progress to. A task that is never updated shows nothing; in a pipe none does."""


def print_json(value: Any) -> None:
    """Machine-readable results on standard output."""
    json.dump(value, sys.stdout, indent=2)
    sys.stdout.write("\n")


def answered_as_json(value: Any) -> bool:
    """Print results as JSON if a program asked for them, and return whether it did."""
    if AS_JSON.get():
        print_json(value)
    return AS_JSON.get()


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A titled table for people on standard output; the first column is words, the others are figures."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="")
    for index, name in enumerate(columns):
        table.add_column(name, justify="left" if index == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row))
    _print(title, table)


def print_pairs(title: str, pairs: Iterable[tuple[str, str]]) -> None:
    """Print names and values for people on standard output, one per line; a long value is folded under itself."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 3, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in pairs:
        table.add_row(Text(name), Text(value))
    _print(title, table)


def _print(title: str, table: Table) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    with console.capture() as capture:
        console.print(Text(title, style="bold"), soft_wrap=True)
        console.print(table)
    print(*(line.rstrip() for line in capture.get().splitlines()), sep="\n")


def facts(values: Mapping[str, Any], title: str) -> None:
    """Print results as JSON, or as names and values, one per line."""
    if not answered_as_json(values):
        print_pairs(title, ((name, _text(value, name)) for name, value in values.items()))


def _text(value: Any, name: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):  # 7 decimals of a latitude are a centimetre
        return f"{value:.7f}" if name.endswith(("lat_deg", "lon_deg", "bounds_deg")) else f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(item, name) for item in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_text(item, name)}" for key, item in value.items()) or "none"
    return "-" if value is None else str(value)
