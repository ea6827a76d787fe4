"""Faults injected into a closed loop: a killed engine, a shifted map, a frozen camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

from engine.budget import Budget
from engine.errors import OptionError
from engine.navigation.navigator import Matcher
from engine.values import Fix, Frame, NoFix, Prior

FAULT_KINDS = ("none", "killed", "shifted", "frozen")


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault and its times.

    Attributes:
        kind: "none"; "killed": the engine stops, and restarts at the end from the filter's estimate;
            "shifted": the map's georeference is off to the east; "frozen": the camera repeats its last picture.
        start_s: when it begins.
        duration_s: how long it lasts; ``math.inf`` to the end of the flight.
        shift_m: how far the map is shifted.
    """

    kind: str = "none"
    start_s: float = 60.0
    duration_s: float = 10.0
    shift_m: float = 40.0

    def acts(self, kind: str, time_s: float) -> bool:
        """Whether it is of this kind and active at this time."""
        return self.kind == kind and self.start_s <= time_s < self.start_s + self.duration_s


class ShiftedMap:
    """A matcher whose map can be shifted to the east while it works.

    If the map shows everything ``shift_m`` too far east, a search near a prior happens that far to its west on the
    correct map, and the fix is reported that far too far east.

    Args:
        matcher: on the correct map.

    Attributes:
        shift_m: current shift; 0 is the correct map.
    """

    def __init__(self, matcher: Matcher) -> None:
        self._matcher = matcher
        self.site, self.camera = matcher.site, getattr(matcher, "camera", None)
        self.shift_m = 0.0

    def locate(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """Same as the matcher's; a prior is in metres from the map's origin."""
        if prior is not None and self.shift_m:
            if prior.east_m is None:
                raise OptionError("prior: expected east_m and north_m over a shifted map")
            prior = replace(prior, east_m=prior.east_m - self.shift_m)
        result = self._matcher.locate(frame, prior, budget)
        if isinstance(result, NoFix) or not self.shift_m:
            return result
        east_m = result.east_m + self.shift_m
        lat, lon = self.site.frame.geodetic_from_enu(east_m, result.north_m)
        return replace(result, east_m=east_m, lat_deg=float(lat), lon_deg=float(lon))
