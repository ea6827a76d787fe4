"""The NCC method (Fig. 5): grey, rectify by height and heading, enhance, correlate in the window, peak, refine."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import replace
from typing import TypeGuard

from engine.kernels.dense import EnhancedFrame
from engine.maps.prepared import PreparedMap
from engine.maps.samples import SampleMap
from engine.maps.tiles import WHOLE_LEVEL_PX
from engine.matching import hypothesis_search, refusals
from engine.matching.agreement import are_near
from engine.matching.candidates import PeakCandidate, nats
from engine.matching.correlation import METHOD, Correlator, expected_window_px
from engine.matching.evidence import Evidence
from engine.matching.for_reports import Explanation, explain_correlation
from engine.matching.ladder import Answer, Rung, Works, climb, is_accepted, rehearse
from engine.matching.method import Method
from engine.matching.peak_evidence import candidate_of, early_stop, null_tested, places_in
from engine.matching.query import Query
from engine.matching.refinement import Refinement, with_tilt_doubt
from engine.matching.structure import match_structure
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.values import NoFix, Prior, Reason, Window

MAX_WINDOW_PX = WHOLE_LEVEL_PX
"""A window of a large map with more pixels than this is searched coarse to fine, as a whole map is."""
_SEARCH, _NULL, _STRUCTURE, _HYPOTHESES = "ncc search", "ncc null", "ncc structure", "ncc hypotheses"  # steps
_AT_ONCE, _REFINEMENT = "refinement at once", "refinement"
_SURROUNDINGS_SIGMA_M = 30.0  # of the window around a place found by a search, in which it must stand out


class Ncc(Method):
    """Normalised cross-correlation; needs height and heading, which may be off by three of their sigmas.

    Args:
        site: the map.
        device: where pictures are correlated.
        options: settings; ``options.ncc`` counts.
    """

    name = METHOD
    loops = (
        "map_points",
        "gauss_newton",
        "surface_loops",
        "local_normalisation",
        "lower_plane",
        "dense_loops",
    )

    def __init__(self, site: OrthoMap, device: Device, options: MatcherOptions) -> None:
        self.options = options.ncc
        self.prepared, self.samples = PreparedMap(site, device), SampleMap(site)

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {"map regions": self.prepared.regions.created, "sampled cells": self.samples.cells.created}

    def warmup(self, query: Query) -> None:
        """Run every variant of every step but the searches, so that it is compiled and its cost known."""
        untilted = replace(query, frame=replace(query.frame, roll_deg=None, pitch_deg=None))
        for each in (query, untilted):
            rungs = _Rungs(self, each)
            for answer in rehearse(each, rungs.levels, None):
                rehearse(each, rungs.refinement, answer)
                if isinstance(answer, PeakCandidate) and self.can_refine(each):
                    rungs.refinement_of(answer).rehearse(answer.fix)
        rungs = _Rungs(self, query)
        rehearse(query, rungs.null, self._known(query, query.needed_nats))
        rehearse(query, rungs.structure, self._known(query, 0.0))

    def warmup_search(self, query: Query) -> None:
        """Search the whole map, or headings and heights about the prior."""
        if query.prior is None:
            self.locate(query)
        else:
            rehearse(query, _Rungs(self, query).search, self._known(query, 0.0))

    def _known(self, query: Query, surprise: float) -> Answer:
        """The frame's peak, with this evidence instead of its own."""
        found = self.find(query)
        return found if isinstance(found, NoFix) else found.weighed(Evidence(surprise, 0.0, math.e, math.e, None))

    def locate(self, query: Query) -> Answer:
        """The place by the frame's own heading and height, else by others that they may be mistaken for."""
        if query.telemetry.height_agl_m is None:
            return self._refuse_without_height(query)
        looks, searches = self.rungs(query)
        return climb(query, [*looks, *searches])[METHOD]

    def rungs(self, query: Query) -> tuple[list[Rung], list[Rung]]:
        """The rungs at a frame's own heading and height, and those at others, if all else is refused.

        A null hypothesis is tested if refinement leaves doubt: the pose is stronger evidence, and cheaper. What
        structure finds is another candidate, which is refined and tested in its turn.
        """
        own = _Rungs(self, query)
        tested = [own.refinement, own.null]
        looks = [own.coarsest, own.at_once, own.null, own.levels, *tested, own.structure, *tested]
        return looks, [own.search, replace(own.refinement, is_needless=is_accepted)]

    def works(self, query: Query) -> Works:
        """Correlation on each level, the frame's own first; or the search of the whole map."""
        if query.prior is None:
            return {(_SEARCH, 0): float(query.site.width_px * query.site.height_px)}
        return {(METHOD, coarser): work for coarser, work in expected_window_px(query).items()}

    def can_refine(self, query: Query) -> bool:
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
            coarser: levels of the map above the frame's own.
            widely: whether to try all headings and heights within three sigmas.
        """
        refusal = self._refuse_unusable(query)
        if refusal is not None:
            return refusal
        correlator, pose = self._correlator(query), query.telemetry
        level = min(query.level_of(pose.known_height_m) + coarser, query.site.levels - 1)
        with query.scheduler.stage("align"):
            aligned = correlator.align(pose, level)
        if isinstance(aligned, NoFix):
            return aligned
        window = correlator.window(aligned)
        if window is None:
            return refusals.outside(query, METHOD)
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
            peak = correlator.search(aligned, window, early_stop(correlator, aligned, window))
        else:
            peak, aligned, hypotheses = hypothesis_search.search(correlator, aligned, window, reach)
        if peak is None:
            detail = "the map does not cover the frame anywhere in the window"
            return query.refuse(Reason.OUTSIDE_MAP, detail, METHOD, window=window)
        if query.scheduler.deadline.remaining_ms < 0:
            detail = "the budget was spent before the peak was known"
            return query.refuse(Reason.LATE, detail, METHOD, window=window)
        tried, fitted = hypotheses * places_in(aligned, window), hypotheses > 1
        return candidate_of(
            correlator, aligned, peak, window, by_search=not is_window, is_fitted=fitted, tried=tried
        )

    def null_tested(self, query: Query, found: PeakCandidate) -> PeakCandidate:
        """The candidate with what chance reaches in its window."""
        return null_tested(self._correlator(query), found)

    def match_structure(self, query: Query, found: PeakCandidate) -> PeakCandidate | None:
        """The highest peak by structure as well, see :mod:`engine.matching.structure`.

        Args:
            query: the frame.
            found: the candidate by grey levels.

        Returns:
            PeakCandidate | None: None if the template is nowhere on the map.
        """
        return match_structure(self._correlator(query), found, self.around(query, found))

    def around(self, query: Query, found: PeakCandidate) -> Correlator:
        """Of the frame where structure is matched: about its prior; after a search, about the place."""
        if found.by_search:
            place = Prior(east_m=found.fix.east_m, north_m=found.fix.north_m, sigma_m=_SURROUNDINGS_SIGMA_M)
            query = replace(query, prior=place)
        return self._correlator(query)

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
        return refusals.if_flat(query, METHOD)


class _Rungs:
    """The ladder of one frame."""

    def __init__(self, ncc: Ncc, query: Query) -> None:
        self._ncc, self._query = ncc, query
        self._works, self._frame_px = ncc.works(query), float(query.gray.size)
        self._pictures: dict[int, EnhancedFrame] = {}
        self.coarsest = Rung(METHOD, "coarsest level", self._if_coarse_suffices, self._search_coarsely)
        self.at_once = Rung(METHOD, "pose of coarse peak", self._if_coarse, self._refine_at_once)
        self.null = Rung(METHOD, "null hypothesis", self._if_untested, self._test_null)
        self.levels = Rung(METHOD, "peak", self._finer, self._correlate)
        self.refinement = Rung(METHOD, "pose", self._if_unrefined, self._refine)
        self.structure = Rung(METHOD, "structure", self._if_unseen, self._match_structure)
        self.search = Rung(METHOD, "headings and heights", self._if_refused, self._search, is_accepted)

    def _if_coarse_suffices(self, answer: Answer | None) -> Works:
        """The coarsest level, if refinement may start from its peak and there is time for both.

        If roll, pitch or the ground's slope is unknown, the pose depends on the peak, which must then be fine.
        """
        query, (*finer, (coarsest, work)) = self._query, self._works.items()
        is_wide = query.site.is_large and work > MAX_WINDOW_PX
        can_confirm = query.telemetry.has_tilt and query.site.has_surface and self._ncc.can_refine(query)
        if is_wide or not (finer and can_confirm and query.scheduler.can_afford({coarsest: work})):
            return {}
        if not query.scheduler.can_afford({coarsest: work, _AT_ONCE: self._frame_px}):
            query.scheduler.note_refusal(_AT_ONCE)
            return {}
        return {coarsest: work}

    def _search_coarsely(self, answer: Answer | None, step: Hashable) -> Answer | None:
        """The peak of the coarsest level, if it promises a fix; else it says nothing: finer levels show more."""
        found = self._find(step)
        return found if self._is_promising(found) else None

    def _if_coarse(self, answer: Answer | None) -> Works:
        return {_AT_ONCE: self._frame_px} if self._is_coarse(answer) else {}

    def _refine_at_once(self, answer: Answer | None, step: Hashable) -> Answer:
        """The pose of a coarse peak refined, or the peak with a tilt that nothing confirmed."""
        assert isinstance(answer, PeakCandidate)  # or it was not offered
        refined = self.refinement_of(answer).refine_at_once(answer)
        return refined or replace(answer, fix=with_tilt_doubt(self._query, answer.fix))

    def _if_untested(self, answer: Answer | None) -> Works:
        """A peak of one window that suffices unless chance does as well there."""
        if not self._is_promising(answer) or is_accepted(answer, self._query) or answer.by_search:
            return {}
        return {_NULL: answer.aligned.work_px(answer.fix.window)}

    def _test_null(self, answer: Answer | None, step: Hashable) -> Answer | None:
        """The peak, compared with what chance reaches."""
        assert isinstance(answer, PeakCandidate)  # or it was not offered
        return self._ncc.null_tested(self._query, answer)

    def _finer(self, answer: Answer | None) -> Works:
        """Levels that are finer than the answer, the finest first; all if there is none that promises a fix."""
        if not self._is_promising(answer):
            return self._works
        # Beside a coarse fix a finer level that does not fit is not missed, so its cost shall not fade.
        *finer, _ = self._works.items()
        affordable = self._query.scheduler.can_afford
        return {step: work for step, work in finer if self._is_coarse(answer) and affordable({step: work})}

    def _correlate(self, answer: Answer | None, step: Hashable) -> Answer:
        """The peak of one level, which sees more than a coarser one; of one place the greater evidence counts.

        Both peaks share the telemetry's errors, and so lie near each other if they are of one place.
        """
        found = self._find(step)
        if not isinstance(found, PeakCandidate):
            return found
        found = self._resting(found)
        if self._is_coarse(answer) and are_near(answer.fix, found.fix, self._ncc.options.exclusion_m):
            best = max(answer, found, key=nats)
            found = replace(best, fix=replace(found.fix, confidence=best.fix.confidence))
        return found

    def _resting(self, found: PeakCandidate) -> PeakCandidate:
        """The candidate; if it is coarse, it rests on a tilt that no picture confirmed."""
        rests_on_tilt = found.fix.stage == "coarse" and self._query.telemetry.has_tilt
        return replace(found, fix=with_tilt_doubt(self._query, found.fix)) if rests_on_tilt else found

    def _find(self, step: Hashable) -> PeakCandidate | NoFix:
        assert isinstance(step, tuple)
        return self._ncc.find(self._query, coarser=step[1])

    def _if_unseen(self, answer: Answer | None) -> Works:
        """Structure about a refused peak, once."""
        if not self._falls_short(answer) or answer.by_structure:
            return {}
        window = self._ncc.around(self._query, answer).window(answer.aligned)
        return {} if window is None else {_STRUCTURE: answer.aligned.work_px(window)}

    def _match_structure(self, answer: Answer | None, step: Hashable) -> Answer | None:
        """The peak of structure and grey levels together, in place of the refused one."""
        assert isinstance(answer, PeakCandidate)  # or it was not offered
        found = self._ncc.match_structure(self._query, answer)
        return None if found is None else self._resting(found)

    def _if_unrefined(self, answer: Answer | None) -> Works:
        """The pose of a peak, of which it is stronger evidence."""
        if not isinstance(answer, PeakCandidate) or answer.by_refinement or not self._ncc.can_refine(self._query):
            return {}
        is_last = answer.fix.stage == "fine" or answer.by_structure or self._falls_short(answer)
        offered = answer.counts and is_last  # of a coarse peak that suffices a finer level comes first
        return {_REFINEMENT: self._frame_px} if offered else {}

    def _refine(self, answer: Answer | None, step: Hashable) -> Answer:
        assert isinstance(answer, PeakCandidate)  # or it was not offered
        return self.refinement_of(answer).refine(answer)

    def _if_refused(self, answer: Answer | None) -> Works:
        """The search of headings and heights, if a peak is refused."""
        return {_HYPOTHESES: max(self._works.values())} if self._falls_short(answer) else {}

    def _search(self, answer: Answer | None, step: Hashable) -> Answer | None:
        """The best of all headings and heights within three sigmas, if structure confirms it.

        A compass near motors is often off by more than a patch tolerates.
        """
        found = self._ncc.find(self._query, widely=True)
        if isinstance(found, NoFix):
            return None
        again = self._ncc.match_structure(self._query, found)
        return again if is_accepted(again, self._query) else None

    def _is_coarse(self, answer: Answer | None) -> TypeGuard[PeakCandidate]:
        """Whether the answer is at reduced resolution, and promises a fix."""
        return self._is_promising(answer) and answer.fix.stage == "coarse"

    def _is_promising(self, answer: Answer | None) -> TypeGuard[PeakCandidate]:
        return isinstance(answer, PeakCandidate) and answer.promises(self._query.risk)

    def _falls_short(self, answer: Answer | None) -> TypeGuard[PeakCandidate]:
        return isinstance(answer, PeakCandidate) and not answer.suffices(self._query.risk)

    def refinement_of(self, found: PeakCandidate) -> Refinement:
        """Of the frame, with the heading and height of a candidate that a search fitted."""
        if found.is_fitted:
            return Refinement(self._query.at(found.aligned.pose), self._ncc.samples)
        return Refinement(self._query, self._ncc.samples, pictures=self._pictures)
