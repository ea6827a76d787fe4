"""Candidates: what the looks at a frame propose, and why one without enough evidence is refused."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from engine.matching.agreement import agree_in_place
from engine.matching.evidence import Evidence, needed_nats, probability
from engine.values import Fix, Peak, Reason

if TYPE_CHECKING:
    from engine.matching.correlation import Aligned

Refusal = tuple[Reason, str]
"""Why a candidate is not accepted, and the figures behind it."""


@dataclass(frozen=True, slots=True)
class Candidate(ABC):
    """A place that a look at a frame proposes.

    Attributes:
        fix: that it gives if accepted, with its probability.
        evidence: for it.
    """

    fix: Fix
    evidence: Evidence

    @property
    def counts(self) -> bool:
        """Whether its evidence counts at all."""
        return True

    def promises(self, risk: float) -> bool:
        """Whether it suffices unless the null hypothesis, if that is not tested yet, does as well."""
        return self.counts and self.evidence.promises(risk)

    def suffices(self, risk: float) -> bool:
        """Whether its fix may be handed out: it is wrong with at most this probability."""
        return self.counts and self.evidence.suffices(risk)

    def refusal(self, risk: float) -> Refusal:
        """Why it does not suffice for this risk."""
        if replace(self, evidence=replace(self.evidence, elsewhere=0.0)).suffices(risk):
            against = f"evidence for another place: {self.evidence.elsewhere:.1f} nats"
            return Reason.AMBIGUOUS, f"{self._wrong(risk)} ({against})"
        return self._refusal(risk)

    @abstractmethod
    def _refusal(self, risk: float) -> Refusal:
        """Why its own evidence does not suffice for this risk."""

    def against(self, others: Iterable[Candidate]) -> Self:
        """The candidate with the evidence for any other place against it."""
        rivals = [
            other.evidence.nats for other in others if other.counts and not agree_in_place(other.fix, self.fix)
        ]
        return self.weighed(replace(self.evidence, elsewhere=max([self.evidence.elsewhere, *rivals])))

    def weighed(self, evidence: Evidence) -> Self:
        """The candidate by other evidence."""
        return replace(self, evidence=evidence, fix=replace(self.fix, confidence=probability(evidence.nats)))

    def coarse(self) -> Self:
        """The candidate, its fix at reduced resolution."""
        return replace(self, fix=replace(self.fix, stage="coarse"))

    def _wrong(self, risk: float) -> str:
        wrong = 1.0 - probability(self.evidence.nats)
        return f"wrong with probability {wrong:.1g}, at most {risk:g} is allowed"

    @property
    def _from_prior(self) -> str:
        off = self.evidence.prior_chi_square
        return f"chi-square {'unknown' if off is None else f'{off:.1f}'} from the prior"


@dataclass(frozen=True, slots=True)
class PeakCandidate(Candidate):
    """The place of a correlation peak.

    Attributes:
        peak: in pixels of the aligned level.
        aligned: the hypothesis that it belongs to.
        by_search: whether it is the best of more than one window at one heading and height.
        is_fitted: whether heading and height were fitted to the picture, which maximises its score.
        by_structure: whether structure was matched as well as grey levels.
        by_refinement: whether refining its pose was tried.
    """

    peak: Peak
    aligned: Aligned
    by_search: bool = False
    is_fitted: bool = False
    by_structure: bool = False
    by_refinement: bool = False

    @property
    def is_inside(self) -> bool:
        """Whether it is a summit, and no slope at the window's edge."""
        return bool(self.peak.curvature.any())

    @property
    def counts(self) -> bool:
        """Whether its evidence counts: not a slope's, nor a fitted score until structure confirms the place."""
        return self.is_inside and (self.by_structure or not self.is_fitted)

    def _refusal(self, risk: float) -> Refusal:
        evidence, score = self.evidence, self.peak.score
        if not self.is_inside:
            return Reason.AMBIGUOUS, f"NCC {score:.3f} still rises at the window's edge"
        sigmas, rival = (math.sqrt(2.0 * surprise) for surprise in (evidence.surprise, evidence.chance))
        if replace(evidence, rival=0.0, null=0.0, elsewhere=0.0, prior_chi_square=None).nats < needed_nats(risk):
            needed = math.sqrt(2.0 * (math.log(evidence.tried) + needed_nats(risk)))
            among = f"{needed:.1f} are needed among {evidence.tried:,.0f} places"
            return Reason.LOW_SCORE, f"best NCC {score:.3f}, {sigmas:.1f} sigmas may be chance: {among}"
        which = "mirrored frame" if evidence.null > evidence.rival else "rival"
        figures = f"NCC {sigmas:.1f} sigmas, {which} at {rival:.1f}, {self._from_prior}"
        if not evidence.promises(risk):
            return Reason.AMBIGUOUS, f"{self._wrong(risk)} ({figures})"
        if self.by_search:
            doubt = "found by a search, not confirmed by the structure about the place"
            return Reason.UNCONFIRMED, f"{doubt} ({figures})"
        return Reason.LATE, f"no time was left to compare it with the mirrored frame ({figures})"


@dataclass(frozen=True, slots=True)
class PoseCandidate(Candidate):
    """The pose that matched features give.

    Attributes:
        is_quick: whether it is by few features, and neither refined nor confirmed.
        is_refinable: False if a refinement of the frame's pose has failed.
    """

    is_quick: bool = False
    is_refinable: bool = True

    def _refusal(self, risk: float) -> Refusal:
        evidence, ten = self.evidence, math.log(10.0)
        if evidence.promises(risk):
            return Reason.LATE, "no time was left to compare a pose by few features with the mirrored frame's"
        by_chance = f"by chance once in 10^{evidence.surprise / ten:.1f}"
        if replace(evidence, null=0.0).nats >= needed_nats(risk):
            figures = f"{by_chance} against 10^{evidence.null / ten:.1f}"
            return Reason.AMBIGUOUS, f"the mirrored frame fits the map as well ({figures}): {self._wrong(risk)}"
        rival = f"rival once in 10^{evidence.rival / ten:.1f}"
        return Reason.BAD_POSE, f"{self._wrong(risk)} ({by_chance}, {rival}, {self._from_prior})"
