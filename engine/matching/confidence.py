"""The confidence model: how probable it is that a peak or a pose is of the right place.

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

_MAX_LOG10_ALARMS = 60.0  # beyond that nothing becomes more probable
_MAX_LEAD = 50.0  # sigmas, as well
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
class PoseFeatures:
    """The features of a pose by matched keypoints.

    Attributes:
        log10_nfa: log10 of the number of false alarms, the poses that chance would support as well.
        prior_chi_square: of the position against the prior, with two degrees of freedom; None without a prior.
        height_chi_square: of the height against the telemetry's, with one degree of freedom; None where the
            height is unknown or doubted.
        rival_share: votes of the best translation elsewhere over those of this one; None where matches did not
            vote, and ``log10_nfa`` is of the pose.
    """

    log10_nfa: float
    prior_chi_square: float | None
    height_chi_square: float | None
    rival_share: float | None = None


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


@dataclass(frozen=True, slots=True)
class PoseModel:
    """Weights of :func:`regressors` of a pose."""

    constant: float
    false_alarms: float
    prior_chi_square: float
    no_prior: float
    height_chi_square: float
    no_height: float
    rival_share: float
    no_vote: float


POSE_MODEL = PoseModel(
    constant=0.775,
    false_alarms=1.849,
    prior_chi_square=-0.414,
    no_prior=-4.696,
    height_chi_square=-0.511,
    no_height=1.715,
    rival_share=-1.418,
    no_vote=3.49,
)
"""Fitted on 2,200 matches: over towns, with parts of the telemetry left out in turns and frames reduced as for
budgets, and of years (the halves of cities and farmland for fitting)."""


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


def regressors(features: PeakFeatures | PoseFeatures) -> NDArray[np.float64]:
    """What the weights are multiplied by.

    A peak counts by its lead, the sigmas by which it stands above its best rival, a pose by its false alarms, both
    by their roots: the first sigmas of a lead say more than the next.

    Args:
        features: of a peak or of a pose.

    Returns:
        (5,) of a peak or (8,) of a pose, in the order of the model's weights.
    """
    if isinstance(features, PeakFeatures):
        prior_chi_square, spread_m = features.agreement.prior_chi_square, features.agreement.spread_m
        lead = min(max(features.sigmas, 0.0) * (1.0 - features.ratio), _MAX_LEAD)
        off, spread = min(prior_chi_square, _MAX_CHI_SQUARE), math.log(max(spread_m, 1.0))
        return np.array([1.0, math.sqrt(lead), off, spread, math.log(max(features.score, _MIN_SCORE))])
    known = [_known(features.prior_chi_square), _known(features.height_chi_square), _known(features.rival_share)]
    alarms = min(max(-features.log10_nfa, 0.0), _MAX_LOG10_ALARMS)
    return np.array([1.0, math.sqrt(alarms), *known[0], *known[1], *known[2]])


def _known(chi_square: float | None) -> tuple[float, float]:
    """A chi-square, limited, and whether it is missing."""
    return (0.0, 1.0) if chi_square is None else (min(chi_square, _MAX_CHI_SQUARE), 0.0)


def probability(features: PeakFeatures | PoseFeatures, model: PeakModel | PoseModel | None = None) -> float:
    """Probability in (0, 1) that the place is right, where every second frame shows a place in its window.

    Args:
        features: of a peak or of a pose.
        model: weights; None takes the fitted ones.
    """
    model = model or (PEAK_MODEL if isinstance(features, PeakFeatures) else POSE_MODEL)
    logit = float(np.dot(_weights(model), regressors(features)))
    return 1.0 / (1.0 + math.exp(-logit))


@lru_cache
def _weights(model: PeakModel | PoseModel) -> NDArray[np.float64]:
    return np.array(astuple(model))
