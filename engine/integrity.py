"""Accept or refuse a match, and say how well a fix is known.

The rules are few and documented in ``docs/integrity.md``; their thresholds were fitted on simulated flights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.confidence import PeakFeatures, PoseFeatures
from engine.errors import OptionError
from engine.geo import chi_square, transport_covariance
from engine.orthomap import OrthoMap
from engine.values import MAX_SIGMA_M, GridPose, Peak, Reason, check_positive

Array = NDArray[np.float64]

CONSISTENT_CHI_SQUARE = 13.8
"""Chi-square of the difference of two positions that chance exceeds once in a thousand, two degrees of freedom."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AssumedErrors:
    """One standard deviation of the telemetry, the map and the ground, where they do not state their own.

    Attributes:
        height_m: of the height, besides its share below.
        height_share: of the height, as a share of it.
        heading_deg: of the heading.
        tilt_deg: of roll and of pitch, where the frame came with them.
        unknown_tilt_deg: of roll and of pitch, where it did not: nothing holds a camera level in flight.
        map_m: georeferencing accuracy per axis, where the map does not state it (:func:`with_map_accuracy`).
        surface_slope_deg: slope accuracy of the surface model under one frame, where it does not state it.
        unknown_slope_deg: the same where flat ground is assumed.
    """

    height_m: float = 0.5
    height_share: float = 0.01
    heading_deg: float = 1.0
    tilt_deg: float = 0.37
    unknown_tilt_deg: float = 4.0
    map_m: float = 0.3
    surface_slope_deg: float = 0.1
    unknown_slope_deg: float = 2.0

    def __post_init__(self) -> None:
        check_positive(self, *self.__dataclass_fields__)
        for name in self.__dataclass_fields__:
            if getattr(self, name) > MAX_SIGMA_M:
                raise OptionError(f"{name}: expected at most {MAX_SIGMA_M:g}, got {getattr(self, name):g}")

    def height_sigma_m(self, height_m: float) -> float:
        """Of a height."""
        return math.hypot(self.height_m, self.height_share * height_m)

    def tilts_deg(self, pose: GridPose) -> tuple[float, float]:
        """Of the roll and of the pitch that a frame came with, or did not."""
        unknown, known = self.unknown_tilt_deg, self.tilt_deg
        return (unknown if pose.roll_deg is None else known, unknown if pose.pitch_deg is None else known)


def with_map_accuracy(site: OrthoMap, errors: AssumedErrors) -> AssumedErrors:
    """The errors with the accuracy that the map states in place of the one assumed of any map."""
    return replace(
        errors,
        map_m=errors.map_m if site.georeference_sigma_m is None else site.georeference_sigma_m,
        surface_slope_deg=errors.surface_slope_deg if site.slope_sigma_deg is None else site.slope_sigma_deg,
    )


# Neighbouring pixels share their noise: so many of them, squared, count as one.
_CORRELATION_PX = 5.0


def score_sigma(pixels: int) -> float:
    """One standard deviation of the NCC of a patch with ground that it does not show.

    The correlation coefficient of N independent samples about zero has the variance 1/N.
    """
    return 1.0 / math.sqrt(max(1.0, pixels / _CORRELATION_PX**2))


@dataclass(frozen=True, slots=True, kw_only=True)
class PeakRule:
    """When a correlation peak is accepted.

    Scores are counted in :func:`score_sigma`, so that a rule holds for small patches as for large ones. Over two
    simulated towns right places lead by 8 and more, with a quarter of the frame hidden by 2.3 and more; on another
    town's map the best led by 1.4, mirrored by 2.5, and where the prior pointed elsewhere by 3.4. On 324 searches
    of heading or height the best reached 11.1 and led by at most 6.7.

    Attributes:
        min_sigmas: a peak below this may be chance.
        min_margin_sigmas: how far the best rival must stay below the peak.
        min_margin_sigmas_whole_map: the same where the whole map was searched, or the place contradicts the prior,
            and nothing else vouches for it.
        max_prior_chi_square: of a position against its prior, above which the two contradict each other; chance
            exceeds this once in ten thousand.
        min_sigmas_searched: as ``min_sigmas``, where the heading or the height was searched for: streets of
            another town, turned until they fit, look like these.
        min_margin_sigmas_searched: as ``min_margin_sigmas``, in the same case.
        min_confidence: probability of :func:`engine.confidence.probability` below which a peak is not accepted.
        null_test_below: confidence below which the peak must also beat the null hypothesis, its own template
            upside down in the same window; 1 always asks for it.
        min_deviation: standard deviation in grey levels below which a frame has no texture.
        exclusion_m: rivals nearer than this are the peak itself.
    """

    min_sigmas: float = 5.0
    min_margin_sigmas: float = 2.0
    min_margin_sigmas_whole_map: float = 3.5
    max_prior_chi_square: float = 18.4
    min_sigmas_searched: float = 13.0
    min_margin_sigmas_searched: float = 8.0
    min_confidence: float = 0.98
    null_test_below: float = 0.995
    min_deviation: float = 3.0
    exclusion_m: float = 6.0

    def __post_init__(self) -> None:
        check_positive(self, *self.__dataclass_fields__)
        if not self.min_confidence < 1.0:
            raise OptionError(f"min_confidence: expected a probability below 1, got {self.min_confidence}")
        if not self.null_test_below <= 1.0:
            raise OptionError(f"null_test_below: expected a probability of at most 1, got {self.null_test_below}")


