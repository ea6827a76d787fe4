"""report.html: a self-contained page on a track, verdict first; needs no network and no other file."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from scenematch.report.explain import SliderFrame
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.loop_charts import LOOP_LEGEND, draw_loop_charts, loop_marks, loop_sentence
from scenematch.report.motion_charts import draw_motion
from scenematch.report.page_charts import draw_charts
from scenematch.report.page_frames import draw_slider, frame_data
from scenematch.report.page_map import TrackMap, draw_map, map_of_tracks, track_marks
from scenematch.report.page_parts import CROSS, charts_with_axis, fill_page, map_with_legend, section
from scenematch.report.page_tables import draw_inputs, draw_refusals, draw_segments, draw_tiles
from scenematch.report.verdict import verdict_of

Legend = list[tuple[str, str]]


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
    sentences = [verdict.accuracy, *([loop_sentence(track.loop)] if track.loop else []), verdict.latency]
    segments = draw_segments(track.summary)
    body = [
        section("Where", _where(track, track_map, bool(shown)), "map-section"),
        section("When", _when(track)),
        *([section("Errors by segment", segments)] if segments else []),
        section("Refusals", draw_refusals(track, shown)),
        section("Frame by frame", draw_slider(track, shown, why_not), "frames"),
        section("Inputs and versions", f'<div class="inputs">\n{draw_inputs(track.settings)}\n</div>'),
    ]
    subheading = f"{track.method}, {len(track.rows)} frames"
    if track.is_timed and len(track.rows) > 1:
        subheading += f" over {track.time[-1]:.0f} s"
    fill_page(
        path,
        heading=track.name,
        subheading=subheading,
        grade=verdict.grade,
        verdict="\n".join(f"<p>{escape(sentence)}</p>" for sentence in sentences),
        body=body,
        data={"box": track_map.box, "frames": [frame_data(item, track, track_map) for item in shown]},
    )


def _view_px(track: FinishedTrack) -> float:
    """Median side of the windows, in map pixels; 0 if unknown."""
    sides = [
        max(row.window_width_px, row.window_height_px)
        for row in track.rows
        if row.fixed and row.window_width_px is not None and row.window_height_px is not None
    ]
    return float(np.median(sides)) if sides else 0.0


def _where(track: FinishedTrack, track_map: TrackMap, slider: bool) -> str:
    """The map with its legend, and the key figures."""
    marks = track_marks(track_map, track)
    if track.loop is not None:
        marks[4:4] = loop_marks(track_map, track.loop)  # above the fixes, below the true path
    fixes, beyond = int(track.fixed.sum()), int(track.errors.beyond.sum())
    refused = len(track.rows) - fixes
    label = f"Map with {fixes} fixes, {beyond} of them beyond three sigmas; {refused} refused."
    drawn = map_with_legend(draw_map(track_map, label, marks), track_map, _map_legend(track, slider))
    tiles = "\n".join(
        f"<li><strong>{escape(v)}</strong><span>{escape(k)}</span></li>" for k, v in draw_tiles(track)
    )
    return f'<div class="where">\n<div>\n{drawn}\n</div>\n<ul class="tiles">\n{tiles}\n</ul>\n</div>'


def _map_legend(track: FinishedTrack, slider: bool) -> Legend:
    has_truth = np.isfinite(track.errors.truth_en_m).any()
    line, kind = ("truth", "truth") if has_truth else ("path of the fixes", "fix")
    legend = [(line, f'<path d="M0 7h22" class="rim"/><path d="M0 7h22" class="{kind}"/>')]
    if track.loop is not None:
        legend += LOOP_LEGEND
    legend.append(("fix", '<path class="dots fix" d="M11 7h0"/>'))
    if np.isfinite(track.errors.covariance_en_m2).any():
        legend.append(("three stated sigmas, of some fixes", '<circle cx="11" cy="7" r="6" class="fix"/>'))
    if not track.fixed.all():
        legend.append(("refused", f'<path d="{CROSS}" class="refused"/>'))
    if track.errors.beyond.any():
        legend.append(("fix beyond three of its sigmas", f'<path d="{CROSS}" class="beyond"/>'))
    if slider:
        legend.append(
            ("frame shown below and its window", '<rect class="now" x="2" y="1" width="18" height="12"/>')
        )
    return legend


def _when(track: FinishedTrack) -> str:
    """The charts over time with their legend."""
    charts = draw_charts(track)
    if track.loop is not None and charts:
        charts[1:1] = draw_loop_charts(track.loop, track)
    charts += draw_motion(track)
    if not charts:
        return "<p>There are no frames.</p>"
    legend = [("fix", '<path class="dots fix" d="M11 7h0"/>')]
    if track.errors.beyond.any():
        legend.append(("fix beyond three of its sigmas", '<path class="dots beyond" d="M11 7h0"/>'))
    if np.isfinite(track.errors.truth_en_m).any():
        legend.append(("truth", '<path d="M0 7h22" class="line truth"/>'))
    if track.telemetry:
        legend.append(("telemetry", '<path d="M0 7h22" class="line telemetry"/>'))
    states = {"coasting": "on dead reckoning", "searching": "searching for a first fix", "lost": "lost"}
    seen = {note.state for note in track.notes or ()}
    legend += [
        (name, f'<rect class="{state}" width="22" height="14"/>')
        for state, name in states.items()
        if state in seen
    ]
    return charts_with_axis(charts, legend)
