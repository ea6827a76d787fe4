"""docs/results/latency.md: the tables and pictures of what :mod:`bench.live.latency` measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.live.endless import GRACE_MS
from bench.live.startup import PARTS
from bench.pages.text import fill, measured, save_pictures, table_of

Row = dict[str, Any]
COLOURS = {"ncc": "#0072b2", "sift": "#d55e00", "auto": "#009e73"}


def write(docs: Path, results: dict[str, Any]) -> None:
    """Fill in the page below ``docs``, and draw its pictures."""
    soaked = [*results["soak"], results["budgets"]["growth"]]
    sections = {
        "budgets": _latency_table(results["budgets"]["rows"]),
        "hogs": _latency_table(results["hogs"]),
        "slow": _slow_table(results["slow"]),
        "queue": _queue_table(results["queue"]),
        "soak": _soak_table(soaked),
        "curve": _curve_table(results["tradeoff"]["curve"]),
        "table one": _table_one(results["tradeoff"]["table"]),
        "startup": _startup_table(results["startup"]),
        "entries": _entries_table(results["entries"]),
    }
    if results["embedded"]:  # else its flight was not there
        sections["embedded"] = _embedded_table(results["embedded"])
    fill(docs / "latency.md", measured() | sections)
    pictures = {
        "latency-budgets.png": _load_chart(results),
        "latency-soak.png": _soak_chart(soaked),
        "latency-tradeoff.png": _tradeoff_chart(results["tradeoff"]["curve"]),
    }
    save_pictures(docs, pictures)


# ----------------------------------------------------------------------------------------------------- tables


def share(value: float | None) -> str:
    """A share in per cent; 100 % only where nothing is missing."""
    if value is None:
        return "-"
    return "100 %" if value == 1.0 else f"{min(100.0 * value, 99.99):.2f} %"


def listed(counts: dict[str, int]) -> str:
    """Names with their counts, those of 0 left out."""
    return ", ".join(f"{name} {count:,}" for name, count in counts.items() if count) or "none"


_BUDGET, _FRAMES = ("budget ms", "budget_ms", "g"), ("frames", "frames", ",")
_ON_TIME, _CAUSES = ("on time", "within", share), ("misses by cause", "causes", listed)
_FIXED, _RMS = ("fixed", "availability", share), ("RMS m", "rms_m", ".2f")
_FALSE, _STALE, _STAGES = ("false", "wrong", "d"), ("stale", "stale", "d"), ("stages", "stages", listed)
_TIMES = (("p50 ms", "p50", ".1f"), ("p99 ms", "p99", ".1f"), ("max ms", "max", ".1f"))


def _latency_table(rows: list[Row]) -> list[str]:
    which = (("who", "who", "s"), _BUDGET, _FRAMES, _ON_TIME, _CAUSES)
    return table_of(rows, *which, *_TIMES, _FIXED, _RMS, _FALSE, _STALE, _STAGES)


def _embedded_table(rows: list[Row]) -> list[str]:
    which = (("who", "who", "s"), _BUDGET, _FRAMES, _ON_TIME, ("within the budget", "within_budget", share))
    return table_of(rows, *which, *_TIMES, _FIXED, _RMS, ("> 10 m off", "wrong", "d"), _STAGES)


def _slow_table(rows: list[Row]) -> list[str]:
    which = (("share of a core", "share", "g"), ("share got", "share_got", ".2f"), _BUDGET, _FRAMES, _ON_TIME)
    kept = (("but for a stop", "within_but_a_stop", share), ("on core", "within_on_core", share), _CAUSES)
    return table_of(rows, *which, *kept, *_TIMES, _FIXED, _RMS, _FALSE, _STALE)


def _queue_table(rows: list[Row]) -> list[str]:
    counts = ((name, name, ",") for name in ("submitted", "answered", "dropped", "late", "fixes"))
    ages = (("age p50 ms", "p50", ".1f"), ("p99", "p99", ".1f"), ("max", "max", ".1f"))
    memory = (("RSS MB before", "rss_before_mb", ".0f"), ("after", "rss_after_mb", ".0f"))
    allowed = [{"allowed_ms": row["deadline_ms"] + row["frame_ms"], **row} for row in rows]
    columns = (("fed", "factor", "{} x".format), ("fed Hz", "fed_hz", ".0f"), *counts, *ages)
    return table_of(allowed, *columns, ("allowed ms", "allowed_ms", ".1f"), _STALE, *memory)


def _from_to(counts: list[float]) -> str:
    return " to ".join(f"{count:.0f}" for count in counts)


def _soak_table(rows: list[Row]) -> list[str]:
    grown = (("growth MB per 10,000 frames", "rss_slope_mb", ".2f"), ("open files", "open_files", _from_to))
    times = (("p99 ms, first tenth", "p99_first", ".1f"), ("last tenth", "p99_last", ".1f"), _TIMES[2])
    which = (("method", "who", "s"), _FRAMES, ("window sizes", "windows", "d"))
    caches = ("cache growth", "cache_growth", listed)
    return table_of(rows, *which, *grown, ("threads", "threads", _from_to), caches, *times, _FIXED, _FALSE)


def _curve_table(rows: list[Row]) -> list[str]:
    return table_of(rows, ("method", "who", "s"), _BUDGET, _RMS, _FIXED, _FALSE, *_TIMES[:2], _ON_TIME, _STAGES)


def _table_one(rows: list[Row]) -> list[str]:
    titles = {"mean": "mean ms", "p50": "p50", "p95": "p95", "p99": "p99", "p999": "p99.9", "max": "max"}
    spread = [{"jitter": row["p99"] - row["p50"], **row} if "p99" in row else row for row in rows]
    spread = [{"availability": None, **row} for row in spread]
    which = (("Table I", "who", "s"), ("threads", "threads", "d"), ("frames", "frames", "d"), _RMS)
    times = ((title, key, ".1f") for key, title in titles.items())
    return table_of(spread, *which, *times, ("jitter", "jitter", ".1f"), _FIXED)


def _startup_table(rows: list[Row]) -> list[str]:
    told = [{**row["parts_s"], **row, "most": max(PARTS, key=row["parts_s"].__getitem__)} for row in rows]
    parts = ((f"{part} s", part, ".2f") for part in PARTS)
    total = (("total s", "total_s", ".2f"), ("most of it", "most", "s"), ("memory MB", "resident_mb", ".0f"))
    fixed = ("fix", "fixed", lambda is_fixed: "yes" if is_fixed else "no")
    columns = (("method", "method", "s"), ("caches", "kept", "s"), *parts, *total, fixed)
    return table_of(told, *columns)


def _entries_table(rows: list[Row]) -> list[str]:
    spent = (("seconds", "seconds", ".2f"), ("on a core s", "core_s", ".2f"), ("memory MB", "resident_mb", ".0f"))
    return table_of(rows, ("what", "what", "`{}`".format), *spent)


# ---------------------------------------------------------------------------------------------------- pictures


def _load_chart(results: dict[str, Any]) -> Figure:
    """Latency of auto against the budget: one panel a load, one mark a percentile, the shade is on time."""
    loads: dict[str, list[Row]] = {"alone": [row for row in results["budgets"]["rows"] if row["who"] == "auto"]}
    for row in results["hogs"]:
        loads.setdefault(row["who"].removeprefix("auto "), []).append(row)
    for row in results["slow"]:
        loads.setdefault(f"{row['share']:g} of a core", []).append(row)
    figure = Figure(figsize=(2.6 * len(loads), 3.4), layout="constrained")
    axes: list[Axes] = figure.subplots(1, len(loads), sharey=True, squeeze=False)[0].tolist()
    for ax, (name, rows) in zip(axes, loads.items(), strict=True):
        budgets, places = [row["budget_ms"] for row in rows], np.arange(len(rows))
        ax.bar(places, [b + GRACE_MS for b in budgets], 0.8, 0.5, color="#009e73", alpha=0.18, label="on time")
        for level, marker, colour in (("p50", "o", "#0072b2"), ("p99", "s", "#e69f00"), ("max", "^", "#d55e00")):
            ax.plot(places, [row[level] for row in rows], marker, color=colour, label=level)
        ax.set_xticks(places, [f"{b:g}" for b in budgets])
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")
        ax.set_title(name, fontsize=9)
        ax.set_xlabel("budget, ms")
        ax.grid(axis="y", alpha=0.25)
    axes[0].set_ylabel("latency, ms")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False, fontsize=9
    )
    return figure


def _soak_chart(rows: list[Row]) -> Figure:
    """Resident memory less that of the first sample."""
    figure = Figure(figsize=(7.5, 3.0), layout="constrained")
    ax = figure.subplots()
    for row in rows:
        memory = np.array(row["rss_mb"])
        frames = np.arange(len(memory)) * row["rss_every"]
        ax.plot(frames, memory - memory[0], color=COLOURS[row["who"]], label=row["who"], linewidth=1.5)
    ax.set_xlabel("frames")
    ax.set_ylabel("growth of memory, MB")
    ax.xaxis.set_major_formatter("{x:,.0f}")
    ax.grid(alpha=0.25)
    ax.legend(frameon=False)
    return figure


def _tradeoff_chart(rows: list[Row]) -> Figure:
    """RMS, availability, and latency against the budget."""
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    accuracy, available, latency = figure.subplots(1, 3)
    for method, colour in COLOURS.items():
        own = [row for row in rows if row["who"] == method]
        budgets = [row["budget_ms"] for row in own]
        rms = [np.nan if row["rms_m"] is None else row["rms_m"] for row in own]
        accuracy.plot(budgets, rms, "o-", color=colour, label=method)
        available.plot(budgets, [100.0 * row["availability"] for row in own], "o-", color=colour)
        latency.plot(budgets, [row["p50"] for row in own], "o-", color=colour)
        latency.plot(budgets, [row["p99"] for row in own], "o--", color=colour, markerfacecolor="white")
    reach = [min(row["budget_ms"] for row in rows), max(row["budget_ms"] for row in rows)]
    latency.plot(reach, reach, color="#999999", linewidth=1.0)
    latency.annotate("budget", (40.0, 50.0), ha="right", va="bottom", fontsize=8, color="#777777")
    latency.set_yscale("log")
    latency.yaxis.set_major_formatter("{x:g}")
    available.set_ylim(-3, 103)
    accuracy.set_ylim(bottom=0.0)
    titles = ("RMS of the fixes, m", "frames with a fix, %", "latency, ms: p50, and p99 dashed")
    for ax, title in zip((accuracy, available, latency), titles, strict=True):
        ax.set_xscale("log")
        ax.set_xlim(0.8 * reach[0], 1.25 * reach[1])
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_xlabel("budget, ms")
        ax.set_title(title, fontsize=10)
        ax.grid(which="both", alpha=0.2)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return figure
