"""Dense refinement of a fix: the whole camera pose, over the surface model or a plane."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TypeGuard

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.geo import attitude_from_rotation, chi_square_of
from engine.kernels.dense import (
    DenseFit,
    EnhancedFrame,
    GaussianPrior,
    Pose,
    correlation_at,
    covariance_of,
    refine,
)
from engine.kernels.scores import enhance
from engine.maps.grids import window_about
from engine.maps.samples import BLOCK_PX, MAX_SAMPLES, SampleMap
from engine.matching.agreement import CHANCE, agree_in_height, are_consistent
from engine.matching.align import shrink
from engine.matching.candidates import PeakCandidate
from engine.matching.covariance import tilt_covariance
from engine.matching.oblique import is_oblique
from engine.matching.query import Query
from engine.matching.unknown_slope import over_unknown_slope, wide_slope_deg
from engine.options import NccOptions
from engine.runtime.scheduler import OutOfTime
from engine.values import Attitude, Fix, NoFix, Reason, Window

Array = NDArray[np.float64]

_COARSER = (
    2  # levels above the frame's own on which a refinement restarts if it fails there, or the tilt is unknown
)
_TILTS_DEG = (-6.0, -3.0, 0.0, 3.0, 6.0)  # tried first about both axes if the tilt is unknown
_MIN_CORRELATION = 0.2  # of an accepted pose with a known tilt: true poses over a town in snow reached 0.29
CONFIRMING_CORRELATION = 0.45
"""Least correlation of a pose that the picture itself confirms, without a known tilt or at the first attempt.

