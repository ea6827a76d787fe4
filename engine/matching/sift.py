"""The SIFT method (Fig. 6): half scale, features of frame and map, matches lifted to 3D, PnP, refinement."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import TypeGuard

from engine.maps.landmarks import LandmarkMap
from engine.maps.samples import SampleMap
from engine.matching.evidence import Candidate
from engine.matching.explanation import Explanation, explain_features
from engine.matching.feature_pose import METHOD, MIN_VOTES, FeatureMatcher
from engine.matching.ladder import SHARES, Rung, Works, climb, rehearse
from engine.matching.method import Method
from engine.matching.query import Query
from engine.matching.refinement import CONFIRMING_CORRELATION, Refinement, with_unconfirmed_tilt
from engine.matching.views import coarser_scale, drawn_px
from engine.options import MatcherOptions, SiftOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import CPU, Device
from engine.values import Fix, NoFix, Result, Window

_FEW_SHARE = 0.5  # of the keypoints, if a pose is refined from few
_FEW, _REFINEMENT = "sift by few features", "refinement of sift"  # steps


class Sift(Method):
    """Scale-invariant features and PnP; needs neither height nor heading.

    Args:
        site: the map.
        device: where kornia's features are computed; the compiled ones are on the CPU.
        options: settings; uses ``options.sift`` and, for refinement, NCC's enhancement of the map.
        samples: of the map for the refinement, if another method already has them.
    """

    loops = (
        "map_points",
        "gauss_newton",
        "local_normalisation",
        "dense_loops",
        "pose_fit",
        "clusters",
        "nearest",
        "sift_refinement",
        "sift_descriptors",
        "sift_extrema",
    )

    def __init__(
        self, site: OrthoMap, device: Device, options: MatcherOptions, samples: SampleMap | None = None
    ) -> None:
        self.options = options.sift
        # kornia launches thousands of operations, which takes a GPU far longer than the compiled loops take.
        on = device if self.options.backend == "kornia" else CPU
        self.landmarks = LandmarkMap(site, on, self.options.backend)
        self._few = replace(
            self.options,
            max_keypoints=max(MIN_VOTES, round(self.options.max_keypoints * _FEW_SHARE)),
            keypoints_per_px=self.options.keypoints_per_px * _FEW_SHARE,
            upsample=1,
        )
        self._enhancement = replace(options.ncc, errors=options.sift.errors)
        if samples is None:
            samples = SampleMap(site, options.ncc.enhance_radius_px, options.ncc.score)
        self.samples = samples

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {"landmark tiles": self.landmarks.tiles.created, "sampled cells": self.samples.cells.created}

    def prepare(self) -> None:
        """Find the map's features on every level that is small enough, or load those of an earlier start."""
        if self.options.map_features == "prepared" and self.options.matcher is None:
            self.landmarks.prepare()

    def warmup(self, query: Query) -> None:
        """Run every variant of every step, so that it is compiled and its cost known."""
        efforts = Efforts(self, query)
        rehearse(query, efforts.few, None)
        for answer in rehearse(query, efforts.all, None):
            rehearse(query, Efforts(self, query).refinement, answer)
            if isinstance(answer, Fix) and self.can_refine(query):
                self._refinement(query).refine_from_coarser(answer)

    def warmup_search(self, query: Query) -> None:
        """Search the whole map."""
        if query.prior is None:
            self.locate(query)

    def locate(self, query: Query, agrees: Callable[[Fix], bool] | None = None) -> Result:
        """A refined fix by few features, else one by all at the highest resolution that time allows.

        Few features take a fifth of the time, and refinement restores the accuracy that their pose lacks.

        Args:
            query: the frame.
            agrees: whether a fix agrees with another method's. The fix is then for comparison: not refined by the
                grey levels that the other uses, and by all features if one by few does not agree.
        """
        efforts = Efforts(self, query, agrees)
        return efforts.settled(climb(query, METHOD, efforts.rungs))

    def few_options(self, query: Query) -> SiftOptions | None:
        """Of few features, at their scale; None if they are not wanted or the map has no such level."""
        height_m = query.telemetry.height_agl_m
        if query.prior is None or height_m is None or not self.can_refine(query):
            return None
        scale = coarser_scale(query, height_m, self.options.scale)
        return None if scale is None else replace(self._few, scale=scale)

    def find_few(self, query: Query, options: SiftOptions) -> Candidate | NoFix:
        """The pose by half as many keypoints, a level coarser and not upsampled."""
        return FeatureMatcher(query, self.landmarks, options).find_at_once()

    def can_refine(self, query: Query) -> bool:
        """Whether poses are refined: only with trusted telemetry over a surface model."""
        options, known = self.options, query.telemetry
        if not options.refine or not options.use_attitude or options.matcher is not None:
            return False
        is_known = known.height_agl_m is not None and known.grid_heading_deg is not None and known.has_tilt
        return is_known and query.site.has_surface

    def refined(self, query: Query, fix: Fix) -> Fix | None:
        """The fix with its pose refined, from a coarser level if necessary; None if that fails."""
        refinement = self._refinement(query)
        return refinement.refine_at_once(fix) or refinement.refine_from_coarser(fix)

    def _refinement(self, query: Query) -> Refinement:
        return Refinement(query, self.samples, self._enhancement)

    def explain(self, query: Query, window: Window) -> Explanation:
        """The matches in a window at the frame's own height and heading."""
        return explain_features(FeatureMatcher(query, self.landmarks, self.options), window)

    def find(self, query: Query, options: SiftOptions | None = None) -> Candidate | NoFix:
        """The pose of one frame, or a refusal if there is none.

        Args:
            query: the frame.
            options: replace the method's own.
        """
        return FeatureMatcher(query, self.landmarks, options or self.options).find()

    def judge(self, query: Query, found: Candidate | NoFix) -> Result:
        """The fix if there is a pose and it is accepted, else a refusal."""
        return FeatureMatcher(query, self.landmarks, self.options).judge(found)

    def works(self, query: Query) -> Works:
        """Shares of the usual scale, by the pixels of the matched picture, which determine the cost."""
        known, scale = query.telemetry, self.options.scale
        if query.prior is None or known.height_agl_m is None:
            step = "sift search" if query.prior is None else "sift heights"
        else:
            step = METHOD
        if known.height_agl_m is None or known.grid_heading_deg is None:
            return {(step, share): query.gray.size * (scale * share) ** 2 for share in SHARES}
        return {(step, share): drawn_px(query, known.height_agl_m, scale * share) for share in SHARES}

    def at_scale(self, query: Query, share: float) -> Result:
        """The fix by all features at a share of the usual scale, not refined; or its refusal."""
        options = self.options if share == 1.0 else replace(self.options, scale=self.options.scale * share)
        result = self.judge(query, self.find(query, options))
        return replace(result, stage="coarse") if share < 1.0 and isinstance(result, Fix) else result


