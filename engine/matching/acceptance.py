"""Acceptance: decides whether to accept a match by either method, or why to refuse it.

The evidence for the match and the allowed risk decide, see :mod:`engine.matching.evidence`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engine.geo import chi_square
from engine.matching.evidence import PeakEvidence, PoseEvidence, needed_nats, probability
from engine.values import Fix, Peak, Reason

Array = NDArray[np.float64]

CONSISTENT_CHI_SQUARE = 13.8
"""Chi-square of the difference of two positions that chance exceeds once in a thousand, two degrees of freedom."""
_HEIGHT_CHI_SQUARE = 16.0  # of the difference of two heights, one degree of freedom


Refusal = tuple[Reason, str]
"""Why a match is not accepted, and the figures behind it."""


def judge_peak(peak: Peak, evidence: PeakEvidence, risk: float, *, is_tested: bool = True) -> Refusal | None:
    """The reason to refuse a correlation peak, or None if it is accepted.

    Args:
        peak: the peak.
        evidence: for it.
        risk: allowed probability of a wrong fix.
        is_tested: whether the evidence was tested by the null hypothesis.
    """
    if not peak.curvature.any():
        return Reason.AMBIGUOUS, f"NCC {peak.score:.3f} still rises at the window's edge"
    if is_tested and evidence.nats >= needed_nats(risk):
        return None
    if replace(evidence, rival_sigmas=0.0, prior_chi_square=None).nats < needed_nats(risk):
        return Reason.LOW_SCORE, f"best NCC {peak.score:.3f}, {evidence.sigmas:.1f} sigmas, may be chance"
    figures = f"NCC {evidence.sigmas:.1f} sigmas, rival at {evidence.rival_sigmas:.1f}, {_known(evidence)}"
    if not is_tested:
        return Reason.UNCONFIRMED, f"found by a search, not confirmed by the structure about the place ({figures})"
    return Reason.AMBIGUOUS, f"{_wrong(evidence.nats, risk)} ({figures})"


def judge_pose(evidence: PoseEvidence, risk: float) -> Refusal | None:
    """The reason to refuse a pose by matched features, or None if it is accepted.

    Args:
        evidence: of the pose.
        risk: probability of a wrong fix that is allowed.
    """
    if evidence.nats >= needed_nats(risk):
        return None
    alarms, wrong = f"log10 of false alarms {evidence.log10_nfa:.1f}", _wrong(evidence.nats, risk)
    if replace(evidence, null_log10_nfa=0.0).nats >= needed_nats(risk):
        figures = f"{alarms} against {evidence.null_log10_nfa:.1f}"
        return Reason.AMBIGUOUS, f"the mirrored frame fits the map as well ({figures}): {wrong}"
    return Reason.BAD_POSE, f"{wrong} ({alarms}, rival at {evidence.rival_share:.0%}, {_known(evidence)})"


def _wrong(nats: float, risk: float) -> str:
    return f"wrong with probability {1.0 - probability(nats):.1g}, at most {risk:g} is allowed"


def _known(evidence: PeakEvidence | PoseEvidence) -> str:
    off = evidence.prior_chi_square
    return f"chi-square {'unknown' if off is None else f'{off:.1f}'} from the prior"


def are_consistent(apart_m: Array, covariance_m2: Array) -> bool:
    """Whether two estimates of one position agree.

    Args:
        apart_m: (2,) from one to the other, in metres.
        covariance_m2: (2, 2) sum of their covariances.

    Returns:
        bool: False if chance alone would set them this far apart less than once in a thousand.
    """
    return chi_square(apart_m, covariance_m2) <= CONSISTENT_CHI_SQUARE


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
    return (first.up_m - second.up_m) ** 2 <= _HEIGHT_CHI_SQUARE * variance_m2