Below it coarser levels are tried and a known tilt is doubted. Without a known tilt true poses over simulated towns
reached 0.53 and wrong ones 0.32.
By day the frames of three simulated flights reached 0.8 and more; in the evening, on a map from noon, half of them
reached 0.6. Poses with a wrong tilt reached 0.30 to 0.35, and 0.87 as soon as the tilt was doubted.
"""
# Possible tilt error if the picture does not confirm the pose: with angles off by 1.5 degrees, half of the frames
# of a simulated flight were not confirmed, and their peaks were up to 7.6 m off at 150 m; with correct angles all
# were confirmed.
_UNCONFIRMED_TILT_DEG = 1.5
# Standard deviation of each angle of an attitude that the image does not confirm.
_DOUBTED_DEG = 6.0
_HEIGHT_SHARE = 2e-4  # bias of the height from walls and the ground hidden behind them: 3 cm at 150 m
_COARSE_SAMPLES = 800  # on a coarser level


@dataclass(frozen=True, slots=True)
class Refinement:
    """Refines the pose of one frame.

    Attributes:
        query: the frame, with height and heading.
        samples: of the map.
        options: of the correlation.
        knows_tilt: whether to trust the roll and pitch that came with the frame, or only to start from them.
    """

    query: Query
    samples: SampleMap
    options: NccOptions
    knows_tilt: bool = True

    def refine(self, found: PeakCandidate) -> PeakCandidate | NoFix:
        """The candidate with its whole pose refined, or a less certain one, or a refusal.

        If the picture hardly confirms the telemetry's attitude, the pose is refined once more as if roll and pitch
        were hardly known; the result counts if the picture confirms it. An attitude that it does not confirm
        counts only if the position agrees with the prior. If roll and pitch are unknown, the picture must
        determine them over a surface model. Without one, where relief may be the reason, the fix stays as it was.
        """
        query, has_tilt, fix = self.query, self.query.telemetry.has_tilt, found.fix
        if has_tilt and query.site.has_surface:
            return self._over_surface(found)
        refined = self._through_all(fix)
        if _is_confirmed(refined):
            return replace(found, fix=refined)
        if has_tilt:
            return self._unconfirmed(replace(found, fix=refined or fix))
        if not query.site.has_surface:
            return found
        detail = "roll and pitch are unknown, and the picture does not determine them"
        return query.refuse(Reason.BAD_POSE, detail, fix.method, score=fix.score, window=fix.window)

    def _over_surface(self, found: PeakCandidate) -> PeakCandidate | NoFix:
        """The same for a known attitude over a surface model, where a pose that can be refined is evidence.

        Of an oblique frame it often cannot be at right places as well, so that says nothing.
        """
        query, fix, evidence = self.query, found.fix, found.evidence
        refined = self._through_all(fix)
        if not _is_confirmed(refined):
            try:
                refined = self._doubting()._through_all(fix) or refined
            except OutOfTime:
                if refined is None:
                    raise
        if refined or not is_oblique(query, query.telemetry.known_attitude):
            evidence = replace(evidence, refined=refined is not None)
        weighed = replace(found, fix=refined or fix).weighed(evidence)
        is_settled = _is_confirmed(refined) or not weighed.suffices(query.risk)
        return weighed if is_settled else self._unconfirmed(weighed)

    def _unconfirmed(self, found: PeakCandidate) -> PeakCandidate | NoFix:
        """A known attitude that the picture does not confirm, refined or not, if the prior agrees."""
        query, fix = self.query, found.fix
        if query.site.has_surface and fix.stage != "refined":
            fix = with_unconfirmed_tilt(query, fix)
        off = query.prior_chi_square(fix)
        agrees = off <= chi_square_of(CHANCE, 2) if off is not None else not query.site.has_surface
        if agrees:
            return replace(found, fix=replace(fix, stage="unconfirmed"))
        against = "no prior does" if off is None else f"the prior does not, at a chi-square of {off:.0f}"
        detail = f"the picture does not confirm the attitude, and {against}"
        return query.refuse(Reason.BAD_POSE, detail, fix.method, score=fix.score, window=fix.window)

    def refine_at_once(self, fix: Fix) -> Fix | None:
        """The fix of a known tilt refined on the frame's own level; None if the picture does not confirm it."""
        prior = self._prior(fix)
        return self._refined(fix, prior, self._at_once(prior))

    def refine_from_coarser(self, fix: Fix) -> Fix | None:
        """The same from a coarser level, where a few pixels span more ground."""
        prior = self._prior(fix)
        return self._refined(fix, prior, self._through_levels(prior, _COARSER))

    def _doubting(self) -> Refinement:
        """The same for a frame whose attitude is hardly known."""
        frame = replace(
            self.query.frame,
            tilt_sigma_deg=_DOUBTED_DEG,
            heading_sigma_deg=max(self.query.frame.heading_sigma_deg or 0.0, _DOUBTED_DEG),
        )
        return replace(self, query=replace(self.query, frame=frame), knows_tilt=False)

    def _through_all(self, fix: Fix) -> Fix | None:
        """The fix with its pose refined, from a coarser level if necessary."""
        prior, fit = self._prior(fix), None
        if self._knows_tilt:
            fit = self._at_once(prior)
        return self._refined(fix, prior, fit or self._through_levels(prior, _COARSER))

    def _refined(self, fix: Fix, prior: GaussianPrior, fit: DenseFit | None) -> Fix | None:
        """The fix with its pose refined; None if refinement failed or led elsewhere."""
        query, errors = self.query, self.query.errors(self.options.errors)
        pose_covariance = None if fit is None else covariance_of(fit, prior)
        if fit is None or pose_covariance is None:
            return None
        if self._is_on_unknown_slope:
            height_m, slope_deg = fit.pose.center_m[2] - query.site.ground_m, errors.unknown_slope_deg
            over = over_unknown_slope(fit.pose, pose_covariance, prior.pose.center_m[:2], height_m, slope_deg)
            if over is None:
                return None
            fit, pose_covariance = replace(fit, pose=over.pose), over.covariance
        covariance = pose_covariance[:3, :3].copy()
        height_m = fit.pose.center_m[2] - query.site.ground_m
        covariance[2, 2] += (_HEIGHT_SHARE * height_m) ** 2
        slope_rad = 0.0
        if not query.site.has_surface and not self._knows_tilt:  # a slope of the ground was mistaken for a tilt
            slope_rad = math.radians(errors.unknown_slope_deg)
        covariance[:2, :2] += (height_m * slope_rad) ** 2 * np.eye(2)
        nadir_px = query.site.pixel_from_enu(fit.pose.center_m[:2])
        doubt_m = query.scale_doubt_m(nadir_px, float(fit.pose.center_m[2]), fit.pose.rotation[2], errors)
        covariance[:2, :2] += doubt_m**2 * np.eye(2)
        tilt_rad = math.hypot(doubt_m / height_m, slope_rad)
        turns_rad2 = pose_covariance[3:6, 3:6] + tilt_covariance(fit.pose.rotation, tilt_rad)
        moved = (fit.pose.center_m - prior.pose.center_m)[:2]
        allowed_m2 = fix.relative_covariance_m2 + covariance[:2, :2]
        if not self.knows_tilt:  # which displaced the peak
            allowed_m2 += (height_m * math.radians(errors.tilt_deg)) ** 2 * np.eye(2)
        if not are_consistent(moved, allowed_m2):
            return None
        refined = self._refined_fix(fix, fit, covariance + errors.map_m**2 * np.eye(3), turns_rad2)
        return refined if agree_in_height(fix, refined) else None

    @property
    def _knows_tilt(self) -> bool:
        return self.knows_tilt and self.query.telemetry.has_tilt

    @property
    def _is_on_unknown_slope(self) -> bool:
        return self._knows_tilt and not self.query.site.has_surface

    def _at_once(self, prior: GaussianPrior) -> DenseFit | None:
        return self._through_levels(prior, 0, CONFIRMING_CORRELATION)

    def _through_levels(
        self, prior: GaussianPrior, coarser: int, min_correlation: float | None = None
    ) -> DenseFit | None:
        """Refine on levels coarser than the frame's, where a few pixels span more ground; then on its own.

        The pose must fit better than the one to begin with.
        """
        query, site, height_m = self.query, self.query.site, self.query.telemetry.known_height_m
        own, has_tilt = query.level_of(height_m), self._knows_tilt
        least = _MIN_CORRELATION if has_tilt else CONFIRMING_CORRELATION
        pose, fit = prior.pose, None
        with query.scheduler.stage("dense"):  # one stage per pass; each may be skipped
            for level in range(min(own + coarser, site.levels - 1), own - 1, -1):
                window = self._footprint(prior.pose, height_m, level)
                if window is None:
                    fit = None
                    continue
                picture = self._enhanced_frame(height_m, level)
                ground = self.samples.find(window, level, MAX_SAMPLES if level == own else _COARSE_SAMPLES)
                if not has_tilt and fit is None:
                    pose = max(_tilted(pose, height_m), key=lambda start: correlation_at(picture, ground, start))
                start, fit = pose, refine(picture, ground, pose, prior)
                pose = start if fit is None else fit.pose
        if fit is None or not fit.converged:
            return None
        at_prior = fit.first_correlation if start is prior.pose else correlation_at(picture, ground, prior.pose)
        return fit if fit.correlation >= max(at_prior, min_correlation or least) else None

    def _prior(self, fix: Fix) -> GaussianPrior:
        """The telemetry's height and attitude; the correlation's position is only a start, without weight."""
        query, known = self.query, self.query.telemetry
        errors = query.errors(self.options.errors)
        height_m = known.known_height_m
        attitude_prior = query.attitude_prior(known.known_attitude.heading_deg, errors.heading_deg, errors)
        precision = np.zeros((8, 8))
        precision[2, 2] = errors.height_sigma_m(height_m) ** -2.0
        precision[3:6, 3:6] = attitude_prior.precision
        unknown_deg = wide_slope_deg(errors.unknown_slope_deg)
        slope_deg = unknown_deg if self._is_on_unknown_slope else errors.surface_slope_deg
        precision[[6, 7], [6, 7]] = math.tan(math.radians(slope_deg)) ** -2.0
        ground_m = query.site.ground_at(query.site.pixel_from_enu([fix.east_m, fix.north_m]))
        center = np.array([fix.east_m, fix.north_m, ground_m + height_m])
        return GaussianPrior(Pose(attitude_prior.rotation, center, np.zeros(2)), precision)

    def _footprint(self, pose: Pose, height_m: float, level: int) -> Window | None:
        """The part of a level that the frame shows, or None if that is less than a few blocks."""
        query = self.query
        rays = query.camera.frame_rays[:4] @ pose.rotation
        ground_m = pose.center_m[:2] + rays[:, :2] * (height_m / -rays[:, 2:])
        corners = query.site.level_from_full(query.site.pixel_from_enu(ground_m), level)
        window = window_about(corners, query.site.level_shape(level), margin_px=0)
        if window is None or min(window.width_px, window.height_px) < 4 * BLOCK_PX:
            return None
        return window

    def _enhanced_frame(self, height_m: float, level: int) -> EnhancedFrame:
        """The frame at the resolution of a level, enhanced like the map."""
        query, options = self.query, self.options
        scale = height_m / query.camera.focal_px / (query.site.gsd_m_per_px * 2.0**level)
        gray, smaller = shrink(query.gray, scale)
        scale /= math.sqrt(smaller[0, 0] * smaller[1, 1])
        radius_px = max(1, round(options.enhance_radius_px / scale)) if options.enhance_radius_px else 0
        enhanced = enhance(gray, radius_px=radius_px, score=options.score)
        return EnhancedFrame(enhanced, smaller @ query.camera.matrix)

    def _refined_fix(self, fix: Fix, fit: DenseFit, covariance_m2: Array, turns_rad2: Array) -> Fix:
        query, center_m = self.query, fit.pose.center_m
        refined = query.fix(
            fix.method,
            query.site.pixel_from_enu(center_m[:2]),
            covariance_m2,
            score=fit.correlation,
            window=fix.window,
            east_north_m=center_m[:2],
            up_m=float(center_m[2]),
            grid_attitude=Attitude(*attitude_from_rotation(fit.pose.rotation.T @ query.camera.mount.T)),
            turn_covariance_rad2=turns_rad2,
            map_sigma_m=self.options.errors.map_m,
        )
        return replace(refined, stage="refined", confidence=fix.confidence)


