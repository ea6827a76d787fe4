"""Dense refinement of a fix: the whole camera pose, over the surface model or a plane."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from engine.geo import Array, attitude_from_rotation, chi_square_of
from engine.kernels import dense
from engine.kernels.dense import DenseFit, EnhancedFrame, GaussianPrior, Pose, Samples
from engine.kernels.scores import RADIUS_PX, enhance
from engine.maps.grids import window_about
from engine.maps.samples import BLOCK_PX, MAX_SAMPLES, SampleMap
from engine.matching.agreement import agree_in_height, are_consistent, offset_between_m
from engine.matching.align import shrink
from engine.matching.candidates import PeakCandidate
from engine.matching.covariance import tilt_covariance
from engine.matching.evidence import RELIABILITY, independent_places, surprise_of
from engine.matching.oblique import is_oblique
from engine.matching.query import Query
from engine.matching.unknown_slope import over_unknown_slope, wide_slope_deg
from engine.runtime.scheduler import OutOfTime
from engine.values import SIGNIFICANCE, Attitude, Fix, NoFix, Reason, Window

_CAPTURE_PX = 20.0  # tilts are tried on the level on which one off by one sigma moves the ground by no more
_CLIMBED = independent_places((2.0 * _CAPTURE_PX) ** 2)  # places about a pose, the best of which refinement finds
_TILTS, _STARTS = np.arange(-3.0, 3.5, 1.5), 3  # sigmas of an unknown tilt, about both axes; the best are refined
CONFIRMING_CORRELATION = 0.45
"""Correlation of a pose at which nothing else is tried: no coarser level, and no doubt of a known tilt.

