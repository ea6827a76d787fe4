"""Decides what may be sent to an autopilot: fixes that continue the track or that another source confirms.

An estimator that has long had no fix realigns to the next one, however far away it is. A navigator accepts matches
that agree with each other for long enough. Together they would follow a shifted map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from engine.assumed_errors import AssumedErrors
from engine.navigation.motion import Array, PositionEstimate, Step, Ways, en_m, place_of, velocity_of
from engine.navigation.tracks import MIN_FRAMES, Track
from engine.options import NavigatorOptions
from engine.values import Fix, Frame, NoFix, Reason

_DRIFT_MPS2 = 9.81 * math.radians(AssumedErrors().tilt_deg)  # gravity taken for an acceleration by a wrong tilt
TOLERANCE_M = 5.0
"""Smaller contradictions are left to the estimator's own gate."""


@dataclass(frozen=True, slots=True)
class _Course:
    """A track by matches and by the velocity that the vehicle states.

    Attributes:
        track: the track.
        stated_mps: (2,) velocity that the vehicle stated with the newest frame; None if it stated none.
        matches: number of matches in it.
        silent_s: time since the last of them.
    """

    track: Track
    stated_mps: Array | None
    matches: int
    silent_s: float

    @property
    def estimate(self) -> PositionEstimate:
        """Its position by all of its matches."""
        sigma_m = math.sqrt(self.track.covariance[1, 1])
        return replace(self.track.estimate, en_m=self.track.filtered_m, sigma_m=sigma_m)

    @property
    def off_mps(self) -> Array:
        """(2,) true velocity minus the stated one; 0 without one."""
        return np.zeros(2) if self.stated_mps is None else self.track.velocity_mps - self.stated_mps

    @property
    def found_mps(self) -> float:
        """Error of the stated velocity found along each axis, beyond its uncertainty."""
        return math.sqrt(max(0.5 * float(self.off_mps @ self.off_mps) - self.track.covariance[2, 2], 0.0))

    def carried(
        self, stated_mps: Array | None, sigma_mps: float, elapsed_s: float, options: NavigatorOptions
    ) -> _Course:
        """The course at a later frame: by the stated velocity, of which the error changes, else by inertia."""
        stated = None
        if stated_mps is not None:
            changed_m2 = options.acceleration_mps2**2 * elapsed_s**3 / 3.0  # of a velocity that walks at random
            stated = Step(stated_mps * elapsed_s, self.stated_mps, stated_mps, sigma_mps, changed_m2)
        track = self.track.carried(Ways(elapsed_s, stated), options)
        return replace(self, track=track, stated_mps=stated_mps, silent_s=self.silent_s + elapsed_s)

    def continued(self, fix: Fix) -> _Course:
        """The course with one more match, which replaces a position from another source than the map."""
        track, place = self.track, place_of(fix)
        if track.fix is None:
            begun, sigma_mps = Track.begun(place, 0.0, 0, fix), math.sqrt(track.covariance[2, 2])
            track = begun.with_velocity(track.velocity_mps, sigma_mps)
        else:
            track = track.matched(place, fix, 0.0)
        return replace(self, track=track, matches=self.matches + 1, silent_s=0.0)


@dataclass(frozen=True, slots=True)
class _Rival:
    """Matches that contradict the course.

    Attributes:
        course: of these matches.
        first: the first of them.
        parted: the course that the first match contradicted, at its frame.
        age_s: time since then.
    """

    course: _Course
    first: Fix
    parted: _Course
    age_s: float

    def followed(self, course: _Course) -> _Course:
        """The course that it contradicts, moved as its matches moved since: both are of one vehicle.

        Args:
            course: at the newest match, by the velocity that the vehicle states.
        """
        parted, seen = self.parted.track, self.course.track
        moved_m = seen.filtered_m - en_m(self.first)
        covariance = seen.covariance.copy()
        covariance[:2, :2] += parted.covariance[:2, :2] + self.first.relative_sigma_m**2
        led = replace(
            course.track,
            en_m=parted.en_m + moved_m,
            filtered_m=parted.filtered_m + moved_m,
            velocity_mps=seen.velocity_mps,
            covariance=covariance,
        )
        return replace(course, track=led)

    @property
    def meeting(self) -> PositionEstimate:
        """Where the first match is expected, given the velocity error that these matches show.

        That error walked at random while nothing was matched, and does so since. If it is larger than assumed, so
        were its walk and the position's error.
        """
        parted, covariance = self.parted, self.parted.track.covariance
        found_mps = self.course.off_mps - parted.off_mps
        age_s = self.age_s + parted.silent_s
        variance = covariance[2, 2] * age_s / max(parted.silent_s, 1e-3) + self.course.track.covariance[2, 2]
        gain_s = covariance[1, 2] / variance
        scale = max(1.0, 0.5 * float(found_mps @ found_mps) / variance)
        variance_m2 = scale * (covariance[1, 1] - gain_s * covariance[1, 2])
        place_m = parted.track.filtered_m + gain_s * found_mps
        return replace(parted.estimate, en_m=place_m, sigma_m=math.sqrt(variance_m2))


