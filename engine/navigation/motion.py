"""Motion between frames: what telemetry and pictures say of it, and positions of other sources."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.geo import chi_square, larger_variance
from engine.options import NavigatorOptions
from engine.orthomap import OrthoMap
from engine.values import MAX_SIGMA_M, Fix, Frame, NoFix, Prior, Reason

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Step:
    """The way between two frames as one source measured it.

    Attributes:
        moved_m: (2,) east and north.
        begin_mps: (2,) velocity at the earlier frame; None if the source did not know it.
        end_mps: (2,) at the later one.
        sigma_mps: standard deviation per axis of the source's lasting error.
        noise_m2: variance per axis of errors that do not last.
    """

    moved_m: Array
    begin_mps: Array | None
    end_mps: Array
    sigma_mps: float
    noise_m2: float


@dataclass(frozen=True, slots=True)
class Ways:
    """All that is known of the way from one frame to the next.

    Attributes:
        interval_s: between them.
        stated: by the telemetry's velocity, if both came with one or the later did.
        seen: by pictures, if they were followed.
    """

    interval_s: float
    stated: Step | None = None
    seen: Step | None = None


@dataclass(frozen=True, slots=True)
class GroundMotion:
    """Movement over the ground between two pictures, measured from them.

    Attributes:
        interval_s: between them.
        moved_m: (2,) east and north.
        noise_m2: (2, 2) covariance of the errors of this step.
        lasting_share: lasting error as a share of the way, from height and heading.
        drift: factor by which a step adds more variance to a long way than alone, because some errors last for
            several steps.
    """

    interval_s: float
    moved_m: Array
    noise_m2: Array
    lasting_share: float
    drift: float

    @property
    def velocity_mps(self) -> Array:
        """(2,) east and north, the mean between the two pictures."""
        return self.moved_m / self.interval_s

    @property
    def velocity_covariance_m2ps2(self) -> Array:
        """(2, 2) covariance of that velocity, including the lasting error."""
        lasting_m2 = self.lasting_share**2 * float(self.moved_m @ self.moved_m)
        return np.asarray((self.noise_m2 + lasting_m2 * np.eye(2)) / self.interval_s**2)

    def step(self, before: Step | None) -> Step:
        """The way of this motion, whose lasting error is a share of the velocity.

        Args:
            before: the step up to the earlier picture; None if it was not measured.
        """
        begin_mps = None if before is None else before.end_mps
        sigma_mps = self.lasting_share * float(np.hypot(*self.velocity_mps))
        noise_m2 = self.drift * larger_variance(self.noise_m2)
        return Step(self.moved_m, begin_mps, self.velocity_mps, sigma_mps, noise_m2)


@dataclass(frozen=True, slots=True)
class PositionEstimate:
    """A position from another source than the match it is compared with.

    Attributes:
        en_m: (2,) east and north.
        sigma_m: one standard deviation of each.
        on_map: whether it came from the same map and so shares its georeferencing error.
    """

    en_m: Array
    sigma_m: float
    on_map: bool = False

    def difference_covariance_m2(self, fix: Fix) -> Array:
        """Covariance of the difference to a fix; the map's error cancels between two fixes on it.

        Args:
            fix: on the map.

        Returns:
            (2, 2) square metres, east and north.
        """
        covariance_m2 = fix.relative_covariance_m2 if self.on_map else fix.covariance_m2[:2, :2]
        return covariance_m2 + self.sigma_m**2 * np.eye(2)

    def spread_m2(self, fix: Fix) -> float:
        """Area of the Gaussian of the difference to a fix: where both agree, its density is one over it."""
        (a, b), (c, d) = self.difference_covariance_m2(fix).tolist()
        return 2.0 * math.pi * math.sqrt(a * d - b * c)

    def chi_square(self, fix: Fix) -> float:
        """Squared Mahalanobis distance to a fix by both covariances: two degrees of freedom."""
        return chi_square(en_m(fix) - self.en_m, self.difference_covariance_m2(fix))

    def log_likelihood_ratio(self, fix: Fix, area_m2: float) -> float:
        """How much more probable the fix is here than anywhere in an area, as a natural logarithm.

        An estimate vaguer than the area says nothing by that, only by how far the fix is off.
        """
        return math.log(max(area_m2 / self.spread_m2(fix), 1.0)) - 0.5 * self.chi_square(fix)

    def refusal(self, fix: Fix) -> NoFix:
        """The refusal of a fix that contradicts this estimate."""
        apart_m = float(np.hypot(*(en_m(fix) - self.en_m)))
        sigma_m = math.hypot(self.sigma_m, fix.relative_sigma_m if self.on_map else fix.sigma_m)
        detail = f"{apart_m:.1f} m from the prediction, sigma {sigma_m:.1f} m"
        return fix.refused(Reason.INCONSISTENT, detail)

    def prior(self, widened: float = 1.0, moved_m: Array | None = None, map_sigma_m: float = 0.0) -> Prior:
        """This estimate as a prior.

        Args:
            widened: factor on the standard deviation; the product is at most :data:`engine.values.MAX_SIGMA_M`.
            moved_m: (2,) movement east and north since the last frame; None is 0.
            map_sigma_m: error of the map between this position and a place on it, or in the world.

        Returns:
            Prior: in metres east and north of the map's origin.
        """
        east, north = (float(v) for v in self.en_m)
        moved_east, moved_north = (0.0, 0.0) if moved_m is None else (float(v) for v in moved_m)
        sigma_m = math.hypot(self.sigma_m * widened, map_sigma_m)
        return Prior(
            east_m=east,
            north_m=north,
            sigma_m=min(sigma_m, MAX_SIGMA_M),
            moved_east_m=moved_east,
            moved_north_m=moved_north,
        )


def position_of(prior: Prior, site: OrthoMap) -> PositionEstimate:
    """The position from another source.

    Args:
        prior: by the other source.
        site: the map that defines the axes.
    """
    if prior.lat_deg is not None and prior.lon_deg is not None:
        return PositionEstimate(site.frame.enu_from_geodetic(prior.lat_deg, prior.lon_deg), prior.sigma_m)
    return PositionEstimate(np.array([prior.east_m, prior.north_m]), prior.sigma_m)  # one of the two is given


def place_of(fix: Fix) -> PositionEstimate:
    """A fix's position relative to the map, for comparison with other fixes on it."""
    return PositionEstimate(en_m(fix), fix.relative_sigma_m, on_map=True)


