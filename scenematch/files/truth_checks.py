"""Checks for bad ground truth: jumps, repeated or coarse positions, heights in another datum, mirrored headings.

A finding is no proof: it states, with a figure, what is implausible in a real flight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.geo import LocalFrame
from engine.maps.grids import wgs84
from engine.maps.rasters import Source
from engine.values import Truth
from scenematch.files.telemetry import TelemetryRow
from scenematch.files.truth import interpolate_truth

Array = NDArray[np.float64]

COARSE_M = 0.5
"""Positions on a grid wider than this count as rounded."""
_MAX_FROZEN_RATIO = 0.02  # of steps of length 0 while others move
_HEIGHT_TOLERANCE_M, _HEIGHT_TOLERANCE_RATIO = 15.0, 0.15  # disagreement of heights that is not reported
_LOCAL_DATUM_M = 30.0  # median below which a surface model is taken to have a datum of its own
_MAX_GEOID_M = 110.0  # largest undulation of the geoid
_MIN_HEIGHT_M, _MAX_HEIGHT_M = 5.0, 5000.0  # plausible heights above the ground
_MAX_HEIGHT_SPREAD = 0.3  # 10th to 90th percentile relative to the median
_MIN_CONCENTRATION = 0.8  # mean resultant length of directions: 1 is one direction, 0 none
_MAX_HEADING_OFFSET_DEG = 30.0
_MIN_STEP_M = 2.0  # below which a step has no course


@dataclass(frozen=True, slots=True)
class TruthFinding:
    """A reason to doubt the truth of a flight.

    Attributes:
        kind: machine-readable: "jump", "outside", "frozen", "coarse", "unknown", "datum", "height" or "heading".
        text: human-readable, with the figure and the first row or frame concerned.
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
) -> list[TruthFinding]:
    """Check truth and telemetry of a flight for what is implausible in a real one.

    Args:
        truth: in the order of time, at least one row.
        rows: the telemetry; empty where there is none.
        site: the map; None omits the check that the flight is on it.
        surface: the surface model. Its heights are taken as above mean sea level, unless their median is about 0,
            which is a datum of its own.
        max_speed_mps: maximum ground speed of the vehicle.

    Returns:
        The findings; empty where nothing is implausible.
    """
    frame = LocalFrame(truth[0].lat_deg, truth[0].lon_deg)
    lat, lon = (np.array([getattr(t, name) for t in truth]) for name in ("lat_deg", "lon_deg"))
    en_m = frame.enu_from_geodetic(lat, lon)
    stamps_s = np.array([t.timestamp_ns for t in truth], dtype=np.float64) * 1e-9
    telemetry = {row.timestamp_ns: row for row in rows}
    heights = _heights(truth, telemetry)
    found = _jumps(en_m, stamps_s, max_speed_mps) + _frozen(en_m) + _coarse(lat, lon, frame)
    found += _outside(lat, lon, site) + _unknown(truth, rows)
    if surface is not None:
        found += _against_ground(heights, _surface_heights(surface, np.column_stack([lon, lat])))
    return found + _height(heights, surface is not None) + _heading(_headings(truth, telemetry), en_m)


def _heights(truth: Sequence[Truth], telemetry: Mapping[int, TelemetryRow]) -> Array:
    """(N, 2) metres above the ground, preferably by the telemetry, and above the sea; NaN where unknown."""

    def pair(t: Truth) -> tuple[float | None, float | None]:
        row = telemetry.get(t.timestamp_ns)
        above_m = t.height_agl_m if row is None or row.height_agl_m is None else row.height_agl_m
        return above_m, row.alt_amsl_m if row is not None and t.alt_amsl_m is None else t.alt_amsl_m

    return np.array([[np.nan if v is None else v for v in pair(t)] for t in truth], dtype=np.float64)


