"""The auto method: NCC and SIFT, each checking the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from engine.matching.agreement import agree_in_height, agree_in_place, are_near
from engine.matching.candidates import Candidate, nats
from engine.matching.for_reports import Explanation
from engine.matching.ladder import Answer, climb, is_accepted, is_late
from engine.matching.method import Method
from engine.matching.ncc import Ncc
from engine.matching.query import Query
from engine.matching.refinement import reaching
from engine.matching.sift import Sift
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.values import Window


class Auto(Method):
    """NCC if height and heading are known, and SIFT if that leaves doubt and time: one ladder, one posterior.

    Args:
        site: the map.
        device: where tensors live.
        options: settings of both.
    """

    name = "auto"
    loops = tuple(dict.fromkeys(Ncc.loops + Sift.loops))

    def __init__(self, site: OrthoMap, device: Device, options: MatcherOptions) -> None:
        self.ncc = Ncc(site, device, options)
        self.sift = Sift(site, device, options, self.ncc.samples)

    @property
    def parts(self) -> Mapping[str, Method]:
        """Both, by name."""
        return {"ncc": self.ncc, "sift": self.sift}

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return self.ncc.cache_counters | self.sift.cache_counters

    def prepare(self) -> None:
        """Prepare both methods' indexes of the map."""
        for part in self.parts.values():
            part.prepare()

    def warmup(self, query: Query) -> None:
        """Run every variant of every step of both methods."""
        self.ncc.warmup(query)
        self.sift.warmup(query)

    def warmup_search(self, query: Query) -> None:
        """Search the whole map by both methods, or headings and heights around the prior by NCC."""
        if query.prior is None:
            self.locate(query)
        else:
            self.ncc.warmup_search(query)

    def locate(self, query: Query) -> Answer:
        """What both propose, each rung in the light of the other method's answer.

        SIFT's follow NCC's looks at the telemetry's own pose, so that they never take time from them.
        """
        pose = query.telemetry
        has_both = pose.height_agl_m is not None and pose.grid_heading_deg is not None
        looks, searches = self.ncc.rungs(query) if has_both else ([], [])
        answers = list(climb(query, [*looks, *self.sift.rungs(query), *searches]).values())
        found = [each for each in answers if isinstance(each, Candidate)]
        if len(found) == 2:
            return self._posterior(query, *found)
        return next((each for each in [*found, *reversed(answers)] if not is_late(each)), answers[0])

    def _posterior(self, query: Query, first: Candidate, second: Candidate) -> Candidate:
        """Of one place the more accurate candidate, of two the more evident one, with the other against it.

        Both compare the same picture and map with the same prior, so their evidence is not added.

        Args:
            query: the frame.
            first: NCC's.
            second: SIFT's.
        """
        both = [each for each in (first, second) if is_accepted(each, query)]
        is_near = are_near(first.fix, second.fix, self.ncc.options.exclusion_m)
        is_one = is_near or agree_in_place(first.fix, second.fix)
        if len(both) < 2 or not is_one:
            best = max(both or [first, second], key=nats)
            return best if is_one else best.against([first, second])
        if not (agree_in_place(first.fix, second.fix) and agree_in_height(first.fix, second.fix)):
            # A telemetry error shifts the patch that NCC searches for, and the pose less so.
            return replace(second, fix=reaching(second.fix, first.fix))
        greater, best = max(both, key=nats).evidence, min(both, key=lambda each: each.fix.sigma_m)
        return replace(best, fix=replace(best.fix, stage="verified")).weighed(greater)

    def explain(self, query: Query, window: Window) -> Explanation:
        """As NCC does."""
        return self.ncc.explain(query, window)
