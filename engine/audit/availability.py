"""Audit: how surely a frame is matched at each place of a map and along a route, and where not, why not.

What :mod:`engine.audit.self_match` measures becomes a probability by a rule that was fitted on simulated towns and
on farmland, see ``docs/audit.md``.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.audit.plan import AuditOptions, AuditPlan, MapPart, fly, plan_audit
from engine.audit.self_match import SelfMatchStatistics, measure
from engine.camera import Camera
from engine.orthomap import OrthoMap

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
    OUTSIDE = 8


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
"""Of the logistic rule: constant, texture, score, lead; fitted by ``python -m bench.accuracy.audit --fit``."""


# -------------------------------------------------------------------------------------------------- judging


@dataclass(frozen=True)
class Audit:
    """What was found of a map.

    Attributes:
        plan: where it was looked.
        evidence: (rows, columns) each; NaN outside the part that was looked at, as are the probabilities.
        availability: (rows, columns) probability of a fix; NaN where the map has no data for a frame.
        flags: (rows, columns) values of :class:`Flag`; OUTSIDE of the part that was looked at.
    """

    plan: AuditPlan
    evidence: SelfMatchStatistics
    availability: Array
    flags: NDArray[np.uint8]

    @property
    def shares(self) -> dict[str, float]:
        """Share of the places that were looked at by the name of their flag."""
        seen = self.flags[self.plan.looked]
        return {flag.name.lower(): float((seen == flag).mean()) for flag in Flag if flag is not Flag.OUTSIDE}

    def at(self, xy_px: ArrayLike) -> Array:
        """Probability (...,) of a fix where the middle of the frame looks at pixels (..., 2) of the map.

        Bilinear between the places; nodata, what lies off the map and what was not looked at count as 0.
        """
        cell = self.plan.cell_from_pixel(xy_px).astype(np.float32)
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
        return np.where(off, 0.0, top * (1 - v) + bottom * v).reshape(cell.shape[:-1]).astype(np.float64)

    def flag_at(self, xy_px: ArrayLike) -> NDArray[np.uint8]:
        """Flags (...,) of the nearest places to pixels (..., 2) of the map; EDGE off the map."""
        cell = np.floor(self.plan.cell_from_pixel(xy_px) + 0.5).astype(int)
        rows, columns = self.flags.shape
        x, y = np.moveaxis(cell, -1, 0)
        on = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
        return np.where(on, self.flags[np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)], Flag.EDGE)


def gather(plan: AuditPlan, measured: Iterable[SelfMatchStatistics]) -> Audit:
    """Judge what was measured at all places that a plan looks at, in their order."""
    rows = list(measured)
    found = {one.name: np.full(plan.cells, np.nan) for one in fields(SelfMatchStatistics)}
    for name, grid in found.items():
        grid[plan.looked] = [getattr(row, name) for row in rows]
    evidence = SelfMatchStatistics(**found)
    own = probability(evidence.texture, evidence.score, evidence.lead)
    met = own
    if plan.other is not None:  # a real change in place of the simulated one
        later = probability(evidence.texture, evidence.other_score, evidence.other_lead)
        met = np.where(np.isnan(later), own, np.minimum(own, later))
    held = np.zeros(plan.cells, np.bool_)
    held[plan.looked] = [plan.holds(place) for place in plan.places_px[plan.looked]]
    flags = np.where(plan.looked, _flags(evidence, own, met, held), Flag.OUTSIDE).astype(np.uint8)
    return Audit(plan, evidence, met, flags)


def audit_map(
    site: OrthoMap,
    camera: Camera,
    height_agl_m: float,
    options: AuditOptions | None = None,
    other: OrthoMap | None = None,
    part: MapPart | None = None,
) -> Audit:
    """AuditPlan, measure and judge; arguments and errors are those of :func:`engine.audit.plan.plan_audit`."""
    plan = plan_audit(site, camera, height_agl_m, options, other, part)
    return gather(plan, measure(plan))


def _flags(evidence: SelfMatchStatistics, own: Array, met: Array, held: NDArray[np.bool_]) -> NDArray[np.uint8]:
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
class RouteAvailability:
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


def predict(audit: Audit, lat_deg: ArrayLike, lon_deg: ArrayLike) -> RouteAvailability:
    """The availability along straight legs between waypoints.

    Args:
        audit: of the map.
        lat_deg: (N,) with N at least 2.
        lon_deg: (N,).

    Raises:
        OptionError: fewer than two waypoints, or all of them at one place.
    """
    site, plan = audit.plan.site, audit.plan
    route = np.stack([np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)], axis=-1)
    flown = fly(site, route, 0.5 * float(plan.spacing_px.min()) * site.gsd_m_per_px, plan.ahead_m)
    xy = site.pixel_from_enu(flown.seen_m)
    chance, flags = audit.at(xy), audit.flag_at(xy)
    stretches = tuple(_stretches(site, flown.at_m, flown.en_m, chance, flags))
    length_m = float(flown.at_m[-1])
    return RouteAvailability(length_m, float(chance.mean()), site.pixel_from_enu(flown.en_m), chance, stretches)


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
