"""The auto method: NCC and SIFT, each checking the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from engine.matching.agreement import agree_in_height, agree_in_place, offset_between_m
from engine.matching.explanation import Explanation
from engine.matching.ladder import is_late
from engine.matching.method import Method
from engine.matching.ncc import Ncc
from engine.matching.query import Query
from engine.matching.sift import Sift
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.values import Fix, NoFix, Reason, Result, Window


class Auto(Method):
    """NCC if height and heading are known, then SIFT if time remains; two fixes must be of one place.

    Args:
        site: the map.
        device: where tensors live.
        options: settings of both.
    """

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

    def locate(self, query: Query) -> Result:
        """The more accurate of two agreeing fixes, a wider one if they hardly agree, or the only fix.

        The second method checks a fix. It runs last, so that it never takes time from the first.
        """
        if query.telemetry.height_agl_m is None or query.telemetry.grid_heading_deg is None:
            return self.sift.locate(query)
        first = self.ncc.locate(query, widely=False)  # SIFT finds the heading by itself
        # Few features follow the telemetry's attitude, and so does a fix that no picture refined: SIFT's will be.
        agrees = partial(_agree, first) if isinstance(first, Fix) and not first.rests_on_attitude else None
        with query.scheduler.with_fix(isinstance(first, Fix)):
            second = self.sift.locate(query, agrees)
        if isinstance(first, NoFix):
            return first if is_late(second) else second
        if isinstance(second, NoFix):
            return first
        offset_m = offset_between_m(first, second)
        if not agree_in_place(first, second):
            if float(np.hypot(*offset_m)) < self.ncc.options.exclusion_m:
                return _vaguer(second, offset_m)
            detail = f"NCC and SIFT are {float(np.hypot(*offset_m)):.1f} m apart"
            return query.refuse(Reason.INCONSISTENT, detail, "auto", score=first.score, window=first.window)
        if not agree_in_height(first, second):
            return _vaguer(second, offset_m)
        # Both compare the same picture and map with the same prior, so their odds are not multiplied.
        stated = [fix.confidence for fix in (first, second) if fix.confidence is not None]
        best = min(first, second, key=lambda fix: fix.sigma_m)
        return replace(best, stage="verified", confidence=max(stated, default=None))

    def explain(self, query: Query, window: Window) -> Explanation:
        """As NCC does."""
        return self.ncc.explain(query, window)


def _agree(first: Fix, second: Fix) -> bool:
    return agree_in_place(first, second) and agree_in_height(first, second)


def _vaguer(second: Fix, offset_m: NDArray[np.float64]) -> Fix:
    """SIFT's fix if NCC found the same place, but further away than both state.

    No other place is so near. A telemetry error shifts the patch that NCC searches for, and the pose less so.
    Which of the two is off is unknown: the covariance covers both.
    """
    covariance_m2 = second.covariance_m2.copy()
    covariance_m2[:2, :2] += offset_m[:, None] * offset_m
    return replace(second, covariance_m2=covariance_m2)
