"""Refusals: why a frame gives no fix, and the figures behind it."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2

from engine.matching.candidates import Candidate, PeakCandidate, PoseCandidate
from engine.matching.evidence import needed_nats, probability
from engine.matching.query import Query
from engine.values import Attitude, NoFix, Reason

Refusal = tuple[Reason, str]
"""Why a candidate is not accepted, and the figures behind it."""
MIN_DEVIATION = 3.0
"""Standard deviation in grey levels below which a frame has no texture."""


def of_candidate(candidate: Candidate, risk: float) -> Refusal:
    """Why a candidate does not suffice for this risk."""
    evidence = candidate.evidence
    if replace(candidate, evidence=replace(evidence, elsewhere=0.0)).suffices(risk):
        against = f"evidence for another place: {evidence.elsewhere:.1f} nats"
        return Reason.AMBIGUOUS, f"{_wrong(candidate, risk)} ({against})"
    if isinstance(candidate, PeakCandidate):
        return _of_peak(candidate, risk)
    assert isinstance(candidate, PoseCandidate)  # there are no others
    return _of_pose(candidate, risk)


def _of_peak(candidate: PeakCandidate, risk: float) -> Refusal:
    evidence, score = candidate.evidence, candidate.peak.score
    if not candidate.is_inside:
        return Reason.AMBIGUOUS, f"NCC {score:.3f} still rises at the window's edge"
    sigmas, rival = (math.sqrt(2.0 * surprise) for surprise in (evidence.surprise, evidence.chance))
    alone = replace(evidence, rival=0.0, null=0.0, elsewhere=0.0, prior_chi_square=None, refined=None)
    if alone.nats < needed_nats(risk):
        needed = math.sqrt(2.0 * (math.log(evidence.tried) + needed_nats(risk)))
        among = f"{needed:.1f} are needed among {evidence.tried:,.0f} places"
        return Reason.LOW_SCORE, f"best NCC {score:.3f}, {sigmas:.1f} sigmas may be chance: {among}"
    which = "turned or mirrored frame" if evidence.null > evidence.rival else "rival"
    pose = "" if evidence.refined is None else f", its pose at {max(evidence.of_pose, 0.0):.1f} nats"
    figures = f"NCC {sigmas:.1f} sigmas, {which} at {rival:.1f}, {_from_prior(candidate)}{pose}"
    if not evidence.promises(risk):
        return Reason.AMBIGUOUS, f"{_wrong(candidate, risk)} ({figures})"
    if candidate.by_search:
        doubt = "found by a search, not confirmed by the structure about the place"
        return Reason.UNCONFIRMED, f"{doubt} ({figures})"
    return Reason.LATE, f"no time was left to compare it with the mirrored frame ({figures})"


def _of_pose(candidate: PoseCandidate, risk: float) -> Refusal:
    evidence, ten = candidate.evidence, math.log(10.0)
    if evidence.promises(risk):
        return Reason.LATE, "no time was left to compare a pose by few features with the mirrored frame's"
    by_chance = f"by chance once in 10^{evidence.surprise / ten:.1f}"
    if replace(evidence, null=0.0).nats >= needed_nats(risk):
        figures = f"{by_chance} against 10^{evidence.null / ten:.1f}"
        return Reason.AMBIGUOUS, f"the mirrored frame fits the map as well ({figures}): {_wrong(candidate, risk)}"
    rival = f"rival once in 10^{evidence.rival / ten:.1f}"
    return Reason.BAD_POSE, f"{_wrong(candidate, risk)} ({by_chance}, {rival}, {_from_prior(candidate)})"


def _wrong(candidate: Candidate, risk: float) -> str:
    wrong = 1.0 - probability(candidate.evidence.nats)
    return f"wrong with probability {wrong:.1g}, at most {risk:g} is allowed"


def _from_prior(candidate: Candidate) -> str:
    off = candidate.evidence.prior_chi_square
    return f"chi-square {'unknown' if off is None else f'{off:.1f}'} from the prior"


# ---------------------------------------------------------------------------- before anything was matched


def if_flat(query: Query, method: str) -> NoFix | None:
    """A refusal if the picture has no texture to match, else None."""
    deviation = float(cv2.meanStdDev(query.gray)[1][0, 0])
    if deviation >= MIN_DEVIATION:
        return None
    figure = f"the frame's grey levels deviate by {deviation:.1f}"
    return query.refuse(Reason.NO_TEXTURE, f"{figure}; {MIN_DEVIATION:g} is required", method)


def tilted(query: Query, attitude: Attitude, method: str) -> NoFix:
    """The refusal of a frame that sees the horizon, or nearly so."""
    tilt = f"roll {attitude.roll_deg:.1f}, pitch {attitude.pitch_deg:.1f} degrees"
    return query.refuse(Reason.TILTED, f"a corner of the frame looks at the horizon ({tilt})", method)


def outside(query: Query, method: str) -> NoFix:
    """The refusal of a frame whose window does not overlap the map."""
    return query.refuse(Reason.OUTSIDE_MAP, "the window lies outside the map", method)


def late(query: Query, method: str) -> NoFix:
    """The refusal of a frame with no time for a method's quickest variant."""
    left_ms = query.scheduler.deadline.remaining_ms
    if left_ms < 0.0:
        return query.refuse(Reason.LATE, "the budget was spent before there was a fix", method)
    detail = f"{left_ms:.1f} ms are left; {method}'s quickest variant takes longer"
    return query.refuse(Reason.LATE, detail, method)
