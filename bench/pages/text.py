"""What the pages of the benchmarks share: tables, and where the figures come from."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import cv2
import torch

from bench import RESULTS, ROOT

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Row = TypeVar("Row")


def printed(rows: Iterable[Row]) -> list[Row]:
    """All of them, dataclasses, each printed as JSON as soon as it is there."""
    out = []
    for row in rows:
        out.append(row)
        print(json.dumps(asdict(row)), flush=True)
    return out


def table(columns: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table, an empty one after it."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows), ""]


def shown(value: Any, form: str = ".2f") -> str:
    """A value in a format, or a dash where there is none."""
    return "-" if value is None or value != value else format(value, form)


def percent(value: float | None) -> str:
    """A share in per cent."""
    return "-" if value is None else f"{100.0 * value:.1f} %"


def table_of(rows: list[dict[str, Any]], *columns: tuple[str, str, str | Callable[[Any], str]]) -> list[str]:
    """Lines of a table of rows; a column is its title, its key in a row, and its format or what writes it."""
    cells = [
        [shown(row.get(key), form) if isinstance(form, str) else form(row[key]) for _, key, form in columns]
        for row in rows
    ]
    return table([title for title, _, _ in columns], cells)


def paragraph(text: str) -> list[str]:
    """Lines of a paragraph that fit the page, an empty one after it."""
    return [*textwrap.wrap(text, 115), ""]


def fill(page: Path, sections: Mapping[str, list[str]]) -> None:
    """Put what was measured between the markers of a page, whose words are its own.

    Args:
        page: is filled; one that is not there becomes a copy of that in docs/results.
        sections: lines by the name of their section, the last of them empty.
    """
    text = (page if page.exists() else RESULTS / page.name).read_text(encoding="utf-8")
    for name, lines in sections.items():
        begin, end = f"<!-- measured: {name} -->", f"<!-- end of {name} -->"
        before, rest = text.split(begin)
        text = "\n".join([before + begin, "", *lines, end + rest.split(end)[1]])
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(text, encoding="utf-8")


def save_pictures(docs: Path, pictures: Mapping[str, Figure], dpi: int = 130) -> None:
    """Save the pictures of a page below ``docs``, by the names of their files."""
    (docs / "img").mkdir(parents=True, exist_ok=True)
    for name, figure in pictures.items():
        figure.savefig(docs / "img" / name, dpi=dpi, facecolor="white")


def measured() -> dict[str, list[str]]:
    """The section that says on what machine."""
    return {"machine": paragraph(f"Measured on {machine()}.")}


def machine() -> str:
    """The machine, the libraries, the commit and the day, in half a sentence."""
    asked = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip() or "unknown"
    versions = f"Python {platform.python_version()}, torch {torch.__version__}, OpenCV {cv2.__version__}"
    made = f"commit {commit}, {date.today()}"
    return f"{os.cpu_count()} cores of a server CPU ({platform.machine()}), no GPU, {versions}, {made}"
