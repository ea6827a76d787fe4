"""``make bench``: turn a pytest-benchmark run into docs/results/benchmarks.md and its charts.

    python -m bench.pages.report RUN.json [--quick] [--docs DIR]

Beside the run it measures the stages of a frame, in a process of its own.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bench.command import parser_on_one_thread
from bench.pages import sift
from bench.pages.sift import TIMES, WHO
from bench.pages.text import fill, measured, save_pictures, table_of
from bench.speed import stages

BASELINE = {"peak": "OpenCV", "step": "OpenCV", "hypotheses": "OpenCV loop"}


def main() -> None:
    """Read the run, measure the rest, write the page."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("run", type=Path, help="what pytest-benchmark wrote")
    parser.add_argument("--quick", action="store_true", help="leave out the stages of a frame")
    options = parser.parse_args()
    run = json.loads(options.run.read_text(encoding="utf-8"))
    rows = [_row(entry) for entry in run["benchmarks"]]
    flown = [] if options.quick else stages.in_own_process()
    charts = sift.charts(rows)
    if flown:
        charts["frame-stages.png"] = _stages_chart(flown)
    sections = {"peak": _peak_table(rows), "step": _step_table(rows), "hypotheses": _hypotheses_table(rows)}
    stages_table = {"stages": _stages_table(flown)} if flown else {}
    fill(options.docs / "benchmarks.md", measured() | stages_table | sections | sift.sections(rows))
    save_pictures(options.docs, charts)


def _row(entry: dict[str, Any]) -> dict[str, Any]:
    data = np.array(entry["stats"]["data"]) * 1e3
    return entry["extra_info"] | {
        "group": entry["group"],
        "median_ms": float(np.median(data)),
        "p95_ms": float(np.percentile(data, 95)),
    }


def _of_task(rows: list[dict[str, Any]], task: str) -> list[dict[str, Any]]:
    """Its rows, each with its ratio to the peer in its group."""
    own = [row for row in rows if row["task"] == task]
    base_ms = {row["group"]: row["median_ms"] for row in own if row["peer"] == BASELINE[task]}
    return [{**row, "ratio": base_ms[row["group"]] / row["median_ms"]} for row in own]


def _stages_table(flown: list[dict[str, Any]]) -> list[str]:
    """A tracked flight by the engine, in turns with OpenCV's step."""
    rows = [
        {
            **row,
            "who": f"{row['flight']}, {row['method']}",
            "ratio": row["opencv_p50_ms"] / row["p50_ms"],
            "fixes": f"{row['fixed']} of {row['frames']}",
        }
        for row in flown
    ]
    times = (
        ("p50 ms", "p50_ms", ".2f"),
        ("p99 ms", "p99_ms", ".2f"),
        ("OpenCV's step ms", "opencv_p50_ms", ".2f"),
    )
    found = (("fixed", "fixes", "s"), ("RMS m", "rms_m", ".3f"), ("NEES", "nees", ".2f"))
    return table_of(rows, ("flight, method", "who", "s"), *times, ("ratio to it", "ratio", ".2f"), *found)


def _stages_chart(flown: list[dict[str, Any]]) -> Figure:
    """Stacked bars of the stages' medians, over the time of OpenCV's step in the same run."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    axes = figure.subplots()
    labels = [f"{row['flight']}, {row['method']}" for row in flown]
    names = list(dict.fromkeys(name for row in flown for name in row["stages_ms"] if name != "rest"))
    left = np.zeros(len(flown))
    for index, name in enumerate([*names, "rest"]):
        share = np.array([row["stages_ms"].get(name, 0.0) / row["opencv_p50_ms"] for row in flown])
        axes.barh(labels, share, left=left, label=name, color=f"C{index % 10}", alpha=1.0 if index < 10 else 0.5)
        left += share
    axes.axvline(1.0, color="black", linewidth=1.0)
    axes.set_xlabel("median time of a frame over that of OpenCV's plain step (line)")
    axes.invert_yaxis()
    figure.legend(loc="outside upper left", ncols=7, frameon=False, fontsize=8)
    return figure


_MEMORY, _TIMES = ("peak MB", "peak_memory_mb", ".0f"), (*TIMES, ("ratio to OpenCV", "ratio", ".2f"))


def _peak_table(rows: list[dict[str, Any]]) -> list[str]:
    """Window and template in, peak out."""
    peaks = [{**row, "size": f"{row['template_px']} in {row['window_px']}"} for row in _of_task(rows, "peak")]
    found = (("score error", "error", ".0e"), _MEMORY)
    return table_of(peaks, ("size, float32", "size", "s"), *WHO[::-1], *_TIMES, *found)


def _step_table(rows: list[dict[str, Any]]) -> list[str]:
    """A 300 x 300 colour frame in, position out."""
    return table_of(_of_task(rows, "step"), *WHO, *_TIMES, ("RMS m", "rms_m", ".2f"))


def _hypotheses_table(rows: list[dict[str, Any]]) -> list[str]:
    """Heading unknown, height within 10 %, the whole map of the paper."""
    figures = (("median ms", "median_ms", ".0f"), ("ratio", "ratio", ".1f"), ("error m", "error_m", ".1f"))
    return table_of(_of_task(rows, "hypotheses"), *WHO, *figures, _MEMORY)


if __name__ == "__main__":
    main()
