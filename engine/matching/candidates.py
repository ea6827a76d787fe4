"""Candidates: what the looks at a frame propose, and whether their evidence suffices."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from engine.matching.agreement import agree_in_place
from engine.matching.evidence import Evidence, probability
from engine.values import Fix, GridPose, Peak

if TYPE_CHECKING:
    from engine.matching.correlation import Aligned


@dataclass(frozen=True, slots=True)
class Candidate:
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

    def against(self, others: Iterable[Candidate]) -> Self:
        """The candidate with the evidence for any other place against it."""
        rivals = (other for other in others if other.counts and not agree_in_place(other.fix, self.fix))
        elsewhere = max([self.evidence.elsewhere, *map(nats, rivals)])
        return self.weighed(replace(self.evidence, elsewhere=elsewhere))

    def weighed(self, evidence: Evidence) -> Self:
        """The candidate by other evidence."""
        return replace(self, evidence=evidence, fix=replace(self.fix, confidence=probability(evidence.nats)))

    def coarse(self) -> Self:
        """The candidate, its fix at reduced resolution."""
        return replace(self, fix=replace(self.fix, stage="coarse"))


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
        """Whether it is a maximum, and no slope at the window's edge."""
        return bool(self.peak.curvature.any())

    @property
    def counts(self) -> bool:
        """Whether its evidence counts: not a slope's, nor a fitted score until structure confirms the place."""
        return self.is_inside and (self.by_structure or not self.is_fitted)


@dataclass(frozen=True, slots=True)
class PoseCandidate(Candidate):
    """The pose that matched features give.

    Attributes:
        is_quick: whether it is by few features, and neither refined nor confirmed.
        refinement_failed: whether refining its pose was tried and gave none.
        drawn_at: the height and heading at which the frame was drawn; None takes the telemetry's.
    """

    is_quick: bool = False
    refinement_failed: bool = False
    drawn_at: GridPose | None = None


def nats(candidate: Candidate) -> float:
    """The evidence for a candidate: the key by which the more evident one is chosen."""
    return candidate.evidence.nats
