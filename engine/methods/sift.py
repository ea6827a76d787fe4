"""The SIFT method (Fig. 6): half scale, features of frame and map, matches lifted to 3D, PnP with RANSAC."""

from __future__ import annotations

from dataclasses import replace

from engine.align import SIDE_STEP_PX
from engine.device import Device
from engine.features import prepare_plans
from engine.indexes.landmarks import LandmarkMap
from engine.methods.explanation import Explanation, explain_features
from engine.methods.feature_pose import METHOD, FeatureMatcher, PoseCandidate
from engine.methods.method import Method
from engine.methods.options import MatcherOptions, SiftOptions
from engine.methods.query import Query
from engine.orthomap import OrthoMap
from engine.tensors import torch
from engine.values import Fix, NoFix, Reason, Result, Window

_REDUCED = (1.0, 0.7, 0.5)  # of the scale at which the frame is matched, the smaller where time is short


class Sift(Method):
    """Scale-invariant features and PnP; needs neither height nor heading.

    Args:
        site: the map.
        device: where tensors live.
        options: settings; ``options.sift`` counts.
    """

    def __init__(self, site: OrthoMap, device: Device, options: MatcherOptions) -> None:
        self.options = options.sift
        self.landmarks = LandmarkMap(site, device)

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {"landmark tiles": self.landmarks.created}

    def prepare(self) -> None:
        """Find the map's features on every level that is small enough, or load those of an earlier start."""
        if self.options.map_features == "prepared" and self.options.matcher is None:
            self.landmarks.prepare()

    def warmup(self, query: Query) -> None:
        """Run every variant of every step, so that it is compiled and its cost known."""
        # A side of an orthophoto has at most twice the frame's pixels; turned by 45 degrees half as many more.
        longest_px = 3 * max(query.gray.shape)
        prepare_plans(range(SIDE_STEP_PX, longest_px + 1, SIDE_STEP_PX), torch.device(query.device))
        for share, work_px in self._work_px(query).items():
            with query.scheduler.costed("sift", work_px):
                self._at_scale(query, share)

    def warmup_search(self, query: Query) -> None:
        """Search the whole map."""
        if query.prior is None:
            self.locate(query)

    def locate(self, query: Query) -> Result:
        """A fix at the highest resolution of the frame that there is time for."""
        step = "sift"
        if query.prior is None or query.telemetry.height_agl_m is None:
            step = "sift search" if query.prior is None else "sift heights"
        works = self._work_px(query)
        share = query.scheduler.first_affordable(step, works)
        if share is None:
            return query.refuse_late(METHOD, step)
        with query.scheduler.costed(step, works[share]):
            return self._at_scale(query, share)

    def explain(self, query: Query, window: Window) -> Explanation:
        """The matches in a window at the frame's own height and heading."""
        return explain_features(FeatureMatcher(query, self.landmarks, self.options), window)

    def find(self, query: Query, options: SiftOptions | None = None) -> PoseCandidate | NoFix:
        """The pose of one frame, or a refusal where there is none.

        Args:
            query: the frame.
            options: in place of the method's own.
        """
        return FeatureMatcher(query, self.landmarks, options or self.options).find()

    def judge(self, query: Query, found: PoseCandidate) -> Result:
        """The fix where its pose is accepted, else a refusal; an improbable pose comes with it as evidence."""
        result = FeatureMatcher(query, self.landmarks, self.options).judge(found)
        # What the null hypothesis reaches as well (ambiguous) is no evidence, however probable it looks.
        if isinstance(result, NoFix) and result.reason is Reason.BAD_POSE:
            return replace(result, candidates=(found.fix,))
        return result

    def _work_px(self, query: Query) -> dict[float, float]:
        """Pixels of the reduced frame, to which the cost is proportional, by the share of the usual scale."""
        return {share: query.gray.size * (self.options.scale * share) ** 2 for share in _REDUCED}

    def _at_scale(self, query: Query, share: float) -> Result:
        options = self.options if share == 1.0 else replace(self.options, scale=self.options.scale * share)
        found = self.find(query, options)
        result = found if isinstance(found, NoFix) else self.judge(query, found)
        return replace(result, stage="coarse") if share < 1.0 and isinstance(result, Fix) else result
