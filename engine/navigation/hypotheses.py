"""Hypotheses: places supported by matches of successive frames, moved by odometry while evidence adds up.

A match that is not accepted is not lost: the next frames speak for its place, or against it. What a match adds is
counted by the ground that is new (:mod:`engine.navigation.odds`): track before detect, in a bounded set.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from engine.matching.evidence import RELIABILITY
from engine.navigation.motion import DriftModel, OdometrySample, PositionEstimate, en_m
from engine.navigation.odds import (
    Sources,
    agreement_log_odds,
    log_odds,
    new_ground_share,
    repeated_log_odds,
)
from engine.values import MAX_SIGMA_M, Fix

MAX_HYPOTHESES = 16
_MIN_LOG_ODDS = -3.0  # a hypothesis with less is dropped
_SEARCHED_MISS, _MISS = math.log(0.1), math.log(0.5)  # evidence of a frame without a match of the place


@dataclass(frozen=True, slots=True)
class Match:
    """A match of the newest frame that has not been accepted yet.

    Attributes:
        fix: the match.
        log_odds: as of a first match, from itself and from the estimates that it agrees with or contradicts.
    """

    fix: Fix
    log_odds: float


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A place and the evidence for it.

    Attributes:
        fix: the newest match of it.
        sample: the odometry at that match.
        count: number of its matches.
        log_odds: from all of them.
    """

    fix: Fix
    sample: OdometrySample
    count: int
    log_odds: float


class Hypotheses:
    """The bounded set of a flight.

    Args:
        drift: of dead reckoning.
        gate: chi-square beyond which a match belongs to another place.
    """

    def __init__(self, drift: DriftModel, gate: float) -> None:
        self._drift, self._gate = drift, gate
        self._known: list[Hypothesis] = []

    @property
    def pending(self) -> Hypothesis | None:
        """The strongest hypothesis; the search centres on it."""
        return max(self._known, key=lambda each: each.log_odds, default=None)

    def clear(self) -> None:
        """Forget all of them."""
        self._known = []

    def position(self, hypothesis: Hypothesis, now: OdometrySample) -> PositionEstimate:
        """Dead reckoning from a hypothesis."""
        drift_m = self._drift.sigma_m(hypothesis.sample, now)
        sigma_m = min(math.hypot(hypothesis.fix.relative_sigma_m, drift_m), MAX_SIGMA_M)
        moved_m = now.moved_m - hypothesis.sample.moved_m
        return PositionEstimate(en_m(hypothesis.fix) + moved_m, sigma_m, log_odds(RELIABILITY), on_map=True)

    def add(
        self,
        match: Match | None,
        now: OdometrySample,
        sources: Sources,
        map_m2: float,
        height_m: float | None,
    ) -> Hypothesis | None:
        """Add the match of one frame to each hypothesis that it agrees with.

        Args:
            match: of the frame, if it has one.
            now: its odometry.
            sources: what else was known, and where the matcher searched.
            map_m2: area of the window if the whole map was searched.
            height_m: above the ground.

        Returns:
            Hypothesis | None: the strongest that the match supports.
        """
        grown: list[Hypothesis] = []
        pending, about_pending = self.pending, sources.searched is not None and sources.searched is sources.pending
        for known in self._known:
            searched = about_pending and known is pending
            before = self.position(known, now)
            if match is None or before.chi_square(match.fix) > self._gate:
                grown.append(replace(known, log_odds=known.log_odds + (_SEARCHED_MISS if searched else _MISS)))
                continue
            searched_m2 = None if searched else sources.searched_m2(map_m2)
            grown.append(_extended(known, match, now, before, searched_m2, height_m))
        if match is not None and all(each.sample is not now for each in grown):
            grown.append(Hypothesis(match.fix, now, 1, match.log_odds))
        grown.sort(key=lambda each: -each.log_odds)
        self._known = [each for each in grown if each.log_odds >= _MIN_LOG_ODDS][:MAX_HYPOTHESES]
        return next((each for each in self._known if each.sample is now), None)


def _extended(
    known: Hypothesis,
    match: Match,
    now: OdometrySample,
    before: PositionEstimate,
    searched_m2: float | None,
    height_m: float | None,
) -> Hypothesis:
    """A hypothesis with one more match.

    Args:
        known: the hypothesis.
        match: the match that agrees with it.
        now: its odometry.
        before: where the hypothesis predicted it.
        searched_m2: the searched area; None if the search was around this prediction.
        height_m: above the ground.
    """
    fix = match.fix
    share = new_ground_share(float(np.hypot(*(en_m(fix) - en_m(known.fix)))), height_m)
    agreement = 0.0 if searched_m2 is None else agreement_log_odds(before, fix, searched_m2)
    gain = repeated_log_odds(fix, agreement, share)
    return Hypothesis(fix, now, known.count + 1, known.log_odds + gain)
