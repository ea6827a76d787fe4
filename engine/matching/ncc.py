"""The NCC method (Fig. 5): grey, rectify by height and heading, enhance, correlate in the window, peak, refine."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace

import numpy as np

from engine.maps.prepared import PreparedMap
from engine.maps.samples import SampleMap
from engine.maps.tiles import WHOLE_LEVEL_PX
from engine.matching import hypothesis_search
from engine.matching.acceptance import agree_in_place, edge_refusal, offset_between_m, peak_refusal
from engine.matching.correlation import METHOD, Aligned, Correlator, expected_window_px
from engine.matching.explanation import Explanation, explain_correlation
from engine.matching.ladder import Rung, Works, climb, is_coarse, is_late, rehearse
from engine.matching.method import Method
from engine.matching.peak_evidence import (
    PeakCandidate,
    candidate_of,
    early_stop,
    null_tested,
    places_in,
)
from engine.matching.query import Query
from engine.matching.refinement import Refinement, with_unconfirmed_tilt
from engine.matching.structure import match_structure
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.values import Fix, NoFix, Prior, Reason, Result, Window

MAX_WINDOW_PX = WHOLE_LEVEL_PX
"""A window of a large map with more pixels than this is searched coarse to fine, as a whole map is."""
_SEARCH, _STRUCTURE, _HYPOTHESES = "ncc search", "ncc structure", "ncc hypotheses"  # steps
_AT_ONCE, _REFINEMENT = "refinement at once", "refinement"
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
        "lower_plane",
        "dense_loops",
    )

    def __init__(self, site: OrthoMap, device: Device, options: MatcherOptions) -> None:
        self.options = options.ncc
        enhancement = self.options.enhance_radius_px, self.options.score
        self.prepared = PreparedMap(site, device, *enhancement)
        self.samples = SampleMap(site, *enhancement)

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {"map regions": self.prepared.regions.created, "sampled cells": self.samples.cells.created}

    def warmup(self, query: Query) -> None:
        """Run every variant of every step but the searches, so that it is compiled and its cost known."""
        untilted = replace(query, frame=replace(query.frame, roll_deg=None, pitch_deg=None))
        for efforts in (Efforts(self, query), Efforts(self, untilted)):
            for answer in rehearse(efforts.query, efforts.levels, None):
                rehearse(efforts.query, efforts.refinement, answer)
        efforts = Efforts(self, query)
        efforts.refuse(self.find(query))  # as if it were refused
        rehearse(query, efforts.structure, None)

    def warmup_search(self, query: Query) -> None:
        """Search the whole map, or headings and heights about the prior."""
        if query.prior is None:
            self.locate(query)
        else:
            efforts = Efforts(self, query)
            efforts.refuse(self.find(query))
            rehearse(query, efforts.search, None)
            rehearse(query, efforts.structure, None)

    def locate(self, query: Query, *, widely: bool = True) -> Result:
        """The fix of a coarse peak whose pose the picture confirms, else of the finest level that time allows.

        Args:
            query: the frame.
            widely: whether to search for the heading and height of a frame that would be refused.
        """
        if query.telemetry.height_agl_m is None:
            return self._refuse_without_height(query)
        efforts = Efforts(self, query)
        return efforts.settled(climb(query, METHOD, efforts.rungs(widely=widely)))

    def works(self, query: Query) -> Works:
        """Correlation on each level, the frame's own first; or the search of the whole map."""
        if query.prior is None:
            return {(_SEARCH, 0): float(query.site.width_px * query.site.height_px)}
        return {(METHOD, coarser): work for coarser, work in expected_window_px(query, self.options).items()}

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
            peak = correlator.search(aligned, window, early_stop(correlator, aligned, window))
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
        return found if searched else found.untested(query.risk)

    def judge(self, query: Query, found: PeakCandidate | NoFix) -> Result:
        """The fix if there is a peak with enough evidence, else a refusal."""
        if isinstance(found, NoFix):
            return found
        peak, evidence = found.peak, found.evidence
        if found.is_inside and evidence.suffices(query.risk):
            return found.fix
        why = peak_refusal(peak.score, evidence, query.risk) if found.is_inside else edge_refusal(peak.score)
        return query.refuse(*why, METHOD, score=peak.score, window=found.fix.window)

    def match_structure(self, query: Query, found: PeakCandidate, window: Window) -> PeakCandidate | None:
        """The highest peak by structure as well, see :mod:`engine.matching.structure`.

        Args:
            query: the frame.
            found: the candidate by grey levels.
            window: to match in; the fix names that of the candidate in any case.

        Returns:
            PeakCandidate | None: None if the template is nowhere on the map.
        """
        with query.scheduler.stage("structure"):
            return match_structure(self._correlator(query), found, window)

    def surroundings(self, query: Query, found: PeakCandidate) -> Window:
        """The window to match structure in: the first one's; after a search, the surroundings of the place."""
        if found.evidence.is_tested:
            return found.fix.window
        place = Prior(east_m=found.fix.east_m, north_m=found.fix.north_m, sigma_m=_SURROUNDINGS_SIGMA_M)
        return self._correlator(replace(query, prior=place)).window(found.aligned) or found.fix.window

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
        return query.refuse_flat(METHOD)

    def _align(self, correlator: Correlator, coarser: int) -> Aligned | NoFix:
        """The frame with its own height and heading."""
        query, pose = correlator.query, correlator.query.telemetry
        level = min(query.level_of(pose.known_height_m) + coarser, query.site.levels - 1)
        with query.scheduler.stage("align"):
            return correlator.align(pose, level)


