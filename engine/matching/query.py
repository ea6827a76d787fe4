"""Input of every method: one frame, its prior, the map, and the frame's clock."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from engine.assumed_errors import AssumedErrors
from engine.camera import Camera
from engine.geo import angle_covariance_deg2, enu_from_body, inverse_2x2, transport_covariance, wrap_heading_deg
from engine.matching.covariance import scale_doubt_m
from engine.matching.evidence import needed_nats, prior_chi_square
from engine.matching.pose import AttitudePrior
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.runtime.scheduler import Scheduler
from engine.values import Attitude, Fix, Frame, GridPose, Look, NoFix, Prior, Reason, Timings, Window
from engine.window import SPREAD_SIGMAS, level_for, place_window, window_size_px

Array = NDArray[np.float64]

_AGREE_SIGMAS = 2.0  # difference at which a measured height still agrees with the telemetry's
_FOUND_HEADING_DEG, _FOUND_HEIGHT_SHARE = 2.0, 0.03  # standard deviations of what a search found


@dataclass(frozen=True)
class Query:
    """One frame on its way to a fix.

    Attributes:
        frame: as received.
        gray: (H, W) its undistorted grey picture.
        camera: pinhole camera of the undistorted picture.
        site: the map.
        prior: where the vehicle should be, or None for anywhere on the map.
        device: where pictures are correlated.
        scheduler: times its stages and decides which steps time allows.
        risk: allowed probability of a wrong fix.
        assumed: errors of telemetry and map, of those that the frame does not state.
        stated_height_m: the height that the frame came with, if a search replaced it.
        looks: what was known after each look so far.
    """

    frame: Frame
    gray: NDArray[np.uint8]
    camera: Camera
    site: OrthoMap
    prior: Prior | None
    device: Device
    scheduler: Scheduler = field(repr=False)
    risk: float
    assumed: AssumedErrors
    stated_height_m: float | None = None
    looks: list[Look] = field(default_factory=list, repr=False)

    @property
    def needed_nats(self) -> float:
        """The evidence that a fix needs."""
        return needed_nats(self.risk)

    @cached_property
    def prior_px(self) -> Array | None:
        """The prior's position in map pixels (x, y); None without one, not finite where the CRS does not reach."""
        prior = self.prior
        if prior is None:
            return None
        with np.errstate(invalid="ignore"):
            if prior.lat_deg is not None and prior.lon_deg is not None:
                return self.site.pixel_from_geodetic(prior.lat_deg, prior.lon_deg)
            return self.site.pixel_from_enu(np.array([prior.east_m, prior.north_m]))  # a Prior has one of the two

    def prior_chi_square(self, fix: Fix) -> float | None:
        """Chi-square of a fix against the prior (:func:`.prior_chi_square`); None without a prior."""
        if self.prior is None or self.prior_px is None:
            return None
        return prior_chi_square(fix, self.site.enu_from_pixel(self.prior_px), self.prior.sigma_m)

    @cached_property
    def telemetry(self) -> GridPose:
        """The frame's height and attitude, with the heading from grid north at the prior's position.

        Without a position it takes the middle of the map, where grid north is true north.
        """
        frame, heading_deg = self.frame, self.frame.heading_deg
        if heading_deg is not None:
            heading_deg = wrap_heading_deg(heading_deg + self._convergence_deg)
        return GridPose(frame.height_agl_m, heading_deg, frame.roll_deg, frame.pitch_deg)

    @cached_property
    def _convergence_deg(self) -> float:
        """What a heading from grid north is more than from true north, where the vehicle should be."""
        if self.prior_px is None or not np.isfinite(self.prior_px).all():
            return 0.0
        lat, lon = self.site.geodetic_from_pixel(self.prior_px)
        return self.site.frame.convergence_deg(float(lat), float(lon))

    @cached_property
    def jacobian(self) -> Array:
        """(2, 2) metres east and north per map pixel where the vehicle should be, else at the map's middle."""
        return self.site.enu_jacobian(self.site.grid.centre_px if self.prior_px is None else self.prior_px)

    def level_of(self, height_m: float) -> int:
        """The pyramid level whose pixels are like the frame's at this height above the ground."""
        return level_for(self.site.gsd_m_per_px, height_m / self.camera.focal_px, self.site.levels)

    def window(
        self,
        center_px: Array,
        footprint_px: tuple[float, float],
        min_px: tuple[float, float],
    ) -> Window | None:
        """The adaptive window in map pixels (eq. 4, 5), or None if it lies outside the map.

        Args:
            center_px: (2,) where the middle of the footprint should lie.
            footprint_px: extent of the whole frame on the map.
            min_px: extent of what will be matched. The window holds it at every position within
                :data:`engine.window.SPREAD_SIGMAS` of the prior, even if equations 4 and 5 would give less.
        """
        prior = self.prior
        if prior is None:
            return Window(0, 0, self.site.width_px, self.site.height_px)
        moved_m = np.array([prior.moved_east_m, prior.moved_north_m])
        moved_px = inverse_2x2(self.jacobian) @ moved_m
        size = window_size_px(footprint_px, (float(moved_px[0]), float(moved_px[1])))
        slack = 2.0 * SPREAD_SIGMAS * prior.sigma_m / self.site.gsd_m_per_px
        width, height = (max(a, b + slack) for a, b in zip(size, min_px, strict=True))
        shape = (self.site.width_px, self.site.height_px)
        return place_window((float(center_px[0]), float(center_px[1])), (width, height), shape)

    @cached_property
    def errors(self) -> AssumedErrors:
        """Of telemetry and map, as the frame states them, or as assumed."""
        return self.assumed.of_frame(self.frame)

    def attitude_prior(self, grid_heading_deg: float, sigma_deg: float, errors: AssumedErrors) -> AttitudePrior:
        """The frame's attitude with its assumed errors about the body's axes; an unknown tilt is taken as level.

        Args:
            grid_heading_deg: clockwise from grid north.
            sigma_deg: of the heading.
            errors: of the tilt.
        """
        known, mount = self.telemetry, self.camera.mount
        enu_from_camera = enu_from_body(known.roll_deg or 0.0, known.pitch_deg or 0.0, grid_heading_deg) @ mount
        return AttitudePrior(enu_from_camera.T, (*errors.tilts_deg(known), sigma_deg), axes=mount)

    def above_ground_m(self, nadir_px: Array, up_m: float) -> float:
        """Height of a camera above the bare ground below it.

        Args:
            nadir_px: (2,) of the camera.
            up_m: of the camera.
        """
        return up_m - float(self.site.ground_at(nadir_px))

    def scale_doubt_m(self, measured_m: float, camera_down: Array) -> float:
        """Position error to allow for if the measured height is not the telemetry's (:func:`.scale_doubt_m`).

        Args:
            measured_m: of the camera, above the ground.
            camera_down: (3,) optical axis in east, north, up.

        Returns:
            One standard deviation per axis, 0 if the heights agree to within two standard deviations.
        """
        stated_m = self.stated_height_m or self.telemetry.height_agl_m
        if stated_m is None:
            return 0.0
        off_m = abs(measured_m - stated_m)
        if off_m <= _AGREE_SIGMAS * self.errors.height_sigma_m(stated_m):
            return 0.0
        stated = self.telemetry.grid_attitude if self.telemetry.has_tilt else None
        stated_down = None if stated is None else self.camera.enu_from_camera(stated)[:, 2]
        return scale_doubt_m(off_m, measured_m, camera_down, stated_down)

    def at(self, pose: GridPose) -> Query:
        """The same query with the heading and height that a search found, as accurate as its steps."""
        height_m = pose.known_height_m
        found = replace(
            self.frame,
            heading_deg=wrap_heading_deg(pose.known_attitude.heading_deg - self._convergence_deg),
            heading_sigma_deg=_FOUND_HEADING_DEG,
            height_agl_m=height_m,
            height_sigma_m=_FOUND_HEIGHT_SHARE * height_m,
        )
        return replace(self, frame=found, stated_height_m=self.frame.height_agl_m)

    # --------------------------------------------------------------------------------------------- answers

    def fix(
        self,
        method: str,
        nadir_px: Array,
        covariance_m2: Array,
        *,
        score: float,
        window: Window,
        center_m: Array | None = None,
        grid_attitude: Attitude | None = None,
        turn_covariance_rad2: Array | None = None,
        map_sigma_m: float = 0.0,
        stage: str = "fine",
    ) -> Fix:
        """A fix of this frame; its heading is from true north at the fix.

        Args:
            method: "ncc", "sift" or "learned".
            nadir_px: (2,) the camera's nadir in map pixels.
            covariance_m2: (3, 3) east, north, up.
            score: of the match.
            window: the searched window.
            center_m: (3,) the camera's centre; None if its height is not measured.
            grid_attitude: the heading from grid north; None if it is not measured.
            turn_covariance_rad2: (3, 3) of a small turn about the camera's axes, with a measured attitude.
            map_sigma_m: the georeference's part of the covariance.
            stage: as :attr:`.Fix.stage`.
        """
        east, north = self.site.enu_from_pixel(nadir_px) if center_m is None else center_m[:2]
        lat, lon = map(float, self.site.geodetic_from_pixel(nadir_px))
        attitude, angles_deg2 = grid_attitude, None
        if attitude is not None:
            turn_deg = self.site.frame.convergence_deg(lat, lon)
            attitude = replace(attitude, heading_deg=wrap_heading_deg(attitude.heading_deg - turn_deg))
            if turn_covariance_rad2 is not None:
                about_body = transport_covariance(self.camera.mount, turn_covariance_rad2)
                angles_deg2 = angle_covariance_deg2(about_body, attitude.roll_deg, attitude.pitch_deg)
        return Fix(
            timestamp_ns=self.frame.timestamp_ns,
            lat_deg=lat,
            lon_deg=lon,
            east_m=float(east),
            north_m=float(north),
            up_m=None if center_m is None else float(center_m[2]),
            covariance_m2=covariance_m2,
            attitude=attitude,
            score=score,
            method=method,
            window=window,
            timings=self.timings,
            map_xy_px=(float(nadir_px[0]), float(nadir_px[1])),
            map_sigma_m=map_sigma_m,
            stage=stage,
            attitude_covariance_deg2=angles_deg2,
        )

    @property
    def timings(self) -> Timings:
        """The timings so far."""
        return Timings(dict(self.scheduler.stages_ms))

    def refuse(
        self,
        reason: Reason,
        detail: str,
        method: str,
        *,
        score: float | None = None,
        window: Window | None = None,
    ) -> NoFix:
        """The refusal of this frame, with what was measured so far."""
        return NoFix(
            reason=reason,
            detail=detail,
            timestamp_ns=self.frame.timestamp_ns,
            method=method,
            score=score,
            window=window,
            timings=self.timings,
        )
