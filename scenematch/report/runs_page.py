"""comparison.html: several finished tracks on one map and one time axis, with their figures in one table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from engine.errors import OptionError
from engine.geo import Array
from scenematch.report.charts import ChartArea, Limits, dots, line
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.metrics import FALSE_SIGMAS, column, figures_in_words, percentiles
from scenematch.report.page_charts import Chart
from scenematch.report.page_map import TrackMap, connected, draw_map, map_of_tracks
from scenematch.report.page_parts import fill_page
from scenematch.report.verdict import metres, verdict_of

MAX_RUNS = 6
"""The number of distinguishable colours."""
_GRADES = ("bad", "mixed", "open", "good")


def write_runs_page(path: Path, tracks: Mapping[str, FinishedTrack]) -> None:
    """Write the page; equal inputs give equal bytes.

    Args:
        path: the file, replaced if it exists.
        tracks: by the names of their runs, all of them with the same map.

    Raises:
        OptionError: there are none, or more than :data:`MAX_RUNS`.
    """
    if not 1 <= len(tracks) <= MAX_RUNS:
        raise OptionError(f"runs: expected 1 to {MAX_RUNS}, got {len(tracks)}")
    first = next(iter(tracks.values()))
    track_map = map_of_tracks(list(tracks.values()))
    verdicts = {name: verdict_of(track.summary) for name, track in tracks.items()}
    truth = next((t.errors.truth_en_m for t in tracks.values() if t.errors.has_truth), np.empty((0, 2)))
    true_path = connected(track_map, truth)
    marks = [line(true_path, "halo"), *_run_marks(tracks, track_map), line(true_path, "truth")]
    label = f"Map with the tracks of {', '.join(tracks)}."
    grades = {verdict.grade for verdict in verdicts.values()}
    fill_page(
        path,
        "runs.html",
        {"box": track_map.box, "frames": []},
        heading=first.name,
        subheading=f"{len(tracks)} runs: {', '.join(tracks)}",
        grade=next(grade for grade in _GRADES if grade in grades),
        sentences=[(name, verdict.accuracy) for name, verdict in verdicts.items()],
        figures=_figures(tracks),
        drawn=draw_map(track_map, label, marks),
        extent_m=track_map.extent_m,
        has_truth=len(true_path) > 0,
        names=list(tracks),
        charts=_charts(tracks),
        run_legend=[(True, name, f'<path class="dots r{i}" d="M11 7h0"/>') for i, name in enumerate(tracks)],
    )


def _figures(tracks: Mapping[str, FinishedTrack]) -> list[tuple[str, ...]]:
    """The table of figures of merit: its head, and one row per run."""
    share = "{:.1%}".format
    columns: dict[str, tuple[str, Callable[[float], str]]] = {
        "fixed": ("availability", share), "median": ("median_m", metres), "95 % below": ("r95_m", metres),
        "largest": ("max_m", metres), "within 3 sigma": ("within_3_sigma", share),
        "NEES": ("nees_mean", "{:.2f}".format), "latency 95 %": ("p95", "{:.1f} ms".format),
    }  # fmt: skip
    rows: list[tuple[str, ...]] = [("run", "method", *columns)]
    for name, track in tracks.items():
        rows.append((name, track.method, *figures_in_words(track.summary, columns.values())))
    return rows


def _run_marks(tracks: Mapping[str, FinishedTrack], track_map: TrackMap) -> list[str]:
    """Fixes and path of each run in its colour."""
    return [
        f'<g class="run{index}">{line(path, f"r{index} thin")}{dots(path, f"r{index}")}</g>'
        for index, path in enumerate(connected(track_map, track.errors.fix_en_m) for track in tracks.values())
    ]


def _charts(tracks: Mapping[str, FinishedTrack]) -> list[Chart]:
    """Error, error in sigmas, and latency over time, and the share of frames by error and latency.

    Charts over time are left out if only some runs have timestamps.
    """
    runs = tracks.values()
    errors_m = [track.errors.distance_m for track in runs]
    latencies_ms = [column(track.rows, "latency_ms") for track in runs]
    shares = [_share_within("error", "m", errors_m), _share_within("latency", "ms", latencies_ms)]
    ends = [track.time_limits[1] for track in runs if track.rows]
    labels = {track.time_label for track in runs if track.rows}
    if len(labels) > 1:  # seconds and frame numbers have no common axis
        return [chart for chart in shares if chart is not None]
    if not ends or not max(ends):
        return []
    time: Limits = (0.0, max(ends))
    series = {
        "Horizontal error (m)": errors_m,
        f"Horizontal error, in stated sigmas; {FALSE_SIGMAS:g} is the limit": [
            np.sqrt(track.errors.normalised_squared_errors) for track in runs
        ],
        "Stated sigma (m)": [track.errors.sigma_m for track in runs],
        "Latency (ms)": latencies_ms,
    }
    (label,) = labels
    times = [track.time for track in runs]
    charts = [_over_time(what, label, time, times, values) for what, values in series.items()]
    return [chart for chart in charts + shares if chart is not None]


def _over_time(
    what: str, label: str, time: Limits, times: Sequence[Array], values: Sequence[Array]
) -> Chart | None:
    high = percentiles(np.concatenate(values), {"p97": 97})["p97"]
    if high is None:
        return None
    area = ChartArea(time, (0.0, max(1.2 * high, 0.1)))
    marks = [
        f'<g class="run{i}">{area.dots(t, v, f"r{i}")}{area.overflow(t, v, f"over r{i}")}</g>'
        for i, (t, v) in enumerate(zip(times, values, strict=True))
    ]
    return what, area.svg(f"{what} over time", label, marks, timed=True)


def _share_within(name: str, unit: str, values: Sequence[Array]) -> Chart | None:
    """Share of all frames, including refused ones, that were answered within a given error or latency.

    A curve ends at the share that was answered: a method that answers few frames accurately ends low, one that
    answers inaccurately rises late.
    """
    high = percentiles(np.concatenate(values), {"p99": 99})["p99"]
    if high is None:
        return None
    top = 1.2 * high
    area = ChartArea((0.0, top), (0.0, 1.02))
    marks = []
    for i, series in enumerate(values):
        order = np.sort(series[np.isfinite(series) & (series <= top)])
        x = np.concatenate([[0.0], np.repeat(order, 2), [top]])
        y = np.concatenate([[0.0], np.repeat(np.arange(order.size + 1), 2)[1:]]) / max(1, series.size)
        marks.append(f'<g class="run{i}">{area.line(x, y, f"r{i}")}</g>')
    what = f"Share of all frames by {name}"
    return what, area.svg(what, f"{name} ({unit})", marks, timed=False)
