"""The SIFT method (Fig. 6): half scale, features of frame and map, matches lifted to 3D, PnP, refinement."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace
from functools import partial

from engine.maps.landmarks import LandmarkMap
from engine.maps.samples import SampleMap
from engine.matching.candidates import PoseCandidate
from engine.matching.evidence import is_beyond_doubt
from engine.matching.feature_pose import METHOD, FeatureMatcher
from engine.matching.for_reports import Explanation, explain_features
from engine.matching.ladder import SHARES, Answer, Rung, Works, climb, is_accepted, rehearse
from engine.matching.method import Method
from engine.matching.pnp import MIN_INLIERS
from engine.matching.query import Query
from engine.matching.refinement import CONFIRMING_CORRELATION, Refinement, with_tilt_doubt
from engine.matching.views import coarser_scale, drawn_px
from engine.options import MatcherOptions, SiftOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import CPU, Device
from engine.values import Fix, NoFix, Window

_FEW_SHARE = 0.5  # of the keypoints, if a pose is refined from few
_FEW, _REFINEMENT = "sift by few features", "refinement of sift"  # steps


class Sift(Method):
    """Scale-invariant features and PnP; needs neither height nor heading.

    Args:
        site: the map.
        device: where kornia's features are computed; the compiled ones are on the CPU.
        options: settings; uses ``options.sift``.
        samples: of the map for the refinement, if another method already has them.
    """

    name = METHOD
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
        self.samples = SampleMap(site) if samples is None else samples

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {"landmark tiles": self.landmarks.tiles.created, "sampled cells": self.samples.cells.created}

    def prepare(self) -> None:
        """Find the map's features on every level that is small enough, or load those of an earlier start."""
        if self.options.matcher is None:
            self.landmarks.prepare()

    def warmup(self, query: Query) -> None:
        """Run every variant of every step, so that it is compiled and its cost known."""
        rungs = _Rungs(self, query)
        rehearse(query, rungs.few, None)
        for answer in rehearse(query, rungs.all, None):
            rehearse(query, rungs.refinement, answer)
            if is_accepted(answer, query) and self.can_refine(query):
                Refinement(query, self.samples).rehearse(answer.fix)

    def warmup_search(self, query: Query) -> None:
        """Search the whole map."""
        if query.prior is None:
            self.locate(query)

    def locate(self, query: Query) -> Answer:
        """A refined pose by few features, else one by all at the highest resolution that time allows.

        Few features take a fifth of the time, and refinement restores the accuracy that their pose lacks.
        """
        return climb(query, self.rungs(query))[METHOD]

    def rungs(self, query: Query) -> list[Rung]:
        """Its rungs, cheap ones first."""
        rungs = _Rungs(self, query)
        return [rungs.few, rungs.refinement, rungs.all, rungs.refinement, rungs.doubted]

    def few_options(self, query: Query) -> SiftOptions | None:
        """Half as many keypoints, a level coarser, not upsampled; None if unwanted or without such a level."""
        options, height_m = self.options, query.telemetry.height_agl_m
        if query.prior is None or height_m is None or not self.can_refine(query):
            return None
        scale = coarser_scale(query, height_m, options.scale)
        if scale is None:
            return None
        keypoints = max(MIN_INLIERS, round(options.max_keypoints * _FEW_SHARE))
        per_px = options.keypoints_per_px * _FEW_SHARE
        return replace(options, max_keypoints=keypoints, keypoints_per_px=per_px, upsample=1, scale=scale)

    def can_refine(self, query: Query) -> bool:
        """Whether poses are refined: only with trusted telemetry over a surface model."""
        options, known = self.options, query.telemetry
        if not options.refine or not options.use_attitude or options.matcher is not None:
            return False
        is_known = known.height_agl_m is not None and known.grid_heading_deg is not None and known.has_tilt
        return is_known and query.site.has_surface

    def refined(self, query: Query, candidate: PoseCandidate) -> Fix | None:
        """The fix with its pose refined; None if that fails, or chance may have given that pose as well."""
        drawn = query if candidate.drawn_at is None else query.at(candidate.drawn_at)
        refinement = Refinement(drawn, self.samples)
        found = refinement.refine_pose(candidate.fix)
        if found is None or not found.is_consistent:
            return None
        counts = found.is_clear or is_beyond_doubt(refinement.surprise_of(found), query.risk)
        return found.fix if counts else None

    def explain(self, query: Query, window: Window) -> Explanation:
        """The matches in a window at the frame's own height and heading."""
        return explain_features(FeatureMatcher(query, self.landmarks, self.options), window)

    def works(self, query: Query) -> Works:
        """Shares of the usual scale, by the pixels of the matched picture, which determine the cost."""
        known, scale = query.telemetry, self.options.scale
        step = METHOD if known.height_agl_m is not None else "sift heights"
        if query.prior is None:
            step = "sift search"
        if known.height_agl_m is None or known.grid_heading_deg is None:
            return {(step, share): query.gray.size * (scale * share) ** 2 for share in SHARES}
        return {(step, share): drawn_px(query, known.height_agl_m, scale * share) for share in SHARES}

    def at_scale(self, query: Query, share: float, *, doubts_tilt: bool = False) -> PoseCandidate | NoFix:
        """The pose by all features at a share of the usual scale, not refined."""
        options = self.options if share == 1.0 else replace(self.options, scale=self.options.scale * share)
        found = FeatureMatcher(query, self.landmarks, options, doubts_tilt=doubts_tilt).find()
        return found if share == 1.0 or isinstance(found, NoFix) else found.coarse()


