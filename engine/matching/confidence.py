"""The confidence model: how probable it is that a peak is of the right place; poses have :mod:`.evidence`.

A peak is high over a wrong place too, where streets or furrows look alike. What tells the two apart: how far the
peak stands above its best rival, measured by chance; how much frame and map have in common there; and how well
its position agrees with the prior. A logistic function of these gives the probability; ``python -m
bench.accuracy.confidence`` fitted its weights on simulated towns and on real pictures of one year on the map of
another. Votes of the frame's blocks, each with its shift, added nothing.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from engine.geo import chi_square
from engine.values import Fix, Peak

_MAX_LEAD = 50.0  # sigmas, beyond which nothing becomes more probable
_MIN_SCORE = 0.02  # below that nothing becomes less probable
_MAX_CHI_SQUARE = 12.0  # beyond that the prior may be the one that is wrong


@dataclass(frozen=True, slots=True)
class PriorAgreement:
    """How well a position agrees with the prior.

    Attributes:
        prior_chi_square: of the position against the prior by the errors of both, with two degrees of freedom.
        spread_m: one standard deviation of these errors, the mean of both axes: the larger, the more wrong places
            would agree as well.
    """

    prior_chi_square: float
    spread_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PeakFeatures:
    """The features of one peak.

    Attributes:
        sigmas: Fisher's z of the score, in standard deviations of chance.
        ratio: the best rival's score as a share of the peak's, in [0, 1].
        score: of the peak: chance is one thing, and how much two pictures of one place have in common another.
        agreement: of its position with the prior.
    """

    sigmas: float
    ratio: float
    score: float
    agreement: PriorAgreement


@dataclass(frozen=True, slots=True)
class PeakModel:
    """Weights of :func:`regressors`; their sum is log(p / (1 - p))."""

    constant: float
    root_lead: float
    prior_chi_square: float
    log_spread: float
    log_score: float


PEAK_MODEL = PeakModel(constant=4.16, root_lead=3.85, prior_chi_square=-0.43, log_spread=-1.79, log_score=0.93)
"""Of the first look: fitted on matches over towns and of years, half of them of frames without a place there."""

SECOND_LOOK_MODEL = PeakModel(
    constant=6.6, root_lead=3.77, prior_chi_square=-0.57, log_spread=-1.64, log_score=2.42
)
"""Of the second look, fitted on the same matches."""


def peak_features(peak: Peak, sigma: float, agreement: PriorAgreement) -> PeakFeatures:
    """The features of a correlation peak.

    Args:
        peak: the peak.
        sigma: one standard deviation of a score of chance, from :func:`engine.matching.covariance.score_sigma`.
        agreement: of its position with the prior.
    """
    z = math.atanh(min(max(peak.score, 0.0), 0.999))
    ratio = max(peak.second_score, 0.0) / max(peak.score, 1e-3)
    return PeakFeatures(sigmas=z / sigma, ratio=min(ratio, 1.0), score=peak.score, agreement=agreement)


def prior_agreement(fix: Fix, prior_m: NDArray[np.float64], sigma_m: float) -> PriorAgreement:
    """How well a fix agrees with a prior.

    Args:
        fix: not accepted yet.
        prior_m: (2,) east and north in metres.
        sigma_m: standard deviation of the prior, per axis.

    Returns:
        PriorAgreement: by the covariances of both. An error of the map is the prior's, which is a place on it.
    """
    apart = np.array([fix.east_m, fix.north_m]) - prior_m
    allowed = fix.relative_covariance_m2 + sigma_m**2 * np.eye(2)
    return PriorAgreement(chi_square(apart, allowed), float(np.linalg.det(allowed)) ** 0.25)


def regressors(features: PeakFeatures) -> NDArray[np.float64]:
    """What the weights are multiplied by.

    A peak counts by the root of its lead, the sigmas by which it stands above its best rival: the first sigmas of
    a lead say more than the next.

    Args:
        features: of a peak.

    Returns:
        (5,) in the order of the model's weights.
    """
    prior_chi_square, spread_m = features.agreement.prior_chi_square, features.agreement.spread_m
    lead = min(max(features.sigmas, 0.0) * (1.0 - features.ratio), _MAX_LEAD)
    off, spread = min(prior_chi_square, _MAX_CHI_SQUARE), math.log(max(spread_m, 1.0))
    return np.array([1.0, math.sqrt(lead), off, spread, math.log(max(features.score, _MIN_SCORE))])


def probability(features: PeakFeatures, model: PeakModel = PEAK_MODEL) -> float:
    """Probability in (0, 1) that the place is right, where every second frame shows a place in its window.

    Args:
        features: of a peak.
        model: weights.
    """
    logit = float(np.dot(_weights(model), regressors(features)))
    return 1.0 / (1.0 + math.exp(-logit))


@lru_cache
def _weights(model: PeakModel) -> NDArray[np.float64]:
    return np.array(astuple(model))
