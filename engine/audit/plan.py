"""Where an audit looks: places over a map, over a part of it or along a route; and what a frame sees there."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.align import GroundView, rectify, view_of
from engine.camera import Camera
from engine.errors import OptionError
from engine.methods.options import NccOptions
from engine.orthomap import OrthoMap
from engine.values import Attitude, Window, check_positive
from engine.window import level_for

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Larger templates cost time and change the answer little: the audit then takes a coarser level.
_MAX_TEMPLATE_PX = 320
_CELLS_PER_PLACE = 250  # of the grid under a part, so that a long corridor does not make it too large for memory
_MARGIN_STEPS = 1.5  # a corridor is at least so wide to each side that places lie all around what is seen on it


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditOptions:
    """What is assumed of the flights that the audit is for.

    Attributes:
        prior_sigma_m: how well the position is known before a match.
        spacing: of the places, as a share of the frame's footprint.
        max_cells: a large map gets wider spacing, so that there are no more places than this.
        ncc: settings of the NCC method.
    """

    prior_sigma_m: float = 10.0
    spacing: float = 0.25
    max_cells: int = 4000
    ncc: NccOptions = field(default_factory=NccOptions)

    def __post_init__(self) -> None:
        check_positive(self, "prior_sigma_m", "spacing", "max_cells")


@dataclass(frozen=True, kw_only=True, eq=False)
class MapPart:
    """The part of a map that is looked at: around a place, along what the camera sees on a route, or both.

    Attributes:
        around: latitude and longitude in degrees, and a radius in metres.
        route: (N, 2) latitude and longitude of waypoints.
        corridor_m: how far to each side of what is seen on the route; None is the longer side of a frame.

    Raises:
        OptionError: a part of nothing, or a distance that is none.
    """

    around: tuple[float, float, float] | None = None
    route: Array | None = None
    corridor_m: float | None = None

    def __post_init__(self) -> None:
        if self.around is None and self.route is None:
            raise OptionError("part: expected around or route, got neither")
        for name, metres in (("around", self.around and self.around[2]), ("corridor_m", self.corridor_m)):
            if metres is not None and not 0.0 < metres < math.inf:
                raise OptionError(f"{name}: expected metres above 0, got {metres:g}")


@dataclass(frozen=True)
class AuditPlan:
    """Where an audit looks, and at what.

    Attributes:
        site: the map.
        camera: what the map will be seen by.
        height_agl_m: from where.
        options: settings.
        level: of the map's pyramid.
        view: of a level camera that looks north, in pixels of the level.
        shape: (h, w) of a template.
        window: the part of the map that the grid of places covers, in pixels of the map.
        looked: (rows, columns) of places; which of them are looked at.
        other: the same ground at another date, or None.
    """

    site: OrthoMap
    camera: Camera
    height_agl_m: float
    options: AuditOptions
    level: int
    view: GroundView
    shape: tuple[int, int]
    window: Window
    looked: Mask
    other: OrthoMap | None = None

    def __len__(self) -> int:
        return int(np.count_nonzero(self.looked))

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of places."""
        return self.looked.shape[0], self.looked.shape[1]

    @property
    def area_px(self) -> float:
        """How much of the map is looked at, in its pixels."""
        return len(self) * float(self.spacing_px.prod())

    @cached_property
    def spacing_px(self) -> Array:
        """(2,) between places along x and y, in pixels of the map."""
        return _spacing_px(self.window, self.cells)

    @property
    def exclusion_px(self) -> float:
        """Rivals nearer than this are the peak itself, in pixels of the level."""
        return self.options.ncc.rule.exclusion_m / (self.site.gsd_m_per_px * 2.0**self.level)

    @cached_property
    def places_px(self) -> Array:
        """(rows, columns, 2) where the middle of the frame looks, in pixels of the map."""
        return _places_px(self.window, self.cells)

    @cached_property
    def ahead_m(self) -> Array:
        """(2,) metres east and north from a level vehicle that flies north to the middle of its frame."""
        return _ahead_m(self.site, self.view, self.level, _middle_px(self.window))

    def cell_from_pixel(self, xy_px: ArrayLike) -> Array:
        """Column and row (..., 2) of the grid of places for pixels (..., 2) of the map; places are integers."""
        corner = np.array([self.window.x0, self.window.y0])
        return np.asarray((np.asarray(xy_px, np.float64) + 0.5 - corner) / self.spacing_px - 0.5)

    def pixel_from_cell(self, cell: ArrayLike) -> Array:
        """Pixels (..., 2) of the map from columns and rows (..., 2) of the grid of places."""
        corner = np.array([self.window.x0, self.window.y0])
        return np.asarray((np.asarray(cell, np.float64) + 0.5) * self.spacing_px + corner - 0.5)

    def corner_px(self, place_px: Array) -> tuple[int, int]:
        """The top-left pixel of the level on which a template lies whose middle is at a place."""
        x, y = self.site.level_from_full(place_px, self.level)
        return round(float(x) - (self.shape[1] - 1) / 2.0), round(float(y) - (self.shape[0] - 1) / 2.0)

    def holds(self, place_px: Array) -> bool:
        """Whether a template at a place lies inside the map."""
        (rows, columns), (x, y) = self.site.level_shape(self.level), self.corner_px(place_px)
        return 0 <= x <= columns - self.shape[1] and 0 <= y <= rows - self.shape[0]


