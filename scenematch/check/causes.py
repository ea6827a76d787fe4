"""Causes: find the single change in telemetry or calibration that makes them agree with the pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from engine.camera import MOUNTS, mount_rotation
from engine.geo import Array, enu_from_body, wrap_difference_deg
from scenematch.check.contradictions import ALARM, SIGMA_DEG, attitude_deg, contradictions, height_sigma_m
from scenematch.check.findings import GAIN, MIN_SEEN, MISFIT, OUTLIER, Finding, TelemetrySeries, capped_cost
from scenematch.check.ground_motion import optical_centre, velocity
from scenematch.check.sightings import Sighting

_GAIN_SHARE = 0.5  # a change of the attitude must reduce the cost by the lesser of this share and of GAIN
_PENALTY = {"discrete": 0.15, "offset": 0.25, "shift": 0.3, "rotation": 0.5}
_ANGLES = ("roll", "pitch", "heading")
# An offset below both, as a share of the height and in sigmas, is named only if single pictures contradict it.
_MIN_HEIGHT_SHARE, _MIN_HEIGHT_SIGMAS = 0.04, 5.0
_SHIFTS_S = np.concatenate([np.arange(-3.0, -0.07, 0.05), np.arange(0.1, 3.01, 0.05)])
_FEET = 0.3048
IN_CALIBRATION = " in the calibration"
"""Ends a cure that is a line in a file; not every flight has one."""


def findings(series: TelemetrySeries, seen: Sequence[Sighting], map_sigma_m: float) -> list[Finding]:
    """Find what does not agree; tests the telemetry's attitude, height and velocity, and then the map.

    Args:
        series: of the whole flight.
        seen: poses of some of its pictures.
        map_sigma_m: georeferencing accuracy of the map.
    """
    if len(seen) < MIN_SEEN:
        return []
    attitude = _attitude(series, seen)
    # A late clock also shifts places forwards.
    is_late = attitude is not None and attitude.cause == "clock"
    turning = None if is_late else optical_centre(series, seen)
    tries = (
        attitude, _height(series, seen), turning or velocity(series, seen),
        _place(series, seen, map_sigma_m),
    )  # fmt: skip
    return [found for found in tries if found is not None]


def is_known(series: TelemetrySeries, seen: Sequence[Sighting]) -> tuple[str, ...]:
    """The telemetry known at enough sightings to be compared."""
    index = [s.index for s in seen]
    tilt_is_known = np.isfinite(series.angles_deg[index, :2]).any()
    angles = {"attitude": series.angles_deg} if tilt_is_known else {"heading": series.angles_deg[:, 2:]}
    columns = {**angles, "height": series.height_m[:, None], "velocity": series.velocity_mps,
               "map": series.reference_m}  # fmt: skip
    return tuple(
        name for name, values in columns.items() if np.isfinite(values[index]).all(axis=1).sum() >= MIN_SEEN
    )


# ------------------------------------------------------------------------------------------------ attitude


def _cost(measured_deg: Array, stated_deg: Array) -> float:
    """Mean chi-square of a component, with each value capped."""
    off = wrap_difference_deg(measured_deg - stated_deg) / SIGMA_DEG
    known = np.isfinite(off)
    return capped_cost(off[known]) if known.any() else 0.0


def _signed(angles: Array) -> Array:
    """Angles with the heading as it was before it was wrapped into [0, 360) as if in degrees."""
    heading = np.where(angles[:, 2] > 2.0 * math.pi + 1e-3, angles[:, 2] - 360.0, angles[:, 2])
    return np.column_stack([angles[:, :2], heading])


_DISCRETE: tuple[tuple[str, str, str, Callable[[Array], Array]], ...] = (
    ("radians", "roll, pitch and heading are in radians", "--correct angles=radians",
     lambda a: np.degrees(_signed(a))),
    ("radians", "the heading is in radians", '--correct "heading_deg=57.29578*heading_deg"',
     lambda a: _signed(a) * [1.0, 1.0, 180.0 / math.pi]),
    ("radians", "roll and pitch are in radians",
     '--correct "roll_deg=57.29578*roll_deg" --correct "pitch_deg=57.29578*pitch_deg"',
     lambda a: a * [180.0 / math.pi, 180.0 / math.pi, 1.0]),
    ("degrees", "the angles were multiplied by 57.3, as if they had been in radians",
     "look at the conversion of the telemetry", np.radians),
    ("swapped", "roll and pitch are swapped",
     "--correct roll_deg=pitch_deg --correct pitch_deg=roll_deg",
     lambda a: a[:, [1, 0, 2]]),
    ("sign", "roll and pitch have the other sign", "--correct roll_deg=-roll_deg --correct pitch_deg=-pitch_deg",
     lambda a: a * [-1.0, -1.0, 1.0]),
    ("sign", "roll has the other sign: positive is right side down", "--correct roll_deg=-roll_deg",
     lambda a: a * [-1.0, 1.0, 1.0]),
    ("sign", "pitch has the other sign: positive is nose up", "--correct pitch_deg=-pitch_deg",
     lambda a: a * [1.0, -1.0, 1.0]),
    ("heading_convention", "the heading is counted counter-clockwise from north",
     "--correct heading_deg=-heading_deg",
     lambda a: a * [1.0, 1.0, -1.0]),
    ("heading_convention", "the heading is counted counter-clockwise from east, as ROS' yaw is",
     "--correct heading_deg=-heading_deg+90", lambda a: a * [1.0, 1.0, -1.0] + [0.0, 0.0, 90.0]),
)  # fmt: skip


def _attitude(series: TelemetrySeries, seen: Sequence[Sighting]) -> Finding | None:
    index = np.array([s.index for s in seen])
    measured = np.array([attitude_deg(s) for s in seen])
    angles = series.angles_deg[index]
    if np.isfinite(angles).sum() < 2 * MIN_SEEN:
        return None
    as_stated = _cost(measured, angles)
    contradicted = _contradicted(series, seen, _ANGLES)
    if as_stated < MISFIT and not contradicted:
        return None
    tried: list[tuple[float, Finding]] = [
        (_cost(measured, change(angles)) + _PENALTY["discrete"], Finding(cause, text, cure))
        for cause, text, cure, change in _DISCRETE
    ]
    tried.append(_turned_heading(measured, angles))
    others = (_turned_mount(measured, angles, series.mount), _late(measured, series, index))
    tried += [other for other in others if other is not None]
    cost, finding = min(tried, key=lambda row: row[0])
    if cost < as_stated - min(GAIN, _GAIN_SHARE * as_stated):
        return finding
    suspected = _listed(contradicted or _ANGLES)
    text = f"{suspected} of the telemetry and of the pictures differ, and no single change would make them agree"
    return Finding("attitude", text, f"look at {suspected}: the unit, the sign, the clock")


def _contradicted(series: TelemetrySeries, seen: Sequence[Sighting], fields: Sequence[str]) -> list[str]:
    """The fields that too many pictures contradict."""
    return [one.field for one in contradictions(series, seen) if one.field in fields and one.pictures >= ALARM]


def _listed(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _turned_heading(measured: Array, angles: Array) -> tuple[float, Finding]:
    off_deg, sigma_deg = _median_angle(measured[:, 2] - angles[:, 2])
    cost = _cost(measured, angles + np.array([0.0, 0.0, off_deg])) + _PENALTY["offset"]
    text = f"the heading reads {abs(off_deg):.1f} degrees too {'low' if off_deg > 0 else 'high'}"
    if abs(off_deg) < 30.0:
        text += " (a magnetic heading, or a compass that is not calibrated)"
    return cost, Finding("heading", text, f"--correct heading_offset_deg={off_deg:+.1f}", off_deg, sigma_deg)


def _turned_mount(measured: Array, angles: Array, mount: Array) -> tuple[float, Finding] | None:
    """One rotation between the telemetry's body and the pictures': the camera is mounted differently."""
    known = np.isfinite(angles).all(axis=1)
    if known.sum() < MIN_SEEN:
        return None
    bodies = [enu_from_body(*row) for row in angles[known]]
    shown = [enu_from_body(*row) for row in measured[known]]
    turns = [b.T @ s for b, s in zip(bodies, shown, strict=True)]  # shown = telemetry's @ turn
    median = _middle_rotation(turns)
    leftover = [_rotation_deg(median.T @ turn) for turn in turns]
    chi = np.minimum((np.array(leftover) / 1.5) ** 2 / 2.0, OUTLIER)
    about_down_deg = math.degrees(math.atan2(median[1, 0], median[0, 0]))
    tilt_deg = math.degrees(math.acos(max(-1.0, min(1.0, float(median[2, 2])))))
    quarter = round(about_down_deg / 90.0) * 90
    sigma_deg = float(np.median(leftover)) / math.sqrt(len(leftover))
    if quarter and abs(about_down_deg - quarter) < 6.0 and tilt_deg < 6.0:
        turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        hung = np.linalg.matrix_power(turned, quarter // 90 % 4) @ mount
        names = [name for name in MOUNTS if np.allclose(mount_rotation(name), hung, atol=1e-6)]
        text = f"the camera is turned by {quarter % 360} degrees from its mount"
        cure = f"--mount {names[0]}" if names else _mount_line(hung)
        return float(chi.mean()) + _PENALTY["discrete"], Finding("mount", text, cure, float(quarter), sigma_deg)
    if tilt_deg < 1.0:  # only about the vertical: reported as a heading
        return None
    axis = (mount @ np.array([0.0, 0.0, 1.0]), median @ mount @ np.array([0.0, 0.0, 1.0]))
    forward_deg = math.degrees(math.atan2(axis[1][0], axis[1][2]) - math.atan2(axis[0][0], axis[0][2]))
    text = (
        f"the camera is tilted {tilt_deg:.1f} degrees from its mount ({forward_deg:+.1f} towards the nose), "
        "or roll and pitch are off by that, or the principal point"
    )
    cure = _mount_line(median @ mount)
    return float(chi.mean()) + _PENALTY["rotation"], Finding("mount", text, cure, tilt_deg, sigma_deg)


def _mount_line(mount: Array) -> str:
    return f"mount: [{', '.join(f'{v:.5f}' for v in mount.ravel())}]{IN_CALIBRATION}"


def _late(measured: Array, series: TelemetrySeries, index: NDArray[np.intp]) -> tuple[float, Finding] | None:
    known = np.isfinite(series.angles_deg).all(axis=1) & np.isfinite(series.time_s)
    if known.sum() < 2 * MIN_SEEN or not np.all(np.diff(series.time_s[known]) > 0.0):
        return None
    time_s, angles = series.time_s[known], series.angles_deg[known].copy()
    angles[:, 2] = np.degrees(np.unwrap(np.radians(angles[:, 2])))

    def cost_of(shift_s: float) -> float:
        at = series.time_s[index] + shift_s
        shifted = np.stack([np.interp(at, time_s, column) for column in angles.T], axis=1)
        return _cost(measured, shifted)

    costs = [cost_of(float(shift_s)) for shift_s in _SHIFTS_S]
    best = int(np.argmin(costs))
    shift_s = float(_SHIFTS_S[best])
    late = "late" if shift_s > 0.0 else "early"
    text = f"the telemetry is {abs(shift_s):.2f} s {late} against the pictures"
    cure = f"--correct offset_s={-shift_s:+.2f}"
    return costs[best] + _PENALTY["shift"], Finding("clock", text, cure, shift_s, 0.05)


def _median_angle(angles_deg: Array) -> tuple[float, float]:
    """Median of angles about their mean direction, and its standard deviation."""
    known = np.radians(angles_deg[np.isfinite(angles_deg)])
    if not known.size:
        return 0.0, math.inf
    middle = math.atan2(np.sin(known).sum(), np.cos(known).sum())
    off = wrap_difference_deg(np.degrees(known - middle))
    return wrap_difference_deg(math.degrees(middle) + float(np.median(off))), _sigma_of_median(off, 0.3)


def _sigma_of_median(values: Array, min_spread: float) -> float:
    """Standard deviation of the values' median, by their spread about it."""
    spread = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    return max(spread, min_spread) * 1.25 / math.sqrt(values.size)


