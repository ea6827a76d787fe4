"""report.html: a self-contained page on a track, its verdict first; it needs no network and no other file."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import metadata, resources
from pathlib import Path
from string import Template
from typing import Any

import cv2
import numpy as np

from engine.formats.notes import FrameNote
from engine.formats.track import TrackRow
from engine.orthomap import OrthoMap
from engine.report.explain import SliderFrame
from engine.report.metrics import WRONG_M, Ground
from engine.report.page_charts import draw_charts
from engine.report.page_map import TrackMap, draw_map, map_of_track
from engine.report.plot_data import TrackPlotData, prepare_plot_data
from engine.report.verdict import MEANINGS, metres, verdict_of
from engine.values import Reason, Truth, Window

_FACTS = {
    "map": "map", "map_sigma_m": "map sigma (m)", "surface": "surface model", "camera": "camera",
    "frames": "frames", "image_topic": "image topic", "telemetry": "telemetry", "frame_stamps": "frame stamps",
    "log_offset_s": "log offset (s)", "truth": "truth", "method": "method", "profile": "profile",
    "device": "device", "start": "start", "budget_ms": "budget (ms)",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class FinishedTrack:
    """A finished track with all inputs of its report.

    Attributes:
        rows: the track.
        truth: in the order of time, or None.
        site: the map.
        ground: level of the ground.
        summary: contents of summary.json, its settings included.
        notes: one per row, or None where the run left none.
    """

    rows: Sequence[TrackRow]
    truth: Sequence[Truth] | None
    site: OrthoMap
    ground: Ground
    summary: Mapping[str, Any]
    notes: Sequence[FrameNote] | None

    def plot_data(self) -> TrackPlotData:
        """Plot data of the track."""
        return prepare_plot_data(self.rows, self.truth, self.site.frame, self.ground, "")


def write_page(path: Path, track: FinishedTrack, shown: Sequence[SliderFrame] = (), why_not: str = "") -> None:
    """Write the page; equal inputs give equal bytes.

    Args:
        path: the file, replaced where it exists.
        track: the track.
        shown: frames of the slider with their images.
        why_not: reason why there are none.
    """
    plot_data, settings = track.plot_data(), track.summary["settings"]
    track_map = map_of_track(track.site, plot_data)
    verdict = verdict_of(track.summary, _median_sigma_m(track.rows), settings.get("budget_ms"))
    charts = draw_charts(track.rows, track.notes, plot_data, settings.get("budget_ms"))
    heading, subheading = _headings(track, plot_data)
    frames = [_frame(item, track, plot_data, track_map) for item in shown]
    data = {"box": track_map.box, "frames": frames}
    parts = {
        "title": escape(f"{heading}: scenematch report"),
        "style": _resource("page.css"),
        "heading": escape(heading),
        "subheading": escape(subheading),
        "grade": verdict.grade,
        "accuracy": escape(verdict.accuracy),
        "latency": escape(verdict.latency),
        "map": draw_map(track_map, plot_data),
        "map_legend": _map_legend(plot_data, track_map, bool(shown)),
        "tiles": "\n".join(
            f"<li><strong>{escape(v)}</strong><span>{escape(k)}</span></li>" for k, v in _tiles(track)
        ),
        "charts": "\n".join(f"<figure><figcaption>{escape(c)}</figcaption>{svg}</figure>" for c, svg in charts)
        + _states_legend(track),
        "refusals": _refusals(track, shown),
        "frames": _slider(track, plot_data, shown, why_not),
        "inputs": _inputs(settings),
        "data": json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
        "script": _resource("page.js"),
    }
    path.write_text(Template(_resource("page.html")).substitute(parts), encoding="utf-8", newline="\n")


def _resource(name: str) -> str:
    return resources.files("engine.report").joinpath(name).read_text(encoding="utf-8")


def _median_sigma_m(rows: Sequence[TrackRow]) -> float | None:
    """Median over fixes of the larger stated sigma, in metres; None without fixes."""
    sigmas = [
        max(row.sigma_east_m, row.sigma_north_m)
        for row in rows
        if row.sigma_east_m is not None and row.sigma_north_m is not None
    ]
    return float(np.median(sigmas)) if sigmas else None


def _headings(track: FinishedTrack, plot_data: TrackPlotData) -> tuple[str, str]:
    """The name of the flight, and the method with the number of frames."""
    settings = track.summary["settings"]
    frames = Path(settings.get("frames") or settings["map"])
    name = frames.parent.name if frames.name == "frames" else frames.stem
    method = str(settings["method"])
    text = f"{method.upper() if method != 'auto' else 'NCC and SIFT'}, {settings['profile']} profile"
    text += f", {len(track.rows)} frames"
    if plot_data.time_label.startswith("time") and len(plot_data.time) > 1:
        text += f" over {plot_data.time[-1]:.0f} s"
    return name or "flight", text


def _tiles(track: FinishedTrack) -> list[tuple[str, str]]:
    """Label and value of the key figures that are known."""
    summary = track.summary
    share = summary["availability"]
    tiles = [(f"fixed, {summary['fixes']} of {summary['frames']}", "-" if share is None else f"{share:.1%}")]
    if summary.get("median_m") is not None:
        tiles += [
            ("median error", metres(summary["median_m"])),
            ("95 % of errors below", metres(summary["r95_m"])),
            ("largest error", metres(summary["max_m"])),
            (f"wrong, more than {WRONG_M:g} m off", str(summary["wrong_over_10m"])),
            ("false, wrong beyond 3 sigma", str(summary["false_fixes"])),
        ]
        if summary["nees_mean"] is not None:
            tiles.append(
                ("NEES: 2 is consistent, less cautious, more overconfident", f"{summary['nees_mean']:.2f}")
            )
    elif (sigma_m := _median_sigma_m(track.rows)) is not None:
        tiles.append(("median of the stated sigmas", metres(sigma_m)))
    if summary.get("height_rms_m") is not None:
        tiles.append(("RMS error of height", metres(summary["height_rms_m"])))
    for name, key in (("latency, median", "p50"), ("latency, 95 % below", "p95")):
        if summary["latency_ms"][key] is not None:
            tiles.append((name, f"{summary['latency_ms'][key]:.1f} ms"))
    return tiles


def _map_legend(plot_data: TrackPlotData, track_map: TrackMap, slider: bool) -> str:
    has_truth = bool(np.isfinite(plot_data.errors.truth_en_m).any())
    wrong = bool((plot_data.errors.distance_m > WRONG_M).any())
    cross = "M6 2l10 10M16 2l-10 10"
    entries = [
        (
            "truth" if has_truth else "path of the fixes",
            f'<path d="M0 7h22" stroke="var(--{"truth" if has_truth else "fix"})"/>',
        ),
        ("fix", '<path class="dots" d="M11 7h0" stroke="var(--fix)"/>'),
        ("its 3 sigma ellipse", '<circle cx="11" cy="7" r="6" stroke="var(--fix)" fill="#0072b220"/>'),
        ("refused", f'<path d="{cross}" stroke="var(--refused)"/>') if plot_data.refused.any() else None,
        (f"fix more than {WRONG_M:g} m off", f'<path d="{cross}" stroke="var(--wrong)"/>') if wrong else None,
        (
            "frame shown below and its window",
            '<rect class="outline" x="2" y="1" width="18" height="12" stroke="var(--now)"/>',
        )
        if slider
        else None,
    ]
    items = "".join(f"<li><svg aria-hidden='true'>{mark}</svg>{name}</li>" for name, mark in filter(None, entries))
    width, height = (
        n * track_map.site.gsd_m_per_px for n in (track_map.window.width_px, track_map.window.height_px)
    )
    return (
        f'<ul class="legend">{items}</ul><p class="hint">{width:,.0f} by {height:,.0f} m of the map. Zoom by the '
        "buttons or Ctrl and the wheel; drag to move.</p>"
    )


def _states_legend(track: FinishedTrack) -> str:
    """Legend of the navigator's states that occurred."""
    seen = {note.state for note in track.notes or ()} - {"tracking"}
    names = {"coasting": "on dead reckoning", "searching": "searching for a first fix", "lost": "lost"}
    items = "".join(
        f'<li><svg aria-hidden="true"><rect class="{state}" width="22" height="14"/></svg>{name}</li>'
        for state, name in names.items()
        if state in seen
    )
    return f'\n<ul class="legend states">{items}</ul>' if items else ""


