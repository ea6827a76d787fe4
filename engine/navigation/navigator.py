"""Navigator: turns frames in order of capture into fixes and carries the search window from frame to frame."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from engine.assumed_errors import AssumedErrors
from engine.budget import Budget, Deadline
from engine.camera import Camera
from engine.errors import OptionError, TelemetryError
from engine.matching.evidence import SEARCHED, needed_nats, probability
from engine.navigation.motion import (
    GroundMotion,
    PositionEstimate,
    Ways,
    en_m,
    is_valid,
    position_of,
    stated_step,
)
from engine.navigation.odometry import VisualOdometry
from engine.navigation.repeats import Picture
from engine.navigation.telemetry_errors import Calibration, TelemetryErrors, considered
from engine.navigation.tracks import MISS, RELIABLE, Match, Track, Tracks, Weighed
from engine.options import MatcherOptions, NavigatorOptions
from engine.orthomap import OrthoMap
from engine.values import Fix, Frame, NoFix, Prior, Reason


class NavigatorState(enum.Enum):
    """How well a navigator knows the position.

    ``SEARCHING`` before the first fix, ``TRACKING`` if the newest frame gave a fix, ``COASTING`` on dead reckoning
    since the last fix, ``LOST`` when dead reckoning has become useless.
    """

    SEARCHING = "searching"
    TRACKING = "tracking"
    COASTING = "coasting"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class _Moment:
    """The flight at one frame: its time and newest stamp, the ways to it, its picture, and the tracks after it."""

    time_s: float
    stamp_ns: int | None
    ways: Ways
    picture: Picture
    tracks: Tracks


@dataclass(frozen=True, slots=True)
class _Accepted:
    """The last accepted fix, when its frame was taken, and the account that it belongs to."""

    fix: Fix
    time_s: float
    number: int


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
        options: settings.

    Raises:
        OptionError: odometry was asked for, and the matcher has no ``camera``.
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
        options_of = getattr(matcher, "options", None)
        assumed = options_of.errors if isinstance(options_of, MatcherOptions) else AssumedErrors()
        self._assumed = assumed.on_map(matcher.site)
        self._errors = TelemetryErrors(o, self._assumed)
        self._camera: Camera | None = getattr(matcher, "camera", None)
        self._pictures = VisualOdometry(self._camera) if o.odometry and self._camera else None
        if o.odometry and self._pictures is None:
            matcher_type = type(matcher).__name__
            raise OptionError(f"odometry: expected a matcher with a `camera`, got {matcher_type} without")
        self._motion: GroundMotion | None = None  # up to the newest frame
        self._start = None if start is None else position_of(start, matcher.site)
        self._last: _Moment | None = None
        self._accepted: _Accepted | None = None
        self._refusals = self._frames_lost = 0  # in a row
        self._resets = 0

    @property
    def options(self) -> NavigatorOptions:
        """The settings."""
        return self._options

    @property
    def state(self) -> NavigatorState:
        """How well the position is known after the last frame."""
        if self._accepted is None:
            return NavigatorState.SEARCHING
        if self._frames_lost:
            return NavigatorState.LOST
        return NavigatorState.TRACKING if self.anchor_age_s == 0.0 else NavigatorState.COASTING

    @property
    def anchor_age_s(self) -> float | None:
        """Age of the last fix when the newest frame was taken, or None before the first."""
        if self._last is None or self._accepted is None:
            return None
        return self._last.time_s - self._accepted.time_s

    @property
    def healthy(self) -> bool:
        """Whether the flight is not lost, and the last fix was at most ``healthy_s`` old at the newest frame."""
        age_s = self.anchor_age_s
        return age_s is not None and age_s <= self._options.healthy_s and self._frames_lost == 0

    @property
    def reset_count(self) -> int:
        """How often the position jumped away from dead reckoning; for MAVLink's reset counter."""
        return self._resets

    @property
    def prediction(self) -> Prior | None:
        """Dead reckoning at the newest frame with its uncertainty; None before one, or without start and match."""
        if self._last is None:
            return None
        tracks, last = self._last.tracks, self._accepted
        track = tracks.best if last is None else tracks.of(last.number) or tracks.best
        if track is None:
            return None
        return track.estimate.prior(map_sigma_m=self._assumed.map_m if track.fix else 0.0)

    @property
    def ground_motion(self) -> GroundMotion | None:
        """Motion to the newest frame, measured from pictures; None if it was not measured."""
        return self._motion

    @property
    def calibration(self) -> Calibration:
        """Estimated errors of the telemetry's attitude, clock and height, with their uncertainties."""
        return self._errors.calibration

    def update(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """The fix of the next frame.

        Args:
            frame: newer than every frame before it.
            prior: this frame's position from a source other than the map. The search centres on it if it is
                tighter than dead reckoning; else it is evidence for or against a place that no track predicts.
            budget: of this frame; replaces the navigator's.

        Raises:
            TelemetryError: the frame is not newer than the last one.
            CalibrationError: the frame is not of the camera's resolution.
        """
        clock, budget = Deadline(Budget()), budget or self._budget
        moment = self._next(frame)
        repeated = moment.picture.refusal(frame)
        if repeated is not None:
            self._take(moment)
            return repeated
        searched, is_given = self._searched(moment.tracks, prior)
        shown = self._errors.corrected(frame, moment.time_s, self._refusals)
        left = budget and budget.after(clock.elapsed_ms if self._pictures else 0.0)
        result = self._matcher.locate(self._with_height(shown), searched, left)
        if isinstance(result, Fix):
            result = considered(result, frame, shown, self._camera)
            if not is_valid(result):
                result = result.refused(Reason.BAD_POSE, "the covariance of the match is not positive definite")
        tracks = moment.tracks
        if isinstance(result, Fix):
            area_m2, height_m = self._searched_m2(result, searched), frame.height_agl_m or self._height_of(result)
            given = None if prior is None else position_of(prior, self._matcher.site)
            match = Match(result, area_m2, moment.ways, height_m, self._refusals, given, is_given)
            weighed = tracks.weighed(match)
            result, tracks = self._judged(result, weighed, moment), weighed.tracks
        elif result.reason is not Reason.LATE:  # a lack of time is no evidence about the position
            self._refusals += 1
            tracks = tracks.missed()
        if isinstance(result, Fix):
            self._errors.note(result, self._height_of(result) if self._matcher.site.has_surface else None)
        self._take(replace(moment, tracks=tracks))
        return result

    # ------------------------------------------------------------------------------------------ predictions

    def _interval_s(self, frame: Frame) -> float:
        """Time from the newest frame to this one.

        Raises:
            TelemetryError: it is not newer.
        """
        stamp, newest = frame.timestamp_ns, None if self._last is None else self._last.stamp_ns
        if stamp is None or newest is None:
            return self._options.default_interval_s
        if stamp <= newest:
            raise TelemetryError(f"timestamp_ns: expected later than the last frame's {newest}, got {stamp}")
        return (stamp - newest) * 1e-9

    def _next(self, frame: Frame) -> _Moment:
        """A new frame, by what was known before."""
        interval_s, last, stamp_ns = self._interval_s(frame), self._last, frame.timestamp_ns
        if self._pictures is not None:
            motion = self._pictures.update(self._with_height(self._errors.without_errors(frame)))
            self._motion = motion if isinstance(motion, GroundMotion) else None
        if last is None:
            ways, tracks = Ways(0.0, stated_step(None, frame, 0.0, self._options)), Tracks(self._options)
            begun = tracks.begun(self._start, ways) if self._start else tracks
            return _Moment(0.0, stamp_ns, ways, Picture.of(frame), begun)
        seen = None
        if self._motion is not None and math.isclose(self._motion.interval_s, interval_s, abs_tol=1e-6):
            seen = self._motion.step(last.ways.seen)  # not seen if a frame in between failed
        ways = Ways(interval_s, stated_step(last.ways.stated, frame, interval_s, self._options), seen)
        return _Moment(
            last.time_s + interval_s,
            last.stamp_ns if stamp_ns is None else stamp_ns,
            ways,
            last.picture.next(frame, ways),
            last.tracks.carried(ways),
        )

    def _take(self, moment: _Moment) -> None:
        """Continue from a frame, and declare the flight lost after too many refusals or too much uncertainty."""
        self._last, track = moment, moment.tracks.best
        if self.anchor_age_s == 0.0 or track is None:
            return
        if self._frames_lost or track.is_lost or self._is_vague(track):
            if not self._frames_lost:
                self._errors.forget()  # a wrong or outdated bias would keep frames refused
            self._frames_lost += 1

    def _searched(self, tracks: Tracks, prior: Prior | None) -> tuple[Prior | None, bool]:
        """Where the matcher searches: about the best track, or the other source if that is tighter (True)."""
        own, track, map_m = None, tracks.sought, self._assumed.map_m
        if track is not None and not self._leads_nowhere(track):
            own = track.estimate.prior(track.widened, track.moved_m, 0.0 if track.fix else map_m)
        misled = self._refusals * MISS >= RELIABLE and self._is_turn(self._refusals)
        if prior is None or misled or (own is not None and own.sigma_m <= prior.sigma_m):
            return own, False
        return replace(prior, sigma_m=math.hypot(prior.sigma_m, map_m)), True

    def _leads_nowhere(self, track: Track) -> bool:
        """Whether the whole map is searched instead: if the flight is lost, in turns."""
        vague = self._is_vague(track)
        is_hopeless = self._frames_lost > 0 and (vague or track.is_lost)
        return is_hopeless and self._is_turn(0 if vague else self._frames_lost - 1)

    def _is_vague(self, track: Track) -> bool:
        """Whether a track is too uncertain to lead a search, or to contradict a match."""
        return track.estimate.sigma_m > self._options.lost_sigma_m

    def _is_turn(self, count: int) -> bool:
        """Whether this frame, of those without a useful prediction, searches the whole map: every second does."""
        return self._matcher.site.is_searchable and count % 2 == 0

    def _with_height(self, frame: Frame) -> Frame:
        """The frame, with the last fix's height if it came without one."""
        if frame.height_agl_m is not None or self._accepted is None or self._frames_lost:
            return frame
        return replace(frame, height_agl_m=self._height_of(self._accepted.fix))

    def _height_of(self, fix: Fix) -> float | None:
        """Height above the ground, if the fix measured it."""
        if fix.up_m is None:
            return None
        height_m = float(fix.up_m - self._matcher.site.ground_at(np.array(fix.map_xy_px)))
        return height_m if height_m > 0.0 else None

    # ---------------------------------------------------------------------------------------------- acceptance

    def _searched_m2(self, fix: Fix, searched: Prior | None) -> float:
        """The area in which a match was searched for."""
        about = PositionEstimate(en_m(fix), 0.0 if searched is None else searched.sigma_m, on_map=True)
        area_m2 = SEARCHED * about.spread_m2(fix)
        if searched is None or fix.confidence is None:  # without a confidence it has not weighed the prior
            area_m2 = max(area_m2, fix.window.area_px * self._matcher.site.gsd_m_per_px**2)
        return area_m2

    def _judged(self, fix: Fix, weighed: Weighed, moment: _Moment) -> Fix | NoFix:
        """The fix if there is enough evidence for it; otherwise it is refused."""
        if weighed.log_odds >= needed_nats(self._options.risk):
            last, self._accepted = self._accepted, _Accepted(fix, moment.time_s, weighed.number)
            if last is not None and (self._frames_lost or weighed.number != last.number):  # a jump
                self._resets += 1
                self._errors.forget()  # what was learnt came from a wrong position
            self._refusals = self._frames_lost = 0
            return fix
        self._refusals += 1
        best = moment.tracks.best
        if best is not None and self._is_known(best) and best.estimate.chi_square(fix) > self._options.gate:
            return best.estimate.refusal(fix)
        asked = f"{1.0 - self._options.risk:g} is required"
        return fix.refused(
            Reason.UNCONFIRMED, f"right with a probability of {probability(weighed.log_odds):.4f}, {asked}"
        )

    def _is_known(self, track: Track) -> bool:
        """Whether a track may contradict a match: a start, or one that gave a fix, if it is not too uncertain."""
        known = track.fix is None or track.log_odds >= needed_nats(self._options.risk)
        return known and not self._is_vague(track)
