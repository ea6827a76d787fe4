"""What a peak or a pose has to say for itself, and how probable it is then that it is the right place.

A peak is high over a wrong place too, where streets or furrows run alike. What tells the two apart is how far it
stands out from chance, how near its best rival comes, and whether the place is where it was expected. One logistic
function of these gives the probability; its constants were fitted by ``python -m bench.accuracy.confidence`` on
simulated towns. Votes of the frame's blocks, each on its own shift, were tried there too and added nothing.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from engine.geo import chi_square
from engine.values import Fix, Peak

_MAX_LOG10_ALARMS = 60.0  # powers of ten; beyond them nothing is surer
_MAX_CHI_SQUARE = 12.0  # chi-square against the prior: beyond it the prior may be the one that is wrong


@dataclass(frozen=True, slots=True)
class PriorAgreement:
    """How a place lies to where it was expected.

    Attributes:
        prior_chi_square: of the position against the prior by the errors of both, with two degrees of freedom.
        spread_m: one standard deviation of these errors, the mean of both axes: the wider, the more places would
            have done as well.
    """

    prior_chi_square: float
    spread_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PeakFeatures:
    """What was measured of one peak.

    Attributes:
        sigmas: Fisher's z of the score, in standard deviations of chance.
        ratio: the best rival's score as a share of the peak's, in [0, 1].
        expected: how its place lies to the prior.
    """

    sigmas: float
    ratio: float
    expected: PriorAgreement


@dataclass(frozen=True, slots=True)
class PoseFeatures:
    """What was measured of a pose by matched features.

    Attributes:
        log10_nfa: log10 of how many poses chance would support as well.
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
"""Of 6,000 matches over six towns, half of them without an answer."""


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
"""Of 4,200 matches, with what telemetry tells left out in turns and the frame reduced as budgets ask."""


def peak_features(peak: Peak, sigma: float, expected: PriorAgreement) -> PeakFeatures:
    """The evidence of a peak.

    Args:
        peak: the peak.
        sigma: one standard deviation of a score of chance, from :func:`engine.integrity.score_sigma`.
        expected: how its place lies to the prior.
    """
    z = math.atanh(min(max(peak.score, 0.0), 0.999))
    ratio = max(peak.second_score, 0.0) / max(peak.score, 1e-3)
    return PeakFeatures(sigmas=z / sigma, ratio=min(ratio, 1.0), expected=expected)


def prior_agreement(fix: Fix, prior_m: NDArray[np.float64], sigma_m: float) -> PriorAgreement:
    """How a fix lies to a prior (2,) east and north with one standard deviation per axis."""
    apart = np.array([fix.east_m, fix.north_m]) - prior_m
    allowed = fix.covariance_m2[:2, :2] + sigma_m**2 * np.eye(2)
    return PriorAgreement(chi_square(apart, allowed), float(np.linalg.det(allowed)) ** 0.25)


def regressors(evidence: PeakFeatures | PoseFeatures) -> NDArray[np.float64]:
    """(5,) of a peak or (6,) of a pose: what the weights are multiplied by.

    Sigmas and false alarms enter by their logarithms: 20 sigmas instead of 10 say as much as 10 instead of 5.
    """
    if isinstance(evidence, PeakFeatures):
        prior_chi_square, spread_m = evidence.expected.prior_chi_square, evidence.expected.spread_m
        sigmas = math.log(max(evidence.sigmas, 0.5))
        return np.array(
            [1.0, sigmas, evidence.ratio, min(prior_chi_square, _MAX_CHI_SQUARE), math.log(max(spread_m, 1.0))]
        )
    known = [_known(evidence.prior_chi_square), _known(evidence.height_chi_square)]
    alarms = min(max(-evidence.log10_nfa, 0.0), _MAX_LOG10_ALARMS)
    return np.array([1.0, math.sqrt(alarms), *known[0], *known[1]])


def _known(off: float | None) -> tuple[float, float]:
    """What a chi-square says, and what it says that there is none."""
    return (0.0, 1.0) if off is None else (min(off, _MAX_CHI_SQUARE), 0.0)


def probability(evidence: PeakFeatures | PoseFeatures, model: PeakModel | PoseModel | None = None) -> float:
    """Probability in (0, 1) that the place is right, where every second frame has an answer.

    Args:
        evidence: of a peak or of a pose.
        model: other weights than those fitted.
    """
    model = model or (PEAK_MODEL if isinstance(evidence, PeakFeatures) else POSE_MODEL)
    logit = float(np.dot(astuple(model), regressors(evidence)))
    return 1.0 / (1.0 + math.exp(-logit))
