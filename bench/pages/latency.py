"""docs/results/latency.md: the tables and pictures of what :mod:`bench.live.latency` measured."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.live.embedded import PRIOR_SIGMA_M
from bench.live.endless import GRACE_MS
from bench.live.startup import PARTS
from bench.pages.text import machine, table

Row = dict[str, Any]
COLOURS = {"ncc": "#0072b2", "sift": "#d55e00", "auto": "#009e73"}
PART_COLOURS = ("#999999", "#0072b2", "#56b4e9", "#d55e00", "#009e73")
INTRO = (
    "Made by `make bench-latency`, one run of it, on {machine}; one thread where nothing else is said. The "
    "built-in flight is drawn once and flown forth and back with rising stamps, between 110 and 150 m high, so "
    "that thousands of frames meet hundreds of sizes of the window. A time is that of one `Navigator.update`, "
    "from call to answer."
)
BUDGETS = (
    f"**On time** is the share of frames answered, by a fix or a refusal, within the budget and {GRACE_MS:g} ms."
    " A miss is attributed to the cause without which the frame would have been on time: *preempted* and *held or "
    "waiting*, the thread was off its core for that long (with and without a preemption counted by the kernel); "
    "*garbage collector*; else the *stage* that ran when the budget ended. **Fixed** is the share with a fix, "
    "**false** are fixes more than 10 m and 3 of their own sigmas off, **stale** those that carry another "
    "frame's stamp. Stages are those that the fixes came from."
)
HOGS = "Beside processes that burn a core each."
EMBEDDED = (
    "`SceneMatcher` embedded as in the README, on a recorded flight of Gazebo flown over and over, beside a busy "
    "process on each core. Priors are the truth and noise of {sigma:g} m; a quarter of a frame's time is a pause; "
    "*realtime* calls `engine.set_realtime()` after the warm-up. **On time**: within the budget and {grace:g} ms."
)
SLOW = (
    "The process is warmed up at full speed and then stopped and continued by signals, 50 times a second: it "
    "becomes four and ten times slower in flight, and the costs that it learned are wrong. Nothing answers while "
    "it is stopped, which no scheduling can avoid; **but for a stop** allows for one stop, and **on core** counts "
    "the thread's own time against the budget. *Share got* is the measured share of a core."
)
QUEUE = (
    "`Live`, auto, deadline {deadline:g} ms, fed at so many times the rate that it takes ({frame:.1f} ms a "
    "frame). **Age** is from capture to output, of every answer; the newest frame wins, and the others are "
    "dropped. Allowed is the deadline and one frame."
)
SOAK = (
    "`ncc` and `sift` with a budget of 40 ms; `auto` is all of its frames above, its times those at 121 ms. "
    "Growth of the resident memory is the slope of a line through all samples after the first tenth; open files"
    " and threads are those at the first and at the last frame. Cache growth is what is planned, compiled or "
    "prepared for the first time: after the warm-up there should be none. Memory of `auto` grows in steps where "
    "its budget does: more steps become affordable, and take their memory once."
)
CURVE = "Every budget flies the same frames. What RMS leaves out, refused frames, is in the middle picture."
TABLE_ONE = (
    "The demo's flight, level at 150 m, without a budget. The paper's times are from a laptop of its own; its "
    "recipe by OpenCV was measured here. Jitter is p99 less p50."
)
STARTUP = (
    "From the start of the process to the first fix, each start in a process of its own. *All kept* is every "
    "start after the first on a machine: compiled code and the map's features lie in caches. An interpreter "
    "that has torch loaded already spares the first two parts."
)
ENTRIES = (
    "Help, completion and `import engine` alone load neither torch nor any other large package; cameras, frames "
    "and maps need NumPy. Each is a process of its own, the median of five; *on a core* leaves out what it waited "
    "for, and memory is the most that was resident."
)


def write(docs: Path, results: dict[str, Any]) -> None:
    """Write the page and its pictures below ``docs``."""
    (docs / "img").mkdir(parents=True, exist_ok=True)
    soaked = [*results["soak"], results["budgets"]["growth"]]
    pictures = {
        "budgets": _load_chart(results),
        "soak": _soak_chart(soaked),
        "tradeoff": _tradeoff_chart(results["tradeoff"]["curve"]),
        "startup": _startup_chart(results["startup"]),
    }
    for name, figure in pictures.items():
        figure.savefig(docs / "img" / f"latency-{name}.png", dpi=130, facecolor="white")
    lines = ["# Latency, measured", "", *_wrapped(INTRO.format(machine=machine()))]
    lines += [
        "## On time, alone on the machine",
        "",
        *_wrapped(BUDGETS),
        *_latency_table(results["budgets"]["rows"]),
    ]
    lines += ["![latency against budget, by load](img/latency-budgets.png)", ""]
    lines += [f"A frame is on time below the top of its bar, {GRACE_MS:g} ms above its budget.", ""]
    lines += ["## On time, beside busy processes", "", *_wrapped(HOGS), *_latency_table(results["hogs"])]
    lines += _embedded(results.get("embedded", []))
    lines += ["## On time, on a share of a core", "", *_wrapped(SLOW), *_slow_table(results["slow"])]
    lines += ["## More frames than time", "", *_queue(results["queue"])]
    lines += ["## A long flight", "", *_wrapped(SOAK), *_soak_table(soaked)]
    lines += ["![growth of the resident memory](img/latency-soak.png)", ""]
    lines += ["## What a budget buys", "", *_wrapped(CURVE)]
    lines += ["![accuracy, availability and latency against budget](img/latency-tradeoff.png)", ""]
    lines += [*_curve_table(results["tradeoff"]["curve"]), "## Table I with its tails", "", *_wrapped(TABLE_ONE)]
    lines += [*_table_one(results["tradeoff"]["table"]), "## From start to first fix", ""]
    lines += [*_startup(results["startup"]), "![seconds by part](img/latency-startup.png)", ""]
    lines += ["## Before the first fix is asked for", "", *_entries(results["entries"])]
    (docs / "latency.md").write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


# ----------------------------------------------------------------------------------------------------- tables


def _wrapped(text: str) -> list[str]:
    return [*textwrap.wrap(text, 115), ""]


def shown(value: float | None, form: str = ".2f") -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else format(value, form)


def share(value: float | None) -> str:
    """A share in per cent; 100 % only where nothing is missing."""
    if value is None:
        return "-"
    return "100 %" if value == 1.0 else f"{min(100.0 * value, 99.99):.2f} %"


def listed(counts: dict[str, int]) -> str:
    """Names with their counts, those of 0 left out."""
    return ", ".join(f"{name} {count:,}" for name, count in counts.items() if count) or "none"


def _latency_table(rows: list[Row]) -> list[str]:
    columns = ["who", "budget ms", "frames", "on time", "misses by cause", "p50 ms", "p99 ms", "max ms"]
    columns += ["fixed", "RMS m", "false", "stale", "stages"]
    cells = [
        [
            row["who"],
            shown(row["budget_ms"], "g"),
            f"{row['frames']:,}",
            share(row["within"]),
            listed(row["causes"]),
            *(shown(row[name], ".1f") for name in ("p50", "p99", "max")),
            share(row["availability"]),
            shown(row["rms_m"]),
            str(row["wrong"]),
            str(row["stale"]),
            listed(row["stages"]),
        ]
        for row in rows
    ]
    return table(columns, cells)


def _embedded(rows: list[Row]) -> list[str]:
    if not rows:  # the flight was not there
        return []
    columns = ["who", "budget ms", "frames", "on time", "within the budget", "p50 ms", "p99 ms", "max ms", "fixed"]
    cells = [
        [
            row["who"],
            shown(row["budget_ms"], "g"),
            f"{row['frames']:,}",
            share(row["within"]),
            share(row["within_budget"]),
            *(shown(row[name], ".1f") for name in ("p50", "p99", "max")),
            share(row["availability"]),
            shown(row["rms_m"]),
            str(row["wrong"]),
            listed(row["stages"]),
        ]
        for row in rows
    ]
    text = EMBEDDED.format(sigma=PRIOR_SIGMA_M, grace=GRACE_MS)
    return [*_wrapped(text), *table([*columns, "RMS m", "> 10 m off", "stages"], cells)]


def _slow_table(rows: list[Row]) -> list[str]:
    columns = ["share of a core", "share got", "budget ms", "frames", "on time", "but for a stop", "on core"]
    columns += ["misses by cause", "p50 ms", "p99 ms", "max ms", "fixed", "RMS m", "false", "stale"]
    cells = [
        [
            shown(row["share"], "g"),
            shown(row["share_got"]),
            shown(row["budget_ms"], "g"),
            f"{row['frames']:,}",
            share(row["within"]),
            share(row["within_but_a_stop"]),
            share(row["within_on_core"]),
            listed(row["causes"]),
            *(shown(row[name], ".1f") for name in ("p50", "p99", "max")),
            share(row["availability"]),
            shown(row["rms_m"]),
            str(row["wrong"]),
            str(row["stale"]),
        ]
        for row in rows
    ]
    return table(columns, cells)


def _queue(rows: list[Row]) -> list[str]:
    columns = ["fed", "fed Hz", "submitted", "answered", "dropped", "late", "fixes", "age p50 ms", "p99", "max"]
    columns += ["allowed ms", "stale", "RSS MB before", "after"]
    cells = [
        [
            f"{row['factor']} x",
            f"{row['fed_hz']:.0f}",
            *(f"{row[name]:,}" for name in ("submitted", "answered", "dropped", "late", "fixes")),
            *(shown(row[name], ".1f") for name in ("p50", "p99", "max")),
            shown(row["deadline_ms"] + row["frame_ms"], ".1f"),
            str(row["stale"]),
            *(f"{row[name]:.0f}" for name in ("rss_before_mb", "rss_after_mb")),
        ]
        for row in rows
    ]
    text = QUEUE.format(deadline=rows[0]["deadline_ms"], frame=rows[0]["frame_ms"])
    return [*_wrapped(text), *table(columns, cells)]


def _soak_table(rows: list[Row]) -> list[str]:
    columns = ["method", "frames", "window sizes", "growth MB per 10,000 frames", "open files", "threads"]
    columns += ["cache growth", "p99 ms, first tenth", "last tenth", "max ms", "fixed", "false"]
    cells = [
        [
            row["who"],
            f"{row['frames']:,}",
            str(row["windows"]),
            shown(row["rss_slope_mb"]),
            *(" to ".join(f"{count:.0f}" for count in row[name]) for name in ("open_files", "threads")),
            listed(row["cache_growth"]),
            *(shown(row[name], ".1f") for name in ("p99_first", "p99_last", "max")),
            share(row["availability"]),
            str(row["wrong"]),
        ]
        for row in rows
    ]
    return table(columns, cells)


def _curve_table(rows: list[Row]) -> list[str]:
    columns = ["method", "budget ms", "RMS m", "fixed", "false", "p50 ms", "p99 ms", "on time", "stages"]
    cells = [
        [
            row["who"],
            shown(row["budget_ms"], "g"),
            shown(row["rms_m"]),
            share(row["availability"]),
            str(row["wrong"]),
            *(shown(row[name], ".1f") for name in ("p50", "p99")),
            share(row["within"]),
            listed(row["stages"]),
        ]
        for row in rows
    ]
    return table(columns, cells)


def _table_one(rows: list[Row]) -> list[str]:
    columns = [
        "Table I",
        "threads",
        "frames",
        "RMS m",
        "mean ms",
        "p50",
        "p95",
        "p99",
        "p99.9",
        "max",
        "jitter",
        "fixed",
    ]
    cells = []
    for row in rows:
        times = [shown(row.get(name), ".1f") for name in ("mean", "p50", "p95", "p99", "p999", "max")]
        jitter = shown(row["p99"] - row["p50"], ".1f") if "p99" in row else "-"
        counts = [str(row.get(name, "-")) for name in ("threads", "frames")]
        cells.append([row["who"], *counts, shown(row["rms_m"]), *times, jitter, share(row.get("availability"))])
    return table(columns, cells)


def _startup(rows: list[Row]) -> list[str]:
    cells = [
        [
            row["method"],
            row["kept"],
            *(shown(row["parts_s"][part]) for part in PARTS),
            shown(row["total_s"]),
            max(PARTS, key=row["parts_s"].__getitem__),
            shown(row.get("resident_mb"), ".0f"),
            "yes" if row["fixed"] else "no",
        ]
        for row in rows
    ]
    columns = ["method", "caches", *(f"{part} s" for part in PARTS), "total s", "most of it", "memory MB", "fix"]
    return [*_wrapped(STARTUP), *table(columns, cells)]


def _entries(rows: list[Row]) -> list[str]:
    cells = [
        [f"`{row['what']}`", shown(row["seconds"]), shown(row["core_s"]), shown(row["resident_mb"], ".0f")]
        for row in rows
    ]
    return [*_wrapped(ENTRIES), *table(["what", "seconds", "on a core s", "memory MB"], cells)]


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


def _startup_chart(rows: list[Row]) -> Figure:
    """Seconds of each part, one bar a start."""
    figure = Figure(figsize=(8.5, 0.45 * len(rows) + 1.4), layout="constrained")
    ax = figure.subplots()
    names = [f"{row['method']}, {row['kept']}" for row in rows]
    left = np.zeros(len(rows))
    for part, colour in zip(PARTS, PART_COLOURS, strict=True):
        spent = np.array([row["parts_s"][part] for row in rows])
        ax.barh(names, spent, left=left, color=colour, label=part)
        left += spent
    ax.invert_yaxis()
    ax.set_xlabel("seconds from the start of the process")
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return figure