def plan_audit(
    site: OrthoMap,
    camera: Camera,
    height_agl_m: float,
    options: AuditOptions | None = None,
    other: OrthoMap | None = None,
    part: MapPart | None = None,
) -> AuditPlan:
    """Lay places over a map, or over a part of it.

    Args:
        site: the map.
        camera: what it will be seen by.
        height_agl_m: from where, above 0.
        options: settings; the defaults serve.
        other: the same ground at another date, by which stale places are found.
        part: of the map; None is all of it.

    Raises:
        OptionError: the height is no height, the camera looks at the horizon, a frame covers more than the map or
            next to nothing of it, or the part does not lie on the map.
    """
    options = options or AuditOptions()
    if not (math.isfinite(height_agl_m) and height_agl_m > 0):
        raise OptionError(f"height_agl_m: expected metres above 0, got {height_agl_m:g}")
    whole = Window(0, 0, site.width_px, site.height_px)
    middle = _middle_px(whole) if part is None else _middle_of(part, site)
    level, view, shape = _seen_at(site, camera, height_agl_m, options, middle)
    step_px = options.spacing * math.sqrt(view.area_px) * 2.0**level
    if part is not None:
        window, looked = _near(part, site, view, level, step_px, options.max_cells)
    else:
        step_px = max(step_px, math.sqrt(whole.area_px / options.max_cells))
        window, looked = whole, np.ones(_cells(whole, step_px), np.bool_)
    return AuditPlan(site, camera, height_agl_m, options, level, view, shape, window, looked, other)


def _seen_at(
    site: OrthoMap, camera: Camera, height_agl_m: float, options: AuditOptions, middle_px: Array
) -> tuple[int, GroundView, tuple[int, int]]:
    """The level of the map that a frame is matched on, its view there, and the shape (h, w) of its template."""
    level = level_for(site.gsd_m_per_px, height_agl_m / camera.focal_px, site.levels)
    blank = np.zeros((camera.height_px, camera.width_px), np.uint8)
    while True:
        jacobian = site.enu_jacobian(middle_px) * 2.0**level
        view = view_of(camera, Attitude(0.0, 0.0, 0.0), height_agl_m, jacobian)
        if view is None:
            raise OptionError("camera: expected one that looks down, got a mount that looks at the horizon")
        rows, columns = site.level_shape(level)
        if max(view.footprint_px) > max(rows, columns):
            size = " x ".join(f"{n * 2**level * site.gsd_m_per_px:.0f}" for n in view.footprint_px)
            extent = " x ".join(f"{n * site.gsd_m_per_px:.0f}" for n in (site.width_px, site.height_px))
            raise OptionError(
                f"height_agl_m: expected a frame within the map's {extent} m, got {size} m from {height_agl_m:g} m"
            )
        patch = rectify(blank, camera, view, fraction=options.ncc.fraction)
        if patch is None:
            raise OptionError(
                f"height_agl_m: expected a frame of 8 x 8 map pixels or more, got less from {height_agl_m:g} m"
            )
        if max(patch.gray.shape) <= _MAX_TEMPLATE_PX or level == site.levels - 1:
            return level, view, (patch.gray.shape[0], patch.gray.shape[1])
        level += 1


# ------------------------------------------------------------------------------------------- the grid of places


def _cells(window: Window, step_px: float) -> tuple[int, int]:
    """Rows and columns of places that lie at most so far apart."""
    return math.ceil(window.height_px / step_px), math.ceil(window.width_px / step_px)


def _spacing_px(window: Window, cells: tuple[int, int]) -> Array:
    return np.array([window.width_px / cells[1], window.height_px / cells[0]])


def _places_px(window: Window, cells: tuple[int, int]) -> Array:
    j, i = np.mgrid[: cells[0], : cells[1]]
    corner = np.array([window.x0, window.y0])
    return np.asarray(np.stack([i + 0.5, j + 0.5], axis=-1) * _spacing_px(window, cells) + corner - 0.5)


def _middle_px(window: Window) -> Array:
    return np.array([window.x0 + (window.width_px - 1) / 2.0, window.y0 + (window.height_px - 1) / 2.0])


# -------------------------------------------------------------------------------------------------------- parts


def _middle_of(part: MapPart, site: OrthoMap) -> Array:
    """The pixel (2,) in the middle of a part, or next to it on the map."""
    places = [] if part.around is None else [np.array([part.around[:2]])]
    places += [] if part.route is None else [part.route]
    xy = site.pixel_from_geodetic(*np.concatenate(places).T)
    middle = (xy.min(axis=0) + xy.max(axis=0)) / 2.0
    return np.asarray(np.clip(np.nan_to_num(middle), 0, [site.width_px - 1, site.height_px - 1]))


