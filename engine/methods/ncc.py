"""The NCC method (Fig. 5): grey, rectify by height and heading, enhance, correlate in the window, peak."""

from __future__ import annotations

from dataclasses import replace

from engine.integrity import judge_peak, ncc_covariance_m2, peak_covariance_px
from engine.methods import bank
from engine.methods.laid import METHOD, Aligned, NccOptions, align, nadir_px, search, window_about
from engine.methods.query import Query, level_for
from engine.prepared import PreparedMap
from engine.types import Attitude, Fix, NoFix, Peak, Reason, Window


def locate(query: Query, prepared: PreparedMap, options: NccOptions, *, coarser: int = 0) -> Fix | NoFix:
    """One frame to a fix by correlation; needs its height, and its heading or the time to search for it.

    Args:
        query: the frame.
        prepared: the map.
        options: settings.
        coarser: levels above the one whose pixels are like the frame's, for an answer that is quicker and cruder.
    """
    frame = query.frame
    if frame.height_agl_m is None:
        return query.refuse(Reason.NO_HEIGHT, "NCC needs the height above ground", METHOD)
    if frame.heading_deg is None and options.heading_search_deg < 180.0:
        return query.refuse(Reason.NO_HEADING, "NCC needs the heading, or a search over all of them", METHOD)
    flat = query.refuse_flat(METHOD, options.rule.min_deviation)
    if flat is not None:
        return flat
    level = level_for(query.site.gsd_m_per_px, frame.height_agl_m / query.camera.focal_px, query.site.levels)
    level = min(level + coarser, query.site.levels - 1)
    with query.watch.stage("align"):
        aligned = align(
            query, frame if frame.heading_deg is not None else replace(frame, heading_deg=0.0), level, options
        )
    if isinstance(aligned, NoFix):
        return aligned
    window = window_about(query, aligned, options)
    if window is None:
        return query.refuse(Reason.OUTSIDE_MAP, "the window lies outside the map", METHOD)
    trusted = bank.is_trusted(frame, options)
    if trusted and query.prior is not None:
        peak = search(query, prepared, aligned, window, options)
    else:
        peak, aligned = bank.search(query, prepared, aligned, window, options)
    if peak is None:
        detail = "the map does not cover the frame anywhere in the window"
        return query.refuse(Reason.OUTSIDE_MAP, detail, METHOD, window=window)
    if query.watch.deadline.remaining_ms < 0:
        return query.refuse(Reason.LATE, "the budget was spent before the peak was known", METHOD, window=window)
    unexpected = query.prior is None or _off_prior(query, aligned, peak) > options.rule.max_prior_chi_square
    pixels = aligned.template.numel()
    refusal = judge_peak(peak, pixels, options.rule, whole_map=unexpected, searched=not trusted)
    if refusal is not None:
        return query.refuse(*refusal, METHOD, score=peak.score, window=window)
    return _fix(query, aligned, peak, window, options)


def _off_prior(query: Query, aligned: Aligned, peak: Peak) -> float:
    """Chi-square, of two degrees of freedom, of the place that the peak means against the prior."""
    assert query.prior is not None
    assert query.prior_px is not None
    apart = query.jacobian @ (nadir_px(query, peak, aligned) - query.prior_px)
    return float(apart @ apart) / query.prior.sigma_m**2


def _fix(query: Query, aligned: Aligned, peak: Peak, window: Window, options: NccOptions) -> Fix:
    """The camera's nadir and its covariance."""
    site, frame = query.site, aligned.frame
    nadir = nadir_px(query, peak, aligned)
    east, north = site.enu_from_pixel(nadir)
    lat, lon = site.geodetic_from_pixel(nadir)
    peak_px2 = peak_covariance_px(peak, aligned.template.numel())
    covariance = ncc_covariance_m2(peak_px2, frame, query.camera, aligned.jacobian, options.errors)
    searched = frame is not query.frame
    attitude = Attitude(frame.roll_deg or 0.0, frame.pitch_deg or 0.0, frame.heading_deg or 0.0)
    return Fix(
        timestamp_ns=frame.timestamp_ns,
        lat_deg=float(lat),
        lon_deg=float(lon),
        east_m=float(east),
        north_m=float(north),
        up_m=None,
        covariance_m2=covariance,
        attitude=attitude if searched else None,
        score=peak.score,
        method=METHOD,
        window=window,
        timings=query.watch.timings,
        map_xy_px=(float(nadir[0]), float(nadir[1])),
    )
