"""The anytime ladder: of each method the best rung that the time left affords, and with both a second opinion.

Costs are learned (:mod:`engine.methods.costs`): before a rung is begun an upper bound of its cost is known, and
one that would come too late is not begun. Without a budget the highest rung is always affordable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from engine.geo import chi_square
from engine.indexes.landmarks import LandmarkMap
from engine.indexes.prepared import PreparedMap
from engine.indexes.samples import SampleMap
from engine.integrity import CONSISTENT_CHI_SQUARE
from engine.methods import hypothesis, ncc, refinement, sift
from engine.methods.hypothesis import NccOptions
from engine.methods.hypothesis_search import is_trusted
from engine.methods.query import Query
from engine.methods.sift import SiftOptions
from engine.values import Fix, NoFix, Reason, Result
from engine.window import SPREAD_SIGMAS

_COARSER = (0, 1, 2)  # levels above the frame's own that NCC may fall back to
_MIN_SIDE_PX = 24  # of what is correlated there
_REDUCED = (1.0, 0.7, 0.5)  # of the scale at which SIFT looks at the frame


@dataclass(frozen=True, slots=True)
class Tools:
    """What the methods work with."""

    prepared: PreparedMap
    landmarks: LandmarkMap
    samples: SampleMap
    ncc: NccOptions
    sift: SiftOptions


def by_ncc(query: Query, tools: Tools) -> Result:
    """NCC on the finest level of the map that the time affords, and its fix refined where there is time."""
    return refine(query, tools, _by_peak(query, tools))


def refine(query: Query, tools: Tools, result: Result) -> Result:
    """The fix of a fine peak with its pose refinement, where that is wanted, can be done and is affordable."""
    if not isinstance(result, Fix) or result.stage != "fine" or not tools.ncc.refine:
        return result
    # A height that was searched for is not the frame's, and a slope nobody knows would be taken for a tilt.
    if not is_trusted(query.frame, tools.ncc) or not query.site.has_surface:
        return result
    work_px = float(query.gray.size)
    if not query.watch.affords("dense", work_px):
        query.watch.give_up("dense", price=False)
        return result
    with query.watch.rung("dense", work_px):
        return refinement.improve(query, result, tools.samples, tools.ncc)


def _by_peak(query: Query, tools: Tools) -> Result:
    """NCC on the finest level of the map that the time affords."""
    if query.frame.height_agl_m is None:
        return ncc.locate(query, tools.prepared, tools.ncc)  # which refuses
    if query.prior is None or not is_trusted(query.frame, tools.ncc):
        rung = "ncc search" if query.prior is None else "ncc bank"
        levels = {0: float(query.site.width_px * query.site.height_px)}
    else:
        rung = "ncc"
        levels = _window_px(query, tools.ncc)
    for coarser, work_px in levels.items():
        if query.watch.affords(rung, work_px):
            with query.watch.rung(rung, work_px):
                result = ncc.locate(query, tools.prepared, tools.ncc, coarser=coarser)
            return _on_stage(result, "coarse" if coarser else "fine")
    return _late(query, hypothesis.METHOD, rung)


def by_sift(query: Query, tools: Tools, *, second: bool = False) -> Result:
    """SIFT at the highest resolution of the frame that the time affords.

    Args:
        query: the frame.
        tools: the map and settings.
        second: a fix is in hand already and must not be lost to an attempt that takes too long.
    """
    rung = "sift"
    if query.prior is None or query.frame.height_agl_m is None:
        rung = "sift search" if query.prior is None else "sift heights"
    for share in _REDUCED:
        options = tools.sift if share == 1.0 else replace(tools.sift, scale=tools.sift.scale * share)
        work_px = query.gray.size * options.scale**2
        if query.watch.affords(rung, work_px):
            with query.watch.rung(rung, work_px):
                result = sift.locate(query, tools.landmarks, options)
            return _on_stage(result, "coarse" if share < 1.0 else "fine")
    return _late(query, sift.METHOD, rung, price=not second)


def by_both(query: Query, tools: Tools) -> Result:
    """NCC where height and heading are known, then SIFT where there is time: two fixes must be of one place.

    Refinement comes last: it makes a fix more accurate, and the second method makes it surer.
    """
    if query.frame.height_agl_m is None or query.frame.heading_deg is None:
        return by_sift(query, tools)
    first = _by_peak(query, tools)
    second = by_sift(query, tools, second=isinstance(first, Fix))
    if isinstance(first, NoFix):
        return first if _was_late(second) else second
    if isinstance(second, NoFix):
        return refine(query, tools, first)
    apart_m = np.array([first.east_m - second.east_m, first.north_m - second.north_m])
    spread_m2 = (first.covariance_m2 + second.covariance_m2)[:2, :2]
    if chi_square(apart_m, spread_m2) > CONSISTENT_CHI_SQUARE:
        detail = f"NCC and SIFT are {float(np.hypot(*apart_m)):.1f} m apart"
        return query.refuse(Reason.INCONSISTENT, detail, "auto", score=first.score, window=first.window)
    first = refine(query, tools, first)
    fixes = [fix for fix in (first, second) if isinstance(fix, Fix)]
    # Both look at one picture over one map with one prior: their odds are not multiplied, the surer one stands.
    stated = [fix.confidence for fix in fixes if fix.confidence is not None]
    best = min(fixes, key=lambda fix: fix.sigma_m)
    return replace(best, stage="verified", confidence=max(stated, default=None))


def every_rung(query: Query, tools: Tools, method: str) -> None:
    """Run each rung once, so that its price is known; the query has a prior."""
    for coarser, work_px in _window_px(query, tools.ncc).items() if method != "sift" else ():
        with query.watch.rung("ncc", work_px):
            result = ncc.locate(query, tools.prepared, tools.ncc, coarser=coarser)
        refine(query, tools, _on_stage(result, "coarse" if coarser else "fine"))
    for share in _REDUCED if method != "ncc" else ():
        options = replace(tools.sift, scale=tools.sift.scale * share)
        with query.watch.rung("sift", query.gray.size * options.scale**2):
            sift.locate(query, tools.landmarks, options)


def _window_px(query: Query, options: NccOptions) -> dict[int, float]:
    """Pixels of the window, by which NCC costs, on the frame's own level and the coarser ones that serve."""
    site, camera, height_m = query.site, query.camera, query.frame.height_agl_m
    assert height_m is not None  # asked for before
    assert query.prior is not None
    own = query.level_of(height_m)
    out = {}
    for coarser in _COARSER:
        gsd_m = site.gsd_m_per_px * 2.0 ** (own + coarser)
        per_px = height_m / (camera.focal_px * gsd_m)
        least = options.fraction * min(camera.width_px, camera.height_px) * per_px
        if coarser == 0 or (own + coarser < site.levels and least >= _MIN_SIDE_PX):
            slack_px = 2.0 * SPREAD_SIGMAS * query.prior.sigma_m / gsd_m
            width, height = (options.margin * n * per_px + slack_px for n in (camera.width_px, camera.height_px))
            rows, columns = site.level_shape(own + coarser)  # beyond which no window reaches
            out[coarser] = min(width, columns) * min(height, rows)
    return out


def _on_stage(result: Result, stage: str) -> Result:
    return replace(result, stage=stage) if isinstance(result, Fix) else result


def _was_late(result: Result) -> bool:
    return isinstance(result, NoFix) and result.reason is Reason.LATE


def _late(query: Query, method: str, rung: str, *, price: bool = True) -> NoFix:
    query.watch.give_up(rung, price=price)
    left_ms = query.watch.deadline.remaining_ms
    detail = f"{left_ms:.1f} ms are left; the least that {method} can do takes longer"
    return query.refuse(Reason.LATE, detail, method)
