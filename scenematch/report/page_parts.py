"""Shared parts of the report's pages: page frame, map with buttons, and charts over time."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from scenematch.report.page_charts import Chart
from scenematch.report.page_map import TrackMap

CROSS = "M6 2l10 10M16 2l-10 10"
"""Of a legend."""


def fill_page(
    path: Path,
    *,
    heading: str,
    subheading: str,
    grade: str,
    verdict: str,
    body: Sequence[str],
    data: Mapping[str, Any],
) -> None:
    """Write a page; equal parts give equal bytes.

    Args:
        path: the file, replaced if it exists.
        heading: plain text.
        subheading: plain text.
        grade: of the verdict, a class of the style sheet.
        verdict: HTML.
        body: HTML sections.
        data: input of the page's script: ``box`` of the map, ``frames`` of the slider.
    """
    parts = {
        "title": escape(f"{heading}: scenematch report"),
        "style": _resource("page.css"),
        "heading": escape(heading),
        "subheading": escape(subheading),
        "grade": grade,
        "verdict": verdict,
        "body": "\n".join(body),
        "data": json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
        "script": _resource("page.js"),
    }
    path.write_text(Template(_resource("page.html")).substitute(parts), encoding="utf-8", newline="\n")


def _resource(name: str) -> str:
    return resources.files("scenematch.report").joinpath(name).read_text(encoding="utf-8")


def section(title: str, body: str, name: str = "") -> str:
    """A section with its heading; with a name it can be linked to."""
    anchor = f' id="{name}"' if name else ""
    return f"<section{anchor}>\n<h2>{escape(title)}</h2>\n{body}\n</section>"


def map_with_legend(drawn: str, track_map: TrackMap, legend: Sequence[tuple[str, str]]) -> str:
    """The drawn map with its buttons, a legend of (name, SVG mark), and its extent."""
    width_m, height_m = track_map.extent_m
    return (
        f'<div class="map-box">\n{drawn}\n<div class="zoom">'
        '<button type="button" id="zoom-in" aria-label="Zoom in">+</button>'
        '<button type="button" id="zoom-out" aria-label="Zoom out">&minus;</button>'
        '<button type="button" id="zoom-all" aria-label="Show all">&#8634;</button></div>\n</div>\n'
        f'<ul class="legend on-map">{_items(legend)}</ul>'
        f'<p class="hint">{width_m:,.0f} by {height_m:,.0f} m of the map. '
        "Zoom by the buttons or Ctrl and the wheel; drag to move.</p>"
    )


def charts_with_axis(charts: Sequence[Chart], legend: Sequence[tuple[str, str]]) -> str:
    """Charts with the buttons of their common time axis, and a legend of (name, SVG mark)."""
    figures = "\n".join(f"<figure><figcaption>{escape(c)}</figcaption>{svg}</figure>" for c, svg in charts)
    return (
        '<div class="time"><p class="hint">Drag across a chart, or Ctrl and the wheel, to zoom all in time.</p>'
        '<output id="time-span"></output>'
        '<button type="button" id="time-in" aria-label="Shorter time">+</button>'
        '<button type="button" id="time-out" aria-label="Longer time">&minus;</button>'
        '<button type="button" id="time-all" aria-label="Whole time">&#8634;</button></div>\n'
        f'<div class="charts">\n{figures}\n</div>\n<ul class="legend">{_items(legend)}</ul>'
    )


def _items(legend: Sequence[tuple[str, str]]) -> str:
    return "".join(f"<li><svg aria-hidden='true'>{mark}</svg>{escape(name)}</li>" for name, mark in legend)


def table(head: Sequence[str], rows: Sequence[Sequence[str]], kind: str = "figures") -> str:
    """A table of texts; it scrolls if wider than the page."""
    heads = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    opened = f'<div class="wide"><table class="{kind}">'
    return f"{opened}<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>"
