"""Errors of the telemetry that last, as states of one Kalman filter that fixes measure: a calibration in flight.

Without a receiver's velocity an estimator lets roll and pitch drift by a degree or two and the heading by five,
and a mount is never quite level. A braking vehicle turns by tens of degrees a second, so an attitude that is 0.1 s
late is degrees off. A barometer's height, or a focal length, is off by a share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from engine.assumed_errors import AssumedErrors
from engine.camera import Camera
from engine.geo import Array, wrap_heading_deg
from engine.matching.covariance import scale_doubt_m
from engine.navigation.tracks import MIN_FRAMES
from engine.options import NavigatorOptions
from engine.values import Attitude, Fix, Frame
from engine.window import SPREAD_SIGMAS

# States: what to add to roll, pitch and heading (deg) and to the height (a share); how late the attitude is (s).
_ANGLES, _HEIGHT, _LAG = slice(0, 3), 3, 4
_NO_RATES_DPS: Array = np.zeros(3)  # if they are unknown
_FIRST_SHARE = 0.07  # error of the height before a picture measured it
_WALK = np.array([0.2, 0.2, 0.5, 1e-3, 0.01])  # standard deviations of the states' change in one second
_REFINED_DEG, _FEATURES_DEG = 0.6, 2.0  # standard deviations of a measured attitude, refined or by features alone
_MAX_INTERVAL_S = 0.5  # between frames; over longer ones the turn rates are unknown
_MAX_PITCH_DEG = 85.0  # beyond, roll and heading are hardly separate
_MIN_SIGMAS = 2.0  # of an angle's error before it is corrected: every frame's matching allows for less


@dataclass(frozen=True, slots=True)
class Bias:
    """The correction to add to a biased attitude, as far as it is known.

    Attributes:
        roll_deg, pitch_deg, heading_deg: to be added to the telemetry's.
        sigma_deg: standard deviations of the three.
    """

    roll_deg: float
    pitch_deg: float
    heading_deg: float
    sigma_deg: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Corrections to add to the telemetry, as far as fixes measured them; None if they did not.

    Attributes:
        attitude: of roll, pitch and heading. A mount error and a principal point error look the same.
        attitude_lag_s: how late the attitude is.
        attitude_lag_sigma_s: standard deviation of the lag of one frame.
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
        assumed: errors of telemetry that states none.
    """

    def __init__(self, options: NavigatorOptions, assumed: AssumedErrors | None = None) -> None:
        o, self._assumed = options, assumed or AssumedErrors()
        self._jitter_s = o.attitude_jitter_s
        self._first = np.array(
            [o.tilt_bias_deg, o.tilt_bias_deg, o.heading_bias_deg, _FIRST_SHARE, o.attitude_lag_s]
        )
        self._mean, self._covariance = np.zeros(5), np.diag(self._first**2)
        self._attitudes = self._heights = 0  # fixes that measured it
        self._time_s = 0.0
        self._stamp_ns: int | None = None
        self._angles_deg: Array | None = None  # of the newest frame, as they came
        self._turn: Array | None = None  # (4,) to it from the frame before: its angles in degrees, and seconds
        self._seen: tuple[Array, float] | None = None  # (3,) its fix's attitude less its own, and their sigma
        self._height_m: float | None = None
        self._settling = 0  # further fixes needed before a search's result is applied
        self._searched = False  # whether the newest frame is the first of a search

    @property
    def calibration(self) -> Calibration:
        """All that was learnt."""
        sigmas, share = np.sqrt(np.diag(self._covariance)).tolist(), float(self._mean[_HEIGHT])
        roll, pitch, heading = self._mean[_ANGLES].tolist()
        attitude = Bias(roll, pitch, heading, tuple(sigmas[_ANGLES])) if self._attitudes else None
        lag_s, lag_sigma_s = float(self._mean[_LAG]), math.hypot(sigmas[_LAG], self._jitter_s)
        height_m = self._height_m if self._heights else None
        if height_m is None:
            return Calibration(attitude, lag_s, lag_sigma_s, None, None, None)
        return Calibration(attitude, lag_s, lag_sigma_s, share * height_m, 1.0 + share, sigmas[_HEIGHT] * height_m)

    def corrected(self, frame: Frame, time_s: float, refusals: int = 0) -> Frame:
        """The frame with the attitude at its capture and the height that pictures measured.

        If frames are refused, heading and height may be off by more than a match tolerates. Then both are
        searched, half as often each time that fails, and after a fix until enough fixes have confirmed them.

        Args:
            frame: the newest.
            time_s: its time on any one clock.
            refusals: number of refusals in a row before it.
        """
        self._follow(frame, time_s)
        shown = self.without_errors(frame, _rates_dps(self._turn))
        if frame.heading_deg is None or self._height_m is None:
            return shown
        runs, rest = divmod(refusals, MIN_FRAMES)
        self._searched = rest == 0 and runs.bit_count() == 1  # after 3, 6, 12, 24 ...
        if self._searched:
            self._settling = MIN_FRAMES
        elif refusals:
            self._settling = 0
        return self._doubted(shown) if self._settling else shown

    def _doubted(self, frame: Frame) -> Frame:
        """The frame with heading and height as uncertain as before the flight, so that both are searched."""
        assert frame.height_agl_m is not None
        _, _, first_deg, first_share, _ = self._first.tolist()
        height_m = max(frame.height_sigma_m or 0.0, first_share * frame.height_agl_m)
        heading_deg = max(frame.heading_sigma_deg or 0.0, first_deg)
        return replace(frame, heading_sigma_deg=heading_deg, height_sigma_m=height_m)

    def without_errors(self, frame: Frame, rates_dps: Array = _NO_RATES_DPS) -> Frame:
        """A frame without the errors known so far; what is not known of them widens its standard deviations.

        Args:
            frame: the newest.
            rates_dps: (3,) of roll, pitch and heading; 0 if they are unknown.

        Returns:
            Frame: the same if nothing is known to be off.
        """
        return self._at_its_height(self._in_its_attitude(frame, rates_dps))

    def _in_its_attitude(self, frame: Frame, rates_dps: Array) -> Frame:
        """The frame with the attitude at its capture."""
        angles = _angles_of(frame)
        if angles is None:
            return frame
        assumed, variance = self._assumed.of_frame(frame), np.diag(self._covariance)
        off = rates_dps * self._mean[_LAG]
        wider_deg2 = rates_dps**2 * (variance[_LAG] + self._jitter_s**2)
        if self._attitudes >= MIN_FRAMES:
            sigma_deg = np.array([assumed.tilt_deg, assumed.tilt_deg, assumed.heading_deg])
            is_off = np.abs(self._mean[_ANGLES]) > _MIN_SIGMAS * sigma_deg
            off = off + self._mean[_ANGLES] * is_off
            wider_deg2 = wider_deg2 + variance[_ANGLES] * is_off
        wider_deg2 = np.minimum(wider_deg2, 180.0**2)  # timestamps in a wrong unit make rates of any size
        if not wider_deg2.any():
            return frame
        roll, pitch, heading = (angles + off).tolist()
        return replace(
            frame,
            roll_deg=roll,
            pitch_deg=max(-90.0, min(pitch, 90.0)),
            heading_deg=wrap_heading_deg(heading),
            tilt_sigma_deg=math.sqrt(assumed.tilt_deg**2 + float(wider_deg2[:2].max())),
            heading_sigma_deg=math.sqrt(assumed.heading_deg**2 + float(wider_deg2[2])),
        )

    def _at_its_height(self, frame: Frame) -> Frame:
        """The frame at the height that pictures measured, if it differs by more than a match tolerates."""
        share, height_m = float(self._mean[_HEIGHT]), frame.height_agl_m
        if height_m is None or self._heights < MIN_FRAMES or share <= -1.0:
            return frame
        assumed = self._assumed.height_sigma_m(height_m) / height_m
        least = SPREAD_SIGMAS * max(assumed, math.sqrt(self._covariance[_HEIGHT, _HEIGHT]))
        return frame if abs(share) <= least else replace(frame, height_agl_m=(1.0 + share) * height_m)

    def note(self, fix: Fix, height_m: float | None) -> None:
        """Learn from an accepted fix of the newest frame.

        Args:
            fix: an accepted fix.
            height_m: that it measured above the ground. None if it measured none, and so no attitude, or if the
                ground is assumed flat, where a slope looks like a tilt: nothing is learnt then.
        """
        self._settling = max(self._settling - 1, 0)
        if self._searched:  # earlier estimates were wrong
            self._searched = False
            self.forget()
        seen, known = fix.attitude, self._angles_deg
        if height_m is None:
            return
        if seen is not None and known is not None and abs(seen.pitch_deg) <= _MAX_PITCH_DEG:
            apart = np.array([seen.roll_deg, seen.pitch_deg, seen.heading_deg]) - known
            off = np.array([math.remainder(angle, 360.0) for angle in apart.tolist()])
            sigma_deg = _REFINED_DEG if fix.stage in ("refined", "verified") else _FEATURES_DEG
            self._seen = off, sigma_deg
        if self._height_m is not None:
            share = height_m / self._height_m - 1.0
            noise_m2 = float(fix.covariance_m2[2, 2]) + self._assumed.height_sigma_m(self._height_m) ** 2
            self._update(np.array([share]), np.eye(5)[[_HEIGHT]], np.array([noise_m2 / self._height_m**2]))
            self._heights += 1

    def _learn_attitude(self, after: Array | None) -> None:
        """Learn from the attitude that the newest frame's fix measured, now that the turn after it is known.

        The turn rates are those from the frame before to the frame after: the noise of the frame's own angles is
        in the rates up to it, where it looks like a lag.
        """
        if self._seen is None:
            return
        (off, sigma_deg), self._seen = self._seen, None
        rates_dps = _rates_dps(None if self._turn is None or after is None else self._turn + after)
        design = np.zeros((3, 5))
        design[:, _ANGLES], design[:, _LAG] = np.eye(3), rates_dps
        self._update(off, design, sigma_deg**2 + (rates_dps * self._jitter_s) ** 2)
        self._attitudes += 1

    def forget(self) -> None:
        """Forget what was learnt, but for the lag: it came from a wrong position, or no longer holds."""
        lag_s, lag_s2 = self._mean[_LAG], self._covariance[_LAG, _LAG]
        self._mean, self._covariance = np.zeros(5), np.diag(self._first**2)
        self._mean[_LAG], self._covariance[_LAG, _LAG] = lag_s, lag_s2
        self._attitudes, self._heights, self._seen = 0, 0, None

    def _follow(self, frame: Frame, time_s: float) -> None:
        """Take the newest frame: learn from the last one's fix, let the states walk, compute the turn."""
        turn = self._turn_to(frame)
        self._learn_attitude(turn)
        self._covariance = self._covariance + np.diag(_WALK**2 * (time_s - self._time_s))
        narrower = np.minimum(self._first / np.sqrt(np.diag(self._covariance)), 1.0)  # no vaguer than at first
        self._covariance *= narrower[:, None] * narrower
        self._time_s, self._stamp_ns, self._turn = time_s, frame.timestamp_ns, turn
        self._angles_deg, self._height_m = _angles_of(frame), frame.height_agl_m

    def _turn_to(self, frame: Frame) -> Array | None:
        """The turn from the newest frame to the next; None if it is unknown."""
        angles_deg, stamp_ns = _angles_of(frame), frame.timestamp_ns
        if self._stamp_ns is None or stamp_ns is None or self._angles_deg is None or angles_deg is None:
            return None
        interval_s = (stamp_ns - self._stamp_ns) * 1e-9
        if not 0.0 < interval_s <= _MAX_INTERVAL_S:
            return None
        steps = [math.remainder(float(step), 360.0) for step in angles_deg - self._angles_deg]
        return np.array([*steps, interval_s])

    def _update(self, measured: Array, design: Array, noise: Array) -> None:
        """A Kalman update."""
        total = design @ self._covariance @ design.T + np.diag(noise)
        most = SPREAD_SIGMAS * np.sqrt(np.diag(total))  # one fix may be wrong
        off = np.clip(measured - design @ self._mean, -most, most)
        gain = self._covariance @ design.T @ np.linalg.inv(total)
        self._mean = self._mean + gain @ off
        left = np.eye(5) - gain @ design
        self._covariance = left @ self._covariance @ left.T + (gain * noise) @ gain.T


