"""Findings of a diagnosis, and the telemetry it compares with the pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from engine.geo import Array

MISFIT = 1.6
"""Mean chi-square of one component, beyond which something is wrong."""
GAIN = 0.6
"""By which a change must reduce it."""
OUTLIER = 9.0
"""Chi-square at which a difference is capped."""
MIN_SEEN = 3
"""Smallest number of pictures, or of displacements between them, that are compared."""


def capped_cost(off: Array) -> float:
    """Mean chi-square of differences in sigmas, each capped."""
    return float(np.minimum(off**2, OUTLIER).mean())


@dataclass(frozen=True, slots=True)
class Finding:
    """An error in the inputs, and the change that would fix it.

    Attributes:
        cause: one word: "radians", "degrees", "swapped", "sign", "heading", "heading_convention", "mount",
            "height", "height_feet", "focal", "clock", "velocity", "frozen", "mirrored", "map"; or
            "attitude" if none of the changes explains the disagreement.
        text: a sentence with the figures.
        cure: the option to try, or what to look at.
        value: size of the error in the unit of the text; None if it has none.
        sigma: standard deviation of the value.
    """

    cause: str
    text: str
    cure: str
    value: float | None = None
    sigma: float | None = None


@dataclass(frozen=True, slots=True)
class Contradiction:
    """How many located pictures contradict a telemetry field by more than three standard deviations.

    Attributes:
        field: "roll", "pitch", "heading", "height" or "velocity".
        pictures: number that contradict it; for the velocity, displacements between consecutive pictures.
        compared: number of pictures at which it was known.
    """

    field: str
    pictures: int
    compared: int


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The errors found in a flight's inputs.

    Attributes:
        findings: strongest first; empty if everything agrees.
        looked_at: number of pictures examined.
        seen: number of them that gave a pose without telemetry.
        compared: telemetry fields that were known and compared with them.
        contradicted: for each known field, how many pictures contradict it.
    """

    findings: list[Finding]
    looked_at: int
    seen: int
    compared: tuple[str, ...]
    contradicted: tuple[Contradiction, ...] = ()


@dataclass(frozen=True, slots=True)
class TelemetrySeries:
    """The telemetry at every picture of a flight; NaN if unknown.

    Attributes:
        time_s: (N,) of the pictures.
        angles_deg: (N, 3) roll, pitch and heading.
        height_m: (N,) above the ground.
        velocity_mps: (N, 2) east and north.
        reference_m: (N, 2) positions of another source, on the map's axes.
        reference_sigma_m: (N,) of them.
        mount: (3, 3) of the calibration.
        focal_px: of the calibration.
    """

    time_s: Array
    angles_deg: Array
    height_m: Array
    velocity_mps: Array
    reference_m: Array
    reference_sigma_m: Array
    mount: Array = field(repr=False)
    focal_px: float
