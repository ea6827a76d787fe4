"""What a correlation peak means: the fix that it makes if it is accepted, and how probable it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from engine.kernels.coarse_to_fine import QuickLook
from engine.kernels.scores import enhance
from engine.matching.acceptance import judge_peak
from engine.matching.confidence import PeakFeatures, PriorAgreement, peak_features, prior_agreement, probability
from engine.matching.correlation import METHOD, Aligned, Correlator
from engine.matching.covariance import (
    misalignment_covariance_px2,
    ncc_covariance_m2,
    peak_covariance_px,
    score_sigma,
)
from engine.matching.query import Query
from engine.values import Fix, Peak, Window

HOPELESS_ODDS = 0.01
"""Odds as a share of those that are asked for, below which what a quick look found is not looked at closely."""
_MAX_CANDIDATES = 4  # of a refused frame
_EXPECTED_CHI_SQUARE = 2.0  # of two degrees of freedom


@dataclass(frozen=True, slots=True)
class PeakCandidate:
    """A peak that is not accepted yet.

    Attributes:
        peak: in pixels of the aligned level.
        aligned: the hypothesis that it belongs to.
        fix: what the peak means, if it is accepted; with its confidence where there are features.
        features: of the confidence model; None where more was searched than a window at one heading and height.
        searched: heading or height were searched for.
    """

    peak: Peak
    aligned: Aligned
    fix: Fix
    features: PeakFeatures | None
    searched: bool


def quick_look(correlator: Correlator, aligned: Aligned, window: Window, min_confidence: float = 0.0) -> QuickLook:
    """Which peaks of a wide window are kept although not every place was scored.

    Args:
        correlator: of the frame.
        aligned: the hypothesis.
        window: that is searched.
        min_confidence: that is asked for, if more than the rule's.

    Returns:
        QuickLook: clear is a peak that is accepted without the null hypothesis; hopeless one whose odds are less
        than :data:`HOPELESS_ODDS` of those that are asked for.
    """
    query, rule = correlator.query, correlator.options.rule
    asked = max(rule.min_confidence, min_confidence)

    def features(peak: Peak) -> PeakFeatures:
        return features_of(query, aligned, peak, fix_of(correlator, aligned, peak, window, searched=False))

    def is_clear(peak: Peak) -> bool:
        known = features(peak)
        confidence = probability(known)
        refusal = judge_peak(peak, aligned.template.size, known, confidence, rule)
        return refusal is None and confidence >= max(asked, rule.null_test_below)

    return QuickLook(is_clear, lambda peak: is_hopeless(probability(features(peak)), asked))


def is_hopeless(confidence: float, asked: float) -> bool:
    """Whether a probability is so low that a closer look cannot be expected to bring what is asked for."""
    return confidence * (1.0 - asked) < HOPELESS_ODDS * asked * (1.0 - confidence)


def with_confidence(correlator: Correlator, found: PeakCandidate, min_confidence: float = 0.0) -> PeakCandidate:
    """The candidate with its probability; one that is not high must also beat the null hypothesis.

    Args:
        correlator: of the frame.
        found: at one heading and height.
        min_confidence: the null hypothesis only lowers a probability, and is not asked about one below this, which
            suffices for nothing.
    """
    query, peak, aligned, rule = correlator.query, found.peak, found.aligned, correlator.options.rule
    features = features_of(query, aligned, peak, found.fix)
    confidence = probability(features)
    if min_confidence <= confidence < rule.null_test_below:
        matters = confidence >= max(rule.min_confidence, min_confidence)
        null_score = _null_score(correlator, aligned, found.fix.window, peak.second_score, matters=matters)
        peak = replace(peak, second_score=max(peak.second_score, null_score))
        features = features_of(query, aligned, peak, found.fix)
        confidence = probability(features)
    return replace(found, peak=peak, features=features, fix=replace(found.fix, confidence=confidence))


def features_of(query: Query, aligned: Aligned, peak: Peak, fix: Fix) -> PeakFeatures:
    """What the confidence model is told of a peak."""
    return peak_features(peak, score_sigma(aligned.template.size), agreement_of(query, fix))


def agreement_of(query: Query, fix: Fix) -> PriorAgreement:
    """Of a fix with the prior; without one any place of the map is as good as another."""
    site = query.site
    if query.prior is None or query.prior_px is None:
        area_m2 = site.width_px * site.height_px * site.gsd_m_per_px**2
        return PriorAgreement(_EXPECTED_CHI_SQUARE, math.sqrt(area_m2 / 12.0))
    return prior_agreement(fix, site.enu_from_pixel(query.prior_px), query.prior.sigma_m)


def _null_score(
    correlator: Correlator, aligned: Aligned, window: Window, rival_score: float, *, matters: bool
) -> float:
    """The best score of the null-hypothesis templates: what this window gives to chance.

    Args:
        correlator: of the frame.
        aligned: the hypothesis.
        window: that was searched.
        rival_score: of the peak's best rival: what is certainly below it does not count.
        matters: whether the peak is accepted without it; else the best of a quick look is good enough.
    """
    options, best = correlator.options, -1.0
    quick = QuickLook(
        is_clear=lambda peak: max(peak.score, peak.second_score) <= rival_score,
        is_hopeless=lambda _: not matters,
    )
    for patch in correlator.nowhere(aligned):
        enhanced = enhance(patch, radius_px=options.enhance_radius_px, score=options.score)
        rival = correlator.search(replace(aligned, template=enhanced), window, quick)
        best = best if rival is None else max(best, rival.score)
    return best


def fix_of(correlator: Correlator, aligned: Aligned, peak: Peak, window: Window, *, searched: bool) -> Fix:
    """The camera's nadir and its covariance; the heading too where it was searched for."""
    query, pose = correlator.query, aligned.pose
    errors = query.errors(correlator.options.errors)
    height_m = pose.height_agl_m
    assert height_m is not None  # asked for before
    rows, columns = aligned.template.shape
    peak_px2 = peak_covariance_px(peak, rows * columns)
    peak_px2 = peak_px2 + misalignment_covariance_px2(peak, (rows, columns), height_m, errors)
    covariance = ncc_covariance_m2(peak_px2, pose, query.camera, aligned.jacobian, errors)
    return query.fix(
        METHOD,
        correlator.nadir_px(peak, aligned),
        covariance,
        score=peak.score,
        window=window,
        grid_attitude=pose.grid_attitude if searched else None,
        map_sigma_m=errors.map_m,
    )


