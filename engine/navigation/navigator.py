"""Navigator: turns frames in order of capture into fixes and carries the search window from frame to frame."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engine.budget import Budget, Deadline
from engine.matching.covariance import map_sigma_of
from engine.matching.evidence import RELIABILITY
from engine.navigation.anchors import Anchor, RecentAnchors
from engine.navigation.hypotheses import Hypotheses, Hypothesis, Match
from engine.navigation.map_offset import MapOffset, MapOffsetEstimator
from engine.navigation.motion import (
    DeadReckoning,
    DriftModel,
    GroundMotion,
    OdometrySample,
    PositionEstimate,
    en_m,
    is_valid,
)
from engine.navigation.odds import (
    MAX_PROBABILITY,
    Sources,
    log_odds,
    match_log_odds,
    position_of,
    probability,
)
from engine.navigation.odometry import VisualOdometry, odometry_of
from engine.navigation.repeats import Repeats
from engine.navigation.state import NavigatorState
from engine.navigation.telemetry_errors import Calibration, TelemetryErrors, considered
from engine.navigation.velocity_check import VelocityCheck
from engine.options import MatcherOptions, NavigatorOptions
from engine.orthomap import OrthoMap
from engine.values import MAX_SIGMA_M, Fix, Frame, NoFix, Prior, Reason

Array = NDArray[np.float64]


class Matcher(Protocol):
    """What a navigator needs from a matcher; :class:`engine.matching.matcher.SceneMatcher` is one."""

    site: OrthoMap

    def locate(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """The camera's position when the frame was taken."""