By day the frames of three simulated flights reached 0.8 and more; in the evening, on a map from noon, half of them
reached 0.6. Poses with a wrong tilt reached 0.30 to 0.35, and 0.87 as soon as the tilt was doubted.
"""
# Possible tilt error if the picture does not confirm the pose: with angles off by 1.5 degrees, half of the frames
# of a simulated flight were not confirmed, and their peaks were up to 7.6 m off at 150 m; with correct angles all
# were confirmed.
_TILT_DOUBT_DEG = 1.5
_HEIGHT_SHARE = 2e-4  # bias of the height from walls and the ground hidden behind them: 3 cm at 150 m
_COARSE_SAMPLES = 800  # on a coarser level
# Places about a pose that show what correlation chance gives there, as shares of the shorter side of the ground in
# the picture: far enough to be other places, near enough for most samples to stay in the picture.
_ELSEWHERE = np.array(
    [(r * np.cos(a), r * np.sin(a), 0.0) for r in (0.2, 0.3, 0.4) for a in np.arange(8) * np.pi / 4]
)


@dataclass(frozen=True, slots=True)
class Refined:
    """A refined pose.

    Attributes:
        fix: that it gives; its score is the correlation of picture and map.
        pose: that was correlated; over an unknown slope the fix differs.
        picture: as it was compared with the map.
        ground: the samples of the map.
        is_consistent: whether it agrees with the fix from which it began; if not, the picture alone speaks for it.
    """

    fix: Fix
    pose: Pose
    picture: EnhancedFrame
    ground: Samples
    is_consistent: bool

    @property
    def is_clear(self) -> bool:
        """Whether it leaves nothing else to try."""
        return self.is_consistent and self.fix.score >= CONFIRMING_CORRELATION

    @property
    def rank(self) -> tuple[bool, float]:
        """The greater, the better."""
        return self.is_clear, self.fix.score


@dataclass(frozen=True, slots=True)
class Refinement:
    """Refines the pose of one frame.

    Attributes:
        query: the frame, with height and heading.
        samples: of the map.
        doubts_tilt: whether the roll and pitch that came with the frame are only a start.
        pictures: the frame enhanced so far, by level.
    """

    query: Query
    samples: SampleMap
    doubts_tilt: bool = False
    pictures: dict[int, EnhancedFrame] = field(default_factory=dict, repr=False, compare=False)

    def refine(self, found: PeakCandidate) -> PeakCandidate | NoFix:
        """The candidate with its whole pose refined and the evidence of that, a less certain one, or a refusal.

        If the picture hardly confirms the telemetry's attitude, the pose is refined again as if roll and pitch
        were hardly known, and the more probable pose counts. If neither has evidence, a wrong attitude is as
        probable as a right one: right poses can be refined in 98 of 100 frames, and attitudes are right in 99 of
        100. Only a prior then confirms the attitude, and the fix is no more certain than that. Without a surface
        model relief may be the reason as well: the fix stays at the peak, and its covariance reaches that pose.
        """
        query, has_tilt, found = self.query, self.query.telemetry.has_tilt, replace(found, by_refinement=True)
        refined = self.refine_pose(found.fix)
        is_clear = refined is not None and refined.is_clear
        if refined is not None and is_clear and found.suffices(query.risk):
            return replace(found, fix=refined.fix)
        own = self._weighed(found, refined)
        best = self._or_doubted(found, own) if has_tilt and not is_clear else own
        if best is not None and own is None and not query.site.has_surface:  # the doubted one
            return replace(found, fix=replace(reaching(found.fix, best.fix), stage="unconfirmed"))
        if best is not None:
            return best
        if has_tilt and query.site.has_surface and not is_oblique(query, query.telemetry.known_attitude):
            # Of few right places, but of many over relief that no model shows, or seen from far off the vertical.
            found = found.weighed(replace(found.evidence, refined=-math.inf))
        if not found.promises(query.risk):
            return found
        if has_tilt:
            return self._resting_on_prior(found)
        if not query.site.has_surface:
            return found
        # Over a known surface nearly every pose can be refined: this tilt is beyond those that were tried.
        detail = "roll and pitch are unknown, and the picture does not determine them"
        return found.fix.refused(Reason.BAD_POSE, detail)

    def _or_doubted(self, found: PeakCandidate, own: PeakCandidate | None) -> PeakCandidate | None:
        """The candidate refined by a known attitude, or as if that were hardly known; the more probable one.

        Unless the other one is less probable than the allowed risk, the covariance covers it.
        """
        doubting = self._doubting()
        try:
            other = doubting._weighed(found, doubting.refine_pose(found.fix), math.log(1.0 - RELIABILITY))
        except OutOfTime:
            if own is None:
                raise
            return own
        if own is None or other is None:
            return own or other
        worse, best = sorted((own, other), key=lambda each: each.evidence.of_pose)
        if best.evidence.of_pose - worse.evidence.of_pose >= self.query.needed_nats:
            return best
        return replace(best, fix=reaching(best.fix, worse.fix))

    def _weighed(
        self, found: PeakCandidate, refined: Refined | None, log_prior: float = 0.0
    ) -> PeakCandidate | None:
        """The candidate with a refined pose; None if chance gives such a pose as well, and it is not clear.

        Args:
            found: the candidate.
            refined: its pose.
            log_prior: of what that assumes about the attitude.
        """
        if refined is None:
            return None
        tried = _CLIMBED if self._knows_tilt else _CLIMBED * len(_TILTS) ** 2
        off = self.query.prior_chi_square(refined.fix)
        if not refined.is_consistent:
            log_prior += math.log(1.0 - RELIABILITY)
        surprise = self.surprise_of(refined) - math.log(tried) + log_prior
        evidence = replace(found.evidence, refined=surprise, prior_chi_square=off)
        moved = replace(found, fix=refined.fix)
        if evidence.of_pose >= self.query.needed_nats:
            return moved.weighed(evidence)
        return moved if refined.is_clear else None

    def surprise_of(self, refined: Refined) -> float:
        """The surprise of a refined pose's correlation, by what the picture reaches about it; 0 if unknown."""
        query, pose = self.query, refined.pose
        height_m = query.telemetry.known_height_m
        level = query.level_of(height_m)
        window = self._footprint(pose, height_m, level)
        if window is None:
            return 0.0
        side_m = min(window.width_px, window.height_px) * query.site.gsd_m_per_px * 2.0**level
        elsewhere = [replace(pose, center_m=pose.center_m + shift) for shift in side_m * _ELSEWHERE]
        seen = [dense.correlation_at(refined.picture, refined.ground, each) for each in elsewhere]
        chance = np.array([score for score in seen if score != 0.0])  # 0 if too little of the map is seen
        if 2 * len(chance) < len(elsewhere):
            return 0.0
        return surprise_of(refined.fix.score, float(chance.std()))

    def _resting_on_prior(self, found: PeakCandidate) -> PeakCandidate | NoFix:
        """A peak whose known attitude no picture confirms; refused if the prior disagrees with it."""
        query, fix = self.query, found.fix
        off = query.prior_chi_square(fix)
        if off is not None and query.prior is not None and off <= chi_square_of(SIGNIFICANCE, 2):
            return replace(found, fix=replace(_less_certain(fix, query.prior.sigma_m), stage="unconfirmed"))
        against = "no prior does" if off is None else f"the prior does not, at a chi-square of {off:.0f}"
        return fix.refused(Reason.BAD_POSE, f"the picture does not confirm roll and pitch, and {against}")

    def refine_at_once(self, found: PeakCandidate) -> PeakCandidate | None:
        """The candidate refined on the frame's own level; None if the picture does not confirm it."""
        refined, found = self._refined(found.fix, self._prior(found.fix), 0), replace(found, by_refinement=True)
        if refined is None or not refined.is_clear:
            return None
        if found.suffices(self.query.risk):
            return replace(found, fix=refined.fix)
        return self._weighed(found, refined)

    def refine_pose(self, fix: Fix) -> Refined | None:
        """The pose refined from a level that suits the tilt, then from its neighbours, until it is clear."""
        prior, best = self._prior(fix), None
        for coarser in self._levels_above:
            refined = self._refined(fix, prior, coarser)
            if refined is not None and (best is None or refined.rank > best.rank):
                best = refined
            if best is not None and best.is_clear:
                break
        return best

    def rehearse(self, fix: Fix) -> None:
        """Refine on every level, with a known and with a doubted attitude, so that all is prepared."""
        for refinement in (self, self._doubting()):  # one level more, for a vehicle that flies higher
            refinement._refined(fix, refinement._prior(fix), max(refinement._levels_above) + 1)

    def _doubting(self) -> Refinement:
        """The same for a frame whose attitude is hardly known."""
        frame, sigma_deg = self.query.frame, self.query.errors.unknown_tilt_deg
        heading_sigma_deg = max(self.query.errors.heading_deg, sigma_deg)
        frame = replace(frame, tilt_sigma_deg=sigma_deg, heading_sigma_deg=heading_sigma_deg)
        return replace(self, query=replace(self.query, frame=frame), doubts_tilt=True)

    def _refined(self, fix: Fix, prior: GaussianPrior, coarser: int) -> Refined | None:
        """The fix with its pose refined from a coarser level on; None if that failed, or hardly fits elsewhere."""
        query, errors = self.query, self.query.errors
        found = self._through_levels(prior, coarser)
        if found is None:
            return None
        fit, picture, ground = found
        pose_covariance, at = dense.covariance_of(fit, prior), fit.pose
        if pose_covariance is None:
            return None
        if self._is_on_unknown_slope:
            height_m, slope_deg = fit.pose.center_m[2] - query.site.ground_m, errors.unknown_slope_deg
            over = over_unknown_slope(fit.pose, pose_covariance, prior.pose.center_m[:2], height_m, slope_deg)
            if over is None:
                return None
            fit, pose_covariance = replace(fit, pose=over.pose), over.covariance
        nadir_px, covariance = query.site.pixel_from_enu(fit.pose.center_m[:2]), pose_covariance[:3, :3].copy()
        height_m = query.above_ground_m(nadir_px, float(fit.pose.center_m[2]))
        covariance[2, 2] += (_HEIGHT_SHARE * height_m) ** 2
        slope_rad, slope = 0.0, fit.pose.slope
        if self._is_on_unknown_slope:  # it may be a tilt of the camera, which looks the same
            slope_rad = math.hypot(*slope)
            covariance[:2, :2] += height_m**2 * slope[:, None] * slope
        elif not query.site.has_surface:  # and a tilt may be a slope of the ground
            slope_rad = math.radians(errors.unknown_slope_deg)
            covariance[:2, :2] += (height_m * slope_rad) ** 2 * np.eye(2)
        doubt_m = query.scale_doubt_m(height_m, fit.pose.rotation[2])
        covariance[:2, :2] += doubt_m**2 * np.eye(2)
        tilt_rad = math.hypot(doubt_m / height_m, slope_rad)
        turns_rad2 = pose_covariance[3:6, 3:6] + tilt_covariance(fit.pose.rotation, tilt_rad)
        moved = (fit.pose.center_m - prior.pose.center_m)[:2]
        allowed_m2 = fix.relative_covariance_m2 + covariance[:2, :2]
        if self.doubts_tilt:  # which displaced the peak
            allowed_m2 += (height_m * math.radians(errors.tilt_deg)) ** 2 * np.eye(2)
        refined = self._refined_fix(fix, fit, covariance + errors.map_m**2 * np.eye(3), turns_rad2)
        is_consistent = are_consistent(moved, allowed_m2) and agree_in_height(fix, refined)
        if not is_consistent and refined.score < CONFIRMING_CORRELATION:
            return None
        return Refined(refined, at, picture, ground, is_consistent)

    @property
    def _knows_tilt(self) -> bool:
        return self.query.telemetry.has_tilt and not self.doubts_tilt

    @property
    def _tilt_deg(self) -> float:
        """The larger standard deviation of roll and pitch."""
        return max(self.query.errors.tilts_deg(self.query.telemetry))

    @property
    def _levels_above(self) -> tuple[int, ...]:
        """How many levels above the frame's own refinements start, in turn.

        First that on which a wrong tilt moves the ground by few pixels, then a finer one, then coarser ones.
        """
        query, height_m = self.query, self.query.telemetry.known_height_m
        own = query.level_of(height_m)
        off_px = height_m * math.radians(self._tilt_deg) / (query.site.gsd_m_per_px * 2.0**own)
        first, most = max(math.ceil(math.log2(off_px / _CAPTURE_PX)), 0), query.site.levels - 1 - own
        return tuple(dict.fromkeys(min(max(first + n, 0), most) for n in (0, -1, 1, 2)))

    @property
    def _is_on_unknown_slope(self) -> bool:
        return self._knows_tilt and not self.query.site.has_surface

    def _through_levels(
        self, prior: GaussianPrior, coarser: int
    ) -> tuple[DenseFit, EnhancedFrame, Samples] | None:
        """Refine on levels coarser than the frame's, where a few pixels span more ground; then on its own.

        If the tilt is unknown, others are tried at the start. The pose must fit better than the prior's.
        """
        query, site, height_m = self.query, self.query.site, self.query.telemetry.known_height_m
        own, has_tilt = query.level_of(height_m), self._knows_tilt
        pose, fit = prior.pose, None
        with query.scheduler.stage("dense"):  # one stage per pass; each may be skipped
            for level in range(min(own + coarser, site.levels - 1), own - 1, -1):
                window = self._footprint(prior.pose, height_m, level)
                if window is None:
                    fit = None
                    continue
                picture = self._enhanced_frame(height_m, level)
                ground = self.samples.find(window, level, MAX_SAMPLES if level == own else _COARSE_SAMPLES)
                starts = [pose]
                if not has_tilt and fit is None:
                    starts = _tilted(pose, height_m, self._tilt_deg)
                    starts.sort(key=lambda each: -dense.correlation_at(picture, ground, each))
                fit = None
                for start in starts[:_STARTS]:
                    other = dense.refine(picture, ground, start, prior)
                    if other is not None and (fit is None or other.correlation > fit.correlation):
                        fit = other
                    if fit is not None and fit.correlation >= CONFIRMING_CORRELATION:
                        break
                pose = pose if fit is None else fit.pose
        if fit is None or not fit.converged:
            return None
        is_direct = has_tilt and coarser == 0
        at_prior = fit.first_correlation if is_direct else dense.correlation_at(picture, ground, prior.pose)
        return (fit, picture, ground) if fit.correlation >= at_prior else None

    def _prior(self, fix: Fix) -> GaussianPrior:
        """The telemetry's height and attitude; the correlation's position is only a start, without weight."""
        query, known, errors = self.query, self.query.telemetry, self.query.errors
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
        """The frame at the resolution of a level, enhanced like the map, once for all attempts."""
        if level in self.pictures:
            return self.pictures[level]
        query = self.query
        scale = height_m / query.camera.focal_px / (query.site.gsd_m_per_px * 2.0**level)
        gray, smaller = shrink(query.gray, scale)
        scale /= math.sqrt(smaller[0, 0] * smaller[1, 1])
        enhanced = enhance(gray, radius_px=max(1, round(RADIUS_PX / scale)))
        self.pictures[level] = EnhancedFrame(enhanced, smaller @ query.camera.matrix)
        return self.pictures[level]

    def _refined_fix(self, fix: Fix, fit: DenseFit, covariance_m2: Array, turns_rad2: Array) -> Fix:
        query, center_m = self.query, fit.pose.center_m
        refined = query.fix(
            fix.method,
            query.site.pixel_from_enu(center_m[:2]),
            covariance_m2,
            score=fit.correlation,
            window=fix.window,
            center_m=center_m,
            grid_attitude=Attitude(*attitude_from_rotation(fit.pose.rotation.T @ query.camera.mount.T)),
            turn_covariance_rad2=turns_rad2,
            map_sigma_m=query.errors.map_m,
        )
        return replace(refined, stage="refined", confidence=fix.confidence)


