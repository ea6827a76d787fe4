"""The NCC method (Fig. 5): grey, rectify by height and heading, enhance, correlate in the window, peak, refine."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from engine.maps.prepared import PreparedMap
from engine.maps.samples import SampleMap
from engine.matching import hypothesis_search
from engine.matching.acceptance import agree_in_place, judge_peak, offset_between_m
from engine.matching.correlation import METHOD, Aligned, Correlator, expected_window_px
from engine.matching.evidence import is_beyond_doubt
from engine.matching.explanation import Explanation, explain_correlation
from engine.matching.method import Method
from engine.matching.oblique import is_ground_below, is_oblique
from engine.matching.peak_evidence import (
    PeakCandidate,
    candidate_of,
    null_tested,
    places_in,
    quick_look,
)
from engine.matching.query import Query
from engine.matching.refinement import Refinement, improved, with_unconfirmed_tilt
from engine.matching.second_look import second_look
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.runtime.scheduler import OutOfTime
from engine.values import Fix, NoFix, Peak, Prior, Reason, Result, Window

MAX_WINDOW_PX = 8 << 20
"""A window of a large map with more pixels than this is searched coarse to fine, as a whole map is."""
_SECOND_LOOK, _HYPOTHESES, _AT_ONCE = "ncc second look", "ncc hypotheses", "refinement at once"  # steps
_SURROUNDINGS_SIGMA_M = 30.0  # of the window around a place found by a search, in which it must stand out


class Ncc(Method):
    """Normalised cross-correlation; needs height and heading, which may be off by three of their sigmas.

    Args:
        site: the map.
        device: where pictures are correlated.
        options: settings; ``options.ncc`` counts.
    """

    loops = (
        "map_points",
        "gauss_newton",
        "surface_loops",
        "local_normalisation",
        "lattice",
        "lower_plane",
        "dense_loops",
    )

    def __init__(self, site: OrthoMap, device: Device, options: MatcherOptions) -> None:
        self.options = options.ncc
        self.prepared = PreparedMap(site, device, self.options.enhance_radius_px, self.options.score)
        self.samples = SampleMap(site, self.prepared.enhanced)

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {"map regions": self.prepared.created, "sampled cells": self.samples.created}

    def warmup(self, query: Query) -> None:
        """Run every variant of every step, so that it is compiled and its cost known."""
        for coarser in expected_window_px(query, self.options):
            self.refine(query, self.correlate(query, coarser))
        untilted = replace(query, frame=replace(query.frame, roll_deg=None, pitch_deg=None))
        self.refine(untilted, self.correlate(untilted))
        found = self.find(query)
        if isinstance(found, PeakCandidate):  # as of a refused frame
            self.find_again(query, found)

    def warmup_search(self, query: Query) -> None:
        """Search the whole map, or headings and heights about the prior."""
        if query.prior is None:
            self.locate(query)
        else:
            self._by_hypotheses(query)

    def locate(self, query: Query) -> Result:
        """A fix on the finest level of the map that time allows, refined if time remains."""
        return self.refine(query, self.begin(query))

    def begin(self, query: Query, *, widely: bool = True) -> Result:
        """A refined fix that starts at the coarsest level, else one by correlation alone, see :meth:`correlate`.

        The peak of the coarsest level is the fix if it was accepted and there is no time for a finer one, or if
        the finer one is at the same place but not accepted.
        """
        coarse = self._by_coarse_peak(query)
        if coarse is None:
            return self.correlate(query, widely=widely)
        scheduler, work_px, is_refuted = query.scheduler, float(query.gray.size), False
        try:
            with scheduler.with_fix():
                if scheduler.can_afford({_AT_ONCE: work_px}):
                    with scheduler.costed(_AT_ONCE, work_px):
                        refined = Refinement(query, self.samples, self.options).refine_at_once(coarse)
                    if refined is not None:
                        return refined
                    coarse, is_refuted = with_unconfirmed_tilt(query, coarse), True
                step, works = self._step(query)
                finer = {level: work for level, work in works.items() if level < max(works)}
                level = scheduler.first_affordable(step, finer)
                if level is None:
                    return coarse
                fine = self.correlate(query, level, widely=widely)
        except OutOfTime:
            return coarse
        if isinstance(fine, Fix):
            return with_unconfirmed_tilt(query, fine) if is_refuted and fine.stage == "coarse" else fine
        is_same = fine.match is not None and self._is_same(coarse, fine.match)
        return coarse if is_same or fine.reason is Reason.LATE else fine

    def _by_coarse_peak(self, query: Query) -> Fix | None:
        """The peak of the coarsest level, if it is accepted and refinement may start from it.

        If roll, pitch or the ground's slope is unknown, the pose depends on the peak, which must then be fine.
        """
        if query.prior is None or not self._can_refine(query):
            return None
        step, works = self._step(query)
        coarser, scheduler = max(works), query.scheduler
        is_wide = query.site.is_large and works[coarser] > MAX_WINDOW_PX
        if not (coarser and query.telemetry.has_tilt and query.site.has_surface) or is_wide:
            return None
        if not scheduler.can_afford({(step, coarser): works[coarser], _AT_ONCE: float(query.gray.size)}):
            if scheduler.can_afford({(step, coarser): works[coarser]}):
                scheduler.note_refusal(_AT_ONCE)
            return None
        _, result = self._find_and_judge(query, step, works, coarser)
        return None if isinstance(result, NoFix) else replace(result, stage="coarse")

    def _is_same(self, coarse: Fix, fine: Fix) -> bool:
        """Whether two peaks are of one place, so that neither is the other's rival."""
        distance_m = float(np.hypot(*offset_between_m(coarse, fine)))
        return distance_m < self.options.exclusion_m and agree_in_place(coarse, fine)

    def correlate(self, query: Query, coarser: int | None = None, *, widely: bool = True) -> Result:
        """A fix by correlation alone.

        Args:
            query: the frame.
            coarser: levels above the one whose pixels are like the frame's; None takes the finest that time
                allows.
            widely: whether to search for the heading and height of a refused frame.
        """
        if query.telemetry.height_agl_m is None:
            return self._refuse_without_height(query)
        step, works = self._step(query)
        if coarser is None:
            coarser = query.scheduler.first_affordable(step, works)
        if coarser is None:
            return query.refuse_late(METHOD, (step, max(works)))
        found, result = self._find_and_judge(query, step, works, coarser)
        if isinstance(found, PeakCandidate) and isinstance(result, NoFix):
            with suppress(OutOfTime):  # the existing refusal stands
                result = self._look_again(query, found) or result
                searched = self._by_hypotheses(query) if widely and isinstance(result, NoFix) else None
                if searched is not None:
                    return searched
            if isinstance(result, NoFix):
                result = replace(result, match=found.fix)
        return replace(result, stage="coarse") if coarser and isinstance(result, Fix) else result

    def _by_hypotheses(self, query: Query) -> Fix | None:
        """A fix with the best of all headings and heights within three sigmas; None without one, or without time.

        A compass near motors is often off by more than a patch tolerates.
        """
        work_px = max(self._step(query)[1].values())
        if not query.scheduler.can_afford({_HYPOTHESES: work_px}):
            query.scheduler.note_refusal(_HYPOTHESES)
            return None
        with query.scheduler.costed(_HYPOTHESES, work_px):
            found = self.find(query, widely=True)
        if isinstance(found, NoFix):
            return None
        result = self._look_again(query, found)
        if not isinstance(result, Fix):
            return None
        refined = self._refined(query.at(found.aligned.pose), result)
        return refined if isinstance(refined, Fix) else None

    def _find_and_judge(
        self, query: Query, step: str, works: dict[int, float], coarser: int
    ) -> tuple[PeakCandidate | NoFix, Result]:
        """Find and judge the highest peak on a level; a variant of a step, whose cost is learned."""
        with query.scheduler.costed((step, coarser), works[coarser]):
            found = self.find(query, coarser=coarser)
            return found, found if isinstance(found, NoFix) else self.judge(query, found)

    def _step(self, query: Query) -> tuple[str, dict[int, float]]:
        """The name of the correlation step, and the work of its variants."""
        if query.prior is None:
            return "ncc search", {0: float(query.site.width_px * query.site.height_px)}
        return "ncc", expected_window_px(query, self.options)

    def refine(self, query: Query, result: Result) -> Result:
        """The fix of a fine peak, its pose refined if that is wanted, possible and affordable."""
        if not isinstance(result, Fix) or result.stage != "fine" or result.attitude is not None:
            return result
        return self._refined(query, result)

    def _refined(self, query: Query, result: Fix) -> Result:
        if not self._can_refine(query):
            return result
        refinement = Refinement(query, self.samples, self.options)
        return improved(query, result, "refinement", refinement.refine)

    def _can_refine(self, query: Query) -> bool:
        """Whether poses are refined."""
        known = query.telemetry
        return self.options.refine and known.height_agl_m is not None and known.grid_attitude is not None

    def explain(self, query: Query, window: Window) -> Explanation:
        """The correlation surface of a window at the frame's own height and heading."""
        return explain_correlation(self._correlator(query), window)

    def find(self, query: Query, *, coarser: int = 0, widely: bool = False) -> PeakCandidate | NoFix:
        """The highest peak of one frame, or a refusal if there is none.

        Args:
            query: the frame.
            coarser: see :meth:`correlate`.
            widely: whether to try all headings and heights within three sigmas, as a search of the map does.
        """
        refusal = self._refuse_unusable(query)
        if refusal is not None:
            return refusal
        correlator = self._correlator(query)
        aligned = self._align(correlator, coarser)
        if isinstance(aligned, NoFix):
            return aligned
        window = correlator.window(aligned)
        if window is None:
            return query.refuse_outside(METHOD)
        wide = query.site.is_large and window.area_px >> 2 * aligned.level > MAX_WINDOW_PX
        if wide and hypothesis_search.coarse_px(correlator, aligned, window) > MAX_WINDOW_PX:
            size = f"{window.width_px} x {window.height_px} px"
            detail = f"a window of {size} is too large to search; a better prior is needed"
            return query.refuse(Reason.MAP_TOO_LARGE, detail, METHOD, window=window)
        reach = hypothesis_search.reach_of(correlator) if widely else hypothesis_search.OWN
        if widely and hypothesis_search.is_single(correlator, aligned, window, reach):
            detail = "its own heading and height are near all possible ones"
            return query.refuse(Reason.LOW_SCORE, detail, METHOD, window=window)
        is_window, hypotheses = not (widely or wide or query.prior is None), 1
        if is_window:
            peak, aligned = self._in_window(correlator, aligned, window)
        else:
            peak, aligned, hypotheses = hypothesis_search.search(correlator, aligned, window, reach)
        if peak is None:
            detail = "the map does not cover the frame anywhere in the window"
            return query.refuse(Reason.OUTSIDE_MAP, detail, METHOD, window=window)
        if query.scheduler.deadline.remaining_ms < 0:
            detail = "the budget was spent before the peak was known"
            return query.refuse(Reason.LATE, detail, METHOD, window=window)
        tried, searched = hypotheses * places_in(aligned, window), hypotheses > 1
        found = candidate_of(correlator, aligned, peak, window, searched=searched, tried=tried)
        if is_window:
            return null_tested(correlator, found)
        return replace(found, is_tested=not searched and is_beyond_doubt(found.evidence.nats, query.risk))

    def _in_window(self, correlator: Correlator, aligned: Aligned, window: Window) -> tuple[Peak | None, Aligned]:
        """The peak of one hypothesis; an oblique frame is redrawn over the ground where it was found."""
        query, pose = correlator.query, aligned.pose
        peak = correlator.search(aligned, window, quick_look(correlator, aligned, window))
        if peak is None or pose.grid_attitude is None or not is_oblique(query, pose.grid_attitude):
            return peak, aligned
        nadir_px = correlator.nadir_px(peak, aligned)
        again = None if is_ground_below(query, nadir_px) else correlator.align(pose, aligned.level, nadir_px)
        if not isinstance(again, Aligned):
            return peak, aligned
        second = correlator.search(again, window, quick_look(correlator, again, window))
        return (peak, aligned) if second is None else (second, again)

    def judge(self, query: Query, found: PeakCandidate) -> Result:
        """The fix if its peak is accepted, else a refusal."""
        refusal = judge_peak(found.peak, found.evidence, query.risk, is_tested=found.is_tested)
        if refusal is not None:
            return query.refuse(*refusal, METHOD, score=found.peak.score, window=found.fix.window)
        return found.fix

    def _look_again(self, query: Query, found: PeakCandidate) -> Result | None:
        """What the second look about the same place gives; None if it sees nothing, or there is no time."""
        again = self.find_again(query, found, self._looked_at(query, found))
        return None if again is None else self.judge(query, again)

    def _looked_at(self, query: Query, found: PeakCandidate) -> Window:
        """The window of a second look: the first one's; after a search, the surroundings of the place."""
        if found.is_tested:
            return found.fix.window
        place = Prior(east_m=found.fix.east_m, north_m=found.fix.north_m, sigma_m=_SURROUNDINGS_SIGMA_M)
        correlator = self._correlator(replace(query, prior=place))
        return correlator.window(found.aligned) or found.fix.window

    def find_again(self, query: Query, found: PeakCandidate, window: Window | None = None) -> PeakCandidate | None:
        """The highest peak of the second look, see :mod:`engine.matching.second_look`.

        Args:
            query: the frame.
            found: the candidate of the first look.
            window: to look at; None takes that of the first look, which the fix names in any case.

        Returns:
            PeakCandidate | None: None if the template is nowhere on the map, or there is no time.
        """
        window = window or found.fix.window
        correlator, scheduler, work_px = self._correlator(query), query.scheduler, found.aligned.work_px(window)
        if not scheduler.can_afford({_SECOND_LOOK: work_px}):
            return None
        with scheduler.costed(_SECOND_LOOK, work_px), scheduler.stage("second look"):
            return second_look(correlator, found, window)

    def _correlator(self, query: Query) -> Correlator:
        return Correlator(query, self.prepared, self.options)

    def _refuse_without_height(self, query: Query) -> NoFix:
        return query.refuse(Reason.NO_HEIGHT, "NCC needs the height above ground", METHOD)

    def _refuse_unusable(self, query: Query) -> NoFix | None:
        """A refusal of a frame that lacks what the method needs."""
        pose = query.telemetry
        if pose.height_agl_m is None:
            return self._refuse_without_height(query)
        if pose.grid_heading_deg is None:
            detail = "NCC needs the heading; with a sigma of 180 degrees it tries all of them"
            return query.refuse(Reason.NO_HEADING, detail, METHOD)
        return query.refuse_flat(METHOD, self.options.min_deviation)

    def _align(self, correlator: Correlator, coarser: int) -> Aligned | NoFix:
        """The frame with its own height and heading."""
        query, pose = correlator.query, correlator.query.telemetry
        assert pose.height_agl_m is not None  # or it was refused
        level = min(query.level_of(pose.height_agl_m) + coarser, query.site.levels - 1)
        with query.scheduler.stage("align"):
            return correlator.align(pose, level)
