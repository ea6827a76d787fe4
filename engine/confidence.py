"""The confidence model: how probable it is that a peak or a pose is of the right place.

A peak is high over a wrong place too, where streets or furrows look alike. Three features tell the two apart: how
far the peak stands out from chance, how near its best rival comes, and how well its position agrees with the
prior. A logistic function of these gives the probability; its weights were fitted by ``python -m
bench.accuracy.confidence`` on simulated towns. Votes of the frame's blocks, each with its shift, added nothing.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from engine.geo import chi_square
from engine.values import Fix, Peak

_MAX_LOG10_ALARMS = 60.0  # beyond that nothing becomes more probable
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
        agreement: of its position with the prior.
    """

    sigmas: float
    ratio: float
    agreement: PriorAgreement


@dataclass(frozen=True, slots=True)
class PoseFeatures:
    """The features of a pose by matched keypoints.

    Attributes:
        log10_nfa: log10 of the number of false alarms, the poses that chance would support as well.
        prior_chi_square: of the position against the prior, with two degrees of freedom; None without a prior.
        height_chi_square: of the height against the telemetry's, with one degree of freedom; None where the
            height is unknown or doubted.
    """

    log10_nfa: float
    prior_chi_square: float | None
    height_chi_square: float | None


@dataclass(frozen=True, slots=True)
class PeakModel:
    """Weights of :func:`regressors`; their sum is log(p / (1 - p))."""

    constant: float
    log_sigmas: float
    ratio: float
    prior_chi_square: float
    log_spread: float


PEAK_MODEL = PeakModel(constant=16.158, log_sigmas=0.536, ratio=-14.075, prior_chi_square=-0.568, log_spread=-1.39)
"""Fitted on 6,000 matches over six towns, half of them of frames that show no place in their window."""


@dataclass(frozen=True, slots=True)
class PoseModel:
    """Weights of :func:`regressors` of a pose."""

    constant: float
    false_alarms: float
    prior_chi_square: float
    no_prior: float
    height_chi_square: float
    no_height: float


POSE_MODEL = PoseModel(
    constant=3.934,
    false_alarms=0.769,
    prior_chi_square=-0.144,
    no_prior=-1.819,
    height_chi_square=-0.264,
    no_height=0.511,
)
"""Fitted on 4,200 matches, with parts of the telemetry left out in turns and frames reduced as for budgets."""


def peak_features(peak: Peak, sigma: float, agreement: PriorAgreement) -> PeakFeatures:
    """The features of a correlation peak.

    Args:
        peak: the peak.
        sigma: one standard deviation of a score of chance, from :func:`engine.covariance.score_sigma`.
        agreement: of its position with the prior.
    """
    z = math.atanh(min(max(peak.score, 0.0), 0.999))
    ratio = max(peak.second_score, 0.0) / max(peak.score, 1e-3)
    return PeakFeatures(sigmas=z / sigma, ratio=min(ratio, 1.0), agreement=agreement)


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

    Sigmas and false alarms enter by their logarithms: from 10 to 20 sigmas is the same step as from 5 to 10.

    Args:
        features: of a peak or of a pose.

    Returns:
        (5,) of a peak or (6,) of a pose, in the order of the model's weights.
    """
    if isinstance(features, PeakFeatures):
        prior_chi_square, spread_m = features.agreement.prior_chi_square, features.agreement.spread_m
        sigmas = math.log(max(features.sigmas, 0.5))
        return np.array(
            [1.0, sigmas, features.ratio, min(prior_chi_square, _MAX_CHI_SQUARE), math.log(max(spread_m, 1.0))]
        )
    known = [_known(features.prior_chi_square), _known(features.height_chi_square)]
    alarms = min(max(-features.log10_nfa, 0.0), _MAX_LOG10_ALARMS)
    return np.array([1.0, math.sqrt(alarms), *known[0], *known[1]])


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
    logit = float(np.dot(astuple(model), regressors(features)))
    return 1.0 / (1.0 + math.exp(-logit))
