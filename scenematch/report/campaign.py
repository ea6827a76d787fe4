"""The tables of a campaign: one row per run, pooled figures of each group, and latencies in a separate file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenematch.files.tables import cell_text, write_table
from scenematch.report.published import COLUMNS, PUBLISHED, published_cells

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
class CampaignRow:
    """One run of a campaign.

    Attributes:
        group: group of flights that are pooled.
        flight: name of the flight.
        run: the method with its settings.
        figures: figures of merit of its summary, without times; None where the run failed.
        latency_ms: p50, p95, p99 and max of the latency of a frame.
        failure: reason why the run failed, or None.
    """

    group: str
    flight: str
    run: str
    figures: Mapping[str, Any] | None
    latency_ms: Mapping[str, float | None] | None
    failure: str | None


def write_tables(folder: Path, rows: Sequence[CampaignRow]) -> None:
    """Write campaign.csv and campaign.md, which have no times, and latencies.csv.

    Equal runs give equal bytes in the first two, independent of machine and order.
    """
    figures = ([*_key(row), *_cells(row.figures, _FIGURES), row.failure or ""] for row in rows)
    write_table(folder / TABLE, TABLE_HEAD, list(figures))
    times = ([*_key(row), *_cells(row.latency_ms, _TIMES)] for row in rows)
    write_table(folder / LATENCIES, (*_NAMES, *(f"{name}_ms" for name in _TIMES)), list(times))
    (folder / PAGE).write_text(_page(rows), encoding="utf-8")


def _key(row: CampaignRow) -> tuple[str, str, str]:
    return row.group, row.flight, row.run


def _cells(values: Mapping[str, Any] | None, names: Sequence[str]) -> list[str]:
    return [cell_text((values or {}).get(name), 4) for name in names]


def are_valid_figures(values: object) -> bool:
    """Whether a value has the figures of a :class:`CampaignRow`, complete and of the right types."""
    if not isinstance(values, dict) or not all(_is_number(values.get(name)) for name in _FIGURES):
        return False
    needed = ["frames", "fixes"]
    needed += ["scored_fixes"] if values.get("rms_m") is not None else []
    needed += ["false_fixes", "wrong_over_10m"] if {"false_fixes", "wrong_over_10m"} & set(values) else []
    return all(type(values.get(name)) is int for name in needed)


def are_valid_latencies(values: object) -> bool:
    """Whether a value has the latencies of a :class:`CampaignRow`."""
    return isinstance(values, dict) and all(_is_number(values.get(name)) for name in _TIMES)


def _is_number(value: object) -> bool:
    """Whether a value is a number whose square is finite, or None."""
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e100)


@dataclass(frozen=True, slots=True)
class PooledRuns:
    """Pooled figures of the runs of one group by one method.

    Attributes:
        group: group of the flights.
        run: the method with its settings.
        flights: number of flights that were tracked.
        failed: number of flights whose run failed.
        frames: number of frames of all flights.
        availability: ratio of frames with a fix.
        rms_m: RMS error over all scored fixes.
        worst_rms_m: largest RMS error of a flight.
        false_fixes: number of fixes more than 10 m and three of their own sigmas off.
        wrong_over_10m: number of fixes more than 10 m off, whatever their sigma.
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


def pool_runs(rows: Sequence[CampaignRow]) -> list[PooledRuns]:
    """Pool every group by run, in the order of appearance; figures that need truth are None without."""
    keys = dict.fromkeys((row.group, row.run) for row in rows)
    return [_pool(*key, [row for row in rows if (row.group, row.run) == key]) for key in keys]


def _pool(group: str, run: str, rows: Sequence[CampaignRow]) -> PooledRuns:
    known = [row.figures for row in rows if row.figures is not None]
    scored = [figures for figures in known if figures.get("rms_m") is not None]
    judged = [figures for figures in known if "false_fixes" in figures]
    frames, fixes = (sum(figures[name] for figures in known) for name in ("frames", "fixes"))
    fixes_scored = sum(figures["scored_fixes"] for figures in scored)
    squares_m2 = sum(figures["scored_fixes"] * figures["rms_m"] ** 2 for figures in scored)
    return PooledRuns(
        group=group,
        run=run,
        flights=len(known),
        failed=len(rows) - len(known),
        frames=frames,
        availability=fixes / frames if frames else None,
        rms_m=math.sqrt(squares_m2 / fixes_scored) if fixes_scored else None,
        worst_rms_m=max((figures["rms_m"] for figures in scored), default=None),
        false_fixes=sum(figures["false_fixes"] for figures in judged) if judged else None,
        wrong_over_10m=sum(figures["wrong_over_10m"] for figures in judged) if judged else None,
    )


POOL_COLUMNS = ("run", "flights", "frames", "fixed", "RMS m", "worst flight", "false", "off > 10 m")


def pooled_cells(pool: PooledRuns) -> tuple[str, ...]:
    """The cells of :data:`POOL_COLUMNS`; what is unknown is a dash."""
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


def _page(rows: Sequence[CampaignRow]) -> str:
    """Markdown with the pooled figures of every group, published results, every run, and failures."""
    out = ["# Campaign", ""]
    pools = pool_runs(rows)
    for group in dict.fromkeys(pool.group for pool in pools):
        out += [f"## {group}", "", *_table(POOL_COLUMNS, [pooled_cells(p) for p in pools if p.group == group]), ""]
        if group in PUBLISHED:
            out += [*_table(COLUMNS, [published_cells(result) for result in PUBLISHED[group]]), ""]
    columns = ("flight", "run", "frames", "fixed", "RMS m", "median m", "95 % m", "max m", "false", "NEES", "up m")
    out += ["## Every run", "", *_table(columns, [_run_cells(row) for row in rows if row.figures]), ""]
    failed = [f"- {row.flight}, {row.run}: {row.failure}" for row in rows if row.failure]
    out += ["## Failed", "", *failed, ""] if failed else []
    return "\n".join(out)


def _run_cells(row: CampaignRow) -> tuple[str, ...]:
    figures = row.figures or {}
    metres = (_shown(figures.get(name), "{:.2f}") for name in ("rms_m", "median_m", "r95_m", "max_m"))
    return (
        row.flight,
        row.run,
        str(figures["frames"]),
        _shown(figures.get("availability"), "{:.1%}"),
        *metres,
        _shown(figures.get("false_fixes"), "{}"),
        _shown(figures.get("nees_mean"), "{:.2f}"),
        _shown(figures.get("height_rms_m"), "{:.2f}"),
    )


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (columns, ["---"] * len(columns), *rows)]
