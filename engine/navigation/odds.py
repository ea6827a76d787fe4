"""Evidence: the probability that a match is right, from its own figures and from other knowledge.

Log-odds, log(p / (1 - p)), of independent evidence add up. Evidence with a common source does not: a match's own
probability already includes the prior it was searched with, and frames of the same ground show the same texture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from engine.matching.evidence import RELIABILITY
from engine.navigation.motion import PositionEstimate
from engine.orthomap import OrthoMap
from engine.values import Fix, Prior

MAX_PROBABILITY = 0.9999
"""Highest probability of a match or track: confidence models were tested on only some ten thousand matches."""
UNSTATED_PROBABILITY = 0.98
"""Probability assumed for a match that states none, as the paper's."""
_SAME_GROUND = 0.5  # weight of a match of ground that was matched before
_HEIGHT_M = 100.0  # assumed if it is unknown


def log_odds(probability: float) -> float:
    """log(p / (1 - p)), limited to :data:`MAX_PROBABILITY` on either side."""
    p = min(max(probability, 1.0 - MAX_PROBABILITY), MAX_PROBABILITY)
    return math.log(p / (1.0 - p))


def probability(odds: float) -> float:
    """The probability of log-odds."""
    return 1.0 / (1.0 + math.exp(-odds))


def match_log_odds(fix: Fix) -> float:
    """Log-odds of a match by itself, if every second frame shows a place in its window."""
    return log_odds(UNSTATED_PROBABILITY if fix.confidence is None else fix.confidence)


def position_of(prior: Prior, site: OrthoMap) -> PositionEstimate:
    """The position from another source, as reliable as that source can be.

    Args:
        prior: by the other source.
        site: the map that defines the axes.
    """
    if prior.east_m is not None and prior.north_m is not None:
        return PositionEstimate(np.array([prior.east_m, prior.north_m]), prior.sigma_m, log_odds(RELIABILITY))
    assert prior.lat_deg is not None  # a Prior has one of the two
    assert prior.lon_deg is not None
    place_m = site.frame.enu_from_geodetic(prior.lat_deg, prior.lon_deg)
    return PositionEstimate(np.asarray(place_m[:2], np.float64), prior.sigma_m, log_odds(RELIABILITY))


def new_ground_share(moved_m: float, height_m: float | None) -> float:
    """The share of a second frame's ground that the first did not show.

    Args:
        moved_m: between the two.
        height_m: above the ground; a frame shows about as much ground.
    """
    return min(1.0, moved_m / (height_m or _HEIGHT_M))


def repeated_log_odds(fix: Fix, agreement: float, new_share: float) -> float:
    """What a second match of one place adds to the first.

    A wrong match of repeated structure recurs at the same place as long as the frame shows the same ground.

    Args:
        fix: the second match.
        agreement: how well it agrees with the first position, as log-odds.
        new_share: the share of its ground that is new.
    """
    weight = _SAME_GROUND + (1.0 - _SAME_GROUND) * new_share
    return weight * match_log_odds(fix) + new_share * agreement


def agreement_log_odds(estimate: PositionEstimate, fix: Fix, area_m2: float) -> float:
    """What an independent estimate adds to the match's log-odds.

    A right match lies about the estimate by the covariances of both, a wrong one anywhere in the area that was
    searched. Where the estimate itself is wrong, it says nothing.

    Args:
        estimate: of the position, by other means.
        fix: the match.
        area_m2: the searched area.
    """
    covariance = 2.0 * math.pi * estimate.difference_covariance_m2(fix)
    log_density = -0.5 * (estimate.chi_square(fix) + math.log(float(np.linalg.det(covariance))))
    log_area = math.log(area_m2 + 2.0 * math.pi * estimate.sigma_m**2)  # a vaguer estimate adds nothing
    wrong = probability(-estimate.log_odds)
    log_right = math.log1p(-wrong) + log_area + log_density
    return min(float(np.logaddexp(log_right, math.log(wrong))), log_odds(MAX_PROBABILITY))


@dataclass(frozen=True, slots=True)
class Sources:
    """What is known about the position at one frame, apart from its image.

    Attributes:
        own: dead reckoning from the last fix or the start.
        given: from another source, with the frame.
        pending: dead reckoning from a match that has not been accepted yet.
        searched: the estimate around which the matcher searched; None for the whole map.
        prior: the matcher's prior, made from ``searched``.
    """

    own: PositionEstimate | None
    given: PositionEstimate | None
    pending: PositionEstimate | None
    searched: PositionEstimate | None = None
    prior: Prior | None = None

    def evidence_of(
        self, estimate: PositionEstimate | None, fix: Fix, window_m2: float, gate: float, trusted_sigma_m: float
    ) -> float:
        """What an estimate adds to the log-odds of a match.

        A match's confidence assumes that every second frame shows a place in its window, and already weighs how
        well position and prior agree. The estimate that was searched around therefore adds only the probability
        that the window shows the place. A match without a confidence has not weighed a vague estimate.

        Args:
            estimate: one of these estimates; None adds nothing.
            fix: the match.
            window_m2: area of the window that was searched.
            gate: chi-square beyond which the two contradict each other.
            trusted_sigma_m: an estimate less certain than this is vague.
        """
        if estimate is None:
            return 0.0
        if estimate is not self.searched:
            return agreement_log_odds(estimate, fix, self.searched_m2(window_m2))
        if estimate.chi_square(fix) > gate:
            return -estimate.log_odds
        weighed = fix.confidence is not None or estimate.sigma_m <= trusted_sigma_m
        return estimate.log_odds if weighed else 0.0

    def searched_m2(self, window_m2: float) -> float:
        """The area of equally probable places: the whole window, or that of the prior's Gaussian."""
        return window_m2 if self.prior is None else 2.0 * math.pi * self.prior.sigma_m**2
