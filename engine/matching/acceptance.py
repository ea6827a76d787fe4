"""Acceptance: when a match by either method is accepted, and why it is refused.

The rules are documented in ``docs/integrity.md``; their thresholds were fitted on simulated flights.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engine.geo import chi_square
from engine.matching.confidence import PeakFeatures
from engine.matching.covariance import score_sigma
from engine.matching.evidence import PoseEvidence, needed_nats, probability
from engine.options import PeakRule
from engine.values import Fix, Peak, Reason

Array = NDArray[np.float64]

CONSISTENT_CHI_SQUARE = 13.8
"""Chi-square of the difference of two positions that chance exceeds once in a thousand, two degrees of freedom."""
_HEIGHT_CHI_SQUARE = 16.0  # of the difference of two heights, one degree of freedom


Refusal = tuple[Reason, str]
"""Why a match is not accepted, and the figures behind it."""


def judge_peak(
    peak: Peak,
    pixels: int,
    features: PeakFeatures | None,
    confidence: float | None,
    rule: PeakRule,
    *,
    searched: bool = False,
) -> Refusal | None:
    """The reason to refuse a correlation peak, or None where it is accepted.

    Args:
        peak: the peak.
        pixels: of the template.
        features: of the confidence model; None where nothing was known of the position, or more was searched
            than a window at one heading and height.
        confidence: that the model gives them; None without them.
        rule: the thresholds.
        searched: the heading or the height was searched for.
    """
    sigma = score_sigma(pixels)
    min_score = sigma * (rule.min_sigmas_searched if searched else rule.min_sigmas)
    if peak.score < min_score:
        return Reason.LOW_SCORE, f"best NCC {peak.score:.3f} may be chance; {min_score:.3f} is asked for"
    if not peak.curvature.any():
        return Reason.AMBIGUOUS, f"NCC {peak.score:.3f} still rises at the window's edge"
    # A position that contradicts the prior is vouched for by the match alone, as in a search of the whole map.
    alone = features is None or features.agreement.prior_chi_square > rule.max_prior_chi_square
    margin = rule.min_margin_sigmas_whole_map if alone else rule.min_margin_sigmas
    margin = sigma * (rule.min_margin_sigmas_searched if searched else margin)
    if peak.score - peak.second_score < margin:
        rival = f"a rival reaches {peak.second_score:.3f}"
        return Reason.AMBIGUOUS, f"best NCC {peak.score:.3f}, {rival}; {margin:.3f} between them is asked for"
    if features is None or confidence is None or confidence >= rule.min_confidence:
        return None
    return _improbable_peak(features, confidence, rule)


def judge_second_look(peak: Peak, features: PeakFeatures, confidence: float, rule: PeakRule) -> Refusal | None:
    """The reason to refuse the peak of a second look, or None where it is accepted.

    Args:
        peak: the peak.
        features: of the confidence model, with the sigma of chance that was measured.
        confidence: that the model gives them.
        rule: the thresholds.
    """
    if not peak.curvature.any():
        return Reason.AMBIGUOUS, f"NCC {peak.score:.3f} still rises at the window's edge"
    if features.agreement.prior_chi_square > rule.max_prior_chi_square:
        figure = f"chi-square {features.agreement.prior_chi_square:.1f}"
        return Reason.AMBIGUOUS, f"the best place of a second look contradicts the prior ({figure})"
    return None if confidence >= rule.min_confidence else _improbable_peak(features, confidence, rule)


def _improbable_peak(features: PeakFeatures, confidence: float, rule: PeakRule) -> Refusal:
    figures = f"NCC {features.sigmas:.1f} sigmas, rival at {features.ratio:.0%}"
    figures += f", chi-square {features.agreement.prior_chi_square:.1f} from the prior"
    asked = f"{rule.min_confidence:g} is asked for ({figures})"
    return Reason.AMBIGUOUS, f"right with a probability of {confidence:.3f}, {asked}"


def judge_pose(evidence: PoseEvidence, risk: float) -> Refusal | None:
    """The reason to refuse a pose by matched features, or None where it is accepted.

    Args:
        evidence: of the pose.
        risk: probability of a wrong fix that is allowed.
    """
    if evidence.nats >= needed_nats(risk):
        return None
    off, alarms = evidence.prior_chi_square, f"log10 of false alarms {evidence.log10_nfa:.1f}"
    known = f"chi-square {'unknown' if off is None else f'{off:.1f}'} from the prior"
    wrong = f"wrong with a probability of {1.0 - probability(evidence.nats):.1g}, {risk:g} is allowed"
    if replace(evidence, null_log10_nfa=0.0).nats >= needed_nats(risk):
        figures = f"{alarms} against {evidence.null_log10_nfa:.1f}"
        return Reason.AMBIGUOUS, f"the mirrored frame fits the map as well ({figures}): {wrong}"
    return Reason.BAD_POSE, f"{wrong} ({alarms}, rival at {evidence.rival_share:.0%}, {known})"


def are_consistent(apart_m: Array, covariance_m2: Array) -> bool:
    """Whether two estimates of one position agree.

    Args:
        apart_m: (2,) from one to the other, in metres.
        covariance_m2: (2, 2) sum of their covariances.

    Returns:
        bool: False where chance alone would set them so far apart less than once in a thousand.
    """
    return chi_square(apart_m, covariance_m2) <= CONSISTENT_CHI_SQUARE


def offset_between_m(first: Fix, second: Fix) -> Array:
    """How far one fix lies from another.

    Args:
        first: The fix at which the offset ends.
        second: The fix at which it begins.

    Returns:
        (2,) metres east and north from the second fix to the first.
    """
    return np.array([first.east_m - second.east_m, first.north_m - second.north_m])


def agree_in_place(first: Fix, second: Fix) -> bool:
    """Whether two fixes by one map are of one place (:func:`are_consistent`); the map's error is that of both."""
    covariance_m2 = first.relative_covariance_m2 + second.relative_covariance_m2
    return are_consistent(offset_between_m(first, second), covariance_m2)


def agree_in_height(first: Fix, second: Fix) -> bool:
    """Whether two poses are equally high; refinement may stay at a wrong height that the telemetry holds it to.

    Args:
        first: one; where it did not measure its height, it agrees with any.
        second: the other.
    """
    if first.up_m is None or second.up_m is None:
        return True
    variance_m2 = float(first.covariance_m2[2, 2] + second.covariance_m2[2, 2])
    variance_m2 -= first.map_sigma_m**2 + second.map_sigma_m**2  # one error, of both
    return (first.up_m - second.up_m) ** 2 <= _HEIGHT_CHI_SQUARE * variance_m2
