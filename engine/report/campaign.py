"""The tables of a campaign: a line a run, the flights of a group pooled, and latencies in a file of their own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.formats.telemetry import cell_text, write_table
from engine.report.published import COLUMNS, PUBLISHED, published_cells

TABLE, PAGE, LATENCIES = "campaign.csv", "campaign.md", "latencies.csv"
_FIGURES = (
    "frames", "fixes", "availability", "scored_fixes", "rms_m", "median_m", "r95_m", "max_m", "wrong_over_10m",
    "false_fixes", "nees_mean", "height_rms_m", "height_bias_m",
)  # fmt: skip
_TIMES = ("p50", "p95", "p99", "max")
_NAMES = ("group", "flight", "run")
TABLE_HEAD = (*_NAMES, *_FIGURES, "failure")
"""The columns of campaign.csv."""


@dataclass(frozen=True, slots=True)
class Line:
    """One run of a campaign.

    Attributes:
        group: what the flight is pooled with.
        flight: its name.
        run: the method with its settings.
        figures: of the summary, without times; None where the run failed.
        latency_ms: p50, p95, p99 and max of a frame.
        failure: why the run failed, or None.
    """

    group: str
    flight: str
    run: str
    figures: Mapping[str, Any] | None
    latency_ms: Mapping[str, float | None] | None
    failure: str | None


def write_tables(folder: Path, lines: Sequence[Line]) -> None:
    """Write campaign.csv and campaign.md, which hold no times, and latencies.csv.

    Equal runs give equal bytes in the first two, on whatever they ran and in whatever order they ended.
    """
    figures = ([*_named(line), *_cells(line.figures, _FIGURES), line.failure or ""] for line in lines)
    write_table(folder / TABLE, TABLE_HEAD, list(figures))
    times = ([*_named(line), *_cells(line.latency_ms, _TIMES)] for line in lines)
    write_table(folder / LATENCIES, (*_NAMES, *(f"{name}_ms" for name in _TIMES)), list(times))
    (folder / PAGE).write_text(_page(lines), encoding="utf-8")


def _named(line: Line) -> tuple[str, str, str]:
    return line.group, line.flight, line.run


def _cells(values: Mapping[str, Any] | None, names: Sequence[str]) -> list[str]:
    return [cell_text((values or {}).get(name), 4) for name in names]


def are_figures(values: object) -> bool:
    """Whether a value can be the figures of a :class:`Line`: a summary's, with those that belong together."""
    if not isinstance(values, dict) or not all(_is_number(values.get(name)) for name in _FIGURES):
        return False
    needed = ["frames", "fixes"]
    needed += ["scored_fixes"] if values.get("rms_m") is not None else []
    needed += ["false_fixes", "wrong_over_10m"] if {"false_fixes", "wrong_over_10m"} & set(values) else []
    return all(type(values.get(name)) is int for name in needed)


def are_times(values: object) -> bool:
    """Whether a value can be the latencies of a :class:`Line`."""
    return isinstance(values, dict) and all(_is_number(values.get(name)) for name in _TIMES)


def _is_number(value: object) -> bool:
    """Whether a value is a number whose square is one too, or unknown."""
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e100)


@dataclass(frozen=True, slots=True)
class Pool:
    """The runs of one group by one method, taken together.

    Attributes:
        group: of the flights.
        run: the method with its settings.
        flights: how many were followed.
        failed: how many could not be.
        frames: of all of them.
        availability: share of the frames that were fixed.
        rms_m: over all scored fixes.
        worst_rms_m: of the flight with the largest.
        false_fixes: more than 10 m and three of their own sigmas off.
        wrong_over_10m: more than 10 m off, whatever they said.
    """

    group: str
    run: str
    flights: int
    failed: int
    frames: int
    availability: float | None
    rms_m: float | None
    worst_rms_m: float | None
    false_fixes: int | None
    wrong_over_10m: int | None


def pooled(lines: Sequence[Line]) -> list[Pool]:
    """Every group by every run, in the order in which they come; what has no truth is None."""
    keys = dict.fromkeys((line.group, line.run) for line in lines)
    return [_pool(*key, [line for line in lines if (line.group, line.run) == key]) for key in keys]


def _pool(group: str, run: str, lines: Sequence[Line]) -> Pool:
    known = [line.figures for line in lines if line.figures is not None]
    scored = [figures for figures in known if figures.get("rms_m") is not None]
    judged = [figures for figures in known if "false_fixes" in figures]
    frames, fixes = (sum(figures[name] for figures in known) for name in ("frames", "fixes"))
    fixes_scored = sum(figures["scored_fixes"] for figures in scored)
    squares_m2 = sum(figures["scored_fixes"] * figures["rms_m"] ** 2 for figures in scored)
    return Pool(
        group=group,
        run=run,
        flights=len(known),
        failed=len(lines) - len(known),
        frames=frames,
        availability=fixes / frames if frames else None,
        rms_m=math.sqrt(squares_m2 / fixes_scored) if fixes_scored else None,
        worst_rms_m=max((figures["rms_m"] for figures in scored), default=None),
        false_fixes=sum(figures["false_fixes"] for figures in judged) if judged else None,
        wrong_over_10m=sum(figures["wrong_over_10m"] for figures in judged) if judged else None,
    )


POOL_COLUMNS = ("run", "flights", "frames", "fixed", "RMS m", "worst flight", "false", "off > 10 m")


def pool_cells(pool: Pool) -> tuple[str, ...]:
    """The figures of :data:`POOL_COLUMNS`; what is unknown is a dash."""
    flights = f"{pool.flights}" + (f" ({pool.failed} failed)" if pool.failed else "")
    return (
        pool.run,
        flights,
        str(pool.frames),
        _shown(pool.availability, "{:.1%}"),
        _shown(pool.rms_m, "{:.2f}"),
        _shown(pool.worst_rms_m, "{:.2f}"),
        _shown(pool.false_fixes, "{}"),
        _shown(pool.wrong_over_10m, "{}"),
    )


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def _page(lines: Sequence[Line]) -> str:
    """The pooled figures of every group with what was published of it, then every run, then what failed."""
    out = ["# Campaign", ""]
    pools = pooled(lines)
    for group in dict.fromkeys(pool.group for pool in pools):
        out += [f"## {group}", "", *_table(POOL_COLUMNS, [pool_cells(p) for p in pools if p.group == group]), ""]
        if group in PUBLISHED:
            out += [*_table(COLUMNS, [published_cells(one) for one in PUBLISHED[group]]), ""]
    columns = ("flight", "run", "frames", "fixed", "RMS m", "median m", "95 % m", "max m", "false", "NEES", "up m")
    out += ["## Every run", "", *_table(columns, [_run_cells(line) for line in lines if line.figures]), ""]
    failed = [f"- {line.flight}, {line.run}: {line.failure}" for line in lines if line.failure]
    out += ["## Failed", "", *failed, ""] if failed else []
    return "\n".join(out)


def _run_cells(line: Line) -> tuple[str, ...]:
    figures = line.figures or {}
    metres = (_shown(figures.get(name), "{:.2f}") for name in ("rms_m", "median_m", "r95_m", "max_m"))
    return (
        line.flight,
        line.run,
        str(figures["frames"]),
        _shown(figures.get("availability"), "{:.1%}"),
        *metres,
        _shown(figures.get("false_fixes"), "{}"),
        _shown(figures.get("nees_mean"), "{:.2f}"),
        _shown(figures.get("height_rms_m"), "{:.2f}"),
    )


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (columns, ["---"] * len(columns), *rows)]
