"""From a correlation peak to the fix that it gives if accepted, and the evidence for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from engine.kernels.coarse_to_fine import EarlyStop
from engine.kernels.scores import enhance
from engine.matching.correlation import METHOD, Aligned, Correlator
from engine.matching.covariance import (
    misalignment_covariance_px2,
    ncc_covariance_m2,
    peak_covariance_px,
    score_sigma,
)
from engine.matching.evidence import (
    Evidence,
    independent_places,
    is_beyond_doubt,
    is_hopeless,
    probability,
    surprise_of,
)
from engine.values import Fix, Peak, Window


@dataclass(frozen=True, slots=True)
class PeakCandidate:
    """A peak that has not been accepted yet.

    Attributes:
        peak: in pixels of the aligned level.
        aligned: the hypothesis that it belongs to.
        fix: the fix that the peak gives if accepted, with its probability.
        evidence: for it.
        searched: whether heading and height were fitted to the picture.
        is_tested: whether the null hypothesis is among its rivals, or would change nothing. A score maximised by a
            fit is no evidence until the structure around the place confirms it.
    """

    peak: Peak
    aligned: Aligned
    fix: Fix
    evidence: Evidence
    searched: bool
    is_tested: bool


def early_stop(correlator: Correlator, aligned: Aligned, window: Window) -> EarlyStop:
    """Which peaks of a wide window to keep although not every place was scored.

    Returns:
        EarlyStop: a clear peak is accepted without the null hypothesis; for a hopeless one not even a closer look
        is expected to give a fix.
    """
    risk = correlator.query.risk

    def nats(peak: Peak) -> float:
        return candidate_of(correlator, aligned, peak, window).evidence.nats

    return EarlyStop(lambda peak: is_beyond_doubt(nats(peak), risk), lambda peak: is_hopeless(nats(peak), risk))


def candidate_of(
    correlator: Correlator,
    aligned: Aligned,
    peak: Peak,
    window: Window,
    *,
    searched: bool = False,
    tried: float = 0.0,
    sigma: float | None = None,
    is_tested: bool = False,
) -> PeakCandidate:
    """The candidate that a peak gives.

    Args:
        correlator: of the frame.
        aligned: the hypothesis.
        peak: in pixels of its level.
        window: in which its rival is the best.
        searched: whether heading and height were fitted to the picture.
        tried: places, times headings and heights, among which it is the best, if more than the window's.
        sigma: standard deviation of a chance score, if measured.
        is_tested: whether the null hypothesis is among its rivals, or would change nothing.
    """
    query, (rows, columns) = correlator.query, aligned.template.shape
    fix = fix_of(correlator, aligned, peak, window, searched=searched)
    sigma = score_sigma(rows * columns) if sigma is None else sigma
    measured = places_in(aligned, window)
    surprise, rival = surprise_of(peak.score, sigma), surprise_of(peak.second_score, sigma)
    evidence = Evidence(surprise, rival, measured, max(tried, measured), query.prior_chi_square(fix))
    fix = replace(fix, confidence=probability(evidence.nats))
    return PeakCandidate(peak, aligned, fix, evidence, searched, is_tested)


def places_in(aligned: Aligned, window: Window) -> float:
    """Number of places in a window at which a hypothesis fits."""
    (rows, columns), scale = aligned.template.shape, 2.0**aligned.level
    return independent_places(
        max(window.width_px / scale - columns, 1.0) * max(window.height_px / scale - rows, 1.0)
    )


def null_tested(correlator: Correlator, found: PeakCandidate) -> PeakCandidate:
    """The candidate; unless beyond doubt, compared with its frame upside down and mirrored."""
    query, peak, aligned, window = correlator.query, found.peak, found.aligned, found.fix.window
    if is_beyond_doubt(found.evidence.nats, query.risk):
        return replace(found, is_tested=True)
    matters = found.evidence.nats >= query.needed_nats
    null_score = _null_score(correlator, aligned, window, peak.second_score, matters=matters)
    peak = replace(peak, second_score=max(peak.second_score, null_score))
    rival = surprise_of(peak.second_score, score_sigma(aligned.template.size))
    evidence = replace(found.evidence, rival=rival)
    fix = replace(found.fix, confidence=probability(evidence.nats))
    return replace(found, peak=peak, fix=fix, evidence=evidence, is_tested=True)


def _null_score(
    correlator: Correlator, aligned: Aligned, window: Window, rival_score: float, *, matters: bool
) -> float:
    """The best score of the null-hypothesis templates: what chance reaches in this window.

    Args:
        correlator: of the frame.
        aligned: the hypothesis.
        window: that was searched.
        rival_score: score of the peak's best rival; certainly lower scores are ignored.
        matters: whether the peak is accepted without it; if not, the best score of an early stop suffices.
    """
    options, best = correlator.options, -1.0
    quick = EarlyStop(
        is_clear=lambda peak: max(peak.score, peak.second_score) <= rival_score,
        is_hopeless=lambda _: not matters,
    )
    for patch in correlator.nowhere(aligned):
        enhanced = enhance(patch, radius_px=options.enhance_radius_px, score=options.score)
        rival = correlator.search(replace(aligned, template=enhanced), window, quick)
        best = best if rival is None else max(best, rival.score)
    return best


def fix_of(correlator: Correlator, aligned: Aligned, peak: Peak, window: Window, *, searched: bool) -> Fix:
    """The camera's nadir and its covariance; also the heading if it was searched."""
    query, pose = correlator.query, aligned.pose
    errors = query.errors(correlator.options.errors)
    height_m = pose.height_agl_m
    assert height_m is not None  # checked before
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
