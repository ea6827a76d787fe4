"""Errors of the telemetry that fixes reveal in flight: of attitude and of height, as a calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from engine.navigation.attitude_bias import AttitudeBias, Bias
from engine.navigation.attitude_lag import AttitudeLag
from engine.options import NavigatorOptions
from engine.values import Fix, Frame

# Standard deviations of a measured height, by refinement or features, as a share of the telemetry's.
_HEIGHT_SHARE, _HEIGHT_M = 0.01, 1.0
_FIRST_SHARE = 0.2  # error of the height before a picture measured it, as a share
_MIN_SHARE, _MIN_SIGMAS, _MIN_FIXES = 0.03, 3.0, 3  # of a height error before it is corrected
_FIRST_SEARCH, _SEARCH_GROWTH = 3, 1.5  # refusals in a row before a search; growth until the next
_SEARCHED_HEADING_DEG = 12.0  # standard deviation of a searched heading
_WALK_SHARE = 1e-3  # change of the height's error in one second, as a share


@dataclass(frozen=True, slots=True)
class Calibration:
    """Corrections to add to the telemetry, as far as fixes measured them; None if they did not.

    Attributes:
        attitude: of roll, pitch and heading. A mount error and a principal point error look the same.
        attitude_lag_s: how late the attitude is.
        attitude_lag_sigma_s: standard deviation of the lag.
        height_m: to be added to the height above ground. If the focal length is too short by some share, heights
            are too low by that share: ``height_factor``.
        height_factor: ratio of the measured height to the telemetry's.
        height_sigma_m: standard deviation of ``height_m``.
    """

    attitude: Bias | None
    attitude_lag_s: float
    attitude_lag_sigma_s: float
    height_m: float | None
    height_factor: float | None
    height_sigma_m: float | None


class TelemetryErrors:
    """Learns errors of the vehicle's telemetry and corrects them.

    Args:
        options: of the navigator; they state how far off attitudes may be.
    """

    def __init__(self, options: NavigatorOptions) -> None:
        self._options = options
        self._lag = AttitudeLag(options.attitude_lag_s, options.attitude_jitter_s)
        self._bias = self._unknown_bias()
        self._height_m: float | None = None  # of the newest frame
        self._off_m = self._variance_m2 = 0.0
        self._time_s: float | None = None
        self._heights = 0
        self._next_search = _FIRST_SEARCH  # refusals in a row at which heading and height are searched
        self._settling = 0  # further fixes needed before a search's result is applied
        self._searched = False  # whether the newest frame is the first of a search

    @property
    def calibration(self) -> Calibration:
        """All that was learnt."""
        known = self._heights > 0 and self._height_m is not None
        return Calibration(
            self._bias.bias, self._lag.mean_s, self._lag.sigma_s,
            self._off_m if known else None,
            1.0 + self._off_m / self._height_m if known and self._height_m else None,
            math.sqrt(self._variance_m2) if known else None,
        )  # fmt: skip

    def corrected(self, frame: Frame, time_s: float, *, late: bool, refusals: int = 0) -> Frame:
        """The frame with the attitude at its capture and the height that pictures measured.

        If frames are refused, heading and height may be off by more than a match tolerates. Then both are
        searched, less often each time that fails, and after a fix until enough fixes have confirmed them.

        Args:
            frame: the newest, or a late one.
            time_s: time of the newest frame on any one clock.
            late: whether the frame is a late one.
            refusals: number of refusals in a row before it.
        """
        if late:
            return self._at_its_height(self._bias.corrected(frame))
        self._height_m = frame.height_agl_m
        if self._time_s is not None and self._height_m is not None:
            walk_m = _WALK_SHARE * self._height_m
            self._variance_m2 += walk_m**2 * max(time_s - self._time_s, 0.0)
        self._time_s = time_s
        shown = self._lag.corrected(frame)
        self._bias.follow(shown, time_s)
        shown = self._at_its_height(self._bias.corrected(shown))
        if frame.heading_deg is None or self._height_m is None:
            return shown
        self._searched = refusals >= self._next_search
        if self._searched:
            self._next_search, self._settling = math.ceil(_SEARCH_GROWTH * refusals), _MIN_FIXES
        elif refusals:
            self._settling = 0
        else:
            self._next_search = _FIRST_SEARCH
        return replace(shown, is_doubted=True) if self._settling else shown

    def without_errors(self, frame: Frame) -> Frame:
        """The newest frame with the known bias of attitude and height removed; call before :meth:`corrected`."""
        return self._at_its_height(self._bias.corrected(frame))

    def _at_its_height(self, frame: Frame) -> Frame:
        """The frame at the height that pictures measured, if it differs by more than a match tolerates."""
        if frame.height_agl_m is None or self._heights < _MIN_FIXES:
            return frame
        least_m = max(_MIN_SHARE * frame.height_agl_m, _MIN_SIGMAS * math.sqrt(self._variance_m2))
        height_m = frame.height_agl_m + self._off_m
        if abs(self._off_m) < least_m or height_m <= 0.0:
            return frame
        return replace(frame, height_agl_m=height_m, height_correction_m=self._off_m)

    def note(self, fix: Fix, ground_m: float | None) -> None:
        """Learn from an accepted fix of the newest frame.

        Args:
            fix: an accepted fix.
            ground_m: height of the ground below it; None if the ground is assumed flat, where a slope looks like a
                tilt.
        """
        self._settling = max(self._settling - 1, 0)
        if self._searched:  # earlier estimates were wrong
            self._searched, self._heights = False, 0
            self._bias.doubt(_SEARCHED_HEADING_DEG)
        self._lag.note(fix, self._bias.bias)
        if ground_m is None:
            return
        self._bias.note(fix)
        if fix.up_m is not None and self._height_m is not None:
            self._note_height(fix.up_m - ground_m - self._height_m, self._height_m)

    def forget(self) -> None:
        """Forget what was learnt: it came from a wrong position, or no longer holds."""
        self._bias = self._unknown_bias()
        self._heights, self._off_m, self._variance_m2 = 0, 0.0, 0.0

    def _unknown_bias(self) -> AttitudeBias:
        return AttitudeBias(self._options.tilt_bias_deg, self._options.heading_bias_deg)

    def _note_height(self, off_m: float, height_m: float) -> None:
        if not self._heights:
            self._variance_m2 = (_FIRST_SHARE * height_m) ** 2
        noise_m2 = _HEIGHT_M**2 + (_HEIGHT_SHARE * height_m) ** 2
        gain = self._variance_m2 / (self._variance_m2 + noise_m2)
        self._off_m += gain * (off_m - self._off_m)
        self._variance_m2 *= 1.0 - gain
        self._heights += 1
