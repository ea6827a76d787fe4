"""Audit: how surely a frame is matched at each place of a map and along a route, and where not, why not.

What :mod:`engine.self_match` measures becomes a probability by a rule that was fitted on simulated towns and
on farmland, see ``docs/audit.md``.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.camera import Camera
from engine.errors import OptionError
from engine.orthomap import OrthoMap
from engine.self_match import AuditOptions, Evidence, Plan, measure, plan_audit

Array = NDArray[np.float64]

SUITABLE = 0.5
"""Probability of a fix from which on a place counts as suitable."""


class Flag(enum.IntEnum):
    """What is found of a place; ``docs/audit.md`` has the measured evidence for each."""

    GOOD = 0
    NODATA = 1
    FLAT = 2
    REPEATED = 3
    UNSTABLE = 4
    WEAK = 5
    STALE = 6
    EDGE = 7


# Why a place is not suitable, in this order; WEAK where none of these is met.
FLAT_TEXTURE = 3.0
REPEATED_RIVAL = 0.5
UNSTABLE_SCORE = 0.58


def probability(texture: ArrayLike, score: ArrayLike, lead: ArrayLike) -> Array:
    """Probability (...,) of a fix: logistic in what NCC's rules look at; NaN where something is unknown."""
    logs = features(texture, score, lead) @ WEIGHTS[1:] + WEIGHTS[0]
    return np.asarray(1.0 / (1.0 + np.exp(-logs)), dtype=np.float64)


def features(texture: ArrayLike, score: ArrayLike, lead: ArrayLike) -> Array:
    """(..., 3) what the probability is computed of: logarithms, clipped where more does not help."""
    ranges = ((0.25, 64.0), (0.5, 64.0), (0.25, 32.0))
    given = np.broadcast_arrays(*(np.asarray(values, np.float64) for values in (texture, score, lead)))
    return np.stack([np.log2(np.clip(v, *limits)) for v, limits in zip(given, ranges, strict=True)], axis=-1)


WEIGHTS = np.array([-16.41, 1.7, 1.89, 1.04])
"""Of the logistic rule: constant, texture, score, lead; fitted by ``python -m bench.audit --fit``."""


# -------------------------------------------------------------------------------------------------- judging


@dataclass(frozen=True)
class Audit:
    """What was found of a map.

    Attributes:
        plan: where it was looked.
        evidence: (rows, columns) each.
        availability: (rows, columns) probability of a fix; NaN where the map has no data for a frame.
        flags: (rows, columns) values of :class:`Flag`.
    """

    plan: Plan
    evidence: Evidence
    availability: Array
    flags: NDArray[np.uint8]

    @property
    def shares(self) -> dict[str, float]:
        """Share of the places by the name of their flag."""
        return {flag.name.lower(): float((self.flags == flag).mean()) for flag in Flag}

    def at(self, xy_px: ArrayLike) -> Array:
        """Probability (...,) of a fix where the middle of the frame looks at pixels (..., 2) of the map.

        Bilinear between the places; nodata, and what lies off the map, counts as 0.
        """
        xy = np.asarray(xy_px, np.float64)
        cell = ((xy + 0.5) / self.plan.spacing_px - 0.5).astype(np.float32)
        known = np.nan_to_num(self.availability, nan=0.0).astype(np.float32)
        flat = cell.reshape(-1, 2)
        low, high = np.zeros(2, np.float32), np.array(known.shape[::-1], np.float32) - 1.0
        inside = np.clip(flat, low, high)  # half a cell at the edge is that of the last place
        x, y = inside.T
        x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
        x1, y1 = np.minimum(x0 + 1, known.shape[1] - 1), np.minimum(y0 + 1, known.shape[0] - 1)
        u, v = x - x0, y - y0
        top, bottom = known[y0, x0] * (1 - u) + known[y0, x1] * u, known[y1, x0] * (1 - u) + known[y1, x1] * u
        off = (np.abs(flat - inside) > 0.5).any(axis=1)
        return np.where(off, 0.0, top * (1 - v) + bottom * v).reshape(xy.shape[:-1]).astype(np.float64)

    def flag_at(self, xy_px: ArrayLike) -> NDArray[np.uint8]:
        """Flags (...,) of the nearest places to pixels (..., 2) of the map; EDGE off the map."""
        cell = np.floor((np.asarray(xy_px, np.float64) + 0.5) / self.plan.spacing_px).astype(int)
        rows, columns = self.flags.shape
        x, y = np.moveaxis(cell, -1, 0)
        on = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
        return np.where(on, self.flags[np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)], Flag.EDGE)


def gather(plan: Plan, measured: Iterable[Evidence]) -> Audit:
    """Judge what was measured at all places of a plan, in their order."""
    rows = list(measured)
    names = [one.name for one in fields(Evidence)]
    evidence = Evidence(*[np.array([getattr(row, name) for row in rows]).reshape(plan.cells) for name in names])
    own = probability(evidence.texture, evidence.score, evidence.lead)
    met = own
    if plan.other is not None:  # a real change in place of the simulated one
        later = probability(evidence.texture, evidence.other_score, evidence.other_lead)
        met = np.where(np.isnan(later), own, np.minimum(own, later))
    held = np.array([plan.holds(place) for place in plan.places_px.reshape(-1, 2)]).reshape(plan.cells)
    return Audit(plan, evidence, met, _flags(evidence, own, met, held))


