"""The NCC method (Fig. 5): grey, rectify by height and heading, enhance, correlate in the window, peak."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from engine.confidence import PeakFeatures, PriorAgreement, peak_features, prior_agreement, probability
from engine.indexes.prepared import PreparedMap
from engine.integrity import (
    PeakRule,
    judge_confidence,
    judge_peak,
    misalignment_covariance_px2,
    ncc_covariance_m2,
    peak_covariance_px,
    score_sigma,
)
from engine.methods import hypothesis_search
from engine.methods.hypothesis import METHOD, Aligned, NccOptions, align, nadir_px, search, window_about
from engine.methods.query import Query
from engine.values import Attitude, Fix, NoFix, Peak, Reason, Window

WIDE_PX = 8 << 20
"""A window of a large map with more pixels than this is searched coarse to fine, as a whole map is."""


@dataclass(frozen=True, slots=True)
class PeakCandidate:
    """A peak that is not judged yet.

    Attributes:
        peak: in pixels of the aligned level.
        aligned: the hypothesis that it belongs to.
        fix: what the peak means, if it is believed.
        trusted: neither heading nor height was searched for.
        expected: how its place lies to the prior; None where there is none, or one that says next to nothing.
        evidence: what speaks for it; None where more was searched than a window at one heading and height.
    """

    peak: Peak
    aligned: Aligned
    fix: Fix
    trusted: bool
    expected: PriorAgreement | None
    evidence: PeakFeatures | None


def find(query: Query, prepared: PreparedMap, options: NccOptions, *, coarser: int = 0) -> PeakCandidate | NoFix:
    """The highest peak of one frame with its evidence, or a refusal where there is none. As :func:`locate`."""
    frame = query.frame
    if frame.height_agl_m is None:
        return query.refuse(Reason.NO_HEIGHT, "NCC needs the height above ground", METHOD)
    if frame.heading_deg is None and options.heading_search_deg < 180.0:
        return query.refuse(Reason.NO_HEADING, "NCC needs the heading, or a search over all of them", METHOD)
    flat = query.refuse_flat(METHOD, options.rule.min_deviation)
    if flat is not None:
        return flat
    level = min(query.level_of(frame.height_agl_m) + coarser, query.site.levels - 1)
    with query.watch.stage("align"):
        first = frame if frame.heading_deg is not None else replace(frame, heading_deg=0.0)
        aligned = align(query, first, level, options)
    if isinstance(aligned, NoFix):
        return aligned
    window = window_about(query, aligned, options)
    if window is None:
        return query.refuse_outside(METHOD)
    trusted = hypothesis_search.is_trusted(frame, options)
    wide = query.site.is_large and window.area_px >> 2 * aligned.level > WIDE_PX
    if wide and hypothesis_search.coarse_px(query, aligned, window, options) > WIDE_PX:
        detail = f"a window of {window.width_px} x {window.height_px} px is not searched; a better prior is needed"
        return query.refuse(Reason.MAP_TOO_LARGE, detail, METHOD, window=window)
    if trusted and query.prior is not None and not wide:
        peak = search(query, prepared, aligned, window, options)
    else:
        peak, aligned = hypothesis_search.search(query, prepared, aligned, window, options)
    if peak is None:
        detail = "the map does not cover the frame anywhere in the window"
        return query.refuse(Reason.OUTSIDE_MAP, detail, METHOD, window=window)
    if query.watch.deadline.remaining_ms < 0:
        return query.refuse(Reason.LATE, "the budget was spent before the peak was known", METHOD, window=window)
    fix = _fix(query, aligned, peak, window, options, trusted=trusted)
    expected = None if wide else _expected(query, fix)
    evidence = None
    if trusted and expected is not None:
        sigma = score_sigma(aligned.template.numel())
        evidence = peak_features(peak, sigma, expected)
        if probability(evidence) < options.rule.sure:
            peak = _against_turned(query, prepared, aligned, window, peak, options)
            evidence = peak_features(peak, sigma, expected)
    return PeakCandidate(peak, aligned, fix, trusted, expected, evidence)


def _against_turned(
    query: Query, prepared: PreparedMap, aligned: Aligned, window: Window, peak: Peak, options: NccOptions
) -> Peak:
    """The peak with the best of the same patch upside down among its rivals.

    Upside down the patch is of no place at all, so its best score is what this window gives to chance. Where the
    compass is wrong by half a turn, it is the true place.
    """
    upside_down = replace(aligned, template=torch.flip(aligned.template, (0, 1)))
    rival = search(query, prepared, upside_down, window, options)
    return peak if rival is None else replace(peak, second_score=max(peak.second_score, rival.score))


def locate(query: Query, prepared: PreparedMap, options: NccOptions, *, coarser: int = 0) -> Fix | NoFix:
    """One frame to a fix by correlation; needs its height, and its heading or the time to search for it.

    Args:
        query: the frame.
        prepared: the map.
        options: settings.
        coarser: levels above the one whose pixels are like the frame's, for an answer that is quicker and cruder.
    """
    found = find(query, prepared, options, coarser=coarser)
    return found if isinstance(found, NoFix) else judge(query, found, options.rule)


def judge(query: Query, found: PeakCandidate, rule: PeakRule) -> Fix | NoFix:
    """The fix with its probability of being right where its peak is believed, else a refusal."""
    evidence, pixels = found.evidence, found.aligned.template.numel()
    # A place that contradicts the prior is vouched for by the match alone, as on a search of the whole map.
    unexpected = found.expected is None or found.expected.prior_chi_square > rule.max_prior_chi_square
    refusal = judge_peak(found.peak, pixels, rule, whole_map=unexpected, searched=not found.trusted)
    if refusal is None and evidence is not None:
        refusal = judge_confidence(evidence, rule.min_confidence)
    if refusal is not None:
        return query.refuse(*refusal, METHOD, score=found.peak.score, window=found.fix.window)
    return found.fix if evidence is None else replace(found.fix, confidence=probability(evidence))


def _expected(query: Query, fix: Fix) -> PriorAgreement | None:
    if query.prior is None or query.prior_px is None:
        return None
    return prior_agreement(fix, query.site.enu_from_pixel(query.prior_px), query.prior.sigma_m)


def _fix(query: Query, aligned: Aligned, peak: Peak, window: Window, options: NccOptions, *, trusted: bool) -> Fix:
    """The camera's nadir and its covariance; the heading too where it was not ``trusted`` but searched for."""
    site, frame = query.site, aligned.frame
    nadir = nadir_px(query, peak, aligned)
    east, north = site.enu_from_pixel(nadir)
    lat, lon = site.geodetic_from_pixel(nadir)
    assert frame.height_agl_m is not None  # asked for before
    rows, columns = aligned.template.shape
    peak_px2 = peak_covariance_px(peak, rows * columns)
    peak_px2 = peak_px2 + misalignment_covariance_px2(peak, (rows, columns), frame.height_agl_m, options.errors)
    covariance = ncc_covariance_m2(peak_px2, frame, query.camera, aligned.jacobian, options.errors)
    attitude = Attitude(frame.roll_deg or 0.0, frame.pitch_deg or 0.0, frame.heading_deg or 0.0)
    return Fix(
        timestamp_ns=frame.timestamp_ns,
        lat_deg=float(lat),
        lon_deg=float(lon),
        east_m=float(east),
        north_m=float(north),
        up_m=None,
        covariance_m2=covariance,
        attitude=None if trusted else attitude,
        score=peak.score,
        method=METHOD,
        window=window,
        timings=query.watch.timings,
        map_xy_px=(float(nadir[0]), float(nadir[1])),
    )
