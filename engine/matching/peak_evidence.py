"""From a correlation peak to the fix that it gives if accepted, and the evidence for it."""

from __future__ import annotations

from dataclasses import replace

from engine.kernels.coarse_to_fine import EarlyStop
from engine.kernels.scores import enhance
from engine.matching.candidates import PeakCandidate
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
    by_search: bool = False,
    is_fitted: bool = False,
    tried: float = 0.0,
    sigma: float | None = None,
) -> PeakCandidate:
    """The candidate that a peak gives.

    Args:
        correlator: of the frame.
        aligned: the hypothesis.
        peak: in pixels of its level.
        window: in which its rival is the best.
        by_search: whether it is the best of more than this window at one heading and height.
        is_fitted: whether heading and height were fitted to the picture.
        tried: places, times headings and heights, among which it is the best, if more than the window's.
        sigma: standard deviation of a chance score, if measured.
    """
    query, (rows, columns) = correlator.query, aligned.template.shape
    fix = fix_of(correlator, aligned, peak, window, is_fitted=is_fitted)
    sigma = score_sigma(rows * columns) if sigma is None else sigma
    measured = places_in(aligned, window)
    surprise, rival = surprise_of(peak.score, sigma), surprise_of(peak.second_score, sigma)
    off = query.prior_chi_square(fix)
    evidence = Evidence(surprise, rival, measured, max(tried, measured), off)
    fix = replace(fix, confidence=probability(evidence.nats))
    return PeakCandidate(fix, evidence, peak, aligned, by_search, is_fitted)


def places_in(aligned: Aligned, window: Window) -> float:
    """Number of places in a window at which a hypothesis fits."""
    (rows, columns), scale = aligned.template.shape, 2.0**aligned.level
    across, down = window.width_px / scale - columns, window.height_px / scale - rows
    return independent_places(max(across, 1.0) * max(down, 1.0))


def null_tested(correlator: Correlator, found: PeakCandidate) -> PeakCandidate:
    """The candidate compared with its frame upside down and mirrored, which show what chance reaches."""
    aligned, rival_score, best = found.aligned, found.peak.second_score, -1.0
    quick = EarlyStop(lambda peak: max(peak.score, peak.second_score) <= rival_score, lambda _: False)
    for patch in correlator.nowhere(aligned):
        rival = correlator.search(replace(aligned, template=enhance(patch)), found.fix.window, quick)
        best = best if rival is None else max(best, rival.score)
    null = surprise_of(best, score_sigma(aligned.template.size))
    return found.weighed(replace(found.evidence, null=null, is_tested=True))


def fix_of(correlator: Correlator, aligned: Aligned, peak: Peak, window: Window, *, is_fitted: bool) -> Fix:
    """The camera's nadir and its covariance; also the heading if it was fitted."""
    query, pose = correlator.query, aligned.pose
    is_coarse = aligned.level > query.level_of(query.telemetry.known_height_m)
    errors = query.errors
    rows, columns = aligned.template.shape
    peak_px2 = peak_covariance_px(peak, rows * columns)
    peak_px2 = peak_px2 + misalignment_covariance_px2(peak, (rows, columns), pose.known_height_m, errors)
    jacobian = query.jacobian * 2.0**aligned.level
    covariance = ncc_covariance_m2(peak_px2, pose, query.camera, jacobian, errors)
    return query.fix(
        METHOD,
        correlator.nadir_px(peak, aligned),
        covariance,
        score=peak.score,
        window=window,
        grid_attitude=pose.grid_attitude if is_fitted else None,
        map_sigma_m=errors.map_m,
        stage="coarse" if is_coarse else "fine",
    )