def _middle_rotation(turns: Sequence[Array]) -> Array:
    """Robust mean of rotations: the mean of those nearest to the one that is nearest to all."""
    apart = np.array([[_rotation_deg(a.T @ b) for b in turns] for a in turns])
    near = np.argsort(apart[int(np.argmin(np.median(apart, axis=1)))])[: max(MIN_SEEN, (3 * len(turns)) // 4)]
    u, _, vt = np.linalg.svd(np.mean([turns[k] for k in near], axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt, np.float64)


def _rotation_deg(rotation: Array) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, (float(np.trace(rotation)) - 1.0) / 2.0))))


# -------------------------------------------------------------------------------------------------- height


def _height(series: TelemetrySeries, seen: Sequence[Sighting]) -> Finding | None:
    height = series.height_m[[s.index for s in seen]]
    measured = np.array([s.height_agl_m for s in seen])
    known = np.isfinite(height)
    if known.sum() < MIN_SEEN:
        return None
    height, measured = height[known], measured[known]
    sigma = height_sigma_m(measured)

    def cost(expected: Array) -> float:
        return capped_cost((measured - expected) / sigma)

    off_m, factor = float(np.median(measured - height)), float(np.median(measured / height))
    by_offset, by_factor = cost(height + off_m), cost(height * factor)
    sigma_m = _sigma_of_median(measured - height, 0.5)
    is_small = abs(off_m) < min(_MIN_HEIGHT_SHARE * float(np.median(measured)), _MIN_HEIGHT_SIGMAS * sigma_m)
    if cost(height) < MISFIT or (is_small and not _contradicted(series, seen, ("height",))):
        return None
    if min(by_offset, by_factor) > cost(height) - GAIN:
        text = "the height does not agree with the pictures, and no offset or factor would make it"
        return Finding("height", text, "look at the telemetry's height")
    if abs(factor / _FEET - 1.0) < 0.04:
        text = "the height is in feet"
        return Finding("height_feet", text, '--correct "height_agl_m=0.3048*height_agl_m"', factor)
    side = "low" if off_m > 0.0 else "high"
    if by_factor < by_offset - 0.3:
        text = f"multiply heights by {factor:.3f}, or divide the focal length by it"
        return Finding("focal", text, f'--correct "height_agl_m={factor:.3f}*height_agl_m"', factor, 0.01)
    text = (
        f"the height reads {abs(off_m):.1f} m too {side} (above sea level, above another ground?), "
        f"or the focal length {abs(100.0 * (factor - 1.0)):.0f} % too {'short' if off_m < 0.0 else 'long'}"
    )
    return Finding("height", text, f"--correct height_offset_m={off_m:+.1f}", off_m, sigma_m)


