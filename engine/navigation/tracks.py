"""Tracks: accounts of one flight as a bounded set of weighed Gaussians, which matches confirm or contradict.

Each is one account of which matches are right, and of whether the telemetry's velocity is. Its Gaussian is over
position and velocity; its log-odds, against "the vehicle is elsewhere", add up over its matches. This is multiple
hypothesis tracking (Reid 1979, https://doi.org/10.1109/TAC.1979.1102177) with two models of motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from engine.matching.evidence import RELIABILITY, nats_of, needed_nats
from engine.navigation.motion import Array, PositionEstimate, Step, Ways, en_m, place_of, stamps_m2
from engine.options import NavigatorOptions
from engine.values import RISK, SIGNIFICANCE, Fix

MAX_TRACKS = 16
MIN_FRAMES = 3
"""Frames that must show the same before it counts: one or two of them may be wrong."""
CERTAIN = needed_nats(RISK)
"""Most that one match adds for a place; most that the two motions of an account may differ by."""
RELIABLE = nats_of(RELIABILITY)
"""Of another source's position."""
MISS = math.log(2.0)
"""What a frame without a match of a place speaks against it: every second frame shows nothing that matches."""
_SAME_GROUND = 0.5  # weight of a match of ground that was matched before


def stated_nats(fix: Fix) -> float:
    """Log-odds of a match by itself, if every second frame shows a place in its window.

    One that states none, as the paper's, is as good as a navigator asks for by default.
    """
    return needed_nats(SIGNIFICANCE) if fix.confidence is None else nats_of(fix.confidence)