def _refusals(track: FinishedTrack, shown: Sequence[SliderFrame]) -> str:
    """Table of reasons, most frequent first, with the detail of one refusal each."""
    if not track.summary["reasons"]:
        return "<p>No frame was refused.</p>" if track.rows else "<p>There are no frames.</p>"
    lines = []
    for name, count in track.summary["reasons"].items():
        indices = [i for i, row in enumerate(track.rows) if row.reason == name]
        known = set(indices)
        position = next((k for k, item in enumerate(shown) if item.index in known), None)
        index = indices[0] if position is None else shown[position].index
        detail = (track.notes[index].detail if track.notes else None) or "-"
        button = (
            "" if position is None else f'<button class="goto" type="button" data-goto="{position}">show</button>'
        )
        cells = (name.replace("_", " "), MEANINGS[Reason(name)], f"{track.rows[index].frame}: {detail}")
        text = "".join(f"<td>{escape(cell)}</td>" for cell in cells[:2])
        text += f'<td class="break">{escape(cells[2])}</td><td>{button}</td>'
        lines.append(f'<tr><td class="count">{count}</td>{text}</tr>')
    head = "<th>frames</th><th>reason</th><th>meaning</th><th>for example</th><th></th>"
    return f'<table class="reasons"><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table>'


def _slider(track: FinishedTrack, plot_data: TrackPlotData, shown: Sequence[SliderFrame], why_not: str) -> str:
    if not shown:
        return f"<p>{escape(why_not or 'No frames are shown.')}</p>"
    text = f"All {len(shown)} frames."
    if len(shown) < len(track.rows):
        wrong = [i for i, distance_m in enumerate(plot_data.errors.distance_m) if distance_m > WRONG_M]
        refused = [i for i, row in enumerate(track.rows) if not row.fixed]
        parts = [
            _share_shown(wrong, shown, "wrong fixes"),
            _share_shown(refused, shown, "refusals"),
            "the others evenly spaced",
        ]
        text = f"{len(shown)} of {len(track.rows)} frames: {', '.join(part for part in parts if part)}."
    return (
        f'<p class="sub">{text} Move by the slider, the arrow keys, or a click on the map or a chart. Each was '
        "matched again for this page, in the window that the run used.</p>"
        '<div class="slider"><button type="button" id="before" aria-label="Frame before">&#9664;</button>'
        '<input type="range" id="slider" min="0" value="0" aria-label="Frame">'
        '<button type="button" id="after" aria-label="Next frame">&#9654;</button><div class="strip" id="strip" '
        'aria-hidden="true"></div></div>'
        '<div class="facts" id="facts" aria-live="polite"></div><div class="pictures" id="pictures"></div>'
        "<noscript><p>The slider needs JavaScript; the rest of the page does not.</p></noscript>"
    )


