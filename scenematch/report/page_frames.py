"""The report's slider over single frames, and the data for its script."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from scenematch.files.notes import FrameNote
from scenematch.files.track import TrackRow
from scenematch.report.explain import SliderFrame, run_window
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.page_map import TrackMap
from scenematch.report.verdict import metres


def shows_frames(page: Path) -> bool:
    """Whether an existing page shows frames; False if there is no file."""
    return page.is_file() and 'id="slider"' in page.read_text(encoding="utf-8", errors="replace")


def draw_slider(track: FinishedTrack, shown: Sequence[SliderFrame], why_not: str) -> str:
    """The slider, or the reason for its absence."""
    if not shown:
        return f"<p>{escape(why_not or 'No frames are shown.')}</p>"
    text = f"{_choice(track, shown)} Move by the slider, the arrow keys, or a click on the map or a chart."
    return (
        f'<p class="sub">{text} Each was matched again for this page, in the window that the run used.</p>'
        '<div class="slider"><button type="button" id="before" aria-label="Frame before">&#9664;</button>'
        '<input type="range" id="slider" min="0" value="0" aria-label="Frame">'
        '<button type="button" id="after" aria-label="Next frame">&#9654;</button><div class="strip" id="strip" '
        'aria-hidden="true"></div></div>'
        '<div class="facts" id="facts" aria-live="polite"></div><div class="pictures" id="pictures"></div>'
        "<noscript><p>The slider needs JavaScript; the rest of the page does not.</p></noscript>"
    )


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


def frame_data(shown: SliderFrame, track: FinishedTrack, track_map: TrackMap) -> dict[str, Any]:
    """The data of one frame for the page's script."""
    i = shown.index
    row, note = track.rows[i], track.notes[i] if track.notes else None
    beyond = bool(track.errors.beyond[i])
    position_m = track.errors.fix_en_m[i] if row.fixed else track.refused_en_m[i]
    window = None if note is None else run_window(row, note)
    reason = (row.reason or "").replace("_", " ")
    return {
        "name": row.frame,
        "kind": "beyond" if beyond else "fix" if row.fixed else "refused",
        "answer": ("Fix beyond three of its sigmas" if beyond else "Fix") if row.fixed else f"Refused: {reason}",
        "detail": None if note is None else note.detail,
        "facts": _facts(i, row, note, track),
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


def _facts(i: int, row: TrackRow, note: FrameNote | None, track: FinishedTrack) -> list[tuple[str, str]]:
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
        ("confidence", None if note is None or note.confidence is None else f"{note.confidence:.3f}"),
        ("method", f"{row.method or '-'}" + (f", {note.stage}" if note is not None and note.stage else "")),
        ("navigator", None if note is None else note.state),
        ("latency", None if row.latency_ms is None else f"{row.latency_ms:.1f} ms"),
    ]
    return [(name, value) for name, value in facts if value is not None]