Refusal = tuple[Reason, str]
"""Why a match is not accepted, and the figures behind it."""


def judge_peak(
    peak: Peak,
    pixels: int,
    features: PeakFeatures | None,
    confidence: float | None,
    rule: PeakRule,
    *,
    searched: bool = False,
) -> Refusal | None:
    """The reason to refuse a correlation peak, or None where it is accepted.

    Args:
        peak: the peak.
        pixels: of the template.
        features: of the confidence model; None where nothing was known of the position, or more was searched
            than a window at one heading and height.
        confidence: that the model gives them; None without them.
        rule: the thresholds.
        searched: the heading or the height was searched for.
    """
    sigma = score_sigma(pixels)
    min_score = sigma * (rule.min_sigmas_searched if searched else rule.min_sigmas)
    if peak.score < min_score:
        return Reason.LOW_SCORE, f"best NCC {peak.score:.3f} may be chance; {min_score:.3f} is asked for"
    if not peak.curvature.any():
        return Reason.AMBIGUOUS, f"NCC {peak.score:.3f} still rises at the window's edge"
    # A position that contradicts the prior is vouched for by the match alone, as in a search of the whole map.
    alone = features is None or features.agreement.prior_chi_square > rule.max_prior_chi_square
    margin = rule.min_margin_sigmas_whole_map if alone else rule.min_margin_sigmas
    margin = sigma * (rule.min_margin_sigmas_searched if searched else margin)
    if peak.score - peak.second_score < margin:
        rival = f"a rival reaches {peak.second_score:.3f}"
        return Reason.AMBIGUOUS, f"best NCC {peak.score:.3f}, {rival}; {margin:.3f} between them is asked for"
    if features is None or confidence is None or confidence >= rule.min_confidence:
        return None
    figures = f"NCC {features.sigmas:.1f} sigmas, rival at {features.ratio:.0%}"
    chi_square_text = f"{features.agreement.prior_chi_square:.1f}"
    return Reason.AMBIGUOUS, _improbable(confidence, rule.min_confidence, figures, chi_square_text)


def judge_pose(features: PoseFeatures, confidence: float, min_confidence: float) -> Refusal | None:
    """The reason to refuse a pose by matched features, or None where it is accepted.

    Args:
        features: of the confidence model.
        confidence: that the model gives them.
        min_confidence: that is asked for.
    """
    if confidence >= min_confidence:
        return None
    figures = f"log10 of false alarms {features.log10_nfa:.1f}"
    off = features.prior_chi_square
    return Reason.BAD_POSE, _improbable(
        confidence, min_confidence, figures, "unknown" if off is None else f"{off:.1f}"
    )


def _improbable(confidence: float, min_confidence: float, figures: str, prior_chi_square: str) -> str:
    asked = f"{min_confidence:g} is asked for ({figures}, chi-square {prior_chi_square} from the prior)"
    return f"right with a probability of {confidence:.3f}, {asked}"


def are_consistent(apart_m: Array, covariance_m2: Array) -> bool:
    """Whether two estimates of one position agree.

    Args:
        apart_m: (2,) from one to the other, in metres.
        covariance_m2: (2, 2) sum of their covariances.

    Returns:
        bool: False where chance alone would set them so far apart less than once in a thousand.
    """
    return chi_square(apart_m, covariance_m2) <= CONSISTENT_CHI_SQUARE


