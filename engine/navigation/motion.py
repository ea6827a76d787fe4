"""Dead reckoning: the displacement between fixes by odometry, and its uncertainty."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError
from engine.geo import chi_square
from engine.values import MAX_SIGMA_M, Fix, Frame, NoFix, Prior, Reason

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OdometrySample:
    """Time and displacement at one frame.

    Attributes:
        time_s: since the first frame.
        moved_m: (2,) displacement east and north since then.
        blind_s: the part of that time without a measured velocity.
        stated_s: the part of that time whose velocity came with its accuracy; the next two accumulate it.
        lasting_m: accumulated errors that last, both axes.
        noise_m2: variance per axis of errors that do not last.
    """

    time_s: float
    moved_m: Array
    blind_s: float
    stated_s: float = 0.0
    lasting_m: float = 0.0
    noise_m2: float = 0.0


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
        points: number of points that agreed.
    """

    interval_s: float
    moved_m: Array
    noise_m2: Array
    lasting_share: float
    drift: float
    points: int

    @property
    def velocity_mps(self) -> Array:
        """(2,) east and north, the mean between the two pictures."""
        return self.moved_m / self.interval_s

    @property
    def velocity_covariance_m2ps2(self) -> Array:
        """(2, 2) covariance of that velocity, including the lasting error."""
        lasting_m2 = self.lasting_share**2 * float(self.moved_m @ self.moved_m)
        return np.asarray((self.noise_m2 + lasting_m2 * np.eye(2)) / self.interval_s**2)

    def added_to(self, last: OdometrySample) -> OdometrySample:
        """The sample at the later picture, given that of the earlier."""
        return OdometrySample(
            last.time_s + self.interval_s,
            last.moved_m + self.moved_m,
            last.blind_s,
            last.stated_s + self.interval_s,
            last.lasting_m + self.lasting_share * float(np.hypot(*self.moved_m)),
            last.noise_m2 + self.drift * float(np.linalg.eigvalsh(self.noise_m2)[-1]),
        )


@dataclass(frozen=True, slots=True)
class VelocityEstimate:
    """A velocity (2,) east and north, and its standard deviation per axis."""

    mps: Array
    sigma_mps: float


class DeadReckoning:
    """Integrates the frames' velocities over time.

    Args:
        late_s: how much older than the newest frame a frame may be.
        default_interval_s: time between frames without a timestamp.
    """

    def __init__(self, late_s: float, default_interval_s: float) -> None:
        self._late_s, self._default_interval_s = late_s, default_interval_s
        self._samples: deque[OdometrySample] = deque()  # of the last late_s
        self._stamps: deque[int] = deque()  # of the same
        self._newest_ns: int | None = None
        self._measured: Array | None = None  # velocity of the newest frame, if it had one

    @property
    def last(self) -> OdometrySample | None:
        """The sample of the newest frame, or None before the first."""
        return self._samples[-1] if self._samples else None

    def is_late(self, frame: Frame) -> bool:
        """Whether a frame is older than the newest one.

        Raises:
            TelemetryError: it came before, or is older than ``late_s``.
        """
        stamp, newest = frame.timestamp_ns, self._newest_ns
        if stamp is None or newest is None or stamp > newest:
            return False
        if stamp in self._stamps:
            raise TelemetryError(f"timestamp_ns: expected a frame that did not come before, got {stamp} again")
        min_stamp_ns = newest - round(self._late_s * 1e9)
        if stamp < min_stamp_ns:
            raise TelemetryError(
                f"timestamp_ns: expected {min_stamp_ns} or later ({newest} was the newest frame), got {stamp}"
            )
        return True

    def sample(
        self, frame: Frame, velocity: VelocityEstimate | None, seen: GroundMotion | None = None
    ) -> OdometrySample:
        """The sample of a frame; changes no state.

        Args:
            frame: a new one, or a late one.
            velocity: assumed if the frame came without one; None assumes none.
            seen: motion since the newest frame, measured from pictures; replaces an assumed velocity.
        """
        last = self.last
        if last is None:
            return OdometrySample(0.0, np.zeros(2), 0.0)
        interval_s = self._default_interval_s
        if frame.timestamp_ns is not None and self._newest_ns is not None:
            interval_s = (frame.timestamp_ns - self._newest_ns) * 1e-9
        if interval_s < 0.0:
            return self._between(last.time_s + interval_s)
        measured = _velocity_of(frame)
        if measured is not None:
            mean = measured if self._measured is None else 0.5 * (measured + self._measured)
            step_m, sigma_mps = mean * interval_s, frame.velocity_sigma_mps
            stated_s, lasting_m = (0.0, 0.0) if sigma_mps is None else (interval_s, sigma_mps * interval_s)
            return replace(
                last,
                time_s=last.time_s + interval_s,
                moved_m=last.moved_m + step_m,
                stated_s=last.stated_s + stated_s,
                lasting_m=last.lasting_m + lasting_m,
            )
        if seen is not None and math.isclose(seen.interval_s, interval_s, abs_tol=1e-6):
            return seen.added_to(last)  # else a frame in between failed: its way is unknown
        step_m = np.zeros(2) if velocity is None else velocity.mps * interval_s
        return replace(
            last,
            time_s=last.time_s + interval_s,
            moved_m=last.moved_m + step_m,
            blind_s=last.blind_s + interval_s,
        )

    def append(self, frame: Frame, sample: OdometrySample) -> None:
        """Add a frame that was matched."""
        stamp, newest = frame.timestamp_ns, self._newest_ns
        if stamp is not None:
            self._stamps.append(stamp)
            if newest is not None and stamp <= newest:
                return  # late
            self._newest_ns = stamp
            self._stamps = deque(known for known in self._stamps if known >= stamp - self._late_s * 1e9)
        self._measured = _velocity_of(frame)
        self._samples.append(sample)
        while len(self._samples) > 2 and self._samples[1].time_s < sample.time_s - self._late_s:
            self._samples.popleft()

    def _between(self, time_s: float) -> OdometrySample:
        """The sample at a time, interpolated between frames; before the first frame, the first sample."""
        times = [sample.time_s for sample in self._samples]
        rows = np.array([(*s.moved_m, s.blind_s, s.stated_s, s.lasting_m, s.noise_m2) for s in self._samples])
        east, north, *others = (float(np.interp(time_s, times, column)) for column in rows.T)
        return OdometrySample(time_s, np.array([east, north]), *others)


