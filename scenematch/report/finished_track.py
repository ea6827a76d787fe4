"""A finished track with all inputs of its report, and the arrays that its plots share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.geo import Array
from engine.orthomap import OrthoMap
from engine.values import Truth
from scenematch.files.telemetry import TelemetryRow
from scenematch.files.track import TrackRow
from scenematch.report.loop_record import LoopRecord
from scenematch.report.metrics import Ground, TrackErrors, errors_en_m, height_pairs_m


@dataclass(frozen=True, eq=False)
class FinishedTrack:
    """A finished track with all inputs of its report; the arrays have one element per row.

    Attributes:
        rows: the track, with its notes if the run left them.
        truth: in the order of time, or None.
        site: the map.
        ground: level of the ground.
        summary: contents of summary.json, its settings included.
        telemetry: of the flight, or None if no longer known.
        loop: plan and estimate of a closed loop, or None.
    """

    rows: Sequence[TrackRow]
    truth: Sequence[Truth] | None
    site: OrthoMap
    ground: Ground
    summary: Mapping[str, Any]
    telemetry: Sequence[TelemetryRow] | None = None
    loop: LoopRecord | None = None

    @property
    def settings(self) -> Mapping[str, Any]:
        """The settings of the run."""
        settings: Mapping[str, Any] = self.summary["settings"]
        return settings

    @property
    def name(self) -> str:
        """Of the flight, by its frames."""
        frames = Path(self.settings.get("frames") or self.settings["map"])
        return (frames.parent.name if frames.name == "frames" else frames.stem) or "flight"

    @property
    def method(self) -> str:
        """Method and profile, in words."""
        method = str(self.settings["method"])
        return f"{method.upper() if method != 'auto' else 'NCC and SIFT'}, {self.settings['profile']} profile"

    @cached_property
    def has_notes(self) -> bool:
        """Whether the run left notes on every frame."""
        return all(row.state is not None for row in self.rows)

    @cached_property
    def is_timed(self) -> bool:
        """Whether every row has a timestamp."""
        return bool(self.rows) and all(row.timestamp_ns is not None for row in self.rows)

    @property
    def time_label(self) -> str:
        """Label of the time axis."""
        return "time (s)" if self.is_timed else "frame"

    @cached_property
    def time(self) -> Array:
        """(N,) seconds since the first frame, or frame numbers if a timestamp is missing."""
        if not self.is_timed:
            return np.arange(len(self.rows), dtype=np.float64)
        stamps_ns = [row.timestamp_ns or 0 for row in self.rows]
        return np.array([(stamp_ns - stamps_ns[0]) / 1e9 for stamp_ns in stamps_ns])

    @property
    def time_limits(self) -> tuple[float, float]:
        """The first and the last time."""
        return float(self.time[0]), float(self.time[-1])

    @cached_property
    def errors(self) -> TrackErrors:
        """Positions of fixes and truth, and their differences, in metres."""
        return errors_en_m(self.rows, self.truth, self.site.frame)

    @cached_property
    def heights(self) -> Array:
        """(N, 2) measured and true height above the ground in metres; NaN where unknown."""
        return height_pairs_m(self.rows, self.truth, self.ground)

    @cached_property
    def fixed(self) -> NDArray[np.bool_]:
        """(N,) whether the frame has a fix."""
        return np.array([row.fixed for row in self.rows], np.bool_)

    @cached_property
    def refused_en_m(self) -> Array:
        """(N, 2) position of refused frames: truth, else interpolated between fixes; NaN for fixes."""
        fix_en_m, positions = self.errors.fix_en_m, self.errors.truth_en_m.copy()
        known = np.isfinite(fix_en_m[:, 0])
        if known.any():
            axes = [np.interp(self.time, self.time[known], axis) for axis in fix_en_m[known].T]
            positions = np.where(np.isfinite(positions), positions, np.stack(axes, axis=1))
        positions[self.fixed] = np.nan
        return positions
