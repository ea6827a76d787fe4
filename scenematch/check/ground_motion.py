"""Compare ground motion between sightings with the velocity: unit, axes, offsets that turn with the heading."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engine.geo import Array, wrap_difference_deg
from scenematch.check.findings import GAIN, MIN_SEEN, MISFIT, OUTLIER, Finding, TelemetrySeries, capped_cost
from scenematch.check.sightings import Sighting

_VELOCITY_FACTORS = {"km/h": 1 / 3.6, "knots": 0.5144, "feet per second": 0.3048}
# For offsets that turn with the heading: minimum reduction of the cost, its share, and the least offset reported.
_TURNING_GAIN, _TURNING_RATIO, _TURNING_SIGMAS, _TURNING_MIN_DEG = 0.35, 2.5, 4.0, 1.2
_MIN_COST = 0.1
# Legs that show them: the vehicle turns, the telemetry agrees, and the tilt at both ends is usual.
_TURN_DEG, _TURN_OFF_DEG, _TILT_OFF_DEG = 15.0, 10.0, 8.0
_MAX_LEG_S, _MIN_LEG_M = 120.0, 4.0
_VELOCITY_SIGMA_MPS, _LEG_SIGMA_M, _ACCELERATION_MPS2 = 0.7, 2.0, 2.0


@dataclass(frozen=True, slots=True)
class _Leg:
    """The displacement between two sightings.

    Attributes:
        first: its first sighting.
        last: its last sighting.
        moved_m: (2,) east and north by the sightings.
        reckoned_m: (2,) the same by the velocity.
        sigma_m: of their difference, per axis.
    """

    first: Sighting
    last: Sighting
    moved_m: Array
    reckoned_m: Array
    sigma_m: float

    @property
    def off(self) -> Array:
        """(2,) difference in sigmas."""
        return (self.moved_m - self.reckoned_m) / self.sigma_m

    @property
    def turn_deg(self) -> float:
        """Change of heading by the sightings, from -180 up to 180."""
        return wrap_difference_deg(self.last.attitude.heading_deg - self.first.attitude.heading_deg)

    @property
    def turned(self) -> Array:
        """(2, 2) effect of an offset forward and to the right on the difference, in sigmas per metre."""
        return (_heading_rotation(self.last) - _heading_rotation(self.first)) / self.sigma_m


def velocity(series: TelemetrySeries, seen: Sequence[Sighting]) -> Finding | None:
    """Find a wrong unit, axis or sign of a velocity that does not agree with the sightings."""
    legs = _legs(series, seen)
    if len(legs) < MIN_SEEN:
        return None
    moved, reckoned = np.array([leg.moved_m for leg in legs]), np.array([leg.reckoned_m for leg in legs])
    sigma = np.array([[leg.sigma_m] for leg in legs])

    def cost(expected: Array) -> float:
        return capped_cost((moved - expected) / sigma)

    tried = [(cost(reckoned[:, ::-1]), "the velocity's east and north are swapped",
              "--correct east_velocity_mps=north_velocity_mps --correct north_velocity_mps=east_velocity_mps"),
             (cost(-reckoned), "the velocity has the other sign",
              "--correct east_velocity_mps=-east_velocity_mps "
              "--correct north_velocity_mps=-north_velocity_mps")]  # fmt: skip
    tried += [
        (cost(factor * reckoned), f"the velocity is in {unit}",
         " ".join(f'--correct "{n}_velocity_mps={factor:.4g}*{n}_velocity_mps"' for n in ("east", "north")))
        for unit, factor in _VELOCITY_FACTORS.items()
    ]  # fmt: skip
    square = float((reckoned**2).sum())
    factor = float(np.median((moved * reckoned).sum(axis=1) / np.maximum((reckoned**2).sum(axis=1), 1e-9)))
    if square > 0.0 and factor > 0.0:
        text = f"the vehicle moves {factor:.2f} times as far between pictures as velocity and stamps say"
        cure = "look at the frame rate, the stamps and the unit of the velocity"
        tried.append((cost(factor * reckoned) + 0.1, text, cure))
    best, text, cure = min(tried, key=lambda row: row[0])
    if cost(reckoned) < MISFIT:
        return None
    if best > cost(reckoned) - GAIN:
        text = "velocity and timestamps do not fit the motion between pictures, and no single change would help"
        return Finding("velocity", text, "look at the velocity and the stamps")
    return Finding("velocity", text, cure, factor)


def leg_differences(series: TelemetrySeries, seen: Sequence[Sighting]) -> Array:
    """(N,) difference of each displacement from the velocity's, in standard deviations."""
    legs = _legs(series, seen)
    return np.array([np.abs(leg.off).max() for leg in legs] if len(legs) >= MIN_SEEN else [], np.float64)


