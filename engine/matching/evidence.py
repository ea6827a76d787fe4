"""Evidence: log-likelihood ratios that decide whether a place is right.

Evidence, in nats, is log p(match | the frame was taken there) - log p(match | it was taken elsewhere, by chance).
Independent evidence adds up, and a fix is accepted if its probability of being wrong is at most the allowed risk.
Chance is measured on the frame itself: by pairs of its own matches that are known to be wrong, by the best rival
elsewhere, by the refined pose moved to places about it and, in doubt, by the mirrored frame, which shows no place
on Earth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.geo import chi_square
from engine.values import Fix
from engine.window import SPREAD_SIGMAS

RELIABILITY = 0.99
"""Probability that a position or a height is right to within its standard deviation; else it may be anything."""
SEARCHED = (2.0 * SPREAD_SIGMAS) ** 2 / (2.0 * math.pi)
"""Area of a window over that of the prior's Gaussian: how much more probable its middle is than other places."""
_MAX_NATS = 30.0  # above it a probability is 1 to the last digit
_UNREFINABLE = 0.02  # share of right places where no pose can be refined: 4 of 190 over six simulated towns
_PLACE_PX = 4.0  # side of the area that counts as one place: enhanced pictures vary on this scale


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence for the best of many places, from extreme values of chance.

    Surprise is -log of the probability that chance does as well at one place: the best of n places is expected at
    log n, and reaches s with probability n exp(-s). The rival, the best elsewhere or of a null hypothesis, shows
    what chance reached. If that is more than its many places explain, places here look alike, and a surprise is
    worth so much less.

    Attributes:
        surprise: of the match.
        rival: the surprise of the best match elsewhere.
        measured: places among which the rival is the best; 2 or more.
        tried: places, times headings and heights, among which the match is the best; at least ``measured``.
        prior_chi_square: of the position against the prior, with two degrees of freedom; None without a prior.
        height_chi_square: of the height against the telemetry's, with one degree of freedom; None if it was not
            measured, or the telemetry's is unknown or doubted.
        null: the surprise of the null hypothesis, the mirrored frame; 0 if it was not matched, or is a rival.
        elsewhere: the evidence for the best other place that another attempt found.
        is_tested: whether the null hypothesis was tested, is among the rivals, or needs no test because a picture
            confirmed the pose; if not, only evidence beyond doubt counts.
        least_alike: how much places looked alike to another look at the frame, on another level; at least 1.
        refined: the surprise of the pose refined there, less what was tried for it; -inf if none could be refined,
            as at few right places, which costs 3.9 nats; None if it was not tried, or says nothing.
    """

    surprise: float
    rival: float
    measured: float
    tried: float
    prior_chi_square: float | None
    height_chi_square: float | None = None
    null: float = 0.0
    elsewhere: float = 0.0
    is_tested: bool = False
    least_alike: float = 1.0
    refined: float | None = None

    @property
    def chance(self) -> float:
        """The surprise that chance reached: of the rival or of the null hypothesis."""
        return max(self.rival, self.null)

    @property
    def alike(self) -> float:
        """How much less a surprise is worth because places look alike: 1 if they do not."""
        return max(self.least_alike, min(self.chance, self.surprise) / math.log(self.measured))

    @property
    def nats(self) -> float:
        """The greater of what the match and its refined pose show, plus what was known before, less elsewhere."""
        seen = max(self.surprise / self.alike - math.log(self.tried), 0.0)
        if self.refined is not None:  # peak and pose compare the same picture: the greater evidence counts
            is_refined = _UNREFINABLE + (1.0 - _UNREFINABLE) * probability(self.of_pose)
            seen = max(seen + math.log(is_refined), self._of_correlation - math.log(self.tried))
        return seen + _of_position(self.prior_chi_square) + _of_height(self.height_chi_square) - self.elsewhere

    @property
    def of_pose(self) -> float:
        """The evidence for the refined pose at this place, against other poses there."""
        return self._of_correlation + _of_position(self.prior_chi_square)

    @property
    def _of_correlation(self) -> float:
        """The evidence of the refined pose's correlation at one place; a rival as good as the peak leaves none."""
        if self.refined is None or self.chance >= self.surprise:
            return -math.inf
        return self.refined * (1.0 - self.chance / self.surprise)

    def promises(self, risk: float) -> bool:
        """Whether it suffices unless the null hypothesis, if that is not tested yet, does as well."""
        return self.nats >= needed_nats(risk)

    def suffices(self, risk: float) -> bool:
        """Whether a fix may be handed out: it is wrong with at most this probability."""
        return self.promises(risk) and (self.is_tested or is_beyond_doubt(self.nats, risk))


def independent_places(positions: float) -> float:
    """Number of independent places among this many pixel positions: neighbours belong to one place."""
    return max(positions / _PLACE_PX**2, math.e)


def surprise_of(score: float, sigma: float) -> float:
    """The surprise of a score in [-1, 1], 0 if negative: Fisher's z is normal, with this sigma by chance."""
    return (math.atanh(min(max(score, 0.0), 0.999)) / sigma) ** 2 / 2.0


def prior_chi_square(fix: Fix, prior_m: NDArray[np.float64], sigma_m: float) -> float:
    """Chi-square, with two degrees of freedom, of a position against the prior, by the errors of both.

    Args:
        fix: not accepted yet; the prior is a place on the map and shares the map's error.
        prior_m: (2,) east and north in metres.
        sigma_m: standard deviation of the prior, per axis.

    Returns:
        float: small if they agree.
    """
    apart_m = np.array([fix.east_m, fix.north_m]) - prior_m
    return chi_square(apart_m, fix.relative_covariance_m2 + sigma_m**2 * np.eye(2))


def _of_position(chi_square: float | None) -> float:
    """Evidence for a place at this distance from the prior's, against one anywhere in the window."""
    return 0.0 if chi_square is None else math.log(_gaussian(chi_square) * SEARCHED + 1.0 - RELIABILITY)


def _of_height(chi_square: float | None) -> float:
    """Evidence of a height this far from the telemetry's. Agreement adds none: wrong poses agree as well."""
    return 0.0 if chi_square is None else math.log(_gaussian(chi_square) + 1.0 - RELIABILITY)


def _gaussian(chi_square: float) -> float:
    return RELIABILITY * math.exp(-0.5 * min(chi_square, 1e3))


def probability(nats: float) -> float:
    """The probability, in (0, 1), that a place is right, if every second frame shows a place in its window."""
    return 1.0 / (1.0 + math.exp(-min(max(nats, -_MAX_NATS), _MAX_NATS)))


def nats_of(probability: float) -> float:
    """The evidence that gives a probability; capped for one of 0 or 1."""
    least = math.exp(-_MAX_NATS)
    return min(math.log(max(probability, least) / max(1.0 - probability, least)), _MAX_NATS)


def is_beyond_doubt(nats: float, risk: float) -> bool:
    """Whether the evidence suffices for the cube of the risk: no null hypothesis is needed.

    Mirrored frames over symmetric ground, which are no chance, reached the square.
    """
    return nats >= 3.0 * needed_nats(risk)


def is_hopeless(nats: float, risk: float) -> bool:
    """Whether there is less than half of the evidence needed, too little for a closer look to help."""
    return nats < 0.5 * needed_nats(risk)


def needed_nats(risk: float) -> float:
    """The evidence at which a fix is wrong with at most this probability.

    Args:
        risk: in (0, 1).
    """
    return math.log((1.0 - risk) / risk)
