"""A finished track with all inputs of its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.orthomap import OrthoMap
from engine.values import Truth
from scenematch.files.notes import FrameNote
from scenematch.files.telemetry import TelemetryRow
from scenematch.files.track import TrackRow
from scenematch.report.loop_record import LoopRecord
from scenematch.report.metrics import Ground
from scenematch.report.plot_data import TrackPlotData, prepare_plot_data


@dataclass(frozen=True, slots=True)
class FinishedTrack:
    """A finished track with all inputs of its report.

    Attributes:
        rows: the track.
        truth: in the order of time, or None.
        site: the map.
        ground: level of the ground.
        summary: contents of summary.json, its settings included.
        notes: one per row, or None if the run left none.
        telemetry: of the flight, or None if no longer known.
        loop: plan and estimate of a closed loop, or None.
    """

    rows: Sequence[TrackRow]
    truth: Sequence[Truth] | None
    site: OrthoMap
    ground: Ground
    summary: Mapping[str, Any]
    notes: Sequence[FrameNote] | None
    telemetry: Sequence[TelemetryRow] | None = None
    loop: LoopRecord | None = None

    def plot_data(self) -> TrackPlotData:
        """Plot data of the track."""
        return prepare_plot_data(self.rows, self.truth, self.site.frame, self.ground)

    @property
    def name(self) -> str:
        """Of the flight, by its frames."""
        settings = self.summary["settings"]
        frames = Path(settings.get("frames") or settings["map"])
        return (frames.parent.name if frames.name == "frames" else frames.stem) or "flight"

    @property
    def method(self) -> str:
        """Method and profile, in words."""
        settings = self.summary["settings"]
        method = str(settings["method"])
        return f"{method.upper() if method != 'auto' else 'NCC and SIFT'}, {settings['profile']} profile"
