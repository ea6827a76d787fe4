"""Errors to assume of telemetry, map and ground if they do not state their own."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from engine.values import MAX_SIGMA_M, Frame, GridPose, check, check_positive

if TYPE_CHECKING:
    from engine.orthomap import OrthoMap


@dataclass(frozen=True, slots=True, kw_only=True)
class AssumedErrors:
    """Standard deviations of the telemetry, the map and the ground, used if they do not state their own.

    Attributes:
        height_m: of the height, besides its share below.
        height_share: of the height, as a share of it.
        heading_deg: of the heading.
        tilt_deg: of roll and of pitch, if the frame came with them.
        unknown_tilt_deg: of roll and of pitch, if it did not: nothing holds a camera level in flight.
        map_m: georeferencing accuracy per axis, if the map does not state it (:meth:`on_map`); the
            default is typical of web maps and public orthophotos.
        surface_slope_deg: slope accuracy of the surface model under one frame, if it does not state its own.
        unknown_slope_deg: slope of the ground if flat ground is assumed: the scale of a mixture of small and
            larger slopes (:mod:`engine.matching.unknown_slope`).

    Raises:
        OptionError: a value is out of range.
    """

    height_m: float = 0.5
    height_share: float = 0.01
    heading_deg: float = 1.0
    tilt_deg: float = 0.37
    unknown_tilt_deg: float = 4.0
    map_m: float = 3.0
    surface_slope_deg: float = 0.1
    unknown_slope_deg: float = 2.0

    def __post_init__(self) -> None:
        sigmas = [name for name in self.__dataclass_fields__ if name != "height_share"]
        check_positive(self, *sigmas)
        for name in sigmas:
            check(self, name, f"at most {MAX_SIGMA_M:g}", lambda sigma: sigma <= MAX_SIGMA_M)
        check(self, "height_share", "a number from 0 up", lambda share: 0.0 <= share < math.inf)

    def height_sigma_m(self, height_m: float) -> float:
        """Standard deviation of a height, in metres."""
        return math.hypot(self.height_m, self.height_share * height_m)

    def tilts_deg(self, pose: GridPose) -> tuple[float, float]:
        """Standard deviations of roll and of pitch, in degrees, by whether they are known."""
        unknown, known = self.unknown_tilt_deg, self.tilt_deg
        return (unknown if pose.roll_deg is None else known, unknown if pose.pitch_deg is None else known)

    def on_map(self, site: OrthoMap) -> AssumedErrors:
        """The errors, with the map's stated accuracy in place of the assumed one."""
        return replace(
            self,
            map_m=self.map_m if site.georeference_sigma_m is None else site.georeference_sigma_m,
            surface_slope_deg=self.surface_slope_deg if site.slope_sigma_deg is None else site.slope_sigma_deg,
        )

    def of_frame(self, frame: Frame) -> AssumedErrors:
        """The errors, with the frame's stated accuracies in place of assumed ones."""
        stated = {"heading_deg": frame.heading_sigma_deg, "tilt_deg": frame.tilt_sigma_deg}
        if frame.height_sigma_m is not None:
            stated |= {"height_m": frame.height_sigma_m, "height_share": 0.0}
        known = {name: value for name, value in stated.items() if value is not None}
        return replace(self, **known) if known else self