def peak_covariance_px(peak: Peak, pixels: int) -> Array:
    """Covariance of a correlation peak (Cramer-Rao).

    For a picture that is the map plus Gaussian noise, the log-likelihood of a shift is N/2 log(1 - rho^2), whose
    second derivative at the peak is N rho rho'' / (1 - rho^2); its inverse is the covariance. N is that of
    :func:`score_sigma`.

    Args:
        peak: the peak.
        pixels: of the template.

    Returns:
        (2, 2) in square pixels, x before y.
    """
    independent = 1.0 / score_sigma(pixels) ** 2
    rho = min(max(peak.score, 0.05), 0.999)
    information = -peak.curvature * independent * rho / (1.0 - rho * rho)
    # A ridge has no curvature along it: the peak is then known to a few pixels there, not infinitely badly.
    values, vectors = np.linalg.eigh(information)
    variances = np.clip(1.0 / np.maximum(values, 1e-9), 0.05**2, 5.0**2)
    return np.asarray((vectors * variances) @ vectors.T, dtype=np.float64)


def misalignment_covariance_px2(
    peak: Peak, shape: tuple[int, int], height_m: float, errors: AssumedErrors
) -> Array:
    """Covariance of a peak whose template is turned or scaled against the map.

    An error of heading or height moves every part of the patch by an amount of its own. Where the parts stay
    within the width of the peak, it lies at their mean, and nothing is lost; where they do not, it follows the
    part with the strongest texture, which may be anywhere. The share between the two is u^2 / (u^2 + width^2).

    Args:
        peak: of the patch.
        shape: (rows, columns) of the patch.
        height_m: above the ground.
        errors: what is assumed of height and heading.

    Returns:
        (2, 2) in square pixels.
    """
    share = math.hypot(errors.height_share, errors.height_m / height_m, math.radians(errors.heading_deg))
    apart = share**2 * (shape[0] ** 2 + shape[1] ** 2) / 24.0  # mean over the patch of one axis
    bend = -float(np.trace(peak.curvature)) / 2.0
    width = max(peak.score, 0.05) / max(bend, 1e-9)
    return np.asarray(apart * apart / (apart + width) * np.eye(2), dtype=np.float64)


def ncc_covariance_m2(
    peak_px2: Array, pose: GridPose, camera: Camera, enu_jacobian: Array, errors: AssumedErrors
) -> Array:
    """Covariance of a fix by correlation.

    The nadir is the position of the template less an offset by height and attitude, so their errors move the fix:
    half a degree of tilt is 1.3 m at 150 m.

    Args:
        peak_px2: (2, 2) covariance of the peak in square pixels.
        pose: height and attitude by which the frame was aligned.
        camera: its mount tells where the optical axis points.
        enu_jacobian: (2, 2) metres east and north per pixel.
        errors: of the telemetry and the map.

    Returns:
        (3, 3) east, north, up in square metres.

    Raises:
        OptionError: the pose lacks its height or its heading.
    """
    attitude, height = pose.grid_attitude, pose.height_agl_m
    if attitude is None or height is None:
        raise OptionError("pose: expected a height and a heading for a fix by correlation")
    values = np.array([height, attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg])
    height_sigma = errors.height_sigma_m(height)
    sigmas = np.array([height_sigma, *errors.tilts_deg(pose), errors.heading_deg])
    aims = _aim_m(camera, np.concatenate([values + np.diag(sigmas), values - np.diag(sigmas)]))
    spread = (aims[:4] - aims[4:]).T / 2.0  # each column is already scaled by its sigma
    horizontal = spread @ spread.T + transport_covariance(enu_jacobian, peak_px2) + errors.map_m**2 * np.eye(2)
    covariance = np.diag([0.0, 0.0, height_sigma**2])
    covariance[:2, :2] = horizontal
    return covariance


def _aim_m(camera: Camera, values: Array) -> Array:
    """Where the optical axis meets the ground, (N, 2) metres east and north of the nadir.

    Args:
        camera: its mount says which way of the body is the axis.
        values: (N, 4) height in metres; roll, pitch and heading in degrees.
    """
    forward, right, down = camera.mount[:, 2]
    sr, sp, sh = np.sin(np.radians(values[:, 1:])).T
    cr, cp, ch = np.cos(np.radians(values[:, 1:])).T
    ahead = cp * forward + sp * (sr * right + cr * down)  # along the heading, see engine.geo.enu_from_body
    aside = cr * right - sr * down
    below = -sp * forward + cp * (sr * right + cr * down)
    reach = values[:, 0] / np.maximum(below, 1e-3)
    return np.stack([(sh * ahead + ch * aside) * reach, (ch * ahead - sh * aside) * reach], axis=1)