def _near(
    part: MapPart, site: OrthoMap, view: GroundView, level: int, step_px: float, max_cells: int
) -> tuple[Window, Mask]:
    """The window of the map under a part, and which places (rows, columns) of a grid on it belong to the part.

    Places lie so far apart, or further where there would be more of them than was asked for.
    """
    gsd_m = site.gsd_m_per_px
    reach_m = part.corridor_m or max(view.footprint_px) * 2.0**level * gsd_m
    while True:
        discs = []  # (N, 3) each: pixels x and y, and a radius
        if part.around is not None:
            discs.append(np.array([[*site.pixel_from_geodetic(*part.around[:2]), part.around[2] / gsd_m]]))
        if part.route is not None:
            ahead_m = _ahead_m(site, view, level, _middle_of(part, site))
            seen = site.pixel_from_enu(fly(site, part.route, 0.5 * step_px * gsd_m, ahead_m).seen_m)
            reach_px = max(reach_m / gsd_m, _MARGIN_STEPS * step_px)
            discs.append(np.column_stack([seen, np.full(len(seen), reach_px)]))
        window = _window_of(np.concatenate(discs), site)
        least_px = math.sqrt(window.area_px / (_CELLS_PER_PLACE * max_cells))
        if step_px < least_px:
            step_px = least_px
            continue
        cells = _cells(window, step_px)
        looked = np.zeros(cells, np.bool_)
        for some in discs:
            looked |= _within(some, window, cells)
        count = np.count_nonzero(looked)
        if count == 0:
            raise OptionError(f"part: expected one on the map {site.name}, got one beside it")
        if count <= max_cells or step_px >= max(window.width_px, window.height_px):
            return window, looked
        step_px *= max(1.02, math.sqrt(count / max_cells))


def _window_of(discs: Array, site: OrthoMap) -> Window:
    """The part of the map around discs (N, 3)."""
    size = np.array([site.width_px, site.height_px])
    xy, reach = discs[:, :2], discs[:, 2:]
    low = np.clip(np.floor((xy - reach).min(axis=0)), 0, size)
    high = np.clip(np.ceil((xy + reach).max(axis=0)) + 1, 0, size)
    if not (high > low).all():  # NaN fails too
        raise OptionError(f"part: expected one on the map {site.name}, got one beside it")
    (x0, y0), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
    return Window(x0, y0, width, height)


def _within(discs: Array, window: Window, cells: tuple[int, int]) -> Mask:
    """Which places (rows, columns) lie within the radius, the same for all, of any of the discs (N, 3)."""
    spacing, reach_px = _spacing_px(window, cells), float(discs[0, 2])
    if len(discs) == 1:
        off = _places_px(window, cells) - discs[0, :2]
        return np.asarray(np.hypot(off[..., 0], off[..., 1]) <= max(reach_px, 0.51 * float(np.hypot(*spacing))))
    x, y = np.floor((discs[:, :2] + 0.5 - np.array([window.x0, window.y0])) / spacing).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < cells[1]) & (y < cells[0])
    far = np.ones(cells, np.uint8)
    far[y[inside], x[inside]] = 0
    if not inside.any():
        return np.zeros(cells, np.bool_)
    return np.asarray(cv2.distanceTransform(far, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * spacing.min() <= reach_px)


# ------------------------------------------------------------------------------------------------------- routes


@dataclass(frozen=True, eq=False)
class RouteSamples:
    """A route in small steps.

    Attributes:
        at_m: (N,) along it.
        en_m: (N, 2) east and north of the vehicle.
        seen_m: (N, 2) the same of where the middle of its frame looks.
    """

    at_m: Array
    en_m: Array
    seen_m: Array


def fly(site: OrthoMap, route: ArrayLike, step_m: float, ahead_m: Array) -> RouteSamples:
    """Straight legs between waypoints in steps of at most so many metres.

    Args:
        site: the map.
        route: (N, 2) latitude and longitude in degrees.
        step_m: above 0.
        ahead_m: (2,) see :attr:`AuditPlan.ahead_m`.

    Raises:
        OptionError: fewer than two waypoints, or all of them at one place.
    """
    corners = np.atleast_2d(site.frame.enu_from_geodetic(*np.asarray(route, np.float64).T))
    legs = np.hypot(*np.diff(corners, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    if along[-1] <= 0.0:
        raise OptionError(f"route: expected two or more places that differ, got {len(corners)} without a way")
    at = np.linspace(0.0, along[-1], max(math.ceil(along[-1] / step_m) + 1, 2))
    en = np.stack([np.interp(at, along, corners[:, axis]) for axis in (0, 1)], axis=1)
    leg = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(legs) - 1)
    leg = np.where(legs[leg] > 0.0, leg, np.argmax(legs > 0.0))
    east, north = np.diff(corners, axis=0)[leg].T / legs[leg]
    looks = np.stack([north * ahead_m[0] + east * ahead_m[1], north * ahead_m[1] - east * ahead_m[0]], axis=1)
    return RouteSamples(at, en, en + looks)


def _ahead_m(site: OrthoMap, view: GroundView, level: int, middle_px: Array) -> Array:
    return np.asarray((site.enu_jacobian(middle_px) * 2.0**level) @ view.center_px)
