"""How results look: tables for people on a terminal, JSON for programs. Everything but results goes to stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import track as rich_track
from rich.table import Table

T = TypeVar("T")

_errors = Console(stderr=True, highlight=False, soft_wrap=True)


def say(text: str) -> None:
    """One line for a person, on standard error."""
    _errors.print(text, markup=False)


def progress(items: Iterable[T], total: int, description: str) -> Iterator[T]:
    """The same items, with a bar on a terminal and nothing in a pipe."""
    shown = _errors.is_terminal
    yield from rich_track(items, description, total, console=_errors, disable=not shown, transient=True)


def print_json(value: Any) -> None:
    """Machine-readable results on standard output."""
    json.dump(value, sys.stdout, indent=2)
    sys.stdout.write("\n")


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A table for people on standard output; as wide as its text where nobody looks at a terminal."""
    table = Table(title=title, title_justify="left", title_style="bold")
    for index, name in enumerate(columns):
        table.add_column(name, justify="left" if index == 0 else "right", no_wrap=index > 0)
    for row in rows:
        table.add_row(*row)
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=160)
    console.print(table)


def facts(values: Mapping[str, Any], as_json: bool, title: str) -> None:
    """Names and values, one a line."""
    if as_json:
        print_json(values)
        return
    print_table(title, ("what", "value"), ((name, _text(value)) for name, value in values.items()))


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(item) for item in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(item)}" for name, item in value.items()) or "-"
    return "-" if value is None else str(value)


_SUMMARY = (
    ("frames", "frames", "{}"),
    ("fixes", "fixes", "{}"),
    ("availability", "availability", "{:.1%}"),
    ("RMS", "rms_m", "{:.2f} m"),
    ("median", "median_m", "{:.2f} m"),
    ("R95", "r95_m", "{:.2f} m"),
    ("largest", "max_m", "{:.2f} m"),
    ("false fixes", "false_fixes", "{}"),
    ("height RMS", "height_rms_m", "{:.2f} m"),
)


def report(summary: Mapping[str, Any], as_json: bool, title: str, out: Path) -> None:
    """The figures of a track, and where its files are."""
    if as_json:
        print_json(summary)
        return
    rows = [(name, form.format(summary[key])) for name, key, form in _SUMMARY if summary.get(key) is not None]
    latency = summary["latency_ms"]
    if latency["p50"] is not None:
        rows.append(("latency p50 / p95", f"{latency['p50']:.1f} / {latency['p95']:.1f} ms"))
    rows += [(f"refused: {reason}", str(count)) for reason, count in summary["reasons"].items()]
    print_table(title, ("what", "value"), rows)
    say(f"written to {out}")
