"""Plot data of a track: times, errors, heights and refusals as arrays, computed once for all plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.geo import Array, LocalFrame
from engine.values import Truth
from scenematch.files.track import TrackRow
from scenematch.report.metrics import Ground, TrackErrors, errors_en_m, height_pairs_m


@dataclass(frozen=True, slots=True)
class TrackPlotData:
    """Arrays that all plots of a track share, one element per frame.

    Attributes:
        time: (N,) seconds since the first frame, or frame numbers if a timestamp is missing.
        time_label: label of the time axis.
        errors: positions of fixes and truth, and their differences, in metres.
        heights: (N, 2) measured and true height above the ground in metres; NaN where unknown.
        refused: (N,) whether the frame was refused.
        refused_en_m: (N, 2) position of refused frames: truth, else interpolated between fixes; NaN for fixes.
    """

    time: Array
    time_label: str
    errors: TrackErrors
    heights: Array
    refused: NDArray[np.bool_]
    refused_en_m: Array


def prepare_plot_data(
    rows: Sequence[TrackRow], truth: Sequence[Truth] | None, frame: LocalFrame, ground: Ground
) -> TrackPlotData:
    """Compute the plot data of a track.

    Args:
        rows: the track.
        truth: in the order of time, or None.
        frame: origin of east and north.
        ground: level of the ground.
    """
    stamps = [row.timestamp_ns for row in rows]
    known = [stamp for stamp in stamps if stamp is not None]
    if rows and len(known) == len(rows):
        time, label = np.array([(stamp - known[0]) / 1e9 for stamp in known]), "time (s)"
    else:
        time, label = np.arange(len(rows), dtype=np.float64), "frame"
    errors = errors_en_m(rows, truth, frame)
    refused = np.array([not row.fixed for row in rows], dtype=bool)
    return TrackPlotData(
        time=time,
        time_label=label,
        errors=errors,
        heights=height_pairs_m(rows, truth, ground),
        refused=refused,
        refused_en_m=_refused_positions(time, errors, refused),
    )


def _refused_positions(time: Array, errors: TrackErrors, refused: NDArray[np.bool_]) -> Array:
    fixed = np.isfinite(errors.fix_en_m[:, 0])
    positions = errors.truth_en_m.copy()
    if fixed.any():
        between = np.stack([np.interp(time, time[fixed], errors.fix_en_m[fixed, axis]) for axis in (0, 1)], axis=1)
        positions = np.where(np.isfinite(positions), positions, between)
    positions[~refused] = np.nan
    return positions


def larger_variance_m2(covariance: Array) -> Array:
    """Largest eigenvalue of symmetric matrices.

    Args:
        covariance: (N, 2, 2) in m^2; may contain NaN.

    Returns:
        (N,) in m^2.
    """
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.asarray((a + c) / 2.0 + np.hypot((a - c) / 2.0, b), dtype=np.float64)