# ---------------------------------------------------------------------------------------------- position


def _place(series: TelemetrySeries, seen: Sequence[Sighting], map_sigma_m: float) -> Finding | None:
    index = np.array([s.index for s in seen])
    reference_m = series.reference_m[index]
    off = np.array([s.en_m for s in seen]) - reference_m
    known = np.isfinite(off).all(axis=1)
    if known.sum() < MIN_SEEN:
        return None
    middle = np.median(off[known], axis=0)
    if not np.isfinite(series.angles_deg[index, :2]).any():
        # A source unaware of tilt may give the positions of what the picture's centre shows.
        shown = np.array([_shown_m(s, series.mount) for s in seen]) - reference_m
        middle = min(middle, np.median(shown[known], axis=0), key=np.linalg.norm)
    sigma_m = math.hypot(float(np.median(series.reference_sigma_m[index][known])), map_sigma_m)
    if float(np.hypot(*middle)) < 3.0 * sigma_m:
        return None
    text = (
        f"the map shows places {np.hypot(*middle):.1f} m ({middle[0]:+.1f} east, {middle[1]:+.1f} north) "
        "from the other positions"
    )
    return Finding("map", text, "look at the map's georeference, or at the datum of the positions",
                   float(np.hypot(*middle)), sigma_m)  # fmt: skip


def _shown_m(seen: Sighting, mount: Array) -> Array:
    """(2,) east and north of what the picture's centre shows, on level ground."""
    axis = enu_from_body(*attitude_deg(seen)) @ mount[:, 2]
    return seen.en_m + axis[:2] / max(-float(axis[2]), 0.1) * seen.height_agl_m