def _share_shown(indices: Sequence[int], shown: Sequence[SliderFrame], kind: str) -> str:
    """How many of some frames are shown, in words; empty where there are none."""
    count = len({item.index for item in shown} & set(indices))
    return (
        ""
        if not indices
        else f"all {count} {kind}"
        if count == len(indices)
        else f"{count} of {len(indices)} {kind}"
    )


def _frame(
    shown: SliderFrame, track: FinishedTrack, plot_data: TrackPlotData, track_map: TrackMap
) -> dict[str, Any]:
    """The data of one frame for the page's script."""
    i = shown.index
    row, note = track.rows[i], track.notes[i] if track.notes else None
    wrong = bool(plot_data.errors.distance_m[i] > WRONG_M)
    position_m = plot_data.refused_en_m[i] if plot_data.refused[i] else plot_data.errors.fix_en_m[i]
    window = None
    if (
        note is not None
        and note.window_x0_px is not None
        and note.window_y0_px is not None
        and row.window_width_px
    ):
        size = (row.window_width_px, row.window_height_px or 0)
        window = track_map.rectangle(Window(note.window_x0_px, note.window_y0_px, *size))
    reason = (row.reason or "").replace("_", " ")
    return {
        "name": row.frame,
        "kind": "wrong" if wrong else "fix" if row.fixed else "refused",
        "answer": ("Wrong fix" if wrong else "Fix") if row.fixed else f"Refused: {reason}",
        "detail": None if note is None else note.detail,
        "facts": _facts(i, row, note, plot_data),
        "t": round(float(plot_data.time[i]), 3),
        "xy": [round(float(v), 1) for v in track_map.drawing_xy(position_m)]
        if np.isfinite(position_m).all()
        else None,
        "window": window,
        "pictures": [
            {"s": p.src, "w": p.width_px, "h": p.height_px, "c": p.caption, "a": p.alt, "o": p.overlay}
            for p in shown.images
        ],
    }


