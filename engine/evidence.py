"""What a correlation peak has to say for itself, and how probable it is then that it is the right place.

A peak is high over a wrong place too, where streets or furrows run alike. What tells the two apart is how far it
stands out from chance, how near its best rival comes, and whether the place is where it was expected. One logistic
function of these gives the probability; its constants were fitted by ``python -m bench.confidence --fit`` on
simulated towns. Votes of the frame's blocks, each on its own shift, were tried there too and added nothing.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from engine.types import Peak

_FARTHEST = 12.0  # chi-square against the prior: beyond it the prior may be the one that is wrong


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What was measured of one peak.

    Attributes:
        sigmas: Fisher's z of the score, in standard deviations of chance.
        ratio: the best rival's score as a share of the peak's, in [0, 1].
        off_prior: chi-square of two degrees of freedom of the place against the prior.
    """

    sigmas: float
    ratio: float
    off_prior: float


@dataclass(frozen=True, slots=True)
class Logistic:
    """Weights of :func:`terms`; their sum is log(p / (1 - p))."""

    constant: float
    log_sigmas: float
    ratio: float
    off_prior: float


FITTED = Logistic(9.338, 1.103, -11.318, -0.532)
"""Of 11,968 matches over six towns, half of them without an answer."""


def evidence_of(peak: Peak, sigma: float, off_prior: float) -> Evidence:
    """The evidence of a peak.

    Args:
        peak: the peak.
        sigma: one standard deviation of a score of chance, from :func:`engine.integrity.score_sigma`.
        off_prior: chi-square of its place against the prior.
    """
    z = math.atanh(min(max(peak.score, 0.0), 0.999))
    ratio = max(peak.second_score, 0.0) / max(peak.score, 1e-3)
    return Evidence(sigmas=z / sigma, ratio=min(ratio, 1.0), off_prior=off_prior)


def terms(evidence: Evidence) -> NDArray[np.float64]:
    """(4,) what the weights are multiplied by.

    Sigmas enter by their logarithm: 20 instead of 10 say as much as 10 instead of 5.
    """
    sigmas, off_prior = max(evidence.sigmas, 0.5), min(evidence.off_prior, _FARTHEST)
    return np.array([1.0, math.log(sigmas), evidence.ratio, off_prior])


def probability(evidence: Evidence, model: Logistic = FITTED) -> float:
    """Probability in (0, 1) that the peak is the right place, where every second frame has an answer."""
    logit = float(np.dot(astuple(model), terms(evidence)))
    return 1.0 / (1.0 + math.exp(-logit))
