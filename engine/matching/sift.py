"""The SIFT method (Fig. 6): half scale, features of frame and map, matches lifted to 3D, PnP, refinement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from engine.features import chosen_backend, prepare_plans
from engine.maps.landmarks import LandmarkMap
from engine.maps.prepared import enhanced_part
from engine.maps.samples import SampleMap
from engine.matching.align import SIDE_STEP_PX
from engine.matching.evidence import is_beyond_doubt, nats_of
from engine.matching.explanation import Explanation, explain_features
from engine.matching.feature_pose import METHOD, MIN_VOTES, FeatureMatcher, PoseCandidate
from engine.matching.method import Method
from engine.matching.query import Query
from engine.matching.refinement import MIN_CORRELATION_AT_ONCE, Refinement, improved, with_unconfirmed_tilt
from engine.matching.views import coarser_scale, drawn_px
from engine.options import MatcherOptions, SiftOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.runtime.scheduler import OutOfTime
from engine.runtime.tensors import torch
from engine.values import Fix, NoFix, Reason, Result, Window

_REDUCED = (1.0, 0.7, 0.5)  # of the scale at which the frame is matched; the smaller if time is short
_FEW_SHARE = 0.5  # of the keypoints, if a pose is refined from few
_FEW, _REFINEMENT = "sift by few features", "refinement of sift"  # steps


class Sift(Method):
    """Scale-invariant features and PnP; needs neither height nor heading.

    Args:
        site: the map.
        device: where tensors live.
        options: settings; uses ``options.sift`` and, for refinement, NCC's enhancement of the map.
        samples: of the map for the refinement, if another method already has them.
    """

    loops = (
        "map_points",
        "gauss_newton",
        "local_normalisation",
        "lattice",
        "dense_loops",
        "pose_fit",
        "clusters",
        "nearest",
        "sift_selection",
        "sift_refinement",
        "sift_descriptors",
        "sift_extrema",
    )

    def __init__(
        self, site: OrthoMap, device: Device, options: MatcherOptions, samples: SampleMap | None = None
    ) -> None:
        self.options = options.sift
        self.landmarks = LandmarkMap(site, device, self.options.backend)
        self._few = replace(
            self.options,
            max_keypoints=max(MIN_VOTES, round(self.options.max_keypoints * _FEW_SHARE)),
            keypoints_per_px=self.options.keypoints_per_px * _FEW_SHARE,
            upsample=1,
        )
        self._enhancement = replace(options.ncc, errors=options.sift.errors)
        if samples is None:
            radius_px, score = options.ncc.enhance_radius_px, options.ncc.score
            samples = SampleMap(site, partial(enhanced_part, site, radius_px, score))
        self.samples = samples

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {"landmark tiles": self.landmarks.created, "sampled cells": self.samples.created}

    def prepare(self) -> None:
        """Find the map's features on every level that is small enough, or load those of an earlier start."""
        if self.options.map_features == "prepared" and self.options.matcher is None:
            self.landmarks.prepare()

    def warmup(self, query: Query) -> None:
        """Run every variant of every step, so that it is compiled and its cost known."""
        # An orthophoto's side has at most twice the frame's pixels; half as many more if turned by 45 degrees.
        longest_px = 3 * max(query.gray.shape)
        if chosen_backend(self.options.backend, torch.device(query.device)) == "compiled":
            prepare_plans(range(SIDE_STEP_PX, longest_px + 1, SIDE_STEP_PX))
        self._by_few_features(query)
        for share, work_px in self._work_px(query).items():
            with query.scheduler.costed(("sift", share), work_px):
                result = self._at_scale(query, share)
            if isinstance(result, Fix) and self._can_refine(query):
                self._refined(query, result)
                Refinement(query, self.samples, self._enhancement).refine_from_coarser(result)

    def warmup_search(self, query: Query) -> None:
        """Search the whole map."""
        if query.prior is None:
            self.locate(query)

    def locate(self, query: Query) -> Result:
        """A refined fix by few features, else one by all at the highest resolution that time allows.

        Few features take a fifth of the time, and refinement restores the accuracy that their pose lacks.
        """
        few = self._by_few_features(query)
        if few is None:
            result = self._by_all_features(query)
            return self._refined(query, result) if isinstance(result, Fix) else result
        refined = self._refined(query, few)
        is_refined, is_certain = refined.stage == "refined", _is_certain(query, few)
        if is_refined and (is_certain or refined.score >= MIN_CORRELATION_AT_ONCE):
            return refined
        result = self._by_all_after(query, few) if is_certain else self._by_all_features(query)
        return self._refined(query, result) if is_refined and isinstance(result, Fix) else result

    def confirm(self, query: Query, agrees: Callable[[Fix], bool]) -> Result:
        """A fix to compare with another method's: not refined by the grey levels that the other uses.

        Args:
            query: the frame.
            agrees: whether a fix agrees with the other method's. If one by few features does not, all are used.
        """
        few = self._by_few_features(query)
        if few is not None and _is_certain(query, few) and agrees(few):
            return few
        return self._by_all_features(query)

    def _by_few_features(self, query: Query) -> Fix | None:
        """A fix by half as many keypoints, a level coarser and not upsampled; None if it is not accepted."""
        scale = self._few_scale(query)
        if scale is None or not self._has_time_for_few(query):
            return None
        with query.scheduler.costed(_FEW, self._work_px(query)[1.0]):
            found = FeatureMatcher(query, self.landmarks, replace(self._few, scale=scale)).find_at_once()
        if isinstance(found, NoFix) or found.evidence.nats < query.needed_nats:
            return None
        return found.fix

    def _few_scale(self, query: Query) -> float | None:
        """The frame's scale for few features; None if they are not wanted or the map has no such level."""
        height_m = query.telemetry.height_agl_m
        if query.prior is None or height_m is None or not self.options.upright or not self._can_refine(query):
            return None
        return coarser_scale(query, height_m, self.options.scale)

    def _has_time_for_few(self, query: Query) -> bool:
        """Whether time allows few features first and then all, or only few."""
        scheduler, works = query.scheduler, self._work_px(query)
        if scheduler.can_afford({_FEW: works[1.0], ("sift", _REDUCED[-1]): works[_REDUCED[-1]]}):
            return True
        is_only = scheduler.has_fix or scheduler.first_affordable("sift", works) is None
        if is_only and scheduler.can_afford({_FEW: works[1.0]}):
            return True
        scheduler.note_refusal(_FEW)
        return False

    def _by_all_after(self, query: Query, few: Fix) -> Result:
        """A fix by all features; without time the fix by few, with a covariance for a wrong tilt.

        Few features of a coarse picture follow the telemetry's attitude, which nothing has confirmed.
        """
        try:
            with query.scheduler.with_fix():
                result = self._by_all_features(query)
        except OutOfTime:
            result = query.refuse_late(METHOD, ("sift", _REDUCED[-1]))
        if isinstance(result, Fix) or result.reason is not Reason.LATE:
            return result
        return replace(with_unconfirmed_tilt(query, few), stage="coarse")

    def _by_all_features(self, query: Query) -> Result:
        """An unrefined fix by all keypoints, at the highest frame resolution that time allows."""
        step = "sift"
        if query.prior is None or query.telemetry.height_agl_m is None:
            step = "sift search" if query.prior is None else "sift heights"
        works = self._work_px(query)
        share = query.scheduler.first_affordable(step, works)
        if share is None:
            return query.refuse_late(METHOD, (step, _REDUCED[-1]))
        with query.scheduler.costed((step, share), works[share]):
            return self._at_scale(query, share)

    def _can_refine(self, query: Query) -> bool:
        """Whether poses are refined: only with trusted telemetry over a surface model."""
        options, known = self.options, query.telemetry
        if not options.refine or not options.use_attitude or options.matcher is not None:
            return False
        is_known = known.height_agl_m is not None and known.grid_heading_deg is not None and known.has_tilt
        return is_known and query.site.has_surface

    def _refined(self, query: Query, fix: Fix) -> Fix:
        """The fix with its pose refined, if that is possible and affordable."""
        if not self._can_refine(query):
            return fix
        refinement = Refinement(query, self.samples, self._enhancement)

        def improve(fix: Fix) -> Fix:
            return refinement.refine_at_once(fix) or refinement.refine_from_coarser(fix) or fix

        return improved(query, fix, _REFINEMENT, improve)

    def explain(self, query: Query, window: Window) -> Explanation:
        """The matches in a window at the frame's own height and heading."""
        return explain_features(FeatureMatcher(query, self.landmarks, self.options), window)

    def find(self, query: Query, options: SiftOptions | None = None) -> PoseCandidate | NoFix:
        """The pose of one frame, or a refusal if there is none.

        Args:
            query: the frame.
            options: replace the method's own.
        """
        return FeatureMatcher(query, self.landmarks, options or self.options).find()

    def judge(self, query: Query, found: PoseCandidate) -> Result:
        """The fix if its pose is accepted, else a refusal."""
        return FeatureMatcher(query, self.landmarks, self.options).judge(found)

    def _work_px(self, query: Query) -> dict[float, float]:
        """Pixels of the matched picture, which determine the cost, per share of the usual scale."""
        known, scale = query.telemetry, self.options.scale
        if not self.options.upright or known.height_agl_m is None or known.grid_heading_deg is None:
            return {share: query.gray.size * (scale * share) ** 2 for share in _REDUCED}
        return {share: drawn_px(query, known.height_agl_m, scale * share) for share in _REDUCED}

    def _at_scale(self, query: Query, share: float) -> Result:
        options = self.options if share == 1.0 else replace(self.options, scale=self.options.scale * share)
        found = self.find(query, options)
        result = found if isinstance(found, NoFix) else self.judge(query, found)
        return replace(result, stage="coarse") if share < 1.0 and isinstance(result, Fix) else result


def _is_certain(query: Query, fix: Fix) -> bool:
    """Whether a pose is so probable that no null hypothesis is needed."""
    assert fix.confidence is not None  # each pose has one
    return is_beyond_doubt(nats_of(fix.confidence), query.risk)
