"""What an autopilot may be sent: fixes that continue the track so far, or that somebody else vouches for.

An estimator that has long had no fix takes the next one for a new alignment, however far away it is. A navigator
gives in to matches that agree with each other for long enough. Together they would follow a map that is shifted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from engine.navigation.motion import Array, PositionEstimate, en_m
from engine.options import NavigatorOptions
from engine.values import Fix, Frame, NoFix, Reason

TOLERANCE_M = 5.0
"""Contradictions that are smaller are left to the estimator's own gate."""
_IN_A_ROW = 3  # matches that contradict the track before it is in dispute, and that agree before it is not
_MAX_GAP_S = 1.0  # between frames over which a stated velocity is integrated


@dataclass(frozen=True, slots=True)
class _Track:
    """A Kalman filter of matches: where they lead by the stated velocity, and by how much that is wrong.

    Attributes:
        en_m: (2,) position at the newest frame.
        off_mps: (2,) velocity less the stated one.
        covariance: (2, 2) of position and velocity error along each axis.
        last: the last match alone, carried on as the position is: a filter lags behind a velocity that changes.
        matches: that it is made of.
        silent_s: since the last of them.
    """

    en_m: Array
    off_mps: Array
    covariance: Array
    last: PositionEstimate
    matches: int = 0
    silent_s: float = 0.0

    @property
    def estimate(self) -> PositionEstimate:
        return replace(self.last, en_m=self.en_m, sigma_m=math.sqrt(self.covariance[0, 0]))

    @property
    def found_mps(self) -> float:
        """By how much the stated velocity was found wrong along each axis, beyond what matches know of it."""
        return math.sqrt(max(0.5 * float(self.off_mps @ self.off_mps) - self.covariance[1, 1], 0.0))

    def carried(self, stated_mps: Array, sigma_mps: float, elapsed_s: float) -> _Track:
        """The track at a later frame; a velocity's error is never known better than to ``sigma_mps``."""
        step, covariance = np.array([[1.0, elapsed_s], [0.0, 1.0]]), self.covariance.copy()
        covariance[1, 1] = max(covariance[1, 1], sigma_mps**2)
        moved_m = (stated_mps + self.off_mps) * elapsed_s
        return replace(
            self,
            en_m=self.en_m + moved_m,
            last=replace(self.last, en_m=self.last.en_m + moved_m),
            covariance=step @ covariance @ step.T,
            silent_s=self.silent_s + elapsed_s,
        )

    def continued(self, fix: Fix) -> _Track:
        """The track with one more match; a position that is not the map's gives way to it."""
        apart_m, variance_m2 = en_m(fix) - self.en_m, fix.relative_sigma_m**2
        gain, covariance = np.array([1.0, 0.0]), np.diag([variance_m2, self.covariance[1, 1]])
        if self.last.on_map:
            gain = self.covariance[0] / (self.covariance[0, 0] + variance_m2)
            covariance = self.covariance - np.outer(gain, self.covariance[0])
        return _Track(
            self.en_m + gain[0] * apart_m,
            self.off_mps + gain[1] * apart_m,
            covariance,
            _position(fix),
            self.matches + 1,
        )


@dataclass(frozen=True, slots=True)
class _Rival:
    """Matches that contradict the track.

    Attributes:
        track: of these matches.
        first: of them.
        parted: the track that it contradicted, at its frame.
    """

    track: _Track
    first: Fix
    parted: _Track

    @property
    def meeting(self) -> PositionEstimate:
        """Where the first match is expected if the velocity's error became that of these matches meanwhile."""
        parted, last = self.parted, self.parted.last
        changed_m = 0.5 * (self.track.off_mps - parted.off_mps) * parted.silent_s
        sigma_m = math.hypot(parted.estimate.sigma_m, last.sigma_m, *changed_m)
        return replace(last, en_m=last.en_m + changed_m, sigma_m=sigma_m)