def _headings(truth: Sequence[Truth], telemetry: Mapping[int, TelemetryRow]) -> Array:
    """(N,) headings in degrees, preferably by the telemetry; NaN where unknown."""

    def one(t: Truth) -> float | None:
        row = telemetry.get(t.timestamp_ns)
        return t.heading_deg if row is None or row.heading_deg is None else row.heading_deg

    return np.array([np.nan if one(t) is None else one(t) for t in truth], dtype=np.float64)


def _jumps(en_m: Array, stamps_s: Array, max_speed_mps: float) -> list[TruthFinding]:
    speeds = np.hypot(*np.diff(en_m, axis=0).T) / np.diff(stamps_s)
    fast = np.flatnonzero(speeds > max_speed_mps)
    if not fast.size:
        return []
    first = int(fast[0])
    return [
        TruthFinding(
            "jump",
            f"{fast.size} of {len(speeds)} steps exceed {max_speed_mps:g} m/s, up to {speeds.max():.0f}; "
            f"the first is after row {first + 1}",
        )
    ]


def _frozen(en_m: Array) -> list[TruthFinding]:
    steps_m = np.hypot(*np.diff(en_m, axis=0).T)
    still = steps_m == 0.0
    ratio = float(still.mean()) if still.size else 0.0
    if ratio <= _MAX_FROZEN_RATIO or ratio == 1.0 or np.median(steps_m[~still]) < _MIN_STEP_M:
        return []
    first = int(np.flatnonzero(still)[0])
    return [
        TruthFinding(
            "frozen",
            f"{still.sum()} of {len(still)} positions repeat the one before, while the others move by "
            f"{np.median(steps_m[~still]):.0f} m; the first is row {first + 2}",
        )
    ]


def _coarse(lat: Array, lon: Array, frame: LocalFrame) -> list[TruthFinding]:
    """The coarsest power of ten on which all values lie."""
    for decimals in range(1, 8):
        if max(np.abs(values - np.round(values, decimals)).max() for values in (lat, lon)) < 1e-10:
            step_m = float(frame.enu_from_geodetic(frame.lat_deg + 10.0**-decimals, frame.lon_deg)[1])
            if step_m > COARSE_M and len(lat) > 1:
                return [
                    TruthFinding(
                        "coarse", f"positions have {decimals} decimals of a degree, steps of {step_m:.1f} m"
                    )
                ]
            return []
    return []


def _outside(lat: Array, lon: Array, site: Source | None) -> list[TruthFinding]:
    if site is None:
        return []
    xy = site.grid.pixels_of(wgs84())[1](np.column_stack([lon, lat]))
    size = (site.grid.width_px, site.grid.height_px)
    inside = ((xy >= -0.5) & (xy <= np.array(size) - 0.5)).all(axis=1)
    if inside.all():
        return []
    first = int(np.flatnonzero(~inside)[0])
    return [
        TruthFinding(
            "outside", f"{(~inside).sum()} of {len(lat)} positions are off the map; the first is row {first + 1}"
        )
    ]


def _unknown(truth: Sequence[Truth], rows: Sequence[TelemetryRow]) -> list[TruthFinding]:
    blind = [row.frame for row in rows if interpolate_truth(truth, row.timestamp_ns) is None]
    if not blind:
        return []
    return [TruthFinding("unknown", f"{len(blind)} of {len(rows)} frames have no truth; the first is {blind[0]}")]


def _height(heights_m: Array, has_surface: bool) -> list[TruthFinding]:
    """Check heights above the ground and above the sea by themselves and against each other."""
    above_m = heights_m[np.isfinite(heights_m[:, 0]), 0]
    both_m = heights_m[np.isfinite(heights_m).all(axis=1)]
    found = []
    median_m = _median(above_m)
    if median_m is not None and not _MIN_HEIGHT_M <= median_m <= _MAX_HEIGHT_M:
        found.append(TruthFinding("height", f"the median height above the ground is {median_m:.0f} m"))
    if len(both_m) > 1 and np.abs(both_m[:, 0] - both_m[:, 1]).max() < 0.01:
        found.append(TruthFinding("datum", "the heights above the ground and above the sea are the same numbers"))
    if median_m and not has_surface:
        low, high = np.percentile(above_m, [10, 90])
        spread = float(high - low) / abs(median_m)
        if spread > _MAX_HEIGHT_SPREAD:
            text = f"the height above the ground varies by {spread:.0%} of its median: it may be above the sea"
            found.append(TruthFinding("datum", f"{text}, over hills; a surface model would decide"))
    return found


