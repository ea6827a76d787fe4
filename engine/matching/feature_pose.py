"""Match one frame with the map by features: lift the matches to 3D, solve for the pose by PnP."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from engine.assumed_errors import AssumedErrors
from engine.geo import Array, attitude_from_rotation, wrap_difference_deg
from engine.kernels.dense import Pose
from engine.maps.landmarks import LandmarkMap
from engine.matching import refusals
from engine.matching.align import MIN_DOWN
from engine.matching.candidates import PoseCandidate
from engine.matching.covariance import tilt_covariance
from engine.matching.evidence import RELIABILITY, Evidence, probability
from engine.matching.feature_matching import VOTE_SHARE, Matched, PointSearch
from engine.matching.pnp import MIN_INLIERS
from engine.matching.pose import AttitudePrior, PoseStats, solve_pose
from engine.matching.query import Query
from engine.matching.unknown_slope import from_level_ground, wide_slope_deg
from engine.matching.views import TelemetryHypothesis, coarser_scale, level_at, view_in, views_of, x_axis_deg
from engine.matching.votes import TURNS_DEG, Vote
from engine.options import MIN_HEIGHT_M, PAPER_SCALE, SiftOptions
from engine.values import Attitude, Fix, NoFix, Reason, Window
from engine.window import SPREAD_SIGMAS

if TYPE_CHECKING:  # it loads torch
    from engine.matching.point_finding import PointFinder


METHOD = "sift"
_MATCHED_HEADING_SIGMA_DEG = 30.0  # of a heading given by the matches alone: nearly no information


@dataclass(frozen=True, slots=True)
class FeatureMatcher:
    """One frame and the landmarks to match it with.

    Attributes:
        query: the frame.
        landmarks: of the map; None if a finder takes their place.
        options: settings.
        finder: finds the matched points instead of features.
        method: name of the method in fixes and refusals.
        doubts_tilt: whether the stated roll and pitch are no better known than missing ones.
    """

    query: Query
    landmarks: LandmarkMap | None
    options: SiftOptions
    finder: PointFinder | None = None
    method: str = METHOD
    doubts_tilt: bool = False

    def find(self) -> PoseCandidate | NoFix:
        """The pose of the frame, or a refusal if there is none."""
        query = self.query
        flat = refusals.if_flat(query, self.method)
        if flat is not None:
            return flat
        first: NoFix | PoseCandidate | None = None
        found: list[tuple[PoseCandidate, FeatureMatcher, TelemetryHypothesis]] = []
        deadline, attempts, count = query.scheduler.deadline, deque(self._attempts()), 0
        while attempts and (first is None or deadline.remaining_ms >= deadline.elapsed_ms):
            (matcher, hypothesis), count = attempts.popleft(), count + 1
            result = matcher._find_with(hypothesis)
            first = first or result
            if isinstance(result, NoFix):
                if result.reason not in (Reason.TOO_FEW_MATCHES, Reason.BAD_POSE):
                    break
                continue
            tried = result.evidence.tried * count  # it is the best of all that was tried so far
            drawn_at = None if matcher.query is query else matcher.query.telemetry
            weighed = replace(result, drawn_at=drawn_at).weighed(replace(result.evidence, tried=tried))
            found.append((weighed, matcher, hypothesis))
            # What is found after the telemetry failed may be as wrong as that.
            if weighed.suffices(query.risk) or (result is first and result.promises(query.risk)):
                break
            again = matcher._at(result, hypothesis) if matcher.query is query else None
            if again is not None:
                attempts.appendleft(again)
        if not found:
            assert first is not None  # the telemetry's own hypothesis is always tried
            return first
        best, matcher, hypothesis = max(found, key=lambda each: each[0].evidence.nats)
        if len(found) == 1 and best.suffices(query.risk):
            return best
        alike = max(each.evidence.alike for each, _, _ in found)
        best = best.weighed(replace(best.evidence, least_alike=alike)).against(each for each, _, _ in found)
        return matcher._null_tested(best, hypothesis)

    def find_at_once(self) -> PoseCandidate | NoFix:
        """The pose of a frame by its own telemetry, with no second attempt and no null hypothesis."""
        return refusals.if_flat(self.query, self.method) or self._find_with(next(self._attempts())[1])

    def _null_tested(self, found: PoseCandidate, hypothesis: TelemetryHypothesis) -> PoseCandidate:
        """The candidate compared with the mirrored frame under the same telemetry."""
        mirrored = replace(self.query, gray=np.ascontiguousarray(self.query.gray[:, ::-1]))
        null = replace(self, query=mirrored)._find_with(hypothesis)
        surprise = 0.0 if isinstance(null, NoFix) else null.evidence.surprise
        return found.weighed(replace(found.evidence, null=surprise, is_tested=True))

    def _attempts(self) -> Iterator[tuple[FeatureMatcher, TelemetryHypothesis]]:
        """Hypotheses to try in turn: the telemetry, the same a level coarser and at full resolution, wider ones.

        A map is often blurrier than its pixels, and a coarser level leaves out what it does not show.
        """
        query, options = self.query, self.options
        height_m = query.telemetry.height_agl_m
        unknown = (MIN_HEIGHT_M, options.max_height_m)
        known = TelemetryHypothesis(unknown if height_m is None else (height_m, height_m), x_axis_deg(query))
        yield self, known
        if height_m is not None and known.x_axis_deg is not None and self.finder is None:
            own = level_at(query, height_m, options.scale)
            coarser = coarser_scale(query, height_m, options.scale)
            if coarser is not None:
                yield replace(self, options=replace(options, scale=coarser)), known
            if own > level_at(query, height_m, 1.0):
                yield replace(self, options=replace(options, scale=1.0)), known
        wide = TelemetryHypothesis(unknown if height_m is None else (height_m / 2.0, height_m * 2.0), None)
        if options.search_widely and wide != known:
            yield self, wide

    def _at(
        self, found: PoseCandidate, hypothesis: TelemetryHypothesis
    ) -> tuple[FeatureMatcher, TelemetryHypothesis] | None:
        """The attempt at the height and heading of a pose; None if it was found with nearly these.

        The frame is drawn as the map would show it, which the telemetry's height or heading did not allow.
        """
        query, fix = self.query, found.fix
        if self.finder is not None or fix.up_m is None or fix.attitude is None:
            return None
        height_m = query.above_ground_m(np.array(fix.map_xy_px), fix.up_m)
        heading_deg = fix.attitude.heading_deg + query.site.frame.convergence_deg(fix.lat_deg, fix.lon_deg)
        stated_m, stated_deg = hypothesis.height_m, query.telemetry.grid_heading_deg
        turn_deg = math.inf if stated_deg is None else abs(wrap_difference_deg(heading_deg - stated_deg))
        is_near = stated_m is not None and abs(height_m - stated_m) < VOTE_SHARE * stated_m
        if height_m < MIN_HEIGHT_M or (is_near and turn_deg < TURNS_DEG[-1] / 2.0):
            return None
        doubts_tilt = self.doubts_tilt or SPREAD_SIGMAS * query.errors.heading_deg < turn_deg < math.inf
        there = query.at(replace(query.telemetry, height_agl_m=height_m, grid_heading_deg=heading_deg % 360.0))
        matcher = replace(self, query=there, doubts_tilt=doubts_tilt)
        return matcher, TelemetryHypothesis((height_m, height_m), x_axis_deg(there))

    def matches_in(self, window: Window) -> tuple[Array, Array, PoseStats | None]:
        """The matches in a window at the frame's own height and heading, and their pose: for reports.

        Returns:
            Points (M, 2) in pixels of the undistorted frame, their places (M, 3) on the ground in metres, and the
            pose with its inliers, or None if the matches are too few or determine none.
        """
        height_m = self.query.telemetry.known_height_m
        hypothesis = TelemetryHypothesis((height_m, height_m), x_axis_deg(self.query))
        views = [view_in(self.query, window, height_m, self.options.scale)]
        found = self._search.find(views, hypothesis)[0]
        return found.points_px, found.points_m, self._pose(found, hypothesis)

    @property
    def _search(self) -> PointSearch:
        """What finds the frame's points on the map: features, or the matcher in their place."""
        source = self.finder or self.landmarks
        if self.finder is None and self.options.matcher is not None:
            from engine.matching.point_finding import PointFinder

            source = PointFinder(self.options.matcher)
        assert source is not None  # only a finder needs no landmarks
        return PointSearch(self.query, source, self.options)

    def _find_with(self, hypothesis: TelemetryHypothesis) -> PoseCandidate | NoFix:
        """Match, lift and solve, under one hypothesis about the telemetry."""
        query, options, scheduler = self.query, self.options, self.query.scheduler
        with scheduler.stage("window"):
            views = views_of(query, hypothesis, self.method, options.scale)
        if isinstance(views, NoFix):
            return views
        if self.finder is not None and any(map(self.finder.too_large, views)):
            pixels = max(view.crop.area_px for view in views)
            detail = f"a window of {pixels} pixels is too large to search; a more accurate position is needed"
            return query.refuse(Reason.MAP_TOO_LARGE, detail, self.method, window=views[0].window)
        matched = self._search.find(views, hypothesis)
        matched.sort(key=lambda found: len(found.points_px), reverse=True)
        count, window = len(matched[0].points_px), matched[0].view.window
        if count < MIN_INLIERS:
            detail = f"{count} matches; {MIN_INLIERS} are required"
            return query.refuse(Reason.TOO_FEW_MATCHES, detail, self.method, window=window)
        if scheduler.deadline.remaining_ms < 0:
            return query.refuse(Reason.LATE, "the budget was spent before the pose", self.method, window=window)
        for found in matched:
            with scheduler.stage("pose"):
                stats = self._pose(found, hypothesis)
            if stats is not None:
                fix = self._fix(stats, found.view.window)
                return fix if isinstance(fix, NoFix) else self._with_confidence(fix, stats, found.vote, hypothesis)
        detail = f"no pose explains enough of the {count} matches"
        return query.refuse(Reason.BAD_POSE, detail, self.method, window=window)

    # ------------------------------------------------------------------------------------------------ pose

    def _pose(self, found: Matched, hypothesis: TelemetryHypothesis) -> PoseStats | None:
        """The pose that the matches agree on and the attitude allows.

        Few matches hardly separate a tilt from a displacement. A known tilt counts even if the heading is unknown:
        the matches themselves then give the heading. If they refute a known one, the tilt is as doubtful: of the
        poses that rest on it and on the matches, the more certain one counts.
        """
        query, options = self.query, self.options
        if not options.use_attitude:
            return self._by_matches(found, None)
        errors = query.errors
        stated_deg, sigma_deg = query.telemetry.grid_heading_deg, errors.heading_deg
        heading_deg, doubts_tilt = stated_deg, self.doubts_tilt
        if heading_deg is None or hypothesis.x_axis_deg is None:
            free = self._by_matches(found, None)
            if free is None:
                return None
            heading_deg = attitude_from_rotation(free.rotation.T @ query.camera.mount.T)[2]
            if stated_deg is not None:
                doubts_tilt |= abs(wrap_difference_deg(heading_deg - stated_deg)) > SPREAD_SIGMAS * sigma_deg
            sigma_deg = _MATCHED_HEADING_SIGMA_DEG
        stated = self._solved(found, heading_deg, sigma_deg, errors)
        if stated is None or not doubts_tilt:
            return stated
        doubting = replace(errors, tilt_deg=max(errors.tilt_deg, errors.unknown_tilt_deg))
        seen = self._solved(found, heading_deg, sigma_deg, doubting)
        above_m = query.above_ground_m(query.site.pixel_from_enu(stated.center_m[:2]), float(stated.center_m[2]))
        stated = _with_tilt_doubt(stated, above_m, math.radians(doubting.tilt_deg))
        return min(filter(None, (stated, seen)), key=lambda each: float(np.trace(each.covariance_center_m2)))

    def _solved(
        self, found: Matched, heading_deg: float, sigma_deg: float, errors: AssumedErrors
    ) -> PoseStats | None:
        """The pose with these errors of the attitude.

        Over unknown ground a part of its tilt may be a slope's. How much, only a stated tilt tells, and that may
        be wrong altogether.
        """
        query, unknown_deg = self.query, errors.unknown_tilt_deg

        def attitude(tilt_deg: float) -> AttitudePrior:
            return query.attitude_prior(heading_deg, sigma_deg, replace(errors, tilt_deg=tilt_deg))

        if not self._divides_tilt:
            return self._by_matches(found, attitude(errors.tilt_deg))
        wide_deg = wide_slope_deg(errors.unknown_slope_deg)
        stats = self._by_matches(found, attitude(math.hypot(errors.tilt_deg, wide_deg)))
        if stats is None:
            return None
        wrong = (1.0 - RELIABILITY) / 5.0  # heavy tails: a wrong attitude may be off by any angle
        tilts = [(RELIABILITY, errors.tilt_deg), (4.0 * wrong, unknown_deg), (wrong, 2.0 * unknown_deg)]
        over = from_level_ground(
            Pose(stats.rotation, stats.center_m, np.zeros(2)),
            stats.covariance,
            found.points_m[stats.inliers].mean(axis=0),
            [(probability, attitude(tilt_deg)) for probability, tilt_deg in tilts],
            errors.unknown_slope_deg,
        )
        rotation, center_m = over.pose.rotation, over.pose.center_m
        return replace(stats, rotation=rotation, center_m=center_m, covariance=over.covariance[:6, :6])

    def _by_matches(self, found: Matched, prior: AttitudePrior | None) -> PoseStats | None:
        """The pose that the matches agree on."""
        pose = replace(self.options.pose, reprojection_px=found.tolerance_px)
        return solve_pose(
            found.points_m,
            found.points_px,
            self.query.camera.matrix,
            pose,
            weights=found.weights,
            prior=prior,
            start=found.start,
        )

    def _fix(self, stats: PoseStats, window: Window) -> Fix | NoFix:
        """The camera's centre as a fix; refused if a drone over this map cannot be there."""
        query, site, options = self.query, self.query.site, self.options
        up = float(stats.center_m[2])
        nadir = site.pixel_from_enu(stats.center_m[:2])
        share = float(stats.inliers.mean())
        down = -float(stats.rotation[2, 2])
        if down < MIN_DOWN or up <= float(site.surface_at(nadir)):
            ray_deg = math.degrees(math.acos(min(max(down, -1.0), 1.0)))
            detail = f"the pose looks {ray_deg:.0f} degrees off the vertical at a height of {up:.0f} m"
            return query.refuse(Reason.BAD_POSE, detail, self.method, score=share, window=window)
        if not query.telemetry.has_tilt:  # features of a coarse picture share errors that look like a tilt
            stats = replace(stats, covariance=stats.covariance * max(1.0, PAPER_SCALE / options.scale) ** 2)
        measured_m = query.above_ground_m(nadir, up)
        doubt_m = query.scale_doubt_m(measured_m, stats.rotation[2])
        above_m = up - float(site.surface_at(nadir))
        attitude = Attitude(*attitude_from_rotation(stats.rotation.T @ query.camera.mount.T))
        stats = _with_tilt_doubt(stats, above_m, math.hypot(self._slope_rad(attitude), doubt_m / above_m))
        return query.fix(
            self.method,
            nadir,
            stats.covariance_center_m2 + query.errors.map_m**2 * np.eye(3),
            score=share,
            window=window,
            center_m=stats.center_m,
            grid_attitude=attitude,
            turn_covariance_rad2=stats.covariance[3:, 3:],
            map_sigma_m=query.errors.map_m,
        )

    def _slope_rad(self, attitude: Attitude) -> float:
        """Standard deviation of the ground's slope that a pose of this attitude does not hold yet.

        Of a tilt that nothing states, any share may be the slope of unknown ground.
        """
        errors, options, has_tilt = self.query.errors, self.options, self.query.telemetry.has_tilt
        if self._divides_tilt:
            return 0.0
        if self.query.site.has_surface:
            return math.radians(errors.surface_slope_deg)
        is_shared = options.use_attitude and not has_tilt
        tilt_deg = math.hypot(attitude.roll_deg, attitude.pitch_deg) if is_shared else 0.0
        return math.radians(math.hypot(errors.unknown_slope_deg, tilt_deg / math.sqrt(3.0)))

    @property
    def _divides_tilt(self) -> bool:
        """Whether a stated tilt divides that of a pose between the camera and ground of unknown slope."""
        has_tilt = self.query.telemetry.has_tilt and self.options.use_attitude
        return has_tilt and not self.query.site.has_surface

    def _with_confidence(
        self, fix: Fix, stats: PoseStats, vote: Vote | None, hypothesis: TelemetryHypothesis
    ) -> PoseCandidate:
        """The candidate of a fix, by the evidence of its vote; without one by the inliers of the pose.

        The height does not count if this hypothesis doubts it.
        """
        query, height_m = self.query, self.query.telemetry.height_agl_m
        errors, height_chi_square = query.errors, None
        if height_m is not None and hypothesis.height_m == height_m:
            assert fix.up_m is not None
            # Above ground both count: an error of the map moves the ground with the camera.
            variance = errors.height_sigma_m(height_m) ** 2 + float(fix.covariance_m2[2, 2]) - errors.map_m**2
            above_m = query.above_ground_m(np.array(fix.map_xy_px), fix.up_m)
            height_chi_square = (above_m - height_m) ** 2 / variance
        if vote is not None:
            rival = vote.rival_surprise(stats.inliers)  # those of the pose are no matches of another place
            surprise, tried = vote.surprise, float(vote.tried)
        else:
            surprise = (stats.log10_tried - stats.log10_nfa) * math.log(10.0)
            rival, tried = 0.0, 10.0**stats.log10_tried
        prior_chi_square = query.prior_chi_square(fix)
        evidence = Evidence(surprise, rival, tried, tried, prior_chi_square, height_chi_square)
        return PoseCandidate(replace(fix, confidence=probability(evidence.nats)), evidence)


def _with_tilt_doubt(stats: PoseStats, above_m: float, sigma_rad: float) -> PoseStats:
    """The pose with a covariance for a wrong tilt, of the camera or of the ground so far below it."""
    covariance = stats.covariance.copy()
    covariance[:2, :2] += (above_m * sigma_rad) ** 2 * np.eye(2)
    covariance[3:, 3:] += tilt_covariance(stats.rotation, sigma_rad)
    return replace(stats, covariance=covariance)
