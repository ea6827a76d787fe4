"""The page's sections on SIFT: features of all libraries, time and quality in one table, and the whole step."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from bench.pages.text import shown, table, table_of

Row = dict[str, Any]

BASELINE = "OpenCV SIFT"
PAPER_NCC, PAPER_SIFT = "paper's NCC", "paper's SIFT"
PAPER_RATIO = 121 / 40  # Table I of the paper: SIFT's time over NCC's
WHO = (("who", "peer", "s"), ("threads", "threads", "d"))
TIMES = (("median ms", "median_ms", ".2f"), ("p95 ms", "p95_ms", ".2f"))
COLOURS = {
    "scenematch": "#d55e00",
    "scenematch, upright": "#e69f00",
    "OpenCV SIFT": "#0072b2",
    "OpenCV SIFT, contrast 0.02": "#56b4e9",
    "COLMAP SIFT": "#009e73",
    "kornia SIFT": "#cc79a7",
    "OpenCV ORB": "#999999",
    "OpenCV AKAZE": "#444444",
}


def sections(rows: list[Row]) -> dict[str, list[str]]:
    """Lines of both sections by their names, of what was measured."""
    features = [row for row in rows if row["task"] == "features"]
    steps = [row for row in rows if row["task"] == "sift step"]
    found = {"features": _features_section(features)} if features else {}
    return found | ({"sift step": _step_section(steps)} if steps else {})


def charts(rows: list[Row]) -> dict[str, Figure]:
    """Pictures by file name."""
    features = [row for row in rows if row["task"] == "features"]
    if not features:
        return {}
    return {"sift-quality.png": _quality_chart(features)}


# ------------------------------------------------------------------------------------------------- features


def _sizes(rows: list[Row]) -> list[tuple[int, int]]:
    return list(dict.fromkeys((row["size"][0], row["size"][1]) for row in rows))


def _peers(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["peer"] for row in rows))


def _time_ms(rows: list[Row], peer: str, size: tuple[int, int], batch: int, threads: int) -> float:
    """Median milliseconds a picture, NaN where it was not measured."""
    for row in rows:
        if (row["peer"], tuple(row["size"]), row["batch"], row["threads"]) == (peer, size, batch, threads):
            return float(row["median_ms"]) / batch
    return float("nan")


def _ratio(rows: list[Row], peer: str, size: tuple[int, int]) -> float:
    return _time_ms(rows, BASELINE, size, 1, 1) / _time_ms(rows, peer, size, 1, 1)


def _figures(rows: list[Row], peer: str, size: tuple[int, int]) -> Row:
    return next(row for row in rows if row["peer"] == peer and tuple(row["size"]) == size)


def _both(row: Row, name: str, form: str) -> str:
    """A figure of the warped pairs / of the frames on their map."""
    return " / ".join("-" if row[kind] is None else shown(row[kind][name], form) for kind in ("warped", "on_map"))


def _features_section(rows: list[Row]) -> list[str]:
    batch = max(row["batch"] for row in rows)
    lines = []
    columns = ["who", "1 thread", "2 threads", f"{batch}, 1 thread", f"{batch}, 2 threads", "ratio"]
    columns += ["keypoints", "repeat %", "score %", "right %", "matches", "error px"]
    for size in _sizes(rows):
        figures = _figures(rows, BASELINE, size)
        pairs = f"{figures['warped_pairs']} pairs warped, {figures['on_map_pairs']} on their map"
        lines += [f"### {size[0]} x {size[1]} ({pairs})", ""]
        lines += table(columns, [_feature_cells(rows, peer, size, batch) for peer in _peers(rows)])
    return lines


def _feature_cells(rows: list[Row], peer: str, size: tuple[int, int], batch: int) -> list[str]:
    row = _figures(rows, peer, size)
    percent = {
        kind: None if row[kind] is None else {name: 100.0 * value for name, value in row[kind].items()}
        for kind in ("warped", "on_map")
    }
    times = [shown(_time_ms(rows, peer, size, b, t), ".1f") for b, t in ((1, 1), (1, 2), (batch, 1), (batch, 2))]
    return [
        peer,
        *times,
        shown(_ratio(rows, peer, size), ".2f"),
        _both(row, "keypoints", ".0f"),
        *(_both(percent, name, ".0f") for name in ("repeatability", "matching_score", "inlier_ratio")),
        _both(row, "correct", ".0f"),
        _both(row, "error_px", ".2f"),
    ]


def _quality_chart(rows: list[Row]) -> Figure:
    """Time against correct matches: up and to the left is better."""
    figure, sizes = Figure(figsize=(10, 4.2), layout="constrained"), _sizes(rows)
    for index, size in enumerate(sizes):
        ax = figure.add_subplot(1, len(sizes), index + 1)
        for name in _peers(rows):
            row, time_ms = _figures(rows, name, size), _time_ms(rows, name, size, 1, 1)
            for kind, marker in (("warped", "o"), ("on_map", "^")):
                if row[kind] is not None:
                    ax.plot(time_ms, row[kind]["correct"], marker, color=COLOURS[name], markersize=8, alpha=0.85)
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        ax.margins(y=0.08)
        ax.set_ylim(bottom=0)
        ax.set_title(f"{size[0]} x {size[1]}", fontsize=10)
        ax.set_xlabel("ms a picture, one thread")
        ax.grid(which="both", alpha=0.25)
        if index == 0:
            ax.set_ylabel("correct matches a pair")
    handles = [figure.axes[0].plot([], [], "o", color=COLOURS[name], label=name)[0] for name in _peers(rows)]
    for marker, what in (("o", "warped pictures"), ("^", "frames on their map")):
        handles += figure.axes[0].plot([], [], marker, color="none", markeredgecolor="black", label=what)
    figure.legend(handles=handles, loc="outside upper center", ncols=5, frameon=False, fontsize=8)
    return figure


# ----------------------------------------------------------------------------------------------------- step


def _step_section(rows: list[Row]) -> list[str]:
    time_ms = {(row["peer"], row["threads"]): row["median_ms"] for row in rows}
    told = [
        {
            **row,
            "times": time_ms[PAPER_SIFT, row["threads"]] / row["median_ms"],
            "found": f"{row['fixes']} of {row['frames']}",
        }
        for row in rows
    ]
    found = (("fixes", "found", "s"), ("RMS m", "rms_m", ".2f"), ("height RMS m", "height_rms_m", ".2f"))
    return [
        *table(["threads", "paper, published", "paper's recipe, here", "scenematch"], _step_ratios(time_ms)),
        *table_of(told, *WHO, *TIMES, ("times the paper's SIFT", "times", ".2f"), *found),
    ]


def _step_ratios(time_ms: dict[tuple[str, int], float]) -> list[list[str]]:
    return [
        [
            str(threads),
            f"{PAPER_RATIO:.1f}",
            f"{time_ms[PAPER_SIFT, threads] / time_ms[PAPER_NCC, threads]:.1f}",
            f"{time_ms['scenematch SIFT', threads] / time_ms['scenematch NCC', threads]:.1f}",
        ]
        for threads in sorted({threads for _, threads in time_ms})
    ]
