"""The learned method: networks match points; the rest is as in SIFT."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import replace
from functools import partial

from engine.learned.loading import load_matcher
from engine.learned.matchers import KeypointMatcher
from engine.maps.keypoints import KeypointMap
from engine.matching.feature_pose import FeatureMatcher
from engine.matching.for_reports import Explanation, explain_features
from engine.matching.ladder import SHARES, Answer, Rung, Works, climb
from engine.matching.method import Method
from engine.matching.point_finding import PointFinder
from engine.matching.query import Query
from engine.matching.views import map_px_per_pixel
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.values import NoFix, Window

METHOD = "learned"


class Learned(Method):
    """A learned matcher instead of SIFT's features; window, pose, probability and covariance are SIFT's.

    Args:
        site: the map.
        device: where the networks live.
        options: settings; uses ``options.learned`` and, after matching, ``options.sift``.

    Raises:
        OptionError: there are no weights, or they make no matcher.
    """

    name = METHOD

    def __init__(self, site: OrthoMap, device: Device, options: MatcherOptions) -> None:
        own = options.learned
        matcher = load_matcher(own.weights, device=device)
        self.keypoints = KeypointMap(site, matcher) if isinstance(matcher, KeypointMatcher) else None
        self.finder = PointFinder(matcher, self.keypoints, own)
        # The frame is turned upright for the network; without the heading it would see less.
        self.options = replace(options.sift, search_widely=False, tolerance_px=own.tolerance_px)
        self.max_picture_px = own.max_picture_px

    warmup_rounds = 1  # each takes seconds without a GPU

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {} if self.keypoints is None else {"keypoint tiles": self.keypoints.tiles.created}

    def locate(self, query: Query) -> Answer:
        """A fix on the finest level of the map that time allows."""
        works: Works = {(METHOD, share): query.gray.size * self._scale(query, share) ** 2 for share in SHARES}
        return climb(query, [Rung(METHOD, "matches", lambda _: works, partial(self._match, query))])[METHOD]

    def _match(self, query: Query, answer: Answer | None, step: Hashable) -> Answer:
        assert isinstance(step, tuple)
        found = self._feature_matcher(query, step[1]).find()
        return found if step[1] == 1.0 or isinstance(found, NoFix) else found.coarse()

    def explain(self, query: Query, window: Window) -> Explanation:
        """The matches in a window at the frame's own height and heading."""
        return explain_features(self._feature_matcher(query, 1.0), window)

    def _feature_matcher(self, query: Query, share: float) -> FeatureMatcher:
        options = replace(self.options, scale=self._scale(query, share))
        return FeatureMatcher(query, None, options, self.finder, METHOD)

    def _scale(self, query: Query, share: float) -> float:
        """The scale at which the frame's pixels equal those of the level that it is matched on."""
        size, most = query.gray.size, self.max_picture_px * share**2
        height_m = query.telemetry.height_agl_m
        if height_m is None:
            return min(1.0, math.sqrt(most / size))
        per_px = map_px_per_pixel(query, height_m)
        level = max(0, math.ceil(math.log2(per_px * math.sqrt(size / most))))
        return min(1.0, per_px / 2.0**level)