@dataclass(frozen=True, slots=True)
class Track:
    """One account of the flight.

    Attributes:
        en_m: (2,) position at the newest frame: the newest match's own, moved since then.
        filtered_m: (2,) the same by all matches, from which the velocity follows; the errors of matches last, so
            that it is no more certain than one.
        velocity_mps: (2,) at the same time.
        covariance: (3, 3) of these three, along each axis.
        support: log-odds from its matches.
        trusts_velocity: whether the telemetry's velocity moves it; else only what pictures show, or inertia.
        number: of the account; two tracks share it, of which one trusts the velocity.
        fix: its newest match; None for a start.
        misses: frames since then.
        moved_m: (2,) its last movement.
    """

    en_m: Array
    filtered_m: Array
    velocity_mps: Array
    covariance: Array
    support: float
    trusts_velocity: bool
    number: int
    fix: Fix | None
    misses: int
    moved_m: Array | None = None

    @classmethod
    def begun(cls, place: PositionEstimate, support: float, number: int, fix: Fix | None) -> Track:
        """A track at a place, at rest, which trusts the telemetry's velocity."""
        covariance = np.zeros((3, 3))
        covariance[:2, :2] = place.sigma_m**2
        return cls(place.en_m, place.en_m, np.zeros(2), covariance, support, True, number, fix, 0)

    @property
    def estimate(self) -> PositionEstimate:
        """Its position, which is on the map once a match gave it."""
        return PositionEstimate(self.en_m, math.sqrt(self.covariance[0, 0]), self.fix is not None)

    @property
    def log_odds(self) -> float:
        """Log-odds of this account at the newest frame."""
        return self.support - MISS * self.misses

    @property
    def is_lost(self) -> bool:
        """Whether so many frames in a row did not match it that it is no better than any other place."""
        return min(self.support, CERTAIN) <= MISS * self.misses

    @property
    def widened(self) -> float:
        """Factor on sigma for a search: a miss that halves the odds of the place doubles the area to search."""
        return math.exp(0.5 * min(MISS * self.misses, CERTAIN))

    def missed(self, kept: float = 1.0) -> Track:
        """The track after a frame that did not match it, with a share of its past evidence."""
        return replace(self, support=self._faded(kept), misses=self.misses + 1)

    def at(self, log_odds: float) -> Track:
        """The track with these odds."""
        return replace(self, support=log_odds + MISS * self.misses)

    def _faded(self, kept: float) -> float:
        """The support with this share of what goes beyond that of one match."""
        return min(self.support, CERTAIN + kept * (self.support - CERTAIN))

    def with_velocity(self, mps: Array, sigma_mps: float) -> Track:
        """The track with the velocity of another source in place of its own.

        Args:
            mps: (2,) east and north.
            sigma_mps: standard deviation of each.

        Returns:
            Track: at the same position.
        """
        covariance = np.zeros((3, 3))
        covariance[:2, :2], covariance[2, 2] = self.covariance[:2, :2], sigma_mps**2
        return replace(self, velocity_mps=mps, covariance=covariance)

    def matched(self, place: PositionEstimate, fix: Fix, support: float) -> Track:
        """The track after a match: its position is the match's own, its velocity is filtered (Kalman).

        What the track's uncertainty does not explain is an error of the stamp and no velocity; the next frame is
        expected as far off again.

        Args:
            place: of the match.
            fix: the match.
            support: with its evidence.

        Returns:
            Track: at the same time.
        """
        apart_m = place.en_m - self.filtered_m
        unexplained_m2 = 0.5 * float(apart_m @ apart_m) - self.covariance[1, 1]  # so the stamp is further off
        variance_m2 = max(place.sigma_m**2, unexplained_m2)
        gain = self.covariance[:, 1] / (self.covariance[1, 1] + variance_m2)
        gain[0] = 1.0
        left = np.diag([0.0, 1.0, 1.0])
        left[1:, 1] -= gain[1:]
        return replace(
            self,
            en_m=place.en_m,
            filtered_m=self.filtered_m + gain[1] * apart_m,
            velocity_mps=self.velocity_mps + gain[2] * apart_m,
            covariance=left @ self.covariance @ left.T + variance_m2 * np.outer(gain, gain),
            support=support,
            fix=fix,
            misses=0,
        )

    def carried(self, ways: Ways, options: NavigatorOptions) -> Track:
        """The track at the next frame."""
        kept = math.exp(-ways.interval_s / options.memory_s)
        step = ways.stated if self.trusts_velocity and ways.stated is not None else ways.seen
        moved = self._drifted(ways.interval_s, options) if step is None else self._led(step, ways.interval_s)
        moved_m, velocity_mps, covariance = moved
        return replace(
            self,
            en_m=self.en_m + moved_m,
            filtered_m=self.filtered_m + moved_m,
            velocity_mps=velocity_mps,
            covariance=covariance,
            support=self._faded(kept),
            moved_m=moved_m,
        )

    def _led(self, step: Step, interval_s: float) -> tuple[Array, Array, Array]:
        """Its way by a step that a source measured, whose velocity has the error that matches found.

        Returns:
            The way (2,), and velocity (2,) and covariance (3, 3) after it.
        """
        track = self if step.begin_mps is not None else self.with_velocity(step.end_mps, step.sigma_mps)
        begin_mps = step.end_mps if step.begin_mps is None else step.begin_mps
        off_mps = track.velocity_mps - begin_mps
        way = np.array([[1.0, 0.0, interval_s], [0.0, 1.0, interval_s], [0.0, 0.0, 1.0]])
        covariance = way @ track.covariance @ way.T
        covariance[:2, :2] += step.noise_m2
        covariance[2, 2] = max(covariance[2, 2], step.sigma_mps**2)  # the error may change
        return step.moved_m + off_mps * interval_s, step.end_mps + off_mps, covariance

    def _drifted(self, interval_s: float, options: NavigatorOptions) -> tuple[Array, Array, Array]:
        """As :meth:`_led`, if nothing measured the way: an acceleration that changes every second, bounded speed.

        The velocity is an Ornstein-Uhlenbeck process whose standard deviation is half of the highest speed.
        """
        sigma_mps = 0.5 * options.max_speed_mps
        fades_s = 2.0 * (sigma_mps / options.acceleration_mps2) ** 2
        kept = math.exp(-interval_s / fades_s)
        way_s = fades_s * (1.0 - kept)
        way = np.array([[1.0, 0.0, way_s], [0.0, 1.0, way_s], [0.0, 0.0, kept]])
        place = fades_s**2 * (2.0 * interval_s / fades_s - 3.0 + 4.0 * kept - kept**2)
        both = fades_s * (1.0 - kept) ** 2
        noise = np.array([[place, place, both], [place, place, both], [both, both, 1.0 - kept**2]])
        covariance = way @ self.covariance @ way.T + sigma_mps**2 * noise
        covariance[:2, :2] += stamps_m2(self.velocity_mps, options)
        return way_s * self.velocity_mps, kept * self.velocity_mps, covariance