def audit(
    site: OrthoMap,
    camera: Camera,
    height_agl_m: float,
    options: AuditOptions | None = None,
    other: OrthoMap | None = None,
) -> Audit:
    """Plan, measure and judge; arguments and errors are those of :func:`plan_audit`."""
    plan = plan_audit(site, camera, height_agl_m, options, other)
    return gather(plan, measure(plan))


def _flags(evidence: Evidence, own: Array, met: Array, held: NDArray[np.bool_]) -> NDArray[np.uint8]:
    with np.errstate(invalid="ignore"):
        reasons = [
            (~held, Flag.EDGE),
            (np.isnan(own), Flag.NODATA),
            (met >= SUITABLE, Flag.GOOD),
            (own >= SUITABLE, Flag.STALE),
            (evidence.texture < FLAT_TEXTURE, Flag.FLAT),
            (evidence.rival >= REPEATED_RIVAL, Flag.REPEATED),
            (evidence.stability < UNSTABLE_SCORE, Flag.UNSTABLE),
        ]
    return np.select([holds for holds, _ in reasons], [flag for _, flag in reasons], Flag.WEAK).astype(np.uint8)


# ---------------------------------------------------------------------------------------------------- routes


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of a route along which places are not suitable.

    Attributes:
        start_lat_deg, start_lon_deg, end_lat_deg, end_lon_deg: where it begins and ends.
        length_m: along the route.
        availability: mean probability of a fix.
        flag: what most of its places suffer from.
    """

    start_lat_deg: float
    start_lon_deg: float
    end_lat_deg: float
    end_lon_deg: float
    length_m: float
    availability: float
    flag: str


@dataclass(frozen=True)
class Route:
    """What an audit predicts along a route.

    Attributes:
        length_m: of the route.
        availability: mean probability of a fix, nodata and what lies off the map counting as 0.
        xy_px: (N, 2) places of the vehicle along it, in pixels of the map.
        probability: (N,) of a fix at each.
        stretches: where places are not suitable, in the order of the flight.
    """

    length_m: float
    availability: float
    xy_px: Array
    probability: Array
    stretches: tuple[Stretch, ...]


def predict(audit: Audit, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Route:
    """The availability along straight legs between waypoints.

    Args:
        audit: of the map.
        lat_deg: (N,) with N at least 2.
        lon_deg: (N,).

    Raises:
        OptionError: fewer than two waypoints, or all of them at one place.
    """
    site, plan = audit.plan.site, audit.plan
    corners = np.atleast_2d(site.frame.enu_from_geodetic(np.asarray(lat_deg), np.asarray(lon_deg)))
    legs = np.hypot(*np.diff(corners, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    if along[-1] <= 0.0:
        raise OptionError(f"route: expected two or more places that differ, got {len(corners)} without a way")
    count = math.ceil(along[-1] / (0.5 * float(plan.spacing_px.min()) * site.gsd_m_per_px)) + 1
    at = np.linspace(0.0, along[-1], max(count, 2))
    en = np.stack([np.interp(at, along, corners[:, axis]) for axis in (0, 1)], axis=1)
    leg = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(legs) - 1)
    leg = np.where(legs[leg] > 0.0, leg, np.argmax(legs > 0.0))
    ahead = np.diff(corners, axis=0)[leg]
    seen = en + _middle_m(plan, np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1])))
    xy = site.pixel_from_enu(seen)
    chance, flags = audit.at(xy), audit.flag_at(xy)
    stretches = tuple(_stretches(site, at, en, chance, flags))
    return Route(float(along[-1]), float(chance.mean()), site.pixel_from_enu(en), chance, stretches)


def _middle_m(plan: Plan, headings_deg: Array) -> Array:
    """(N, 2) metres east and north from a level vehicle to the middle of its frame; 0 for a nadir camera."""
    north_m = (plan.site.enu_jacobian(plan.places_px[0, 0]) * 2.0**plan.level) @ plan.view.center_px
    sine, cosine = np.sin(np.radians(headings_deg)), np.cos(np.radians(headings_deg))
    return np.stack([cosine * north_m[0] + sine * north_m[1], cosine * north_m[1] - sine * north_m[0]], axis=1)


def _stretches(
    site: OrthoMap, at_m: Array, en_m: Array, chance: Array, flags: NDArray[np.uint8]
) -> Iterator[Stretch]:
    poor = np.concatenate([[False], chance < SUITABLE, [False]])
    edges = np.flatnonzero(poor[1:] != poor[:-1])
    for first, end in edges.reshape(-1, 2):
        part = slice(first, end)
        lat, lon = site.frame.geodetic_from_enu(*en_m[[first, end - 1]].T)
        reasons = flags[part][flags[part] != Flag.GOOD]  # between places the nearest one may still be good
        worst = Flag(int(np.bincount(reasons).argmax())) if reasons.size else Flag.WEAK
        length_m = float(at_m[end - 1] - at_m[first])
        places = (float(lat[0]), float(lon[0]), float(lat[1]), float(lon[1]))
        yield Stretch(*places, length_m, float(chance[part].mean()), worst.name.lower())
