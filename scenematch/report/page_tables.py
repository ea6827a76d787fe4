"""Tables of the report: refusals, inputs and versions."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from html import escape
from importlib import metadata
from typing import Any

import cv2
import numpy as np

from engine.values import Reason
from scenematch.report.explain import SliderFrame
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.verdict import MEANINGS

_FACTS = {
    "map": "map", "map_sigma_m": "map sigma (m)", "surface": "surface model", "camera": "camera",
    "frames": "frames", "every": "one frame in", "image_topic": "image topic", "telemetry": "telemetry",
    "odometry_topic": "velocity from", "frame_stamps": "frame stamps",
    "log_offset_s": "log offset (s)", "truth": "truth", "method": "method", "profile": "profile",
    "device": "device", "start": "start", "budget_ms": "budget (ms)",
}  # fmt: skip


def draw_refusals(track: FinishedTrack, shown: Sequence[SliderFrame]) -> str:
    """Table of reasons, most frequent first, each with the detail of one refusal."""
    if not track.summary["reasons"]:
        return "<p>No frame was refused.</p>" if track.rows else "<p>There are no frames.</p>"
    lines = []
    for name, count in track.summary["reasons"].items():
        indices = [i for i, row in enumerate(track.rows) if row.reason == name]
        known = set(indices)
        position = next((k for k, item in enumerate(shown) if item.index in known), None)
        index = indices[0] if position is None else shown[position].index
        detail = track.rows[index].detail or "-"
        button = (
            "" if position is None else f'<button class="goto" type="button" data-goto="{position}">show</button>'
        )
        cells = (name.replace("_", " "), MEANINGS[Reason(name)], f"{track.rows[index].frame}: {detail}")
        text = "".join(f"<td>{escape(cell)}</td>" for cell in cells[:2])
        text += f'<td class="break">{escape(cells[2])}</td><td>{button}</td>'
        lines.append(f'<tr><td class="count">{count}</td>{text}</tr>')
    head = "<th>frames</th><th>reason</th><th>meaning</th><th>for example</th><th></th>"
    return f'<table class="reasons"><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table>'


def draw_inputs(settings: Mapping[str, Any]) -> str:
    """Inputs and settings, changes from the defaults, and versions."""

    def listed(pairs: Sequence[tuple[str, str]]) -> str:
        body = "".join(f'<tr><td>{escape(k)}</td><td class="break">{escape(v)}</td></tr>' for k, v in pairs)
        return f"<table><tbody>{body}</tbody></table>"

    inputs = [(name, "-" if settings.get(key) is None else str(settings[key])) for key, name in _FACTS.items()]
    if settings.get("heights"):
        inputs.append(
            ("heights from", ", ".join(f"{source} ({count})" for source, count in settings["heights"].items()))
        )
    changes = [(name, str(value)) for name, value in (settings.get("changed") or {}).items()]
    changed = listed(changes) if changes else "<p>Nothing.</p>"
    versions = [
        ("scenematch", metadata.version("scenematch-engine")),
        ("torch", metadata.version("torch")),
        ("OpenCV", cv2.__version__),
        ("numpy", np.__version__),
        ("Python", platform.python_version()),
    ]
    return (
        f"<div><h3>Inputs and settings</h3>{listed(inputs)}</div>"
        f"<div><h3>Changed from the defaults</h3>{changed}<h3>Versions</h3>{listed(versions)}</div>"
    )
