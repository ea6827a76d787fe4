"""How results look: tables for people on a terminal, JSON for programs. Everything but results goes to stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.progress import track as rich_track
from rich.table import Table
from rich.text import Text

T = TypeVar("T")

_errors = Console(stderr=True, highlight=False)
_PIPE_WIDTH = 500  # where nobody looks at a terminal, nothing is folded


def say(text: str) -> None:
    """One line for a person, on standard error; never folded."""
    print(" ".join(text.split()), file=sys.stderr, flush=True)


def progress(items: Iterable[T], total: int, description: str) -> Iterator[T]:
    """The same items, with a bar on a terminal and nothing in a pipe."""
    shown = _errors.is_terminal
    yield from rich_track(items, description, total, console=_errors, disable=not shown, transient=True)


@contextmanager
def progress_callback(description: str) -> Iterator[Callable[[int, int], None]]:
    """A function to be told how much is done and how much there is: a bar on a terminal from then on.

    So what turns out to take no time shows nothing, as everything does in a pipe.
    """
    shown = Progress(console=_errors, disable=not _errors.is_terminal, transient=True)
    task = shown.add_task(description)

    def tell(done: int, total: int) -> None:
        shown.start()  # once is as good as often
        shown.update(task, completed=done, total=total)

    try:
        yield tell
    finally:
        shown.stop()


def print_json(value: Any) -> None:
    """Machine-readable results on standard output."""
    json.dump(value, sys.stdout, indent=2)
    sys.stdout.write("\n")


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A titled table for people on standard output; the first column is words, the others are figures."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="")
    for index, name in enumerate(columns):
        table.add_column(name, justify="left" if index == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row))
    _print(title, table)


def print_pairs(title: str, pairs: Iterable[tuple[str, str]]) -> None:
    """Names and values for people on standard output, one a line; a long value is folded under itself."""
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 3, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in pairs:
        table.add_row(Text(name), Text(value))
    _print(title, table)


def _print(title: str, table: Table) -> None:
    console = Console(highlight=False)
    if console.is_terminal:
        console.print(Text(title, style="bold"), soft_wrap=True)
        console.print(table)
        return
    wide = Console(highlight=False, width=_PIPE_WIDTH)
    with wide.capture() as capture:
        wide.print(table)
    lines = (line.rstrip() for line in capture.get().splitlines())
    print(title, *lines, sep="\n")


def facts(values: Mapping[str, Any], as_json: bool, title: str) -> None:
    """Names and values, one a line."""
    if as_json:
        print_json(values)
    else:
        print_pairs(title, ((name, _text(value, name)) for name, value in values.items()))


def _text(value: Any, name: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):  # of a latitude, 7 decimals are a centimetre
        return f"{value:.7f}" if name.endswith(("lat_deg", "lon_deg", "bounds_deg")) else f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(item, name) for item in value)
    return "-" if value is None else str(value)


_SUMMARY = (
    ("frames", "frames", "{}"),
    ("fixes", "fixes", "{}"),
    ("availability", "availability", "{:.1%}"),
    ("RMS error", "rms_m", "{:.2f} m"),
    ("median error", "median_m", "{:.2f} m"),
    ("95 % within", "r95_m", "{:.2f} m"),
    ("largest error", "max_m", "{:.2f} m"),
    ("false fixes", "false_fixes", "{}"),
    ("mean NEES (2 is honest)", "nees_mean", "{:.2f}"),
    ("height RMS error", "height_rms_m", "{:.2f} m"),
)


def report(summary: Mapping[str, Any], as_json: bool, title: str, out: Path) -> None:
    """The figures of a track, and where its files are."""
    if as_json:
        print_json(summary)
        return
    known = [(name, form, summary[key]) for name, key, form in _SUMMARY if summary.get(key) is not None]
    # A wild value keeps to its column.
    pairs = [(name, form.replace(".2f", ".1e" if abs(v) >= 1e5 else ".2f").format(v)) for name, form, v in known]
    latency = summary["latency_ms"]
    if latency["p50"] is not None:
        shown = ", ".join(f"{name} {latency[name]:.1f}" for name in ("p50", "p95", "p99", "max"))
        pairs.append(("latency", f"{shown} ms"))
    if summary["deadlines_missed"]:
        pairs.append(("deadlines missed", str(summary["deadlines_missed"])))
    pairs += [(f"refused: {reason}", str(count)) for reason, count in summary["reasons"].items()]
    print_pairs(title, pairs)
    say(f"written to {out}")