class Efforts:
    """The efforts on one frame: the rungs of SIFT's ladder and what they leave to each other.

    Args:
        sift: the method.
        query: the frame.
        agrees: see :meth:`Sift.locate`.
    """

    def __init__(self, sift: Sift, query: Query, agrees: Callable[[Fix], bool] | None = None) -> None:
        self._sift, self._query, self._agrees = sift, query, agrees
        self._few: Candidate | None = None
        self._few_options = sift.few_options(query)
        self._is_settled = self._is_unrefinable = False
        self._works, frame_px = sift.works(query), float(query.gray.size)
        self.few = Rung(self._if_few_suffice, self._by_few)
        self.few_refined = Rung(
            lambda answer: {} if self._few is None or agrees else {_REFINEMENT: frame_px}, self._refine_few
        )
        self.all = Rung(lambda answer: {} if self._is_settled else self._works, self._by_all)
        self.refinement = Rung(
            lambda answer: {_REFINEMENT: frame_px} if self._is_refinable(answer) else {}, self._refine
        )

    @property
    def rungs(self) -> list[Rung]:
        """In their order."""
        return [self.few, self.few_refined, self.all, self.refinement]

    def settled(self, answer: Result) -> Result:
        """The ladder's answer; a fix by few features that nothing confirmed has a covariance for a wrong tilt.

        Few features of a coarse picture follow the telemetry's attitude.
        """
        if not self._is_by_few(answer) or self._is_settled:
            return answer
        return replace(with_unconfirmed_tilt(self._query, answer), stage="coarse")

    # ------------------------------------------------------------------------------------------------ rungs

    def _if_few_suffice(self, answer: Result | None) -> Works:
        """Few features, if time allows all of them as well, or only few."""
        if self._few_options is None:
            return {}
        (_, work), *_, (least, least_work) = self._works.items()
        scheduler = self._query.scheduler
        is_only = scheduler.has_fix or not scheduler.can_afford({least: least_work})
        if is_only or scheduler.can_afford({_FEW: work, least: least_work}):
            return {_FEW: work}
        scheduler.note_refusal(_FEW)
        return {}

    def _by_few(self, answer: Result | None, step: Hashable) -> Fix | None:
        """The fix by few features, if it is beyond doubt and agrees; one with less evidence may be refined."""
        assert self._few_options is not None  # or it was not offered
        found = self._sift.find_few(self._query, self._few_options)
        if isinstance(found, NoFix) or found.evidence.nats < self._query.needed_nats:
            return None
        self._few = found
        if not found.evidence.suffices(self._query.risk) or (self._agrees and not self._agrees(found.fix)):
            return None
        self._is_settled = self._agrees is not None
        return found.fix

    def _refine_few(self, answer: Result | None, step: Hashable) -> Fix | None:
        """The fix by few features refined, if they suffice or the picture confirms it."""
        assert self._few is not None  # or it was not offered
        refined = self._sift.refined(self._query, self._few.fix)
        self._is_unrefinable = refined is None
        suffices = self._few.evidence.suffices(self._query.risk)
        if refined is None or not (suffices or refined.score >= CONFIRMING_CORRELATION):
            return None
        self._is_settled = True
        return refined

    def _by_all(self, answer: Result | None, step: Hashable) -> Result:
        """The fix by all features, or their refusal."""
        assert isinstance(step, tuple)
        return self._sift.at_scale(self._query, step[1])

    def _is_refinable(self, answer: Result | None) -> bool:
        is_done = self._is_settled or self._is_unrefinable or self._agrees is not None
        return (
            isinstance(answer, Fix)
            and not self._is_by_few(answer)
            and not is_done
            and self._sift.can_refine(self._query)
        )

    def _is_by_few(self, answer: Result | None) -> TypeGuard[Fix]:
        return self._few is not None and answer is self._few.fix

    def _refine(self, answer: Result | None, step: Hashable) -> Fix | None:
        """The fix by all features refined."""
        assert isinstance(answer, Fix)
        return self._sift.refined(self._query, answer)
