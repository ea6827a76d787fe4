"""Checks that flag bad ground truth: jumps, frozen or coarse places, heights in another datum, mirrored headings.

A finding is no proof. It says what an honest flight would hardly show, with the figure that it was seen by.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.formats.telemetry import TelemetryRow
from engine.formats.truth import interpolate_truth
from engine.geo import LocalFrame
from engine.maps.grids import wgs84
from engine.maps.rasters import Source
from engine.values import Truth

Array = NDArray[np.float64]

COARSE_M = 0.5
"""Places that lie on a grid wider than this were rounded."""
_FROZEN_SHARE = 0.02  # of neighbours at the very same place while others move
_HEIGHT_M, _HEIGHT_SHARE = 15.0, 0.15  # by how much heights may disagree before it is told
_OWN_ZERO_M = 30.0
_GEOID_M = 110.0  # the geoid is nowhere further from the ellipsoid
_LOW_M, _HIGH_M = 5.0, 5000.0
_UNSTEADY = 0.3  # tenth to ninetieth percentile as a share of the median
_STEADY = 0.8  # length of the mean of unit vectors: 1 is one direction, 0 none
_ASIDE_DEG = 30.0
_MOVES_M = 2.0


@dataclass(frozen=True, slots=True)
class Finding:
    """Something about a flight that makes its truth doubtful.

    Attributes:
        kind: a word for programs: "jump", "outside", "frozen", "coarse", "unknown", "datum", "height", "heading".
        text: the same for people, with the figure and the first place where it is seen.
    """

    kind: str
    text: str


def check_truth(
    truth: Sequence[Truth],
    rows: Sequence[TelemetryRow],
    *,
    site: Source | None = None,
    surface: Source | None = None,
    max_speed_mps: float = 70.0,
) -> list[Finding]:
    """Look at a flight's truth and telemetry for what an honest flight would hardly show.

    Args:
        truth: in the order of time, at least one row.
        rows: the telemetry; empty where there is none.
        site: the map; None does not ask whether the flight is on it.
        surface: the surface model. Its heights are taken to be above the mean sea level, unless they are about 0,
            which is a zero of its own.
        max_speed_mps: that the vehicle can fly over ground.
    """
    frame = LocalFrame(truth[0].lat_deg, truth[0].lon_deg)
    lat, lon = (np.array([getattr(t, name) for t in truth]) for name in ("lat_deg", "lon_deg"))
    en_m = frame.enu_from_geodetic(lat, lon)
    stamps_s = np.array([t.timestamp_ns for t in truth], dtype=np.float64) * 1e-9
    told = {row.timestamp_ns: row for row in rows}
    heights = _heights(truth, told)
    found = _jumps(en_m, stamps_s, max_speed_mps) + _frozen(en_m) + _coarse(lat, lon, frame)
    found += _outside(lat, lon, site) + _unknown(truth, rows)
    if surface is not None:
        found += _against_ground(heights, _surface_heights(surface, np.column_stack([lon, lat])))
    return found + _height(heights, surface is not None) + _heading(_headings(truth, told), en_m)


def _heights(truth: Sequence[Truth], told: Mapping[int, TelemetryRow]) -> Array:
    """Above the ground, as the telemetry has it where it does, and above the sea (N, 2); NaN where unknown."""

    def pair(t: Truth) -> tuple[float | None, float | None]:
        row = told.get(t.timestamp_ns)
        above_m = t.height_agl_m if row is None or row.height_agl_m is None else row.height_agl_m
        return above_m, row.alt_amsl_m if row is not None and t.alt_amsl_m is None else t.alt_amsl_m

    return np.array([[np.nan if v is None else v for v in pair(t)] for t in truth], dtype=np.float64)


def _headings(truth: Sequence[Truth], told: Mapping[int, TelemetryRow]) -> Array:
    """In degrees (N,), as the telemetry has them where it does; NaN where unknown."""

    def one(t: Truth) -> float | None:
        row = told.get(t.timestamp_ns)
        return t.heading_deg if row is None or row.heading_deg is None else row.heading_deg

    return np.array([np.nan if one(t) is None else one(t) for t in truth], dtype=np.float64)


def _jumps(en_m: Array, stamps_s: Array, max_speed_mps: float) -> list[Finding]:
    speeds = np.hypot(*np.diff(en_m, axis=0).T) / np.diff(stamps_s)
    fast = np.flatnonzero(speeds > max_speed_mps)
    if not fast.size:
        return []
    first = int(fast[0])
    return [
        Finding(
            "jump",
            f"{fast.size} of {len(speeds)} steps are faster than {max_speed_mps:g} m/s, up to {speeds.max():.0f}; "
            f"the first is after row {first + 1}",
        )
    ]


def _frozen(en_m: Array) -> list[Finding]:
    steps_m = np.hypot(*np.diff(en_m, axis=0).T)
    still = steps_m == 0.0
    share = float(still.mean()) if still.size else 0.0
    if share <= _FROZEN_SHARE or share == 1.0 or np.median(steps_m[~still]) < _MOVES_M:
        return []
    first = int(np.flatnonzero(still)[0])
    return [
        Finding(
            "frozen",
            f"{still.sum()} of {len(still)} places are the very place before, where the others move by "
            f"{np.median(steps_m[~still]):.0f} m; the first is row {first + 2}",
        )
    ]


def _coarse(lat: Array, lon: Array, frame: LocalFrame) -> list[Finding]:
    """The coarsest power of ten on which all values lie."""
    for decimals in range(1, 8):
        if max(np.abs(values - np.round(values, decimals)).max() for values in (lat, lon)) < 1e-10:
            step_m = float(frame.enu_from_geodetic(frame.lat_deg + 10.0**-decimals, frame.lon_deg)[1])
            if step_m > COARSE_M and len(lat) > 1:
                return [Finding("coarse", f"places have {decimals} decimals of a degree, steps of {step_m:.1f} m")]
            return []
    return []


def _outside(lat: Array, lon: Array, site: Source | None) -> list[Finding]:
    if site is None:
        return []
    xy = site.grid.pixels_of(wgs84())[1](np.column_stack([lon, lat]))
    size = (site.grid.width_px, site.grid.height_px)
    inside = ((xy >= -0.5) & (xy <= np.array(size) - 0.5)).all(axis=1)
    if inside.all():
        return []
    first = int(np.flatnonzero(~inside)[0])
    return [
        Finding("outside", f"{(~inside).sum()} of {len(lat)} places are off the map; the first is row {first + 1}")
    ]


def _unknown(truth: Sequence[Truth], rows: Sequence[TelemetryRow]) -> list[Finding]:
    blind = [row.frame for row in rows if interpolate_truth(truth, row.timestamp_ns) is None]
    if not blind:
        return []
    return [Finding("unknown", f"{len(blind)} of {len(rows)} frames have no truth; the first is {blind[0]}")]


def _height(heights_m: Array, has_surface: bool) -> list[Finding]:
    """What heights above the ground and above the sea show of each other, and of themselves."""
    above_m = heights_m[np.isfinite(heights_m[:, 0]), 0]
    both_m = heights_m[np.isfinite(heights_m).all(axis=1)]
    found = []
    middle_m = _median(above_m)
    if middle_m is not None and not _LOW_M <= middle_m <= _HIGH_M:
        found.append(Finding("height", f"the height above the ground is {middle_m:.0f} m in the median"))
    if len(both_m) > 1 and np.abs(both_m[:, 0] - both_m[:, 1]).max() < 0.01:
        found.append(Finding("datum", "the heights above the ground and above the sea are the same numbers"))
    if middle_m and not has_surface:
        low, high = np.percentile(above_m, [10, 90])
        share = float(high - low) / abs(middle_m)
        if share > _UNSTEADY:
            text = f"the height above the ground varies by {share:.0%} of its median: it may be one above the sea"
            found.append(Finding("datum", f"{text}, over hills; a surface model would tell"))
    return found


def _against_ground(heights_m: Array, ground_m: Array) -> list[Finding]:
    """What each height would be if it were what it says, by the surface below."""
    above_m, sea_m = heights_m.T
    clear_m, off_m = _median(sea_m - ground_m), _median(above_m - (sea_m - ground_m))
    found = []
    if clear_m is not None and clear_m < _LOW_M:
        text = f"the height above the sea is {clear_m:.0f} m above the surface model in the median"
        found.append(Finding("datum", text))
    if off_m is None or clear_m is None or abs(off_m) <= max(_HEIGHT_M, _HEIGHT_SHARE * abs(clear_m)):
        return found
    level_m = _median(ground_m)
    if level_m is not None and abs(level_m) < _OWN_ZERO_M:
        return found  # a surface model that counts from a zero of its own
    why = "of no datum that is known here"
    if level_m is not None and abs(off_m - level_m) < _HEIGHT_M:
        why = f"the level of the ground ({level_m:.0f} m): it is one above the sea"
    elif abs(off_m) < _GEOID_M:
        why = "which the geoid could explain: one of the two may be above the ellipsoid"
    text = f"the height above the ground is {off_m:+.0f} m off the one above the sea less the surface model, {why}"
    return [*found, Finding("datum", text)]


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _surface_heights(surface: Source, lon_lat: Array) -> Array:
    """Heights (N,) of the surface model at places; NaN off it."""
    xy = surface.grid.pixels_of(wgs84())[1](lon_lat)
    size = (surface.grid.width_px, surface.grid.height_px)
    out = np.full(len(xy), np.nan)
    dataset: Any = surface.dataset
    for k, (x, y) in enumerate(np.round(xy).astype(int)):
        if 0 <= x < size[0] and 0 <= y < size[1]:
            value = float(dataset.read(1, window=((y, y + 1), (x, x + 1)), masked=True).filled(np.nan)[0, 0])
            out[k] = value if -1000.0 < value < 20000.0 else np.nan
    return out


def _heading(headings_deg: Array, en_m: Array) -> list[Finding]:
    """The heading against the course over ground, where the vehicle moves."""
    lacking = int(np.isnan(headings_deg).sum())
    found = []
    if lacking:
        text = f"{lacking} of {len(headings_deg)} rows have no heading, which ncc cannot do without"
        found.append(Finding("heading", text))
    steps_m = np.diff(en_m, axis=0)
    known = np.isfinite(headings_deg[:-1]) & (np.hypot(*steps_m.T) > _MOVES_M)
    if known.sum() < 3:
        return found
    heading, course = np.radians(headings_deg[:-1][known]), np.arctan2(*steps_m[known].T)
    ahead, mirrored, turns = (np.exp(1j * a).mean() for a in (heading - course, -heading - course, course))
    aside_deg = float(np.degrees(np.angle(ahead)))
    if abs(ahead) >= _STEADY and abs(aside_deg) > _ASIDE_DEG:
        text = f"the heading is {aside_deg:+.0f} degrees off the course over ground, steadily"
        found.append(Finding("heading", f"{text}: reversed, or the aircraft's where the camera's is meant"))
    if abs(ahead) < _STEADY <= abs(mirrored) and abs(turns) < _STEADY:
        found.append(Finding("heading", "the heading turns against the course over ground: it is mirrored"))
    return found
