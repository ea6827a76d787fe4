"""What an autopilot may be sent: fixes that continue the track so far, or that somebody else vouches for.

An estimator that has long had no fix takes the next one for a new alignment, however far away it is. A navigator
gives in to matches that agree with each other for long enough. Together they would follow a map that is shifted.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from engine.navigation.motion import DriftModel, OdometrySample, PositionEstimate, en_m
from engine.options import NavigatorOptions
from engine.values import Fix, Frame, NoFix, Reason

TOLERANCE_M = 5.0
"""Contradictions that are smaller are left to the estimator's own gate."""
_IN_A_ROW = 3  # matches that contradict the track before it is in dispute, and that agree before it is not
_MEMORY_S = 3.0  # over which fixes are the track
_MAX_GAP_S = 1.0  # between frames over which a measured velocity is integrated


@dataclass(frozen=True, slots=True)
class _Place:
    """A position, and the odometry at its frame."""

    estimate: PositionEstimate
    sample: OdometrySample


class TrackGuard:
    """Follows what the autopilot was sent, and matches that contradict it.

    The track is the fixes of the last 3 s, carried on by the vehicle's velocity. A match contradicts it where it
    contradicts most of them, so that one wrong fix is no track. It is in dispute once three matches in a row lie
    further from it than both their uncertainties explain, and more than 5 m. While it is, no match is trusted that
    continues those matches, however vague the track becomes meanwhile: only three in a row that agree with a track
    still known to 50 m end the dispute, or :meth:`confirm`.

    Args:
        start: where the flight begins; None where that is not known.
        options: those of the navigator, whose drift and gates count here, too.
    """

    def __init__(self, start: PositionEstimate | None = None, options: NavigatorOptions | None = None) -> None:
        self._options = o = options or NavigatorOptions()
        self._drift = DriftModel(o.measured_velocity_sigma_mps, o.acceleration_mps2, o.max_speed_mps)
        self._now = OdometrySample(0.0, np.zeros(2), 0.0)
        self._newest_ns: int | None = None
        self._track: deque[_Place] = deque([] if start is None else [_Place(start, self._now)])
        self._rival: _Place | None = None  # the newest match that contradicted the track
        self._contradictions = self._agreements = 0
        self._distance_m = 0.0
        self.has_fix = False  # whether the autopilot was sent one

    @property
    def is_disputed(self) -> bool:
        """Whether matches contradict the track, so that nobody knows which of the two is right."""
        return self._contradictions >= _IN_A_ROW

    @property
    def distance_m(self) -> float:
        """How far the last match was from the track."""
        return self._distance_m

    def confirm(self) -> None:
        """Take the next fix for the track, wherever it is: an operator has vouched for it."""
        self._rival = None
        self._track.clear()
        self._contradictions = self._agreements = 0

    def anchor(self, position: PositionEstimate) -> None:
        """Take another source's position at the newest frame for the track, until a first fix is sent."""
        if not self.has_fix:
            self._track = deque([_Place(position, self._now)])

    def advance(self, frame: Frame, time_ns: int) -> None:
        """Carry the odometry on to the time of a frame, by the velocity that came with it."""
        elapsed_s = 0.0 if self._newest_ns is None else (time_ns - self._newest_ns) * 1e-9
        if elapsed_s < 0.0:
            return
        self._newest_ns = time_ns
        now, east, north = self._now, frame.east_velocity_mps, frame.north_velocity_mps
        if east is None or north is None or elapsed_s > _MAX_GAP_S:
            self._now = replace(now, time_s=now.time_s + elapsed_s, blind_s=now.blind_s + elapsed_s)
            return
        sigma_mps = frame.velocity_sigma_mps
        self._now = replace(
            now,
            time_s=now.time_s + elapsed_s,
            moved_m=now.moved_m + np.array([east, north]) * elapsed_s,
            stated_s=now.stated_s + (0.0 if sigma_mps is None else elapsed_s),
            lasting_m=now.lasting_m + (sigma_mps or 0.0) * elapsed_s,
        )

    def trusts(self, result: Fix | NoFix) -> bool:
        """Whether a fix may be sent; refused matches count for and against the track, too."""
        fix = _match(result)
        if fix is None:
            return False
        contradicts = 2 * sum(self._contradicts(place, fix) for place in self._track) > len(self._track)
        if self._track:
            self._distance_m = float(np.median([self._apart_m(place, fix) for place in self._track]))
        if self.is_disputed:
            self._settle(fix, contradicts=contradicts)
        else:
            self._contradictions = self._contradictions + 1 if contradicts else 0
        here = _Place(_position(fix), self._now)
        if contradicts or self.is_disputed:
            self._rival = here if contradicts or self._continues_rival(fix) else self._rival
            return False
        if isinstance(result, NoFix):
            return False
        self._track.append(here)
        while self._now.time_s - self._track[0].sample.time_s > _MEMORY_S and len(self._track) > 1:
            self._track.popleft()
        self._rival = None
        return True

    def _settle(self, fix: Fix, *, contradicts: bool) -> None:
        """End a dispute where matches return to a track that is still known, and leave its rival."""
        known = bool(self._track) and self._at(self._track[-1]).sigma_m <= self._options.trusted_sigma_m
        returned = known and not contradicts and not self._continues_rival(fix)
        self._agreements = self._agreements + 1 if returned else 0
        if self._agreements >= _IN_A_ROW:
            self._contradictions = self._agreements = 0

    def _continues_rival(self, fix: Fix) -> bool:
        return self._rival is not None and not self._contradicts(self._rival, fix)

    def _contradicts(self, place: _Place, fix: Fix) -> bool:
        """Whether a fix is further from a place than the uncertainties explain, and than is tolerated."""
        is_far = self._apart_m(place, fix) > TOLERANCE_M
        return is_far and self._at(place).chi_square(fix) > self._options.gate

    def _apart_m(self, place: _Place, fix: Fix) -> float:
        return float(np.hypot(*(en_m(fix) - self._at(place).en_m)))

    def _at(self, place: _Place) -> PositionEstimate:
        """The position of a place, carried on by odometry to the newest frame."""
        moved_m = self._now.moved_m - place.sample.moved_m
        drift_m = self._drift.sigma_m(place.sample, self._now)
        sigma_m = math.hypot(place.estimate.sigma_m, drift_m)
        return replace(place.estimate, en_m=place.estimate.en_m + moved_m, sigma_m=sigma_m)


def _match(result: Fix | NoFix) -> Fix | None:
    """The match of a frame, also of one that was refused for contradicting the navigator's own track."""
    if isinstance(result, Fix):
        return result
    return next(iter(result.candidates), None) if result.reason is Reason.INCONSISTENT else None


def _position(fix: Fix) -> PositionEstimate:
    return PositionEstimate(en_m(fix), fix.relative_sigma_m, on_map=True)
