"""Evidence: the currency in which it is decided whether a place is right.

Log-evidence, in nats, is log p(what was seen | it was taken there) - log p(the same | it was taken somewhere else,
that looks like chance). Independent evidence adds up, and a fix is handed out if the odds that the sum gives leave
no more than the risk that is allowed. What chance does is measured on the frame itself: by the pairs of its own
matches that are known to be wrong, by the best rival elsewhere, and, in doubt, by the same frame mirrored, which
shows no place on Earth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.geo import chi_square
from engine.values import Fix
from engine.window import SPREAD_SIGMAS

INDEPENDENT = 0.7
"""Which share of what matches say is independent: keypoints overlap, and several lie on one thing. Fitted on towns
and on the places for fitting, so that evidence e for a wrong place is met no more often than exp(-e)."""
RELIABILITY = 0.99
"""Probability that a position, or a height, holds within its standard deviation; else it may be anything."""
_SEARCHED = (2.0 * SPREAD_SIGMAS) ** 2 / (2.0 * math.pi)
"""Area of a window over that of the prior's Gaussian: by so much its middle is more probable than other places."""
_MAX_NATS = 30.0  # beyond which a probability is 1 to the last digit
_PLACE_PX = 4.0  # side of the area whose scores are one place's: an enhanced picture changes over so many pixels


@dataclass(frozen=True, slots=True)
class PeakEvidence:
    """What speaks for the highest peak of a correlation surface: extreme values of chance.

    Scores of chance are normal: the best of n places is expected at sqrt(2 ln n) sigmas, and reaches s sigmas with
    a probability of n exp(-s^2 / 2). The rival, the best score elsewhere or of the null hypothesis, is what chance
    reached. If it is higher than so many places explain, places here look alike, and a sigma is as much more.

    Attributes:
        sigmas: Fisher's z of the score, in standard deviations of chance.
        rival_sigmas: the same of the rival.
        measured: places among which the rival is the best.
        tried: places, times headings and heights, among which the peak is the best; no fewer.
        prior_chi_square: of the position against the prior, with two degrees of freedom; None without a prior.
    """

    sigmas: float
    rival_sigmas: float
    measured: float
    tried: float
    prior_chi_square: float | None

    @property
    def nats(self) -> float:
        """The sum of all of it."""
        alike = max(1.0, min(self.rival_sigmas, self.sigmas) / _expected_sigmas(self.measured))
        seen = (self.sigmas / alike) ** 2 / 2.0 - math.log(self.tried)
        return max(seen, 0.0) + _of_position(self.prior_chi_square)


def _expected_sigmas(places: float) -> float:
    return math.sqrt(2.0 * math.log(places))


def independent_places(positions: float) -> float:
    """How many places so many positions, in pixels, are: scores of neighbours are of one place."""
    return max(positions / _PLACE_PX**2, math.e)


def sigmas_of(score: float, sigma: float) -> float:
    """Fisher's z of a score in [-1, 1], 0 of a negative one, in standard deviations of a score of chance."""
    return math.atanh(min(max(score, 0.0), 0.999)) / sigma


def prior_chi_square(fix: Fix, prior_m: NDArray[np.float64], sigma_m: float) -> float:
    """Chi-square, of two degrees of freedom, of a position against the prior by the errors of both.

    Args:
        fix: not accepted yet; an error of the map is the prior's as well, which is a place on it.
        prior_m: (2,) east and north in metres.
        sigma_m: standard deviation of the prior, per axis.

    Returns:
        float: small if they agree.
    """
    apart_m = np.array([fix.east_m, fix.north_m]) - prior_m
    return chi_square(apart_m, fix.relative_covariance_m2 + sigma_m**2 * np.eye(2))


@dataclass(frozen=True, slots=True)
class PoseEvidence:
    """What speaks for a pose by matched keypoints.

    Attributes:
        log10_nfa: log10 of the number of false alarms, the poses that chance would support as well.
        prior_chi_square: of the position against the prior, with two degrees of freedom; None without a prior.
        height_chi_square: of the height against the telemetry's, with one degree of freedom; None if the
            height is unknown or doubted.
        rival_share: votes of the best translation elsewhere over those of this one; 0 where matches did not vote,
            and ``log10_nfa`` is of the pose.
        null_log10_nfa: log10 of the false alarms that the mirrored frame reaches; 0 where it was not asked.
    """

    log10_nfa: float
    prior_chi_square: float | None
    height_chi_square: float | None
    rival_share: float = 0.0
    null_log10_nfa: float = 0.0

    @property
    def nats(self) -> float:
        """The sum of all of it."""
        alarms = max(-self.log10_nfa, 0.0)
        chance = max(self.rival_share * alarms, -self.null_log10_nfa)
        seen = INDEPENDENT * math.log(10.0) * max(alarms - chance, 0.0)
        return seen + _of_position(self.prior_chi_square) + _of_height(self.height_chi_square)


def _of_position(chi_square: float | None) -> float:
    """Of a place that lies so far from the prior's, against one anywhere in the window."""
    return 0.0 if chi_square is None else math.log(_gaussian(chi_square) * _SEARCHED + 1.0 - RELIABILITY)


def _of_height(chi_square: float | None) -> float:
    """Of a height that lies so far from the telemetry's. Agreement says nothing: wrong poses agree as well."""
    return 0.0 if chi_square is None else math.log(_gaussian(chi_square) + 1.0 - RELIABILITY)


def _gaussian(chi_square: float) -> float:
    return RELIABILITY * math.exp(-0.5 * min(chi_square, 1e3))


def probability(nats: float) -> float:
    """The probability, in (0, 1), that a place is right, where every second frame shows a place in its window."""
    return 1.0 / (1.0 + math.exp(-min(max(nats, -_MAX_NATS), _MAX_NATS)))


def nats_of(probability: float) -> float:
    """The evidence that gives a probability; that of 1 is as much as counts."""
    return min(math.log(probability / max(1.0 - probability, math.exp(-_MAX_NATS))), _MAX_NATS)


def is_beyond_doubt(nats: float, risk: float) -> bool:
    """Whether a place has evidence for the square of the risk: no null hypothesis is asked."""
    return nats >= 2.0 * needed_nats(risk)


def is_hopeless(nats: float, risk: float) -> bool:
    """Whether a place has less than half of the evidence that is needed, so that no closer look will bring it."""
    return nats < 0.5 * needed_nats(risk)


def needed_nats(risk: float) -> float:
    """The evidence at which a fix is wrong with no more than this probability.

    Args:
        risk: in (0, 1).
    """
    return math.log((1.0 - risk) / risk)
