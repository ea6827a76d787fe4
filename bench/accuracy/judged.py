"""One match by one method: its scores, and what became of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from bench.accuracy.trials import Ground, Trial, drawn_prior, trial
from bench.accuracy.truth import off
from engine import Fix, Frame, MatcherOptions, NoFix, OrthoMap, Prior, SceneMatcher
from engine.budget import Budget, Deadline
from engine.matching.candidates import PeakCandidate
from engine.matching.feature_pose import FeatureMatcher
from engine.matching.ncc import Ncc
from engine.matching.query import Query
from engine.matching.sift import Sift
from engine.ncc_fft import surface
from engine.options import NccOptions, SiftOptions
from engine.window import level_crop
from scenematch.report.metrics import FALSE_SIGMAS, WRONG_M

M = TypeVar("M", Ncc, Sift)

METHODS = {"NCC": 0.5, "NCC, refined": 0.2, "SIFT": 0.2, "auto": 0.1}
"""Which share of the matches is by which."""
SCORES = {
    "NCC": ("probability", "NCC", "PSR", "second peak"),
    "NCC, refined": ("probability",),
    "SIFT": ("probability", "false alarms", "share of inliers"),
    "auto": ("probability",),
}
GREY, STRUCTURE = "NCC, grey levels", "NCC, structure"
"""Methods for fits: the parts of NCC, of which the second is asked where the first is refused."""
RISKS = (1e-2, 1e-3, 1e-4)
"""Of the protection levels that are kept."""
_PSR_PX = 11.0


class Row(NamedTuple):
    """One match. Of what found nothing, ``scores`` is empty; ``squared`` is NaN where the truth is not on the map.

    ``right`` is of what was found, accepted or not: within 10 m of the truth, or within 3 of its own sigmas.
    """

    ground: str
    kind: str
    method: str
    fixed: bool
    right: bool
    scores: list[float]  # as SCORES names them; higher speaks for it
    regressors: list[float]
    error_m: float
    sigma_m: float
    squared: float  # squared Mahalanobis distance from the truth
    levels_m: Sequence[float] = ()  # protection levels of what was found, by RISKS


class Bench:
    """A ground with its maps and, made when they are needed, the matchers over them."""

    def __init__(self, here: Ground, other: Ground) -> None:
        self.here, self.other = here, other
        self._made: dict[tuple[str, str], SceneMatcher] = {}

    @cached_property
    def maps(self) -> dict[str, OrthoMap]:
        """By the names of :class:`bench.accuracy.trials.Trial`."""
        here = self.here
        return {"own": here.site, "old": here.old, "tiled": here.tiled, "other": self.other.site}

    def matcher(self, on: str, method: str) -> SceneMatcher:
        """A matcher over one of the maps."""
        key = (on, method)
        if key not in self._made:
            options = MatcherOptions(ncc=NccOptions(refine=method != "NCC"))
            engine = {"SIFT": "sift", "auto": "auto"}.get(method, "ncc")
            self._made[key] = SceneMatcher(self.maps[on], self.here.camera, engine, "cpu", options)
        return self._made[key]

    def trials(self, numbers: range, rng: np.random.Generator) -> Iterator[Trial]:
        """Matches by their numbers; on another map the prior is where frames of that map were taken."""
        for number in numbers:
            made = trial(self.here, number, rng)
            if made.on == "other":
                place = self.other.places_m[rng.integers(len(self.other.places_m))]
                made = replace(made, prior=drawn_prior(place, rng))
            yield made

    def judged(self, made: Trial, method: str) -> Row:
        """The match by a method as the engine is set up."""
        matcher = self.matcher(made.on, method)
        if method == "NCC":
            return self.peaked(made)
        if method in (GREY, STRUCTURE):
            return self.looked(made, method)
        if method == "SIFT":
            return self.posed(made, made.frame, made.prior, matcher.options.sift)
        fix = matcher.locate(made.frame, made.prior)
        if isinstance(fix, NoFix):
            return self.no_match(made, method)
        return self.row(made, method, fix, True, [fix.confidence or 0.0], [])

    def peak(self, made: Trial) -> tuple[Query, Ncc, PeakCandidate | NoFix]:
        """The highest peak of a match by NCC's grey levels, accepted or not."""
        matcher = self.matcher(made.on, "NCC")
        query, ncc = _query(matcher, made.frame, made.prior), _part(matcher, "ncc", Ncc)
        found = ncc.find(query)
        if not isinstance(found, NoFix) and found.promises(query.risk) and not found.suffices(query.risk):
            found = ncc.null_tested(query, found)
        return query, ncc, found

    def peaked(self, made: Trial) -> Row:
        """The match by NCC alone: by structure where the peak by grey levels is refused."""
        query, ncc, found = self.peak(made)
        if isinstance(found, NoFix):
            return self.no_match(made, "NCC")
        if not found.suffices(query.risk):
            found = ncc.match_structure(query, found) or found
        ratio = math.sqrt(found.evidence.rival / max(found.evidence.surprise, 1e-6))
        scores = [found.fix.confidence or 0.0, found.peak.score, _psr(query, ncc, found), -ratio]
        return self.row(made, "NCC", found.fix, found.suffices(query.risk), scores, [found.evidence.nats])

    def looked(self, made: Trial, method: str) -> Row:
        """The match by one look of NCC alone."""
        query, ncc, peak = self.peak(made)
        found = None if isinstance(peak, NoFix) else peak
        if found is not None and method == STRUCTURE:
            found = ncc.match_structure(query, found)
        if found is None:
            return self.no_match(made, method)
        scores = [found.fix.confidence or 0.0, found.peak.score]
        return self.row(made, method, found.fix, found.suffices(query.risk), scores, [found.evidence.nats])

    def posed(self, made: Trial, frame: Frame, prior: Prior | None, options: SiftOptions) -> Row:
        """The match by SIFT, accepted or not."""
        matcher = self.matcher(made.on, "SIFT")
        query = _query(matcher, frame, prior)
        landmarks = _part(matcher, "sift", Sift).landmarks
        found = FeatureMatcher(query, landmarks, options).find()
        if isinstance(found, NoFix):
            return self.no_match(made, "SIFT")
        false_alarms = found.evidence.surprise - math.log(found.evidence.tried)
        scores = [found.fix.confidence or 0.0, false_alarms, found.fix.score]
        return self.row(made, "SIFT", found.fix, found.suffices(query.risk), scores, [found.evidence.nats])

    def no_match(self, made: Trial, method: str) -> Row:
        """A match that found nothing."""
        return Row(self.here.name, made.kind, method, False, False, [], [], np.inf, np.nan, np.nan)

    def row(self, made: Trial, method: str, fix: Fix, fixed: bool, scores: list[float], nats: list[float]) -> Row:
        """What was found, held against its truth."""
        name, kind = self.here.name, made.kind
        levels_m = [fix.protection_level_m(risk) for risk in RISKS]
        if made.truth_m is None:
            return Row(name, kind, method, fixed, False, scores, nats, np.inf, fix.sigma_m, np.nan, levels_m)
        error_m, sigmas = off(self.here.seen(fix), made.truth_m)
        right = error_m <= WRONG_M or error_m <= FALSE_SIGMAS * fix.sigma_m
        return Row(name, kind, method, fixed, right, scores, nats, error_m, fix.sigma_m, sigmas**2, levels_m)


def _query(matcher: SceneMatcher, frame: Frame, prior: Prior | None) -> Query:
    return matcher._query(frame, prior, Deadline(Budget()))


def _part(matcher: SceneMatcher, name: str, kind: type[M]) -> M:
    """The method of a matcher that is only made of that one."""
    method = matcher._method.parts.get(name, matcher._method)
    assert isinstance(method, kind)
    return method


def _psr(query: Query, ncc: Ncc, found: PeakCandidate) -> float:
    """Peak-to-sidelobe ratio: the peak above the mean of the rest, in standard deviations of the rest."""
    crop = level_crop(query.site, found.fix.window, found.aligned.level)
    region, template = ncc.prepared.cut(crop, found.aligned.level), found.aligned.template
    scores = np.asarray(surface(replace(region.search, counts=None), template[None])[0])
    y, x = np.unravel_index(int(scores.argmax()), scores.shape)
    rows, columns = np.ogrid[: scores.shape[0], : scores.shape[1]]
    rest = scores[np.hypot(rows - y, columns - x) > _PSR_PX]
    return float((scores[y, x] - rest.mean()) / max(float(rest.std()), 1e-6)) if rest.size else 0.0