def _legs(series: TelemetrySeries, seen: Sequence[Sighting]) -> list[_Leg]:
    """The legs between sightings whose velocity is known."""
    return [leg for first, last in pairwise(seen) if (leg := _leg(series, first, last)) is not None]


def _heading_rotation(seen: Sighting) -> Array:
    """(2, 2) from forward and right to east and north."""
    heading = math.radians(seen.attitude.heading_deg)
    sine, cosine = math.sin(heading), math.cos(heading)
    return np.array([[sine, cosine], [cosine, -sine]])


def optical_centre(series: TelemetrySeries, seen: Sequence[Sighting]) -> Finding | None:
    """Find places that are off forwards or to the right: they move whenever the vehicle turns."""
    tilts_deg = np.array([(one.attitude.roll_deg, one.attitude.pitch_deg) for one in seen])
    off_deg = np.abs(tilts_deg - np.median(tilts_deg, axis=0)).max(axis=1)
    usual = [one for one, tilt_off_deg in zip(seen, off_deg, strict=True) if tilt_off_deg < _TILT_OFF_DEG]
    legs = [leg for leg in _legs(series, usual) if _turns_as_stated(series, leg)]
    turning = np.array([abs(leg.turn_deg) > _TURN_DEG for leg in legs], bool)
    if len(legs) < MIN_SEEN or not turning.any():
        return None
    rows, off = np.array([leg.turned for leg in legs]), np.array([leg.off for leg in legs])
    aside_m, information = _common_offset(rows, off, turning)
    as_stated, best = capped_cost(off), capped_cost(off - rows @ aside_m)
    height_m = float(np.median([one.height_agl_m for one in seen]))
    # Most legs are more accurate than assumed.
    sigma_m = math.sqrt(max(best, _MIN_COST) * float(np.trace(np.linalg.inv(information))))
    size_m = float(np.hypot(*aside_m))
    aside_deg = math.degrees(math.atan2(size_m, height_m))
    if as_stated - best < _TURNING_GAIN or best > as_stated / _TURNING_RATIO:
        return None
    if size_m < _TURNING_SIGMAS * sigma_m or aside_deg < _TURNING_MIN_DEG:
        return None
    off_px = series.focal_px / height_m * (series.mount.T @ [*aside_m, 0.0])[:2]
    text = (
        f"places lie {aside_m[0]:+.1f} m forward and {aside_m[1]:+.1f} m right of their true place, whichever way "
        "the vehicle heads: the optical centre is off, or the camera's mount and the attitude alike"
    )
    cure = f"look at the calibration: cx and cy would be {-off_px[0]:+.0f} and {-off_px[1]:+.0f} px other"
    return Finding("mount", text, cure, aside_deg, math.degrees(sigma_m / height_m))


def _turns_as_stated(series: TelemetrySeries, leg: _Leg) -> bool:
    """Whether the telemetry confirms the turn: legs to and from a false sighting would show the same offset."""
    first_deg, last_deg = series.angles_deg[[leg.first.index, leg.last.index], 2].tolist()
    off_deg: float = wrap_difference_deg(leg.turn_deg - (last_deg - first_deg))
    return abs(off_deg) < _TURN_OFF_DEG  # not if it is unknown


def _common_offset(rows: Array, off: Array, turning: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The offset that most legs share, and its information (2, 2).

    A single leg with a turn shows it, and the best is averaged with all legs that agree: until it is known, an
        offset of many sigmas makes every leg an outlier.
    """
    shown = np.linalg.solve(rows[turning], off[turning][..., None])[..., 0]
    offset_m = min(shown, key=lambda one: capped_cost(off - rows @ one))
    agreeing = (np.abs(off - rows @ offset_m) < OUTLIER**0.5).all(axis=1)
    design = rows[agreeing].reshape(-1, 2)
    information = design.T @ design
    return np.linalg.solve(information, design.T @ off[agreeing].ravel()), information


def _leg(series: TelemetrySeries, a: Sighting, b: Sighting) -> _Leg | None:
    between = slice(a.index, b.index + 1)
    time_s, velocity = series.time_s[between], series.velocity_mps[between]
    seconds = float(time_s[-1] - time_s[0])
    if not (np.isfinite(velocity).all() and np.isfinite(time_s).all()) or not seconds > 0.0:
        return None
    reckoned = np.asarray(np.trapezoid(velocity, time_s, axis=0), np.float64)
    moved = b.en_m - a.en_m
    if seconds > _MAX_LEG_S or max(float(np.hypot(*moved)), float(np.hypot(*reckoned))) < _MIN_LEG_M:
        return None
    coarse_m = _ACCELERATION_MPS2 / 12.0 * float((np.diff(time_s) ** 2).sum())  # of the trapezoids
    return _Leg(a, b, moved, reckoned, math.hypot(_LEG_SIGMA_M, _VELOCITY_SIGMA_MPS * seconds, coarse_m))
