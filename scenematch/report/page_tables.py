"""Tables of the report: refusals, inputs and versions."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

import cv2
import numpy as np

from engine.values import Reason
from scenematch.report.explain import SliderFrame
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.verdict import MEANINGS

Pairs = list[tuple[str, str]]
"""Names and values."""
_FACTS = {
    "map": "map", "map_sigma_m": "map sigma (m)", "surface": "surface model", "camera": "camera",
    "frames": "frames", "every": "one frame in", "image_topic": "image topic", "telemetry": "telemetry",
    "odometry_topic": "velocity from", "frame_stamps": "frame stamps",
    "log_offset_s": "log offset (s)", "truth": "truth", "method": "method", "profile": "profile",
    "device": "device", "start": "start", "budget_ms": "budget (ms)",
}  # fmt: skip


def refusals(track: FinishedTrack, shown: Sequence[SliderFrame]) -> list[tuple[Any, ...]]:
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


def inputs(settings: Mapping[str, Any]) -> Pairs:
    """Inputs and settings of a run, in words."""
    pairs = [(name, "-" if settings.get(key) is None else str(settings[key])) for key, name in _FACTS.items()]
    if settings.get("heights"):
        counts = ", ".join(f"{source} ({count})" for source, count in settings["heights"].items())
        pairs.append(("heights from", counts))
    return pairs


def versions() -> Pairs:
    """Versions of what computed the page."""
    return [
        ("scenematch", metadata.version("scenematch-engine")),
        ("torch", metadata.version("torch")),
        ("OpenCV", cv2.__version__),
        ("numpy", np.__version__),
        ("Python", platform.python_version()),
    ]