def with_tilt_doubt(query: Query, fix: Fix) -> Fix:
    """The fix of a frame whose picture does not confirm its attitude, with a covariance for a wrong tilt."""
    return _less_certain(fix, query.telemetry.known_height_m * math.radians(_TILT_DOUBT_DEG))


def reaching(fix: Fix, other: Fix) -> Fix:
    """The fix with a covariance that covers another as well: which of the two is right is unknown."""
    up_m = 0.0 if fix.up_m is None or other.up_m is None else fix.up_m - other.up_m
    offset_m = np.append(offset_between_m(fix, other), up_m)
    return replace(fix, covariance_m2=fix.covariance_m2 + offset_m[:, None] * offset_m)


def _less_certain(fix: Fix, sigma_m: float) -> Fix:
    """The fix with one more error, of this standard deviation per axis."""
    return replace(fix, covariance_m2=fix.covariance_m2 + np.diag([sigma_m**2, sigma_m**2, 0.0]))


def _tilted(pose: Pose, height_m: float, sigma_deg: float) -> list[Pose]:
    """The pose and tilted variants that look at the same point, where correlation found the frame's middle."""

    def reach_m(rotation: Array) -> Array:
        return np.asarray(rotation[2] * (height_m / -rotation[2, 2]))

    out = [pose]
    for x, y in itertools.product(_TILTS, _TILTS):
        rotation = cv2.Rodrigues(np.radians([x * sigma_deg, y * sigma_deg, 0.0]))[0] @ pose.rotation
        out.append(Pose(rotation, pose.center_m + reach_m(pose.rotation) - reach_m(rotation), pose.slope))
    return out