def _facts(i: int, row: TrackRow, note: FrameNote | None, plot_data: TrackPlotData) -> list[tuple[str, str]]:
    sigma = (
        None if row.sigma_east_m is None or row.sigma_north_m is None else (row.sigma_east_m, row.sigma_north_m)
    )
    error_m, known = float(plot_data.errors.distance_m[i]), bool(np.isfinite(plot_data.errors.distance_m[i]))
    facts = [
        (
            plot_data.time_label.partition(" ")[0],
            f"{plot_data.time[i]:.2f} s" if "(s)" in plot_data.time_label else f"{i}",
        ),
        ("error", metres(error_m) if known else None),
        ("stated sigma", None if sigma is None else f"{sigma[0]:.2f} m east, {sigma[1]:.2f} m north"),
        ("score", None if row.score is None else f"{row.score:.3f}"),
        ("confidence", None if note is None or note.confidence is None else f"{note.confidence:.3f}"),
        ("method", f"{row.method or '-'}" + (f", {note.stage}" if note is not None and note.stage else "")),
        ("navigator", None if note is None else note.state),
        ("latency", None if row.latency_ms is None else f"{row.latency_ms:.1f} ms"),
    ]
    return [(name, value) for name, value in facts if value is not None]


def _inputs(settings: Mapping[str, Any]) -> str:
    """Inputs and settings, changes from the defaults, and versions."""

    def table(pairs: Sequence[tuple[str, str]]) -> str:
        body = "".join(f'<tr><td>{escape(k)}</td><td class="break">{escape(v)}</td></tr>' for k, v in pairs)
        return f"<table><tbody>{body}</tbody></table>"

    inputs = [(name, "-" if settings.get(key) is None else str(settings[key])) for key, name in _FACTS.items()]
    if settings.get("heights"):
        inputs.append(
            ("heights from", ", ".join(f"{source} ({count})" for source, count in settings["heights"].items()))
        )
    changes = [(name, str(value)) for name, value in (settings.get("changed") or {}).items()]
    changed = table(changes) if changes else "<p>Nothing.</p>"
    versions = [
        ("scenematch", metadata.version("scenematch-engine")),
        ("torch", metadata.version("torch")),
        ("OpenCV", cv2.__version__),
        ("numpy", np.__version__),
        ("Python", platform.python_version()),
    ]
    return (
        f"<div><h3>Inputs and settings</h3>{table(inputs)}</div>"
        f"<div><h3>Changed from the defaults</h3>{changed}<h3>Versions</h3>{table(versions)}</div>"
    )