@dataclass(frozen=True, slots=True)
class Match:
    """A match of the newest frame, and what it is to be judged by.

    Attributes:
        fix: the match.
        searched_m2: area that was searched.
        ways: to the frame; a place that no track predicted begins with their velocity.
        height_m: above the ground; if it is unknown, all ground counts as seen before.
        refusals: frames in a row before it without a fix.
        given: another source's position; it speaks for or against a place that no track predicted.
        is_about_given: whether it was searched about that position, so that the two agree and it has spoken.
    """

    fix: Fix
    searched_m2: float
    ways: Ways
    height_m: float | None
    refusals: int
    given: PositionEstimate | None
    is_about_given: bool

    @property
    def support(self) -> float:
        """What it adds to the log-odds of a place that no track predicted.

        Its own evidence takes every second frame to show a place. After n refusals it is one in n + 2 (Laplace). A
        position that rests on the telemetry's attitude alone is as reliable as any other source's.
        """
        most = RELIABLE if self.fix.rests_on_attitude and not self.is_about_given else CERTAIN
        own = min(stated_nats(self.fix) - math.log1p(self.refusals), most)
        if self.given is None or self.is_about_given:
            return own
        here = min(self.given.log_likelihood_ratio(self.fix, self.searched_m2), CERTAIN)
        return own + float(np.logaddexp(math.log(RELIABILITY) + here, math.log(1.0 - RELIABILITY)))

    def new_share(self, track: Track) -> float:
        """The share of its ground that the track's last match did not show; a frame shows about its height."""
        if track.fix is None:
            return 1.0
        return min(1.0, float(np.hypot(*(en_m(self.fix) - en_m(track.fix)))) / (self.height_m or math.inf))


@dataclass(frozen=True, slots=True)
class Weighed:
    """The tracks after a match.

    Attributes:
        tracks: all of them.
        number: of the account that the match belongs to.
        log_odds: that the match is right.
    """

    tracks: Tracks
    number: int
    log_odds: float


