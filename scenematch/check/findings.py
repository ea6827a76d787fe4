"""Findings of a diagnosis, and the telemetry that it compares with the pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that does not fit, and the change that would make it fit.

    Attributes:
        cause: one word: "radians", "degrees", "swapped", "sign", "heading", "heading_convention", "mount",
            "height", "height_feet", "focal", "clock", "velocity", "stamps", "frozen", "mirrored", "map"; or
            "attitude" where none of the changes explains what does not fit.
        text: a sentence with the figures.
        cure: the option to try, or what to look at.
        value: of the error in the unit of the text; None if it has none.
        sigma: standard deviation of the value.
    """

    cause: str
    text: str
    cure: str
    value: float | None = None
    sigma: float | None = None


@dataclass(frozen=True, slots=True)
class Contradiction:
    """How many placed pictures contradict one field of the telemetry, by more than three standard deviations.

    Attributes:
        field: "roll", "pitch", "heading", "height" or "velocity".
        pictures: that contradict it; of the velocity the ways from one picture to the next.
        compared: pictures at which it was known.
    """

    field: str
    pictures: int
    compared: int


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What was found of a flight's inputs.

    Attributes:
        findings: the strongest first; empty where everything fits.
        looked_at: pictures that were looked at.
        seen: of them, those whose pose the picture showed by itself.
        compared: what of the telemetry was known and held against them.
        contradicted: by how many pictures, for each field of the telemetry that was known.
    """

    findings: list[Finding]
    looked_at: int
    seen: int
    compared: tuple[str, ...]
    contradicted: tuple[Contradiction, ...] = ()


@dataclass(frozen=True, slots=True)
class TelemetrySeries:
    """What the telemetry says at every picture of a flight; NaN where it says nothing.

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