def _against_ground(heights_m: Array, ground_m: Array) -> list[TruthFinding]:
    """Check both heights against the surface model."""
    above_m, sea_m = heights_m.T
    clear_m, off_m = _median(sea_m - ground_m), _median(above_m - (sea_m - ground_m))
    found = []
    if clear_m is not None and clear_m < _MIN_HEIGHT_M:
        text = f"the median height above the sea is {clear_m:.0f} m above the surface model"
        found.append(TruthFinding("datum", text))
    if (
        off_m is None
        or clear_m is None
        or abs(off_m) <= max(_HEIGHT_TOLERANCE_M, _HEIGHT_TOLERANCE_RATIO * abs(clear_m))
    ):
        return found
    level_m = _median(ground_m)
    if level_m is not None and abs(level_m) < _LOCAL_DATUM_M:
        return found  # the surface model has a datum of its own
    cause = "for no known datum"
    if level_m is not None and abs(off_m - level_m) < _HEIGHT_TOLERANCE_M:
        cause = f"the level of the ground ({level_m:.0f} m): it is above the sea"
    elif abs(off_m) < _MAX_GEOID_M:
        cause = "which the geoid could explain: one of the two may be above the ellipsoid"
    text = f"the height above the ground is {off_m:+.0f} m off that above the sea minus the surface model, {cause}"
    return [*found, TruthFinding("datum", text)]


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _surface_heights(surface: Source, lon_lat: Array) -> Array:
    """(N,) heights in metres of the surface model at (N, 2) longitudes and latitudes; NaN outside it."""
    xy = surface.grid.pixels_of(wgs84())[1](lon_lat)
    size = (surface.grid.width_px, surface.grid.height_px)
    out = np.full(len(xy), np.nan)
    dataset: Any = surface.dataset
    for k, (x, y) in enumerate(np.round(xy).astype(int)):
        if 0 <= x < size[0] and 0 <= y < size[1]:
            value = float(dataset.read(1, window=((y, y + 1), (x, x + 1)), masked=True).filled(np.nan)[0, 0])
            out[k] = value if -1000.0 < value < 20000.0 else np.nan
    return out


def _heading(headings_deg: Array, en_m: Array) -> list[TruthFinding]:
    """Check the heading against the course over ground, where the vehicle moves."""
    missing = int(np.isnan(headings_deg).sum())
    found = []
    if missing:
        text = f"{missing} of {len(headings_deg)} rows have no heading, which ncc requires"
        found.append(TruthFinding("heading", text))
    steps_m = np.diff(en_m, axis=0)
    known = np.isfinite(headings_deg[:-1]) & (np.hypot(*steps_m.T) > _MIN_STEP_M)
    if known.sum() < 3:
        return found
    heading, course = np.radians(headings_deg[:-1][known]), np.arctan2(*steps_m[known].T)
    aligned, mirrored, courses = (np.exp(1j * a).mean() for a in (heading - course, -heading - course, course))
    offset_deg = float(np.degrees(np.angle(aligned)))
    if abs(aligned) >= _MIN_CONCENTRATION and abs(offset_deg) > _MAX_HEADING_OFFSET_DEG:
        text = f"the heading is {offset_deg:+.0f} degrees off the course over ground throughout"
        found.append(TruthFinding("heading", f"{text}: reversed, or the aircraft's instead of the camera's"))
    if abs(aligned) < _MIN_CONCENTRATION <= abs(mirrored) and abs(courses) < _MIN_CONCENTRATION:
        found.append(TruthFinding("heading", "the heading turns against the course over ground: it is mirrored"))
    return found