def candidates_of(correlator: Correlator, found: PeakCandidate) -> tuple[Fix, ...]:
    """The peaks of a refused frame, each with its probability beside the others; none where no model holds.

    Rivals belong to it: over repeated structure they follow the vehicle as faithfully as the right place does.
    """
    query, aligned, window = correlator.query, found.aligned, found.fix.window
    if found.features is None or query.prior is None or query.scheduler.deadline.remaining_ms < 0:
        return ()
    exclusion_px = correlator.options.rule.exclusion_m / (query.site.gsd_m_per_px * 2.0**aligned.level)
    apart_px = max(2, round(exclusion_px))
    with query.scheduler.stage("candidates"):
        best = correlator.best_places(aligned, window, apart_px, _MAX_CANDIDATES)
    if best is None:
        return (found.fix,)
    (places, corner_px), fixes = best, [found.fix]
    for x, y, score in places:
        place = corner_px + np.array([x, y])
        if max(abs(place - [found.peak.x, found.peak.y])) <= apart_px:
            continue
        peak = replace(found.peak, x=place[0], y=place[1], score=score, second_score=found.peak.score)
        fix = fix_of(correlator, aligned, peak, window, searched=False)
        fixes.append(replace(fix, confidence=probability(features_of(query, aligned, peak, fix))))
    return tuple(fixes[:_MAX_CANDIDATES])
