"""From a correlation peak to the fix that it gives if accepted, and the evidence for it."""

from __future__ import annotations

from dataclasses import replace

from engine.kernels.coarse_to_fine import EarlyStop
from engine.kernels.scores import enhance
from engine.matching.candidates import PeakCandidate
from engine.matching.correlation import METHOD, Aligned, Correlator
from engine.matching.covariance import (
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
    off = query.prior_chi_square(fix)
    evidence = Evidence(surprise, rival, measured, max(tried, measured), off, is_tested=is_tested)
    fix = replace(fix, confidence=probability(evidence.nats))
    return PeakCandidate(fix, evidence, peak, aligned, searched)


def places_in(aligned: Aligned, window: Window) -> float:
    """Number of places in a window at which a hypothesis fits."""
    (rows, columns), scale = aligned.template.shape, 2.0**aligned.level
    return independent_places(
        max(window.width_px / scale - columns, 1.0) * max(window.height_px / scale - rows, 1.0)
    )


def null_tested(correlator: Correlator, found: PeakCandidate) -> PeakCandidate:
    """The candidate; unless beyond doubt, compared with its frame upside down and mirrored."""
    query, peak, aligned, window = correlator.query, found.peak, found.aligned, found.fix.window
    evidence = replace(found.evidence, is_tested=True)
    if is_beyond_doubt(evidence.nats, query.risk):
        return found.weighed(evidence)
    matters = evidence.nats >= query.needed_nats
    null_score = _null_score(correlator, aligned, window, peak.second_score, matters=matters)
    return found.weighed(replace(evidence, null=surprise_of(null_score, score_sigma(aligned.template.size))))


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
    best = -1.0
    quick = EarlyStop(
        is_clear=lambda peak: max(peak.score, peak.second_score) <= rival_score,
        is_hopeless=lambda _: not matters,
    )
    for patch in correlator.nowhere(aligned):
        enhanced = enhance(patch)
        rival = correlator.search(replace(aligned, template=enhanced), window, quick)
        best = best if rival is None else max(best, rival.score)
    return best


def fix_of(correlator: Correlator, aligned: Aligned, peak: Peak, window: Window, *, searched: bool) -> Fix:
    """The camera's nadir and its covariance; also the heading if it was searched."""
    query, pose = correlator.query, aligned.pose
    is_coarse = aligned.level > query.level_of(query.telemetry.known_height_m)
    errors = query.errors(correlator.options.errors)
    rows, columns = aligned.template.shape
    peak_px2 = peak_covariance_px(peak, rows * columns)
    covariance = ncc_covariance_m2(peak_px2, pose, query.camera, aligned.jacobian, errors)
    return query.fix(
        METHOD,
        correlator.nadir_px(peak, aligned),
        covariance,
        score=peak.score,
        window=window,
        grid_attitude=pose.grid_attitude if searched else None,
        map_sigma_m=errors.map_m,
        stage="coarse" if is_coarse else "fine",
    )