def considered(fix: Fix, frame: Frame, shown: Frame, camera: Camera | None) -> Fix:
    """The fix, less certain if the height was corrected: the focal length may be what is wrong.

    Args:
        fix: of the frame.
        frame: as it came.
        shown: as it was matched.
        camera: None takes it to look down.
    """
    if frame.height_agl_m is None or shown.height_agl_m in (None, frame.height_agl_m):
        return fix
    assert shown.height_agl_m is not None
    stated = Attitude(shown.roll_deg or 0.0, shown.pitch_deg or 0.0, shown.heading_deg or 0.0)
    down, stated_down = (
        np.array([0.0, 0.0, -1.0]) if camera is None else camera.enu_from_camera(attitude)[:, 2]
        for attitude in (fix.attitude or stated, stated)
    )
    doubt_m = scale_doubt_m(shown.height_agl_m - frame.height_agl_m, shown.height_agl_m, down, stated_down)
    return replace(fix, covariance_m2=fix.covariance_m2 + np.diag([doubt_m**2, doubt_m**2, 0.0]))


def _angles_of(frame: Frame) -> Array | None:
    """Roll, pitch and heading, if all are known."""
    known = (frame.roll_deg, frame.pitch_deg, frame.heading_deg)
    return None if None in known else np.array(known, np.float64)


def _rates_dps(turn: Array | None) -> Array:
    """(3,) of roll, pitch and heading; 0 if the turn is unknown."""
    return _NO_RATES_DPS if turn is None else turn[:3] / turn[3]