class Efforts:
    """The efforts on one frame: the rungs of NCC's ladder and what they leave to each other.

    Args:
        ncc: the method.
        query: the frame.
    """

    def __init__(self, ncc: Ncc, query: Query) -> None:
        self.query, self._ncc = query, ncc
        self._accepted: PeakCandidate | None = None  # the peak of the answer
        self._refused: PeakCandidate | None = None  # the newest peak, if it was not accepted
        self._is_new = False  # whether its structure was not matched yet
        self._refusal: NoFix | None = None  # of the frame at its own heading and height
        self._doubtful: PeakCandidate | None = None  # that it refuses, which a refined pose may confirm
        self._works, frame_px = ncc.works(query), float(query.gray.size)
        self.coarsest = Rung(self._if_coarse_suffices, self._search_coarsely)
        self.at_once = Rung(lambda answer: {_AT_ONCE: frame_px} if is_coarse(answer) else {}, self._refine_at_once)
        self.levels = Rung(self._finer, self._correlate)
        self.structure = Rung(self._if_unseen, self._match_structure)
        self.doubted = Rung(
            lambda answer: {_REFINEMENT: frame_px} if self._is_doubtful(answer) else {}, self._refine_doubtful
        )
        self.search = Rung(self._if_refused, self._search)
        self.refinement = Rung(
            lambda answer: {_REFINEMENT: frame_px} if self._is_refinable(answer) else {}, self._refine
        )

    def rungs(self, *, widely: bool) -> list[Rung]:
        """In their order; ``widely`` is that of :meth:`Ncc.locate`."""
        wide = [self.search, self.structure] if widely else []
        own = [self.coarsest, self.at_once, self.levels, self.structure, self.doubted]
        return [*own, *wide, self.refinement]

    def settled(self, answer: Result) -> Result:
        """The ladder's answer, or the refusal of the finer level if that contradicts a coarse fix."""
        refusal = self._refusal
        if not is_coarse(answer) or refusal is None or is_late(refusal):
            return answer
        is_same = refusal.match is not None and self._is_same(answer, refusal.match)
        return answer if is_same else refusal

    def refuse(self, found: PeakCandidate | NoFix) -> None:
        """Take a peak as refused."""
        self._refused, self._is_new = (found, True) if isinstance(found, PeakCandidate) else (None, False)

    # ------------------------------------------------------------------------------------------------ rungs

    def _if_coarse_suffices(self, answer: Result | None) -> Works:
        """The coarsest level, if refinement may start from its peak and there is time for both.

        If roll, pitch or the ground's slope is unknown, the pose depends on the peak, which must then be fine.
        """
        query, (*finer, (coarsest, work)) = self.query, self._works.items()
        is_wide = query.site.is_large and work > MAX_WINDOW_PX
        if is_wide or not (finer and self._can_confirm and query.scheduler.can_afford({coarsest: work})):
            return {}
        if not query.scheduler.can_afford({coarsest: work, _AT_ONCE: float(query.gray.size)}):
            query.scheduler.note_refusal(_AT_ONCE)
            return {}
        return {coarsest: work}

    def _finer(self, answer: Result | None) -> Works:
        """Every level that is finer than the answer."""
        if answer is not None and not is_coarse(answer):
            return {}
        if answer is None:
            return self._works
        # Beside a coarse fix a finer level that does not fit is not missed, so its cost shall not fade.
        *finer, _ = self._works.items()
        return {step: work for step, work in finer if self.query.scheduler.can_afford({step: work})}

    def _search_coarsely(self, answer: Result | None, step: Hashable) -> Result | None:
        """The peak of the coarsest level, if it is accepted; a refusal says nothing, as finer levels show more."""
        result = self._ncc.judge(self.query, self._find(step))
        return replace(result, stage="coarse") if isinstance(result, Fix) else None

    def _correlate(self, answer: Result | None, step: Hashable) -> Result | None:
        """The peak of one level."""
        found = self._find(step)
        self.refuse(found)
        return self._judged(answer, found, found)

    def _find(self, step: Hashable) -> PeakCandidate | NoFix:
        assert isinstance(step, tuple)
        return self._ncc.find(self.query, coarser=step[1])

    def _match_structure(self, answer: Result | None, step: Hashable) -> Result | None:
        """Structure where the refused peak lies."""
        query, first, self._is_new = self.query, self._refused, False
        assert first is not None  # or it was not offered
        again = self._ncc.match_structure(query, first, self._ncc.surroundings(query, first))
        if again is None:
            return None
        if not first.searched:
            return self._judged(answer, again, first)
        result = self._ncc.judge(query, again)
        if isinstance(result, NoFix):
            return None
        self.query, self._refused, self._accepted = query.at(again.aligned.pose), None, again
        return result

    def _judged(
        self, answer: Result | None, found: PeakCandidate | NoFix, first: PeakCandidate | NoFix
    ) -> Result | None:
        """The fix of a peak, or its refusal, which names the match by grey levels and leaves a coarse fix."""
        query = self.query
        result = self._ncc.judge(query, found)
        if isinstance(result, NoFix):
            self._refusal = replace(result, match=None if isinstance(first, NoFix) else first.fix)
            if isinstance(found, PeakCandidate) and found.evidence.is_tested:
                self._doubtful = found  # structure's, if it was matched: it sees what grey levels see, and more
            return None if isinstance(answer, Fix) else self._refusal
        assert isinstance(found, PeakCandidate)
        self._refused, self._accepted = None, found
        if found.aligned.level == query.level_of(query.telemetry.known_height_m):
            return result
        result = replace(result, stage="coarse")
        return with_unconfirmed_tilt(query, result) if is_coarse(answer) else result

    def _if_unseen(self, answer: Result | None) -> Works:
        """Structure about a refused peak, once."""
        found = self._refused
        if found is None or not self._is_new:
            return {}
        return {_STRUCTURE: found.aligned.work_px(self._ncc.surroundings(self.query, found))}

    def _if_refused(self, answer: Result | None) -> Works:
        """The search of headings and heights, if a peak is refused."""
        return {} if self._refused is None else {_HYPOTHESES: max(self._works.values())}

    def _search(self, answer: Result | None, step: Hashable) -> None:
        """The best of all headings and heights within three sigmas; only structure can accept it.

        A compass near motors is often off by more than a patch tolerates.
        """
        self.refuse(self._ncc.find(self.query, widely=True))

    def _refine_at_once(self, answer: Result | None, step: Hashable) -> Fix:
        """The pose of a coarse peak refined, or the peak with a tilt that nothing confirmed."""
        assert isinstance(answer, Fix)
        return self._refinement.refine_at_once(answer) or with_unconfirmed_tilt(self.query, answer)

    def _refine(self, answer: Result | None, step: Hashable) -> Result:
        """The pose of a fine peak refined."""
        assert isinstance(answer, Fix)
        assert self._accepted is not None  # a fine peak was
        return self._refinement.refine(replace(self._accepted, fix=answer))

    def _is_refinable(self, answer: Result | None) -> bool:
        return isinstance(answer, Fix) and answer.stage == "fine" and self._ncc.can_refine(self.query)

    def _is_doubtful(self, answer: Result | None) -> bool:
        """Whether a refused peak lacks no more evidence than a refined pose over a surface model gives."""
        found = self._doubtful
        if isinstance(answer, Fix) or found is None or not found.is_inside or not self._can_confirm:
            return False
        return replace(found.evidence, refined=True).suffices(self.query.risk)

    def _refine_doubtful(self, answer: Result | None, step: Hashable) -> Fix | None:
        """The pose of a refused peak, if it can be refined."""
        assert self._doubtful is not None  # or it was not offered
        refined = self._refinement.refine(self._doubtful)
        if isinstance(refined, NoFix):
            return None
        self._refused = None
        return refined

    @property
    def _can_confirm(self) -> bool:
        """Whether refinement may confirm a place: with a known attitude over a surface model."""
        query = self.query
        return query.telemetry.has_tilt and query.site.has_surface and self._ncc.can_refine(query)

    @property
    def _refinement(self) -> Refinement:
        return Refinement(self.query, self._ncc.samples, self._ncc.options)

    def _is_same(self, coarse: Fix, fine: Fix) -> bool:
        """Whether two peaks are of one place, so that neither is the other's rival."""
        distance_m = float(np.hypot(*offset_between_m(coarse, fine)))
        return distance_m < self._ncc.options.exclusion_m and agree_in_place(coarse, fine)