@dataclass(frozen=True, slots=True)
class Tracks:
    """The accounts of one flight, the most probable first.

    Attributes:
        options: of the navigator.
        known: at most :data:`MAX_TRACKS`.
        count: of accounts so far.
    """

    options: NavigatorOptions
    known: tuple[Track, ...] = ()
    count: int = 0

    @property
    def best(self) -> Track | None:
        """The most probable one."""
        return self.known[0] if self.known else None

    @property
    def sought(self) -> Track | None:
        """Where to look: the most probable one that is not lost, if there is one."""
        return next((each for each in self.known if not each.is_lost), self.best)

    def of(self, number: int) -> Track | None:
        """The more probable track of an account."""
        return next((each for each in self.known if each.number == number), None)

    def begun(self, start: PositionEstimate, ways: Ways) -> Tracks:
        """With the flight's first account, at a position of another source; the ways are those to its frame."""
        return self._kept(self._born(start, RELIABLE, ways), self.count + 1)

    def carried(self, ways: Ways) -> Tracks:
        """At the next frame."""
        return replace(self, known=tuple(each.carried(ways, self.options) for each in self.known))

    def missed(self) -> Tracks:
        """After a frame without a match; it leaves half of the past evidence, and half of the odds."""
        return self._kept(each.missed(0.5) for each in self.known)

    def weighed(self, match: Match) -> Weighed:
        """After a match, with the probability that it is right.

        The match belongs to the account that predicts it best. If that is right, the match is right by its own
        evidence and by how much better it lies there than anywhere in the searched area; else it lies there by
        chance. The track goes on from it and, unless it is right with the probability asked for, also without it.
        A match that is more probable by itself than by any account begins one.
        """
        fix = match.fix
        place = place_of(fix)
        owners, others = self._owners(match)
        best = max((ratio for ratio, _ in owners), default=0.0)
        with_it, right, wrong = [], [], [0.0, *(each.log_odds for each in others)]
        for ratio, each in owners:
            log_odds = each.log_odds + _gain(each, match, ratio, best)
            nats = stated_nats(fix) + ratio + MISS  # of the match, if the track is right
            with_it.append(each.matched(place, fix, log_odds))
            right.append(log_odds - float(np.logaddexp(0.0, -nats)))
            wrong.append(log_odds - float(np.logaddexp(0.0, nats)))
            if nats < needed_nats(self.options.risk):
                others.append(each.missed().at(wrong[-1]))
        count = self.count
        if all(each.log_odds < match.support for each in with_it):  # the vehicle is rather elsewhere, namely here
            with_it += self._born(place, match.support, match.ways, fix)
            right.append(match.support)
            count += 1
        odds = float(np.logaddexp.reduce(right)) - float(np.logaddexp.reduce(wrong))
        number = max(with_it, key=lambda each: each.log_odds).number
        return Weighed(self._kept([*others, *with_it], count), number, odds)

    def _owners(self, match: Match) -> tuple[list[tuple[float, Track]], list[Track]]:
        """The tracks of the account that predicts a match best, with how well they do, and all others."""
        near, gate = [], self.options.gate
        for each in self.known:
            estimate = each.estimate
            if estimate.chi_square(match.fix) <= gate:
                ratio = estimate.log_likelihood_ratio(match.fix, match.searched_m2)
                near.append((max(ratio, -CERTAIN), each))
        number = max(near, key=lambda pair: pair[0])[1].number if near else None
        owners = [(ratio, each) for ratio, each in near if each.number == number]
        taken = {id(each) for _, each in owners}
        return owners, [each.missed() for each in self.known if id(each) not in taken]

    def _born(self, place: PositionEstimate, support: float, ways: Ways, fix: Fix | None = None) -> list[Track]:
        """The two tracks of a new account, whose velocity is unknown but for the telemetry's or the pictures'."""
        begun = Track.begun(place, support, self.count, fix)
        led = free = begun.with_velocity(np.zeros(2), 0.5 * self.options.max_speed_mps)
        if ways.seen is not None:
            led = free = begun.with_velocity(ways.seen.end_mps, ways.seen.sigma_mps)
        if ways.stated is not None:
            led = begun.with_velocity(ways.stated.end_mps, ways.stated.sigma_mps)
        return [led, replace(free, support=support - CERTAIN, trusts_velocity=False)]

    def _kept(self, tracks: Iterable[Track], count: int | None = None) -> Tracks:
        """The most probable tracks of these; of those that share their newest match, one of each motion."""
        groups: dict[int, list[Track]] = {}
        for each in tracks:
            groups.setdefault(id(each.fix), []).append(each)
        pairs = sorted(map(_paired, groups.values()), key=lambda pair: -pair[0].log_odds)
        known = [each for k, pair in enumerate(pairs) if k == 0 or not pair[0].is_lost for each in pair]
        return replace(self, known=tuple(known[:MAX_TRACKS]), count=self.count if count is None else count)


def _gain(track: Track, match: Match, ratio: float, best: float) -> float:
    """What a match that agrees with a track adds to its log-odds.

    A wrong match of repeated structure recurs as long as the frame shows the same ground, and a wrong attitude
    moves all matches that rest on it alike.

    Args:
        track: at the match's frame.
        match: the match.
        ratio: how much better it lies here than anywhere, by the track's Gaussian.
        best: the same for the best of the tracks that it agrees with.
    """
    share = match.new_share(track)
    if match.fix.rests_on_attitude and track.fix is not None and track.fix.rests_on_attitude:
        return ratio - best
    own = (_SAME_GROUND + (1.0 - _SAME_GROUND) * share) * min(stated_nats(match.fix), CERTAIN)
    return own + share * min(best, CERTAIN) + ratio - best


def _paired(tracks: list[Track]) -> list[Track]:
    """Of tracks that share their newest match the best with the velocity and the best without; the better first.

    The velocity may become wrong, or right again, at any frame: neither becomes improbable for good.
    """
    first = max(tracks, key=lambda each: each.log_odds)
    others = (each for each in tracks if each.trusts_velocity is not first.trusts_velocity)
    other = max(others, key=lambda each: each.log_odds, default=None)
    least = first.log_odds - CERTAIN
    if other is None or other.log_odds < least:
        other = replace(other or first, trusts_velocity=not first.trusts_velocity).at(least)
    return [first, other]