class TrackGuard:
    """Tracks the fixes sent to the autopilot and the matches that contradict them.

    The track consists of the fixes that were sent, propagated by the velocity that the vehicle states. It also
    estimates the error of that velocity, and assumes errors of the same size from then on. Without fixes an
    estimator's velocity drifts, by the share of gravity that its tilt error takes for an acceleration. A match
    contradicts the track if it is further away than their uncertainties explain, and more than 5 m. Three such
    matches in a row that continue each other form a rival and start a dispute. During a dispute the track moves as
    the rival does, whatever the vehicle states, and no match that continues the rival is trusted, however vague
    the track becomes. A dispute ends

    - with three matches in a row that agree with a track that is not lost;
    - with a rival whose own motion shows an error of the stated velocity that explains how far it is off: this
      happens after an outage, whereas a shifted map causes a jump;
    - with a rival that agrees with the earlier track, if there have been fewer than three fixes since;
    - with :meth:`confirm`.

    Args:
        start: where the flight begins; None if unknown.
        options: those of the navigator; its drift and gates also apply here.
    """

    def __init__(self, start: PositionEstimate | None = None, options: NavigatorOptions | None = None) -> None:
        self._options = options or NavigatorOptions()
        self._newest_ns: int | None = None
        self._stated_mps: Array | None = None  # the newest one
        self._track = None if start is None else self._begun(start)
        self._before = self._track  # as last vague, propagated without the fixes since
        self._rival: _Rival | None = None
        self._agreements = 0
        self.distance_m = 0.0  # from the track to the last match
        self.has_fix = False  # whether one was sent to the autopilot

    @property
    def is_disputed(self) -> bool:
        """Whether matches contradict the track, so that it is unknown which of the two is right."""
        return self._rival is not None and self._rival.course.matches >= MIN_FRAMES

    def confirm(self) -> None:
        """Continue the track at the next fix, wherever it is: an operator has confirmed it."""
        self._track = self._before = self._rival = None
        self._agreements = 0

    def anchor(self, position: PositionEstimate) -> None:
        """Start the track at another source's position at the newest frame, until a first fix is sent."""
        if not self.has_fix:
            self._track = self._before = self._begun(position)

    def advance(self, frame: Frame, time_ns: int) -> None:
        """Propagate track and rival to the time of a frame by the velocity that came with it."""
        elapsed_s = 0.0 if self._newest_ns is None else (time_ns - self._newest_ns) * 1e-9
        if elapsed_s < 0.0:
            return
        self._newest_ns, self._stated_mps, sent = time_ns, velocity_of(frame), self._track
        drifted_mps = 0.0 if sent is None else _DRIFT_MPS2 * sent.silent_s
        assumed_mps = math.hypot(self._options.measured_velocity_sigma_mps, drifted_mps)
        sigma_mps = frame.velocity_sigma_mps or assumed_mps
        known = self._stated_mps, sigma_mps, elapsed_s, self._options
        if sent is not None:
            found_mps = math.hypot(sigma_mps, sent.found_mps)
            self._track = sent.carried(self._stated_mps, found_mps, elapsed_s, self._options)
        if self._before is not None:
            self._before = self._before.carried(*known)
        if self._rival is not None:
            course, age_s = self._rival.course.carried(*known), self._rival.age_s + elapsed_s
            self._rival = replace(self._rival, course=course, age_s=age_s)

    def trusts(self, result: Fix | NoFix) -> bool:
        """Whether a fix may be sent; refused matches also count for and against the track."""
        fix = _match(result)
        if fix is None:
            return False
        track = self._track or self._begun(place_of(fix))
        self.distance_m = float(np.hypot(*(en_m(fix) - track.track.filtered_m)))
        contradicts = self._contradicts(track.estimate, fix)
        was_disputed = self.is_disputed
        continues = self._rival is not None and not self._contradicts(self._rival.course.estimate, fix)
        if contradicts or (was_disputed and continues):
            self._agreements = 0
            if self._rival is not None and continues:
                self._rival = replace(self._rival, course=self._rival.course.continued(fix))
            else:
                begun = self._begun(place_of(fix), fix, 0.5 * self._options.max_speed_mps)
                self._rival = _Rival(replace(begun, matches=1), fix, track, 0.0)
            if not self.is_disputed:
                return False
            if not self._is_right(self._rival, track, fix):
                self._track = self._rival.followed(track)
                return False
            track = self._rival.course
        elif was_disputed:
            self._agreements += track.estimate.sigma_m <= self._options.lost_sigma_m
            if self._agreements < MIN_FRAMES:
                return False
        self._rival, self._agreements = None, 0
        if isinstance(result, NoFix):
            return False
        if track.matches == 0 or track.estimate.sigma_m > TOLERANCE_M:
            self._before, track = self._track, replace(track, matches=0)
        self._track = track.continued(fix)
        return True

    def _begun(self, place: PositionEstimate, fix: Fix | None = None, sigma_mps: float = 0.0) -> _Course:
        """A course that begins at a place with the stated velocity."""
        stated_mps = np.zeros(2) if self._stated_mps is None else self._stated_mps
        track = Track.begun(place, 0.0, 0, fix).with_velocity(stated_mps, sigma_mps)
        return _Course(track, self._stated_mps, 0, 0.0)

    def _is_right(self, rival: _Rival, track: _Course, fix: Fix) -> bool:
        """Whether the evidence favours a rival: the track has a fix or two, or a wrong velocity misled it."""
        if track.matches < MIN_FRAMES:
            return self._before is None or not self._contradicts(self._before.estimate, fix)
        return not self._contradicts(rival.meeting, rival.first)

    def _contradicts(self, estimate: PositionEstimate, fix: Fix) -> bool:
        """Whether a fix is further from a position than the uncertainties and the tolerance allow."""
        is_far = float(np.hypot(*(en_m(fix) - estimate.en_m))) > TOLERANCE_M
        return is_far and estimate.chi_square(fix) > self._options.gate


def _match(result: Fix | NoFix) -> Fix | None:
    """The match of a frame, including one that only the navigator's own track speaks against."""
    if isinstance(result, Fix):
        return result
    match = result.match
    if match is None or result.reason is Reason.INCONSISTENT:
        return match
    suffices = result.reason is Reason.UNCONFIRMED and math.isfinite(match.protection_level_m())
    return match if suffices else None