def _is_confirmed(refined: Fix | None) -> TypeGuard[Fix]:
    """Whether a picture confirms a refined pose."""
    return refined is not None and refined.score >= CONFIRMING_CORRELATION


def with_unconfirmed_tilt(query: Query, fix: Fix) -> Fix:
    """The fix of a frame whose picture does not confirm its attitude, with a covariance for a wrong tilt."""
    doubt_m = query.telemetry.known_height_m * math.radians(_UNCONFIRMED_TILT_DEG)
    return replace(fix, covariance_m2=fix.covariance_m2 + np.diag([doubt_m**2, doubt_m**2, 0.0]))


def _tilted(pose: Pose, height_m: float) -> list[Pose]:
    """The pose and tilted variants that look at the same point, where correlation found the frame's middle."""

    def reach_m(rotation: Array) -> Array:
        return np.asarray(rotation[2] * (height_m / -rotation[2, 2]))

    out = [pose]
    for x_deg, y_deg in itertools.product(_TILTS_DEG, _TILTS_DEG):
        rotation = cv2.Rodrigues(np.radians([x_deg, y_deg, 0.0]))[0] @ pose.rotation
        out.append(Pose(rotation, pose.center_m + reach_m(pose.rotation) - reach_m(rotation), pose.slope))
    return out
