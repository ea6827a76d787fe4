"""What goes wrong in a closed loop by choice: an engine that is killed, a map that is shifted, a frozen camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from engine.budget import Budget
from engine.errors import OptionError
from engine.navigator import Matcher
from engine.values import Fix, Frame, NoFix, Prior

KINDS = ("none", "killed", "shifted", "frozen")


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault and when.

    Attributes:
        kind: "none"; "killed": the engine is gone, and begins anew at the end, where the filter believes itself;
            "shifted": the map lies to the east of where it says; "frozen": the camera repeats its last picture.
        start_s: when it begins.
        duration_s: how long it lasts; ``math.inf`` to the end of the flight.
        shift_m: how far the map is shifted.

    Raises:
        OptionError: the kind is unknown, or a number is out of range.
    """

    kind: str = "none"
    start_s: float = 60.0
    duration_s: float = 10.0
    shift_m: float = 40.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise OptionError(f"fault: expected one of {', '.join(KINDS)}, got {self.kind!r}")
        if not (math.isfinite(self.start_s) and self.start_s >= 0.0):
            raise OptionError(f"start_s: expected 0 or more, got {self.start_s}")
        if not self.duration_s > 0.0:
            raise OptionError(f"duration_s: expected above 0, got {self.duration_s}")
        if not math.isfinite(self.shift_m):
            raise OptionError(f"shift_m: expected a finite number, got {self.shift_m}")

    def acts(self, kind: str, time_s: float) -> bool:
        """Whether it is of this kind and acts at this time."""
        return self.kind == kind and self.start_s <= time_s < self.start_s + self.duration_s


class ShiftedMap:
    """A matcher whose map can be shifted to the east while it works.

    A map that shows everything ``shift_m`` too far east finds what it is asked for near a place by looking that
    far west of it on the right map, and says where it found it that far too far east.

    Args:
        matcher: on the right map.

    Attributes:
        shift_m: as it stands; 0 is the right map.
    """

    def __init__(self, matcher: Matcher) -> None:
        self._matcher = matcher
        self.site = matcher.site
        self.shift_m = 0.0

    def locate(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """As the matcher; a prior is one in metres about the map's origin."""
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
