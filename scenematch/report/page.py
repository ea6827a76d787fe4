"""report.html: a self-contained page on a track, verdict first; needs no network and no other file."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from engine.values import Reason
from scenematch.files.track import TrackRow
from scenematch.report.explain import SliderFrame, run_window
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.page_charts import draw_charts
from scenematch.report.page_map import TrackMap, draw_map, loop_marks, map_of_tracks, track_marks
from scenematch.report.page_parts import fill_page
from scenematch.report.verdict import MEANINGS, key_figures, loop_sentence, metres, verdict_of


def write_page(path: Path, track: FinishedTrack, shown: Sequence[SliderFrame] = (), why_not: str = "") -> None:
    """Write the page; equal inputs give equal bytes.

    Args:
        path: the file, replaced if it exists.
        track: the track.
        shown: frames of the slider with their images.
        why_not: why there are none.
    """
    track_map = map_of_tracks([track], _view_px(track))
    verdict = verdict_of(track.summary)
    subheading = f"{track.method}, {len(track.rows)} frames"
    if track.is_timed and len(track.rows) > 1:
        subheading += f" over {track.time[-1]:.0f} s"
    fill_page(
        path,
        "track.html",
        {"box": track_map.box, "frames": [_frame_data(item, track, track_map) for item in shown]},
        heading=track.name,
        subheading=subheading,
        grade=verdict.grade,
        sentences=[verdict.accuracy, *([loop_sentence(track.loop)] if track.loop else []), verdict.latency],
        drawn=_map(track, track_map),
        extent_m=track_map.extent_m,
        figures=key_figures(track.summary),
        charts=draw_charts(track),
        refusals=_refusals(track, shown),
        choice=_choice(track, shown) if shown else "",
        why_not=why_not or "No frames are shown.",
        track=track,
        has_sigmas=np.isfinite(track.errors.covariance_en_m2).any(),
        versions=_versions(),
    )


def _view_px(track: FinishedTrack) -> float:
    """Median side of the windows, in map pixels; 0 if unknown."""
    sides = [
        max(row.window_width_px, row.window_height_px)
        for row in track.rows
        if row.fixed and row.window_width_px is not None and row.window_height_px is not None
    ]
    return float(np.median(sides)) if sides else 0.0


def _map(track: FinishedTrack, track_map: TrackMap) -> str:
    """The map with the marks of the track."""
    marks = track_marks(track_map, track)
    if track.loop is not None:
        marks[4:4] = loop_marks(track_map, track.loop)  # above the fixes, below the true path
    fixes, beyond = int(track.fixed.sum()), int(track.errors.beyond.sum())
    refused = len(track.rows) - fixes
    label = f"Map with {fixes} fixes, {beyond} of them beyond three sigmas; {refused} refused."
    return draw_map(track_map, label, marks)


# ------------------------------------------------------------------------------------------------ frame by frame


def shows_frames(page: Path) -> bool:
    """Whether an existing page shows frames; False if there is no file."""
    return page.is_file() and 'id="slider"' in page.read_text(encoding="utf-8", errors="replace")


def _choice(track: FinishedTrack, shown: Sequence[SliderFrame]) -> str:
    """Describe which frames are shown."""
    if len(shown) == len(track.rows):
        return f"All {len(shown)} frames."
    kinds = {"beyond three sigmas": np.flatnonzero(track.errors.beyond), "refused": np.flatnonzero(~track.fixed)}
    there = {item.index for item in shown}
    parts = [
        f"{'' if there.issuperset(found) else f'{len(there.intersection(found))} of '}{len(found)} {kind}"
        for kind, found in kinds.items()
        if found.size
    ]
    parts.append("the others evenly spaced" if parts else "evenly spaced")
    return f"{len(shown)} of {len(track.rows)} frames: {', '.join(parts)}."


def _frame_data(shown: SliderFrame, track: FinishedTrack, track_map: TrackMap) -> dict[str, Any]:
    """The data of one frame for the page's script."""
    i = shown.index
    row = track.rows[i]
    beyond = bool(track.errors.beyond[i])
    position_m = track.errors.fix_en_m[i] if row.fixed else track.refused_en_m[i]
    window = run_window(row)
    reason = (row.reason or "").replace("_", " ")
    return {
        "name": row.frame,
        "kind": "beyond" if beyond else "fix" if row.fixed else "refused",
        "answer": ("Fix beyond three of its sigmas" if beyond else "Fix") if row.fixed else f"Refused: {reason}",
        "detail": row.detail,
        "facts": _facts(i, row, track),
        "t": round(float(track.time[i]), 3),
        "xy": [round(float(v), 1) for v in track_map.drawing_xy(position_m)]
        if np.isfinite(position_m).all()
        else None,
        "window": None if window is None else track_map.rectangle(window),
        "pictures": [
            {"s": p.src, "w": p.width_px, "h": p.height_px, "c": p.caption, "a": p.alt, "o": p.overlay}
            for p in shown.images
        ],
    }


def _facts(i: int, row: TrackRow, track: FinishedTrack) -> list[tuple[str, str]]:
    """Figures of one frame by name."""
    stated = None
    if row.sigma_east_m is not None and row.sigma_north_m is not None:
        stated = f"{row.sigma_east_m:.2f} m east, {row.sigma_north_m:.2f} m north"
    error_m = float(track.errors.distance_m[i])
    sigmas = float(np.sqrt(track.errors.normalised_squared_errors[i]))
    facts = [
        ("time", f"{track.time[i]:.2f} s") if track.is_timed else ("frame", f"{i}"),
        ("error", metres(error_m) if np.isfinite(error_m) else None),
        ("in its sigmas", f"{sigmas:.1f}" if np.isfinite(sigmas) else None),
        ("stated sigma", stated),
        ("score", None if row.score is None else f"{row.score:.3f}"),
        ("confidence", None if row.confidence is None else f"{row.confidence:.3f}"),
        ("method", f"{row.method or '-'}" + (f", {row.stage}" if row.stage else "")),
        ("evidence, nats", row.looks),
        ("navigator", row.state),
        ("latency", None if row.latency_ms is None else f"{row.latency_ms:.1f} ms"),
    ]
    return [(name, value) for name, value in facts if value is not None]


# ------------------------------------------------------------------------------------------------------- tables


def _refusals(track: FinishedTrack, shown: Sequence[SliderFrame]) -> list[tuple[Any, ...]]:
    """For each reason, most frequent first: count, name, meaning, an example, its place among the shown frames."""
    rows: list[tuple[Any, ...]] = []
    for name, count in track.summary["reasons"].items():
        indices = [i for i, row in enumerate(track.rows) if row.reason == name]
        known = set(indices)
        position = next((k for k, item in enumerate(shown) if item.index in known), None)
        row = track.rows[indices[0] if position is None else shown[position].index]
        example = f"{row.frame}: {row.detail or '-'}"
        rows.append((count, name.replace("_", " "), MEANINGS[Reason(name)], example, position))
    return rows


def _versions() -> list[tuple[str, str]]:
    """Versions of what computed the page."""
    return [
        ("scenematch", metadata.version("scenematch-engine")),
        ("torch", metadata.version("torch")),
        ("OpenCV", cv2.__version__),
        ("numpy", np.__version__),
        ("Python", platform.python_version()),
    ]