class Navigator:
    """Follows a flight: matches each frame in the window predicted by dead reckoning from the last fix.

    A fix is accepted if there is enough evidence for it: its own, and its agreement with predictions, other
    sources and other fixes; see ``docs/integrity.md``.

    Args:
        matcher: matches single frames.
        start: where the flight begins; None searches the whole map until the first fix.
        budget: of each frame; None sets no limit.
        options: settings; ``odometry`` needs a matcher with a ``camera``.
    """

    def __init__(
        self,
        matcher: Matcher,
        start: Prior | None = None,
        budget: Budget | None = None,
        options: NavigatorOptions | None = None,
    ) -> None:
        self._matcher = matcher
        self._budget = budget
        self._options = o = options or NavigatorOptions()
        self._drift = DriftModel(o.measured_velocity_sigma_mps, o.acceleration_mps2, o.max_speed_mps)
        self._odometry = DeadReckoning(o.late_s, o.default_interval_s)
        options_of = getattr(matcher, "options", None)
        assumed = options_of.ncc.errors if isinstance(options_of, MatcherOptions) else None
        self._errors = TelemetryErrors(o, assumed)
        self._pictures = odometry_of(matcher) if o.odometry else None
        self._motion: GroundMotion | None = None  # up to the newest frame
        self._repeats = Repeats()
        self._velocity = VelocityCheck(o.measured_velocity_sigma_mps, o.acceleration_mps2)
        self._recent = RecentAnchors(self._drift)
        self._anchor = None if start is None else Anchor(position_of(start, matcher.site), None)
        self._map_offset = MapOffsetEstimator()
        self._hypotheses = Hypotheses(self._drift, o.gate)
        self._refusals = self._frames_lost = 0  # in a row
        self._fixed = self._lost = False  # whether the newest frame was fixed; whether the flight is lost
        self._resets = 0

    @property
    def state(self) -> NavigatorState:
        """How well the position is known after the last frame."""
        if self._anchor is None or self._anchor.fix is None:
            return NavigatorState.SEARCHING
        if self._lost:
            return NavigatorState.LOST
        return NavigatorState.TRACKING if self._fixed else NavigatorState.COASTING

    @property
    def tracking(self) -> bool:
        """Whether there is a fix to continue from."""
        return self.state in (NavigatorState.TRACKING, NavigatorState.COASTING)

    @property
    def anchor_age_s(self) -> float | None:
        """Age of the last fix when the newest frame was taken, or None before the first."""
        anchor, now = self._anchor, self._odometry.last
        if anchor is None or anchor.fix is None or anchor.sample is None or now is None:
            return None
        return now.time_s - anchor.sample.time_s

    @property
    def healthy(self) -> bool:
        """Whether the position is based on a fix from the last ``healthy_s`` seconds."""
        age_s = self.anchor_age_s
        return self.tracking and age_s is not None and age_s <= self._options.healthy_s

    @property
    def reset_count(self) -> int:
        """How often the position jumped away from dead reckoning; for MAVLink's reset counter."""
        return self._resets

    @property
    def prediction(self) -> Prior | None:
        """Dead reckoning at the newest frame with its uncertainty; None without a start or a fix."""
        now = self._odometry.last
        if now is None or (estimate := self._reckoned(now)) is None:
            return None
        return estimate.prior(map_sigma_m=map_sigma_of(self._matcher.site) if estimate.on_map else 0.0)

    @property
    def ground_motion(self) -> GroundMotion | None:
        """Motion to the newest frame, measured from pictures; None if it was not measured."""
        return self._motion

    @property
    def map_offset(self) -> MapOffset | None:
        """The map's offset from the priors of :meth:`update`; it moves no fix. None without priors."""
        return self._map_offset.offset

    @property
    def calibration(self) -> Calibration:
        """Estimated errors of the telemetry's attitude, clock and height, with their uncertainties."""
        return self._errors.calibration

    def update(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """The fix of the next frame.

        Args:
            frame: the newest, or one late by at most ``late_s``. A late frame is matched where the vehicle was
                then, and does not turn back the navigator's state.
            prior: this frame's position from a source other than the map. The search centres on it if it is
                tighter than dead reckoning; it always counts as evidence for or against a match.
            budget: of this frame; replaces the navigator's.

        Raises:
            TelemetryError: the frame came before, or is older than ``late_s``.
            CalibrationError: the frame is not of the camera's resolution.
        """
        clock, budget = Deadline(Budget()), budget or self._budget
        late, raw = self._odometry.is_late(frame), frame
        frame = self._velocity.shown(frame)
        self._motion = None if late or self._pictures is None else self._seen_motion(self._pictures, frame)
        now = self._odometry.sample(frame, self._recent.velocity, self._motion)
        repeated = None if late else self._repeats.refusal(frame, now)
        if repeated is not None:
            self._odometry.append(frame, now)
            self._fixed = False
            self._note_loss(now)
            return repeated
        sources = self._sources(now, prior, late=late)
        shown = self._errors.corrected(frame, now.time_s, late=late, refusals=self._refusals)
        left = budget and budget.after(clock.elapsed_ms if self._pictures else 0.0)
        result = self._matcher.locate(self._with_height(shown), sources.prior, left)
        if isinstance(result, Fix):
            result = considered(result, frame, shown, getattr(self._matcher, "camera", None))
        if self._anchor is not None and self._anchor.sample is None:
            self._anchor = replace(self._anchor, sample=now)
        self._odometry.append(frame, now)
        if isinstance(result, Fix):
            result = self._judge(result, now, sources, raw, late=late)
            if isinstance(result, Fix) and sources.given is not None:
                self._map_offset.add(result, sources.given, now.time_s)
        elif not late and result.reason is not Reason.LATE:
            self._hypotheses.add(None, now, sources, 0.0, frame.height_agl_m)
        if not late:
            if isinstance(result, Fix):
                self._errors.note(result, self._ground_below(result))
            self._fixed = isinstance(result, Fix)
            if isinstance(result, NoFix) and result.reason is not Reason.LATE:
                self._refusals += 1  # a lack of time is no evidence about the position
            self._note_loss(now)
        return result

    # ------------------------------------------------------------------------------------------ predictions

    def _seen_motion(self, pictures: VisualOdometry, frame: Frame) -> GroundMotion | None:
        """How far the vehicle moved since the last frame, if the pictures show it."""
        motion = pictures.update(self._with_height(self._errors.without_errors(frame)))
        return motion if isinstance(motion, GroundMotion) else None

    def _reckoned(self, now: OdometrySample, anchor: Anchor | None = None) -> PositionEstimate | None:
        """Dead reckoning from an anchor; by default the last one."""
        anchor = anchor or self._anchor
        if anchor is None or anchor.sample is None:
            return None if anchor is None else anchor.position
        drift_m = self._drift.sigma_m(anchor.sample, now, self._recent.velocity)
        sigma_m = min(math.hypot(anchor.position.sigma_m, drift_m), MAX_SIGMA_M)
        odds = 0.0 if self._refusals >= self._options.lost_after else anchor.position.log_odds
        if now.blind_s != anchor.sample.blind_s:
            odds = min(odds, log_odds(RELIABILITY))
        place_m = anchor.position.en_m + now.moved_m - anchor.sample.moved_m
        return PositionEstimate(place_m, sigma_m, odds, anchor.position.on_map)

    def _forget_way(self, now: OdometrySample) -> None:
        """Treat the way since the last fix as unknown, because the velocity that measured it is wrong."""
        anchor = self._anchor
        if anchor is not None and anchor.sample is not None:
            unknown_s = now.time_s - anchor.sample.time_s
            start = replace(now, time_s=anchor.sample.time_s, blind_s=now.blind_s - unknown_s)
            self._anchor = replace(anchor, sample=start)
        self._recent = RecentAnchors(self._drift)
        self._hypotheses.clear()

    def _sources(self, now: OdometrySample, prior: Prior | None, *, late: bool) -> Sources:
        """What is known about the position, and where the matcher searches."""
        given = None if prior is None else position_of(prior, self._matcher.site)
        sources = Sources(self._reckoned(now), given, self._pending_position(now))
        chosen, chosen_prior = self._searched(sources, now, late=late)
        misled = self._refusals >= self._options.lost_after and self._is_turn(self._refusals)
        if prior is not None and not misled and (chosen_prior is None or prior.sigma_m < chosen_prior.sigma_m):
            sigma_m = math.hypot(prior.sigma_m, map_sigma_of(self._matcher.site))
            chosen, chosen_prior = given, replace(prior, sigma_m=sigma_m)
        return replace(sources, searched=chosen, prior=chosen_prior)

    def _searched(
        self, sources: Sources, now: OdometrySample, *, late: bool
    ) -> tuple[PositionEstimate | None, Prior | None]:
        """The navigator's own estimate to search around, and the prior made from it; None for the whole map."""
        estimate, options = sources.own, self._options
        if self._lost or estimate is None:
            pending = sources.pending
            if pending is not None and pending.sigma_m <= options.trusted_sigma_m:
                return pending, pending.prior()
            vague = estimate is None or estimate.sigma_m > options.lost_sigma_m
            if estimate is None or self._is_turn(0 if vague else self._frames_lost):
                return None, None
        growth = options.growth ** min(self._refusals, options.lost_after)
        last = self._odometry.last
        moved_m = None if late or last is None else now.moved_m - last.moved_m
        map_m = 0.0 if estimate.on_map else map_sigma_of(self._matcher.site)
        return estimate, estimate.prior(growth, moved_m, map_m)

    def _is_turn(self, count: int) -> bool:
        """Whether this frame, of those without a useful prediction, searches the whole map."""
        return self._matcher.site.is_searchable and count % self._options.search_every == 0

    def _pending_position(self, now: OdometrySample) -> PositionEstimate | None:
        """Dead reckoning from the strongest pending match."""
        pending = self._hypotheses.pending
        return None if pending is None else self._hypotheses.position(pending, now)

    def _ground_below(self, fix: Fix) -> float | None:
        """Height of the ground below a fix that measured its height; None if the ground is assumed flat."""
        site = self._matcher.site
        known = fix.up_m is not None and site.has_surface
        return float(site.ground_at(np.array(fix.map_xy_px))) if known else None

    def _with_height(self, frame: Frame) -> Frame:
        """The frame, with the last fix's height if it came without one."""
        fix = None if self._anchor is None or self._lost else self._anchor.fix
        if frame.height_agl_m is not None or fix is None or fix.up_m is None:
            return frame
        site = self._matcher.site
        height = fix.up_m - site.ground_at(site.pixel_from_enu(en_m(fix)))
        return replace(frame, height_agl_m=height) if height > 0 else frame

    # ---------------------------------------------------------------------------------------------- acceptance

    def _judge(self, fix: Fix, now: OdometrySample, sources: Sources, raw: Frame, *, late: bool) -> Fix | NoFix:
        """The fix if there is enough evidence for it; otherwise keep it pending and refuse it for now."""
        if not is_valid(fix):
            return fix.refused(Reason.BAD_POSE, "the covariance of the match is not positive definite")
        if not late and self._velocity.note(fix, raw, now.time_s):
            self._forget_way(now)
            sources = replace(sources, own=self._reckoned(now), pending=None)
        required, against = self._options.min_log_odds, self._against(fix, now)
        own, given = (self._evidence_of(source, fix, sources) for source in (sources.own, sources.given))
        disputed = given < 0.0
        if self._anchor is not None and self._anchor.disputed:
            given = 0.0  # an error of the other source lasts: ignore it until it agrees again
        others = match_log_odds(fix) + given
        if against is None and own + others >= required:
            self._accept(fix, now, 1, own + others, jump=False, disputed=disputed)
            return fix
        if late:
            return self._refuse_match(fix, against, own + others)
        match = Match(fix, others if against is not None else own + others)
        found = self._hypotheses.add(match, now, sources, self._map_m2(fix), raw.height_agl_m)
        odds = match.log_odds if found is None else found.log_odds
        return self._decide(found, now, fix, disputed=disputed) or self._refuse_match(fix, against, odds)

    def _decide(self, found: Hypothesis | None, now: OdometrySample, fix: Fix, *, disputed: bool) -> Fix | None:
        """The fix of a hypothesis that enough matches support."""
        if found is None or found.count < 2 or found.log_odds < self._options.min_log_odds:
            return None
        against = self._against(fix, now)
        if against is not None and self._dead_reckoning_outweighs(now, found.count):
            return None
        self._accept(fix, now, found.count, found.log_odds, jump=against is not None, disputed=disputed)
        return fix

    def _evidence_of(self, estimate: PositionEstimate | None, fix: Fix, sources: Sources) -> float:
        """What an estimate adds to the log-odds of a match."""
        options = self._options
        return sources.evidence_of(estimate, fix, self._map_m2(fix), options.gate, options.trusted_sigma_m)

    def _map_m2(self, fix: Fix) -> float:  # area of the window
        return float(fix.window.area_px * self._matcher.site.gsd_m_per_px**2)

    def _against(self, fix: Fix, now: OdometrySample) -> PositionEstimate | None:
        """A trusted prediction that a fix contradicts: from the last fix, or from one some seconds ago.

        Wrong matches may drift too slowly to show from frame to frame; velocities over seconds reveal it.
        """
        predictions = [self._reckoned(now)]
        oldest = self._recent.oldest
        if oldest is not None and now.blind_s == oldest.odometry.blind_s:
            predictions.append(self._reckoned(now, oldest))
        for estimate in predictions:
            known = estimate is not None and estimate.sigma_m <= self._options.trusted_sigma_m
            if estimate is not None and known and estimate.chi_square(fix) > self._options.gate:
                return estimate
        return None

    def _dead_reckoning_outweighs(self, now: OdometrySample, against: int) -> bool:
        """Whether dead reckoning outweighs this many fixes that agree with each other but not with it."""
        anchor = self._anchor
        if anchor is None or anchor.sample is None or now.blind_s > anchor.sample.blind_s:
            return False  # the velocity was not measured
        return against <= anchor.support and now.time_s - anchor.sample.time_s <= self._options.hold_s

    def _accept(
        self, fix: Fix, now: OdometrySample, count: int, odds: float, *, jump: bool, disputed: bool
    ) -> None:
        """Continue dead reckoning from this fix, with the log-odds of all evidence for it."""
        last = self._anchor
        known = last is not None and last.fix is not None
        if known and last is not None and last.sample is not None and now.time_s < last.sample.time_s:
            return  # a late one
        jump = jump or self._lost
        self._resets += known and jump
        if jump:  # what was learnt came from a wrong position
            self._errors.forget()
        support = count if last is None or jump else last.support + count
        odds = min(odds, log_odds(MAX_PROBABILITY))
        position = PositionEstimate(en_m(fix), fix.relative_sigma_m, odds, on_map=True)
        self._anchor = Anchor(position, now, fix, support, disputed)
        self._recent.append(self._anchor, jump=jump)
        self._refusals, self._frames_lost, self._lost = 0, 0, False
        self._hypotheses.clear()

    def _refuse_match(self, fix: Fix, against: PositionEstimate | None, odds: float) -> NoFix:
        """The refusal of a match without enough evidence."""
        if against is not None:
            return replace(against.refusal(fix), match=fix)
        asked = f"{self._options.min_confidence:g} is required"
        return fix.refused(Reason.UNCONFIRMED, f"right with a probability of {probability(odds):.4f}, {asked}")

    def _note_loss(self, now: OdometrySample) -> None:
        """Declare the flight lost, or drop its start, after too many refusals or too much uncertainty."""
        anchor, options = self._anchor, self._options
        if anchor is None or self._fixed:
            return
        if self._refusals == options.lost_after:  # a wrong or outdated bias would keep them refused
            self._errors.forget()
        estimate = self._reckoned(now)
        far = estimate is not None and estimate.sigma_m > options.lost_sigma_m
        if anchor.fix is not None:
            self._frames_lost += self._lost
            self._lost = self._lost or far or self._refusals >= options.lost_after
        elif self._refusals >= options.lost_after:
            self._anchor = None
