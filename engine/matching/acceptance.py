"""Acceptance: why a peak or a pose without enough evidence is refused, and whether estimates agree.

The evidence for the match and the allowed risk decide (:meth:`engine.matching.evidence.Evidence.suffices`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engine.geo import chi_square, chi_square_of
from engine.matching.evidence import Evidence, needed_nats, probability
from engine.values import Fix, Reason

Array = NDArray[np.float64]

CHANCE = 1e-3
"""Two estimates contradict each other if chance sets them so far apart less often than this."""
Refusal = tuple[Reason, str]
"""Why a match is not accepted, and the figures behind it."""


def edge_refusal(score: float) -> Refusal:
    """Of a correlation peak at the edge of its window.

    Args:
        score: of the peak.
    """
    return Reason.AMBIGUOUS, f"NCC {score:.3f} still rises at the window's edge"


def peak_refusal(score: float, evidence: Evidence, risk: float) -> Refusal:
    """Why the evidence for a correlation peak does not suffice.

    Args:
        score: of the peak.
        evidence: for it.
        risk: allowed probability of a wrong fix.
    """
    sigmas, rival = (math.sqrt(2.0 * surprise) for surprise in (evidence.surprise, evidence.chance))
    if replace(evidence, rival=0.0, null=0.0, prior_chi_square=None).nats < needed_nats(risk):
        return Reason.LOW_SCORE, f"best NCC {score:.3f}, {sigmas:.1f} sigmas, may be chance"
    figures = f"NCC {sigmas:.1f} sigmas, rival at {rival:.1f}, {_known(evidence)}"
    if not evidence.is_tested:
        return Reason.UNCONFIRMED, f"found by a search, not confirmed by the structure about the place ({figures})"
    return Reason.AMBIGUOUS, f"{_wrong(evidence.nats, risk)} ({figures})"


def pose_refusal(evidence: Evidence, risk: float) -> Refusal:
    """Why the evidence for a pose by matched features does not suffice.

    Args:
        evidence: for it.
        risk: allowed probability of a wrong fix.
    """
    by_chance = f"by chance once in 10^{evidence.surprise / math.log(10):.1f}"
    wrong = _wrong(evidence.nats, risk)
    if replace(evidence, null=0.0).nats >= needed_nats(risk):
        figures = f"{by_chance} against 10^{evidence.null / math.log(10):.1f}"
        return Reason.AMBIGUOUS, f"the mirrored frame fits the map as well ({figures}): {wrong}"
    rival = f"rival once in 10^{evidence.rival / math.log(10):.1f}"
    return Reason.BAD_POSE, f"{wrong} ({by_chance}, {rival}, {_known(evidence)})"


def _wrong(nats: float, risk: float) -> str:
    return f"wrong with probability {1.0 - probability(nats):.1g}, at most {risk:g} is allowed"


def _known(evidence: Evidence) -> str:
    off = evidence.prior_chi_square
    return f"chi-square {'unknown' if off is None else f'{off:.1f}'} from the prior"


def are_consistent(apart_m: Array, covariance_m2: Array) -> bool:
    """Whether two estimates of one position agree.

    Args:
        apart_m: (2,) from one to the other, in metres.
        covariance_m2: (2, 2) sum of their covariances.

    Returns:
        bool: False if they contradict each other, see :data:`CHANCE`.
    """
    return chi_square(apart_m, covariance_m2) <= chi_square_of(CHANCE, 2)


def offset_between_m(first: Fix, second: Fix) -> Array:
    """How far one fix lies from another.

    Args:
        first: The fix at the offset's end.
        second: The fix at its start.

    Returns:
        (2,) metres east and north from the second fix to the first.
    """
    return np.array([first.east_m - second.east_m, first.north_m - second.north_m])


def agree_in_place(first: Fix, second: Fix) -> bool:
    """Whether two fixes on one map are of one place (:func:`are_consistent`); they share the map's error."""
    covariance_m2 = first.relative_covariance_m2 + second.relative_covariance_m2
    return are_consistent(offset_between_m(first, second), covariance_m2)


def agree_in_height(first: Fix, second: Fix) -> bool:
    """Whether two poses are equally high; the telemetry may hold refinement at a wrong height.

    Args:
        first: one pose; if it did not measure its height, it agrees with any.
        second: the other pose.
    """
    if first.up_m is None or second.up_m is None:
        return True
    variance_m2 = float(first.covariance_m2[2, 2] + second.covariance_m2[2, 2])
    variance_m2 -= first.map_sigma_m**2 + second.map_sigma_m**2  # they share this error
    return (first.up_m - second.up_m) ** 2 <= chi_square_of(CHANCE, 1) * variance_m2