class TrackGuard:
    """Follows what the autopilot was sent, and matches that contradict it.

    The track is the fixes that were sent, carried on by the velocity that the vehicle states. The error of that
    velocity is estimated with it: by as much as the fixes found it wrong, it may be wrong from then on. A match
    contradicts the track where it is further away than both their uncertainties explain, and more than 5 m. Three
    in a row that continue each other, its rival, put it in dispute. While it is, no match is trusted that
    continues the rival, however vague the track becomes meanwhile. It ends

    - by three matches in a row that agree with a track still known to 50 m;
    - by a rival whose own way proves the stated velocity wrong, if by its velocity it began where the track had
      ended: as after an outage, while a map that shifts jumps;
    - by a rival that agrees with what was known before, where the track since then is fewer than three fixes;
    - by :meth:`confirm`.

    Args:
        start: where the flight begins; None if that is not known.
        options: those of the navigator, whose drift and gates count here, too.
    """

    def __init__(self, start: PositionEstimate | None = None, options: NavigatorOptions | None = None) -> None:
        self._options = options or NavigatorOptions()
        self._newest_ns: int | None = None
        self._stated_mps = np.zeros(2)  # the newest one
        self._sigma_mps = self._unknown_mps
        self._track = None if start is None else _begun(start)
        self._before = self._track  # when its position was last vague, carried on without the fixes since
        self._rival: _Rival | None = None
        self._agreements = 0
        self._distance_m = 0.0
        self.has_fix = False  # whether the autopilot was sent one

    @property
    def is_disputed(self) -> bool:
        """Whether matches contradict the track, so that nobody knows which of the two is right."""
        return self._rival is not None and self._rival.track.matches >= _IN_A_ROW

    @property
    def distance_m(self) -> float:
        """How far the last match was from the track."""
        return self._distance_m

    def confirm(self) -> None:
        """Take the next fix for the track, wherever it is: an operator has vouched for it."""
        self._track = self._before = self._rival = None
        self._agreements = 0

    def anchor(self, position: PositionEstimate) -> None:
        """Take another source's position at the newest frame for the track, until a first fix is sent."""
        if not self.has_fix:
            self._track = self._before = _begun(position)

    def advance(self, frame: Frame, time_ns: int) -> None:
        """Carry track and rival on to the time of a frame, by the velocity that came with it."""
        elapsed_s = 0.0 if self._newest_ns is None else (time_ns - self._newest_ns) * 1e-9
        if elapsed_s < 0.0:
            return
        self._newest_ns = time_ns
        self._sigma_mps = self._unknown_mps
        if (
            frame.east_velocity_mps is not None
            and frame.north_velocity_mps is not None
            and elapsed_s <= _MAX_GAP_S
        ):
            self._stated_mps = np.array([frame.east_velocity_mps, frame.north_velocity_mps])
            self._sigma_mps = frame.velocity_sigma_mps or self._options.measured_velocity_sigma_mps
        if self._track is not None:
            sigma_mps = math.hypot(self._sigma_mps, self._track.found_mps)
            self._track = self._track.carried(self._stated_mps, sigma_mps, elapsed_s)
        if self._before is not None:
            self._before = self._before.carried(self._stated_mps, self._sigma_mps, elapsed_s)
        if self._rival is not None:
            track = self._rival.track.carried(self._stated_mps, self._sigma_mps, elapsed_s)
            self._rival = replace(self._rival, track=track)

    def trusts(self, result: Fix | NoFix) -> bool:
        """Whether a fix may be sent; refused matches count for and against the track, too."""
        fix = _match(result)
        if fix is None:
            return False
        track = self._track or _begun(_position(fix))
        self._distance_m = float(np.hypot(*(en_m(fix) - track.en_m)))
        contradicts = self._contradicts(track.estimate, fix)
        was_disputed = self.is_disputed
        continues = self._rival is not None and not self._contradicts(self._rival.track.estimate, fix)
        if contradicts or (was_disputed and continues):
            self._agreements = 0
            if self._rival is not None and continues:
                self._rival = replace(self._rival, track=self._rival.track.continued(fix))
            else:
                self._rival = _Rival(replace(_begun(_position(fix), self._unknown_mps), matches=1), fix, track)
            if not (self.is_disputed and self._is_right(self._rival, track, fix)):
                return False
            track = self._rival.track
        elif was_disputed:
            self._agreements += track.estimate.sigma_m <= self._options.trusted_sigma_m
            if self._agreements < _IN_A_ROW:
                return False
        self._rival, self._agreements = None, 0
        if isinstance(result, NoFix):
            return False
        if track.matches == 0 or track.estimate.sigma_m > TOLERANCE_M:
            self._before, track = self._track, replace(track, matches=0)
        self._track = track.continued(fix)
        return True

    @property
    def _unknown_mps(self) -> float:
        """Of each axis of a velocity of which nothing is known."""
        return 0.5 * self._options.max_speed_mps

    def _is_right(self, rival: _Rival, track: _Track, fix: Fix) -> bool:
        """Whether the evidence is for a rival: the track is a fix or two, or the stated velocity misled it."""
        if track.matches < _IN_A_ROW:
            return self._before is None or not self._contradicts(self._before.estimate, fix)
        off_mps = rival.track.off_mps
        variance = max(rival.track.covariance[1, 1], self._sigma_mps**2)
        is_velocity_wrong = float(off_mps @ off_mps) > self._options.gate * variance
        return is_velocity_wrong and not self._contradicts(rival.meeting, rival.first)

    def _contradicts(self, estimate: PositionEstimate, fix: Fix) -> bool:
        """Whether a fix is further from a position than the uncertainties explain, and than is tolerated."""
        is_far = float(np.hypot(*(en_m(fix) - estimate.en_m))) > TOLERANCE_M
        return is_far and estimate.chi_square(fix) > self._options.gate


def _begun(position: PositionEstimate, velocity_sigma_mps: float = 0.0) -> _Track:
    return _Track(position.en_m, np.zeros(2), np.diag([position.sigma_m**2, velocity_sigma_mps**2]), position)


def _match(result: Fix | NoFix) -> Fix | None:
    """The match of a frame, also of one that was refused for contradicting the navigator's own track."""
    if isinstance(result, Fix):
        return result
    return next(iter(result.candidates), None) if result.reason is Reason.INCONSISTENT else None


def _position(fix: Fix) -> PositionEstimate:
    return PositionEstimate(en_m(fix), fix.relative_sigma_m, on_map=True)
