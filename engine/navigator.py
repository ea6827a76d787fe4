"""Navigator: frames in the order of capture, to fixes; it carries the window from one to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engine.budget import Budget
from engine.errors import OptionError, TelemetryError
from engine.orthomap import OrthoMap
from engine.types import Fix, Frame, NoFix, Prior, Reason, check_positive

Array = NDArray[np.float64]


class Matcher(Protocol):
    """What a navigator needs of a matcher; :class:`engine.matcher.SceneMatcher` is one."""

    site: OrthoMap

    def locate(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """Where the camera was when the frame was taken."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NavigatorOptions:
    """How a position is carried from frame to frame.

    Attributes:
        measured_velocity_sigma_mps: of a velocity that came with the frame.
        acceleration_mps2: how hard the vehicle may accelerate while its velocity is taken from its last fixes.
        max_speed_mps: assumed while nothing is known of the velocity.
        growth: factor on the uncertainty for every refusal in a row.
        default_interval_s: time between frames that carry no stamp.
        lost_after: refusals in a row after which the whole map is searched again.
    """

    measured_velocity_sigma_mps: float = 0.5
    acceleration_mps2: float = 3.0
    max_speed_mps: float = 15.0
    growth: float = 1.4
    default_interval_s: float = 0.2
    lost_after: int = 12

    def __post_init__(self) -> None:
        check_positive(self, *self.__dataclass_fields__)
        if self.growth < 1.0:
            raise OptionError(f"growth: expected 1 or more, got {self.growth}")


@dataclass(slots=True)
class _Track:
    """What is carried over: the last fix, the dead-reckoned way since then, and the refusals since then."""

    fix: Fix
    velocity_mps: Array | None
    moved_m: Array
    variance_m2: float
    refusals: int = 0


class Navigator:
    """Follows a flight: each frame is matched in the window where the last fixes say it must lie.

    Args:
        matcher: matches single frames.
        start: where the flight begins; None searches the whole map until a first fix.
        budget: of each frame; None does not hurry.
        options: settings; the defaults serve.
    """

    def __init__(
        self,
        matcher: Matcher,
        start: Prior | None = None,
        budget: Budget | None = None,
        options: NavigatorOptions | None = None,
    ) -> None:
        self._matcher = matcher
        self._start = start
        self._budget = budget
        self._options = options or NavigatorOptions()
        self._track: _Track | None = None
        self._last_ns: int | None = None
        self._start_refusals = 0

    @property
    def tracking(self) -> bool:
        """Whether there is a fix to carry on from."""
        return self._track is not None

    def update(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """The fix of the next frame.

        Args:
            frame: taken after every frame before it.
            prior: what somebody else knows of this frame's place; used where it is tighter than what the last
                fixes say.
            budget: of this frame, in place of the navigator's.

        Raises:
            TelemetryError: the frame is not newer than the last one.
        """
        interval_s = self._interval_s(frame)
        own = self._predict(frame, interval_s)
        if own is None or (prior is not None and prior.sigma_m < own.sigma_m):
            own = prior if prior is not None else own
        result = self._matcher.locate(self._with_height(frame), own, budget or self._budget)
        self._last_ns = frame.timestamp_ns if frame.timestamp_ns is not None else self._last_ns
        if isinstance(result, Fix):
            self._accept(result, frame)
        elif result.reason is Reason.LATE:
            pass  # no time to look says nothing of where the vehicle is
        elif self._track is not None:
            self._track.refusals += 1
            if self._track.refusals >= self._options.lost_after:
                self._track, self._start = None, None
        else:
            self._start_refusals += 1
            if self._start_refusals >= self._options.lost_after:
                self._start = None
        return result

    def _interval_s(self, frame: Frame) -> float:
        if frame.timestamp_ns is None or self._last_ns is None:
            return self._options.default_interval_s
        interval_s = (frame.timestamp_ns - self._last_ns) * 1e-9
        if interval_s <= 0:
            raise TelemetryError(
                f"timestamp_ns: expected later than {self._last_ns} (the frame before), got {frame.timestamp_ns}"
            )
        return interval_s

    def _predict(self, frame: Frame, interval_s: float) -> Prior | None:
        """Dead reckoning over one interval: where the frame must lie, and how uncertain that is."""
        options, track = self._options, self._track
        if track is None:
            if self._start is None:
                return None
            return replace(self._start, sigma_m=self._start.sigma_m * options.growth**self._start_refusals)
        if frame.east_velocity_mps is not None and frame.north_velocity_mps is not None:
            velocity = np.array([frame.east_velocity_mps, frame.north_velocity_mps])
            step_sigma = options.measured_velocity_sigma_mps * interval_s
        elif track.velocity_mps is not None:
            velocity = track.velocity_mps
            step_sigma = 0.5 * options.acceleration_mps2 * interval_s**2 + 1.0 * interval_s
        else:
            velocity = np.zeros(2)
            step_sigma = options.max_speed_mps * interval_s / 2.0
        step = velocity * interval_s
        track.moved_m = track.moved_m + step
        track.variance_m2 += step_sigma**2
        place = np.array([track.fix.east_m, track.fix.north_m]) + track.moved_m
        sigma = math.sqrt(track.variance_m2) * options.growth**track.refusals
        return Prior(
            east_m=float(place[0]),
            north_m=float(place[1]),
            sigma_m=sigma,
            moved_east_m=float(step[0]),
            moved_north_m=float(step[1]),
        )

    def _with_height(self, frame: Frame) -> Frame:
        """The frame with the last fix's height where it came without one."""
        if frame.height_agl_m is not None or self._track is None or self._track.fix.up_m is None:
            return frame
        height = self._track.fix.up_m - self._matcher.site.ground_m
        return replace(frame, height_agl_m=height) if height > 0 else frame

    def _accept(self, fix: Fix, frame: Frame) -> None:
        """Start the next dead reckoning at this fix."""
        velocity = None
        last = self._track
        if last is not None and fix.timestamp_ns is not None and last.fix.timestamp_ns is not None:
            moved = np.array([fix.east_m - last.fix.east_m, fix.north_m - last.fix.north_m])
            velocity = moved / ((fix.timestamp_ns - last.fix.timestamp_ns) * 1e-9)
        self._track = _Track(fix, velocity, np.zeros(2), fix.sigma_m**2)
        self._start_refusals = 0