class _Rungs:
    """The ladder of one frame."""

    def __init__(self, sift: Sift, query: Query) -> None:
        self._sift, self._query = sift, query
        self._few_options = sift.few_options(query)
        self._works = sift.works(query)
        self.few = Rung(METHOD, "few features", self._if_few_suffice, self._by_few)
        self.all = Rung(METHOD, "all features", self._if_few_do_not_suffice, self._by_all)
        self.refinement = Rung(METHOD, "pose", self._if_refinable, self._refine)
        by_matches = partial(self._by_all, doubts_tilt=True)
        self.doubted = Rung(METHOD, "all features, tilt doubted", self._if_unconfirmed, by_matches)

    def _if_few_suffice(self, answer: Answer | None) -> Works:
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

    def _by_few(self, answer: Answer | None, step: Hashable) -> Answer | None:
        """The pose by few features if it promises a fix, to be refined; it follows the stated attitude."""
        query, options = self._query, self._few_options
        assert options is not None  # or it was not offered
        found = FeatureMatcher(query, self._sift.landmarks, options).find_at_once()
        if isinstance(found, NoFix) or not found.promises(query.risk):
            return None
        return replace(found, fix=with_tilt_doubt(query, found.fix), is_quick=True).coarse()

    def _if_few_do_not_suffice(self, answer: Answer | None) -> Works:
        is_left = isinstance(answer, PoseCandidate) and answer.is_quick and not answer.refinement_failed
        return self._works if answer is None or is_left else {}

    def _by_all(self, answer: Answer | None, step: Hashable, *, doubts_tilt: bool = False) -> Answer:
        """The pose by all features; if the tilt is doubted, it does not rest on the stated one."""
        assert isinstance(step, tuple)
        return self._sift.at_scale(self._query, step[1], doubts_tilt=doubts_tilt)

    def _if_unconfirmed(self, answer: Answer | None) -> Works:
        """All features without the stated tilt, if a refinement has failed, which makes that doubtful."""
        return self._works if isinstance(answer, PoseCandidate) and answer.refinement_failed else {}

    def _if_refinable(self, answer: Answer | None) -> Works:
        """The pose of few features that promise a fix, or of all that suffice, unless a refinement has failed."""
        if not isinstance(answer, PoseCandidate) or answer.refinement_failed or answer.fix.stage == "refined":
            return {}
        is_wanted = answer.is_quick or is_accepted(answer, self._query)
        offered = is_wanted and self._sift.can_refine(self._query)
        return {_REFINEMENT: float(self._query.gray.size)} if offered else {}

    def _refine(self, answer: Answer | None, step: Hashable) -> Answer | None:
        """The pose refined, if its features are beyond doubt or the picture confirms it."""
        assert isinstance(answer, PoseCandidate)  # or it was not offered
        refined = self._sift.refined(self._query, answer)
        if refined is None:
            return replace(answer, refinement_failed=True)
        if not (is_accepted(answer, self._query) or refined.score >= CONFIRMING_CORRELATION):
            return None
        return replace(answer, fix=refined, is_quick=False, evidence=replace(answer.evidence, is_tested=True))
