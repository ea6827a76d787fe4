"""Availability of fixes over a map and along a route: their probability, and why it is low.

A logistic rule, fitted on simulated towns and on farmland, turns the statistics of
:mod:`scenematch.check.self_match` into a probability, see ``docs/audit.md``.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.geo import Array
from engine.orthomap import OrthoMap
from scenematch.check.plan import AuditPlan, sample_route
from scenematch.check.self_match import SelfMatchStatistics, measure_self_match

SUITABLE = 0.5
"""Probability of a fix at and above which a cell counts as suitable."""


class Flag(enum.IntEnum):
    """Result for a cell; ``docs/audit.md`` has the measurements behind each."""

    GOOD = 0
    NODATA = 1
    FLAT = 2
    REPEATED = 3
    UNSTABLE = 4
    WEAK = 5
    EDGE = 6
    OUTSIDE = 7


# Reasons why a cell is not suitable, in this order; WEAK if none of these applies.
FLAT_TEXTURE = 3.0
REPEATED_RIVAL = 0.5
UNSTABLE_SCORE = 0.58


def fix_probability(texture: ArrayLike, score: ArrayLike, lead: ArrayLike) -> Array:
    """Probability of a fix: a logistic function of the statistics that decide NCC's fixes.

    Args:
        texture: (...,) see :class:`scenematch.check.self_match.SelfMatchStatistics`, as the others.
        score: (...,) in sigmas.
        lead: (...,) in sigmas.

    Returns:
        (...,) in (0, 1); NaN where one of them is.
    """
    logs = regressors(texture, score, lead) @ WEIGHTS[1:] + WEIGHTS[0]
    return np.asarray(1.0 / (1.0 + np.exp(-logs)), dtype=np.float64)


def regressors(texture: ArrayLike, score: ArrayLike, lead: ArrayLike) -> Array:
    """Regressors of :func:`fix_probability`: base-2 logarithms, clipped beyond the point of benefit.

    Args:
        texture: (...,) above 0.
        score: (...,) in sigmas.
        lead: (...,) in sigmas.

    Returns:
        (..., 3) in the order of :data:`WEIGHTS`.
    """
    ranges = ((0.25, 64.0), (0.5, 64.0), (0.25, 32.0))
    given = np.broadcast_arrays(*(np.asarray(values, np.float64) for values in (texture, score, lead)))
    return np.stack([np.log2(np.clip(v, *limits)) for v, limits in zip(given, ranges, strict=True)], axis=-1)


WEIGHTS = np.array([-16.41, 1.7, 1.89, 1.04])
"""Logistic weights (constant, texture, score, lead), fitted by ``python -m bench.accuracy.audit --fit``."""


# ---------------------------------------------------------------------------------------------------- audits


@dataclass(frozen=True)
class Audit:
    """The audit of a map.

    Attributes:
        plan: grid of cells.
        statistics: (rows, columns) each; NaN outside the audited part, as is the availability.
        availability: (rows, columns) probability of a fix; NaN where the map has no data for a frame.
        flags: (rows, columns) values of :class:`Flag`; OUTSIDE beyond the audited part.
    """

    plan: AuditPlan
    statistics: SelfMatchStatistics
    availability: Array
    flags: NDArray[np.uint8]

    @property
    def shares(self) -> dict[str, float]:
        """Share of the audited cells by the name of their flag."""
        seen = self.flags[self.plan.audited]
        return {flag.name.lower(): float((seen == flag).mean()) for flag in Flag if flag is not Flag.OUTSIDE}

    def at(self, xy_px: ArrayLike) -> Array:
        """Probability of a fix, bilinear between cells.

        Args:
            xy_px: (..., 2) pixels of the map that the middle of a frame shows.

        Returns:
            (...,) in [0, 1]; nodata, pixels off the map and cells outside the audited part count as 0.
        """
        from engine.kernels.map_points import bilinear_heights  # numba takes a while to import

        known, cell = np.nan_to_num(self.availability), np.ascontiguousarray(self.plan.cell_from_pixel(xy_px))
        found = np.empty(cell.shape[:-1])
        bilinear_heights(known.astype(np.float32), cell.reshape(-1, 2), found.reshape(-1))
        return np.nan_to_num(found)

    def flag_at(self, xy_px: ArrayLike) -> NDArray[np.uint8]:
        """Flags of the nearest cells.

        Args:
            xy_px: (..., 2) pixels of the map.

        Returns:
            (...,) uint8 values of :class:`Flag`; EDGE off the map.
        """
        framed = np.pad(self.flags, 1, constant_values=Flag.EDGE)
        cell = np.floor(self.plan.cell_from_pixel(xy_px) + 0.5).astype(int)
        x, y = np.moveaxis(np.clip(cell, -1, self.flags.shape[::-1]) + 1, -1, 0)
        return np.asarray(framed[y, x], np.uint8)


def audit_of(plan: AuditPlan, measured: Iterable[SelfMatchStatistics] | None = None) -> Audit:
    """Audit a map.

    Args:
        plan: of the audit.
        measured: statistics of all audited cells in the plan's order; None measures them.
    """
    rows = list(measure_self_match(plan) if measured is None else measured)
    found = {one.name: np.full(plan.cells, np.nan) for one in fields(SelfMatchStatistics)}
    for name, grid in found.items():
        grid[plan.audited] = [getattr(row, name) for row in rows]
    statistics = SelfMatchStatistics(**found)
    availability = fix_probability(statistics.texture, statistics.score, statistics.lead)
    inside_map = np.zeros(plan.cells, np.bool_)
    inside_map[plan.audited] = [plan.contains(center) for center in plan.centers_px[plan.audited]]
    flags = np.where(plan.audited, _flags(statistics, availability, inside_map), Flag.OUTSIDE).astype(np.uint8)
    return Audit(plan, statistics, availability, flags)


def _flags(
    statistics: SelfMatchStatistics, availability: Array, inside_map: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    with np.errstate(invalid="ignore"):
        reasons = [
            (~inside_map, Flag.EDGE),
            (np.isnan(availability), Flag.NODATA),
            (availability >= SUITABLE, Flag.GOOD),
            (statistics.texture < FLAT_TEXTURE, Flag.FLAT),
            (statistics.rival >= REPEATED_RIVAL, Flag.REPEATED),
            (statistics.stability < UNSTABLE_SCORE, Flag.UNSTABLE),
        ]
    return np.select([holds for holds, _ in reasons], [flag for _, flag in reasons], Flag.WEAK).astype(np.uint8)


# ---------------------------------------------------------------------------------------------------- routes


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of a route with no suitable cells.

    Attributes:
        start_lat_deg, start_lon_deg, end_lat_deg, end_lon_deg: its ends.
        length_m: along the route.
        availability: mean probability of a fix.
        flag: the most frequent reason.
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
    """Predicted availability along a route.

    Attributes:
        length_m: of the route.
        availability: mean probability of a fix; nodata and positions off the map count as 0.
        xy_px: (N, 2) positions of the vehicle along it, in pixels of the map.
        probability: (N,) of a fix at each.
        stretches: parts with no suitable cells, in the order of the flight.
    """

    length_m: float
    availability: float
    xy_px: Array
    probability: Array
    stretches: tuple[Stretch, ...]


def predict_route(audit: Audit, lat_deg: ArrayLike, lon_deg: ArrayLike) -> RouteAvailability:
    """The availability along straight legs between waypoints.

    Args:
        audit: of the map.
        lat_deg: (N,) with N at least 2.
        lon_deg: (N,).

    Returns:
        RouteAvailability: sampled at half the spacing of the cells.

    Raises:
        OptionError: fewer than two waypoints, or all of them equal.
    """
    site, plan = audit.plan.site, audit.plan
    route = np.stack([np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)], axis=-1)
    samples = sample_route(site, route, 0.5 * float(plan.spacing_px.min()) * site.gsd_m_per_px, plan.view_offset_m)
    xy = site.pixel_from_enu(samples.view_m)
    probabilities, flags = audit.at(xy), audit.flag_at(xy)
    stretches = tuple(_stretches(site, samples.along_m, samples.en_m, probabilities, flags))
    length_m = float(samples.along_m[-1])
    return RouteAvailability(
        length_m, float(probabilities.mean()), site.pixel_from_enu(samples.en_m), probabilities, stretches
    )


def _stretches(
    site: OrthoMap, along_m: Array, en_m: Array, probabilities: Array, flags: NDArray[np.uint8]
) -> Iterator[Stretch]:
    poor = np.concatenate([[False], probabilities < SUITABLE, [False]])
    edges = np.flatnonzero(poor[1:] != poor[:-1])
    for first, end in edges.reshape(-1, 2):
        part = slice(first, end)
        lat, lon = site.frame.geodetic_from_enu(*en_m[[first, end - 1]].T)
        reasons = flags[part][flags[part] != Flag.GOOD]  # between cells, the nearest may still be good
        worst = Flag(int(np.bincount(reasons).argmax())) if reasons.size else Flag.WEAK
        length_m = float(along_m[end - 1] - along_m[first])
        ends_deg = (float(lat[0]), float(lon[0]), float(lat[1]), float(lon[1]))
        yield Stretch(*ends_deg, length_m, float(probabilities[part].mean()), worst.name.lower())