@dataclass(frozen=True, slots=True)
class DriftModel:
    """How the error of dead reckoning grows.

    Attributes:
        measured_sigma_mps: of a measured velocity. Such errors last: they grow with time, not its square root.
        acceleration_mps2: the vehicle's acceleration while its velocity is not measured; its direction changes
            every second.
        max_speed_mps: speed assumed if it is unknown.
    """

    measured_sigma_mps: float
    acceleration_mps2: float
    max_speed_mps: float

    def sigma_m(
        self, start: OdometrySample, end: OdometrySample, velocity: VelocityEstimate | None = None
    ) -> float:
        """Standard deviation, per axis, of the displacement between two samples.

        Args:
            start: either of the two.
            end: the other.
            velocity: assumed if none was measured; None if none was assumed.
        """
        blind_s = abs(end.blind_s - start.blind_s)
        measured_s = max(0.0, abs(end.time_s - start.time_s) - blind_s - abs(end.stated_s - start.stated_s))
        lasting_m = self.measured_sigma_mps * measured_s + abs(end.lasting_m - start.lasting_m)
        blind_m = 0.5 * self.max_speed_mps * blind_s
        if velocity is not None:
            changed_m = self.acceleration_mps2 * math.sqrt(blind_s**3 / 3.0)  # a random walk of the velocity
            blind_m = min(velocity.sigma_mps * blind_s + changed_m, 2.0 * blind_m)
        return math.hypot(lasting_m + blind_m, math.sqrt(abs(end.noise_m2 - start.noise_m2)))

    def velocity(self, apart_m: Array, sigma_m: float, interval_s: float) -> VelocityEstimate | None:
        """The velocity at the later of two fixes; None if they are so far apart that it predicts nothing.

        Args:
            apart_m: (2,) from the earlier to the later.
            sigma_m: standard deviation of that difference, per axis.
            interval_s: between them.

        Returns:
            VelocityEstimate | None: (2,) m/s to the east and north, and its standard deviation.
        """
        changed_mps = self.acceleration_mps2 * math.sqrt(interval_s / 3.0)
        if 2.0 * changed_mps >= 0.5 * self.max_speed_mps:  # it changes as much again in the next interval
            return None
        return VelocityEstimate(apart_m / interval_s, sigma_m / interval_s + changed_mps)


@dataclass(frozen=True, slots=True)
class PositionEstimate:
    """A position from another source than the match it is compared with.

    Attributes:
        en_m: (2,) east and north.
        sigma_m: one standard deviation of each.
        log_odds: log(p / (1 - p)), with p the probability that it is right to within its standard deviation.
        on_map: whether it came from the same map and so shares its georeferencing error.
    """

    en_m: Array
    sigma_m: float
    log_odds: float = 0.0
    on_map: bool = False

    def difference_covariance_m2(self, fix: Fix) -> Array:
        """Covariance of the difference to a fix; the map's error cancels between two fixes on it.

        Args:
            fix: on the map.

        Returns:
            (2, 2) square metres, east and north.
        """
        covariance = fix.relative_covariance_m2 if self.on_map else fix.covariance_m2[:2, :2]
        return np.asarray(covariance + self.sigma_m**2 * np.eye(2))

    def chi_square(self, fix: Fix) -> float:
        """Squared Mahalanobis distance to a fix by both covariances: two degrees of freedom."""
        return chi_square(en_m(fix) - self.en_m, self.difference_covariance_m2(fix))

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
            map_sigma_m: error of the map between this position and a place on it.

        Returns:
            Prior: in metres east and north of the map's origin.
        """
        east, north = (float(v) for v in self.en_m)
        moved_east, moved_north = (0.0, 0.0) if moved_m is None else (float(v) for v in moved_m)
        sigma_m = min(math.hypot(self.sigma_m * widened, map_sigma_m), MAX_SIGMA_M)
        return Prior(
            east_m=east, north_m=north, sigma_m=sigma_m, moved_east_m=moved_east, moved_north_m=moved_north
        )


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
    finite = bool(np.isfinite(fix.covariance_m2).all() and np.isfinite(en_m(fix)).all())
    if not finite or not np.linalg.eigvalsh(fix.covariance_m2)[0] > 0.0:
        return False
    return bool(np.linalg.eigvalsh(fix.relative_covariance_m2)[0] > 0.0)


def _velocity_of(frame: Frame) -> Array | None:
    if frame.east_velocity_mps is None or frame.north_velocity_mps is None:
        return None
    return np.array([frame.east_velocity_mps, frame.north_velocity_mps])
