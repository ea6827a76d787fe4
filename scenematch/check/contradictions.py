"""Contradictions: count the pictures at which a telemetry field is off by more than three standard deviations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from engine.geo import Array, wrap_difference_deg
from scenematch.check.findings import Contradiction, TelemetrySeries
from scenematch.check.ground_motion import leg_differences
from scenematch.check.sightings import Sighting

SIGMA_DEG = np.array([1.2, 1.2, 1.5])
"""Standard deviations of roll, pitch and heading by features alone, against the telemetry's."""
_HEIGHT_SHARE, _HEIGHT_M = 0.02, 1.5  # of a height by features alone
_SIGMAS = 3.0
# None of gazebo-a1's 160 placed pictures contradicts right telemetry: fewer than 1.9 % do (95 % confidence).
# Three of sixteen is the smallest number that pictures so rare reach, in any of four fields, in less than 2 % of
# flights.
ALARM = 3
"""Number of pictures from which a contradiction is more than chance."""


def contradictions(series: TelemetrySeries, seen: Sequence[Sighting]) -> tuple[Contradiction, ...]:
    """How many pictures contradict each telemetry field; unknown fields are left out.

    Args:
        series: of the whole flight.
        seen: the poses of some of its pictures.
    """
    index = [s.index for s in seen]
    measured = np.array([attitude_deg(s) for s in seen]).reshape(-1, 3)
    off = wrap_difference_deg(measured - series.angles_deg[index]) / SIGMA_DEG
    heights = np.array([s.height_agl_m for s in seen])
    columns = {
        "roll": off[:, 0],
        "pitch": off[:, 1],
        "heading": off[:, 2],
        "height": (heights - series.height_m[index]) / height_sigma_m(heights),
        "velocity": leg_differences(series, seen),
    }
    return tuple(_counted(field, column) for field, column in columns.items() if np.isfinite(column).any())


def attitude_deg(seen: Sighting) -> tuple[float, float, float]:
    """Roll, pitch and heading that a picture shows, in degrees."""
    return seen.attitude.roll_deg, seen.attitude.pitch_deg, seen.attitude.heading_deg


def height_sigma_m(height_m: Array) -> Array:
    """Standard deviation of heights by features alone."""
    return np.hypot(_HEIGHT_SHARE * height_m, _HEIGHT_M)


def _counted(field: str, sigmas: Array) -> Contradiction:
    known = np.isfinite(sigmas)
    return Contradiction(field, int((np.abs(sigmas[known]) > _SIGMAS).sum()), int(known.sum()))