def en_m(fix: Fix) -> Array:
    """East and north of a fix.

    Args:
        fix: a position.

    Returns:
        (2,) metres.
    """
    return np.array([fix.east_m, fix.north_m])


def is_valid(fix: Fix) -> bool:
    """Whether the position is finite and the covariance positive definite."""
    covariances = fix.covariance_m2, fix.relative_covariance_m2
    is_finite = np.isfinite(fix.covariance_m2).all() and np.isfinite(en_m(fix)).all()
    return bool(is_finite and all(np.linalg.eigvalsh(each)[0] > 0.0 for each in covariances))


def velocity_of(frame: Frame) -> Array | None:
    """The telemetry's velocity.

    Args:
        frame: any.

    Returns:
        (2,) m/s east and north; None if the frame came without.
    """
    if frame.east_velocity_mps is None or frame.north_velocity_mps is None:
        return None
    return np.array([frame.east_velocity_mps, frame.north_velocity_mps])


def stamps_m2(mps: Array, options: NavigatorOptions) -> float:
    """Variance of a way because the stamps at both of its ends are off.

    Args:
        mps: (2,) velocity along it.
        options: of the navigator.

    Returns:
        Square metres per axis.
    """
    return 2.0 * options.attitude_jitter_s**2 * float(mps @ mps)


def stated_step(before: Step | None, frame: Frame, interval_s: float, options: NavigatorOptions) -> Step | None:
    """The way to a frame by the velocities that came with it and with the one before.

    Between the two the velocity walks at random, by the vehicle's acceleration.

    Args:
        before: the step to the frame before; None if it came without a velocity.
        frame: the later one.
        interval_s: between them.
        options: of the navigator.

    Returns:
        Step | None: None if the later frame came without a velocity.
    """
    end_mps, begin_mps = velocity_of(frame), None if before is None else before.end_mps
    if end_mps is None:
        return None
    mean_mps, changes = (end_mps, 3.0) if begin_mps is None else (0.5 * (begin_mps + end_mps), 12.0)
    between_m2 = options.acceleration_mps2**2 * interval_s**3 / changes  # of a walk between known ends
    between_m2 += stamps_m2(mean_mps, options)
    sigma_mps = frame.velocity_sigma_mps or options.measured_velocity_sigma_mps
    return Step(mean_mps * interval_s, begin_mps, end_mps, sigma_mps, between_m2)
