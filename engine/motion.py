"""Dead reckoning: the displacement between fixes by odometry, and its uncertainty."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError
from engine.geo import chi_square
from engine.values import MAX_SIGMA_M, Fix, Frame, Prior

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OdometrySample:
    """Time and displacement at one frame.

    Attributes:
        time_s: since the first frame.
        moved_m: (2,) displacement east and north since then.
        blind_s: the part of that time without a measured velocity.
    """

    time_s: float
    moved_m: Array
    blind_s: float


@dataclass(frozen=True, slots=True)
class VelocityEstimate:
    """A velocity (2,) east and north, and one standard deviation of each of the two."""

    mps: Array
    sigma_mps: float


class DeadReckoning:
    """Integrates the frames' velocities over their stamps.

    Args:
        late_s: how much older than the newest frame a frame may be.
        default_interval_s: time between frames that carry no stamp.
    """

    def __init__(self, late_s: float, default_interval_s: float) -> None:
        self._late_s, self._default_interval_s = late_s, default_interval_s
        self._samples: deque[OdometrySample] = deque()  # of the last late_s
        self._stamps: deque[int] = deque()  # of the same
        self._newest_ns: int | None = None
        self._measured: Array | None = None  # velocity of the newest frame, where it had one

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

    def sample(self, frame: Frame, velocity: VelocityEstimate | None) -> OdometrySample:
        """The sample of a frame; nothing is changed by it.

        Args:
            frame: a new one, or a late one.
            velocity: assumed where the frame came without one; None assumes none.
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
            return OdometrySample(last.time_s + interval_s, last.moved_m + mean * interval_s, last.blind_s)
        step = np.zeros(2) if velocity is None else velocity.mps * interval_s
        return OdometrySample(last.time_s + interval_s, last.moved_m + step, last.blind_s + interval_s)

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
        """The sample at a time between two frames; of an earlier time the first of all."""
        times = [sample.time_s for sample in self._samples]
        rows = np.array([(*sample.moved_m, sample.blind_s) for sample in self._samples])
        east, north, blind = (float(np.interp(time_s, times, column)) for column in rows.T)
        return OdometrySample(time_s, np.array([east, north]), blind)


@dataclass(frozen=True, slots=True)
class DriftModel:
    """How the error of dead reckoning grows.

    Attributes:
        measured_sigma_mps: of a measured velocity. Such errors last: they add up with time, not with its root.
        acceleration_mps2: how hard the vehicle accelerates, for a second at a time and then some other way, while
            its velocity is not measured.
        max_speed_mps: where nothing is known of it.
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
            velocity: assumed where none was measured; None where none was assumed.
        """
        blind_s = abs(end.blind_s - start.blind_s)
        measured_s = max(0.0, abs(end.time_s - start.time_s) - blind_s)
        blind_m = 0.5 * self.max_speed_mps * blind_s
        if velocity is not None:
            changed_m = self.acceleration_mps2 * math.sqrt(blind_s**3 / 3.0)  # a random walk of the velocity
            blind_m = min(velocity.sigma_mps * blind_s + changed_m, 2.0 * blind_m)
        return self.measured_sigma_mps * measured_s + blind_m

    def velocity(self, apart_m: Array, sigma_m: float, interval_s: float) -> VelocityEstimate | None:
        """The velocity at the later of two fixes; None where they are so far apart that it predicts nothing.

        Args:
            apart_m: (2,) from one to the other.
            sigma_m: of that, per axis.
            interval_s: between them.

        Returns:
            VelocityEstimate | None: (2,) m/s to the east and north, and its standard deviation.
        """
        changed_mps = self.acceleration_mps2 * math.sqrt(interval_s / 3.0)
        if 2.0 * changed_mps >= 0.5 * self.max_speed_mps:  # over as long an interval it changes as much again
            return None
        return VelocityEstimate(apart_m / interval_s, sigma_m / interval_s + changed_mps)


@dataclass(frozen=True, slots=True)
class PositionEstimate:
    """A position by other means than the match that it is compared with.

    Attributes:
        en_m: (2,) east and north.
        sigma_m: one standard deviation of each.
        log_odds: log(p / (1 - p)) of the probability that it holds within its standard deviation.
        on_map: it came from the same map, and shares the error of its georeference.
    """

    en_m: Array
    sigma_m: float
    log_odds: float = 0.0
    on_map: bool = False

    def difference_covariance_m2(self, fix: Fix) -> Array:
        """Covariance of the difference to a fix; an error of the map cancels between two fixes on it.

        Args:
            fix: on the map.

        Returns:
            (2, 2) square metres, east and north.
        """
        covariance = fix.relative_covariance_m2 if self.on_map else fix.covariance_m2[:2, :2]
        return np.asarray(covariance + self.sigma_m**2 * np.eye(2))

    def chi_square(self, fix: Fix) -> float:
        """Squared distance of a fix in units of both covariances: two degrees of freedom."""
        return chi_square(en_m(fix) - self.en_m, self.difference_covariance_m2(fix))

    def prior(self, widened: float = 1.0, moved_m: Array | None = None, map_sigma_m: float = 0.0) -> Prior:
        """The same as a prior.

        Args:
            widened: factor on the standard deviation, which is bounded by :data:`engine.values.MAX_SIGMA_M`.
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
