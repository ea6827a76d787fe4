"""Plan an audit: a grid of cells over a map, a part of it or a route, and a frame's view there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.camera import Camera
from engine.errors import OptionError
from engine.geo import Array
from engine.matching.align import GroundView, rectify, view_of
from engine.options import NccOptions
from engine.orthomap import OrthoMap
from engine.values import Attitude, Window, check_positive
from engine.window import level_for

Mask = NDArray[np.bool_]

NCC = NccOptions()
"""Settings of the method that an audit predicts fixes of."""

# Larger templates take longer and change little, so the audit then uses a coarser level.
_MAX_TEMPLATE_PX = 320
_CELLS_PER_AUDITED = 250  # of the grid under a part, which bounds its memory for a long corridor
_MARGIN_STEPS = 1.5  # smallest half width of a corridor, so that cells surround every position on it


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditOptions:
    """Assumptions about the flights to audit for.

    Attributes:
        prior_sigma_m: standard deviation of the position before a match.
        spacing: distance of the cells, as a share of the frame's footprint.
        max_cells: upper bound on the number of audited cells; the spacing grows accordingly.
    """

    prior_sigma_m: float = 10.0
    spacing: float = 0.25
    max_cells: int = 4000

    def __post_init__(self) -> None:
        check_positive(self, "prior_sigma_m", "spacing", "max_cells")


@dataclass(frozen=True, kw_only=True, eq=False)
class MapPart:
    """The part of a map to audit: around a position, along the ground seen from a route, or both.

    Attributes:
        around: latitude and longitude in degrees, and a radius in metres.
        route: (N, 2) latitude and longitude of waypoints.
        corridor_m: half width around the ground seen from the route; None is the longer side of a frame.

    Raises:
        OptionError: neither is given, or a distance is not above 0.
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
class CellGrid:
    """A grid of equal cells over a part of the map.

    Attributes:
        window: the part, in pixels of the map.
        cells: rows and columns.
    """

    window: Window
    cells: tuple[int, int]

    @classmethod
    def over(cls, window: Window, step_px: float) -> CellGrid:
        """The grid of the largest cells that are at most ``step_px`` wide."""
        return cls(window, (math.ceil(window.height_px / step_px), math.ceil(window.width_px / step_px)))

    @cached_property
    def spacing_px(self) -> Array:
        """(2,) size of a cell along x and y, in pixels of the map."""
        return np.array([self.window.width_px / self.cells[1], self.window.height_px / self.cells[0]])

    @cached_property
    def centers_px(self) -> Array:
        """(rows, columns, 2) centres of the cells, in pixels of the map; the middle of a frame shows them."""
        j, i = np.mgrid[: self.cells[0], : self.cells[1]]
        return self.pixel_from_cell(np.stack([i, j], axis=-1))

    def cell_from_pixel(self, xy_px: ArrayLike) -> Array:
        """Grid coordinates of pixels.

        Args:
            xy_px: (..., 2) pixels of the map.

        Returns:
            (..., 2) column and row, integers at the centres of cells.
        """
        corner = np.array([self.window.x0, self.window.y0])
        return np.asarray((np.asarray(xy_px, np.float64) + 0.5 - corner) / self.spacing_px - 0.5)

    def pixel_from_cell(self, cell: ArrayLike) -> Array:
        """Pixels of grid coordinates, the inverse of :meth:`cell_from_pixel`.

        Args:
            cell: (..., 2) column and row.

        Returns:
            (..., 2) pixels of the map.
        """
        corner = np.array([self.window.x0, self.window.y0])
        return np.asarray((np.asarray(cell, np.float64) + 0.5) * self.spacing_px + corner - 0.5)


@dataclass(frozen=True)
class AuditPlan(CellGrid):
    """The grid of an audit, and the view of a frame.

    Attributes:
        site: the map.
        height_agl_m: of the flights.
        options: settings.
        level: of the map's pyramid.
        view: of a level camera that looks north, in pixels of the level.
        view_offset_m: (2,) metres east and north from a level vehicle heading north to the middle of its frame.
        shape: (h, w) of a template.
        audited: (rows, columns) which cells are audited.
    """

    site: OrthoMap
    height_agl_m: float
    options: AuditOptions
    level: int
    view: GroundView
    view_offset_m: Array
    shape: tuple[int, int]
    audited: Mask

    def __len__(self) -> int:
        return int(np.count_nonzero(self.audited))

    @property
    def area_px(self) -> float:
        """Audited area in pixels of the map."""
        return len(self) * float(self.spacing_px.prod())

    def corner_px(self, center_px: Array) -> tuple[int, int]:
        """The top-left pixel of a template.

        Args:
            center_px: (2,) its middle, in pixels of the map.

        Returns:
            (x, y) in pixels of the level.
        """
        x, y = self.site.level_from_full(center_px, self.level)
        return round(float(x) - (self.shape[1] - 1) / 2.0), round(float(y) - (self.shape[0] - 1) / 2.0)

    def contains(self, center_px: Array) -> bool:
        """Whether a template is inside the map.

        Args:
            center_px: (2,) its middle, in pixels of the map.

        Returns:
            bool: True if all of it is.
        """
        (rows, columns), (x, y) = self.site.level_shape(self.level), self.corner_px(center_px)
        return 0 <= x <= columns - self.shape[1] and 0 <= y <= rows - self.shape[0]


def plan_audit(
    site: OrthoMap,
    camera: Camera,
    height_agl_m: float,
    options: AuditOptions | None = None,
    part: MapPart | None = None,
) -> AuditPlan:
    """Plan the audit of a map, or of a part of it.

    Args:
        site: the map.
        camera: of the flights.
        height_agl_m: of the flights, above 0.
        options: settings.
        part: of the map; None is all of it.

    Raises:
        OptionError: the height is not above 0, the camera looks at the horizon, a frame covers more than the map
            or fewer than 8 x 8 of its pixels, or the part is not on the map.
    """
    options = options or AuditOptions()
    if not (math.isfinite(height_agl_m) and height_agl_m > 0):
        raise OptionError(f"height_agl_m: expected metres above 0, got {height_agl_m:g}")
    whole = Window(0, 0, site.width_px, site.height_px)
    middle = np.array([site.width_px - 1, site.height_px - 1]) / 2.0 if part is None else _middle_of(part, site)
    level, view, shape = _seen_at(site, camera, height_agl_m, options, middle)
    view_offset_m = np.asarray((site.enu_jacobian(middle) * 2.0**level) @ view.center_px)
    step_px = options.spacing * math.sqrt(view.area_px) * 2.0**level
    if part is not None:
        reach_m = part.corridor_m or max(view.footprint_px) * 2.0**level * site.gsd_m_per_px
        grid, audited = _near(part, site, reach_m, view_offset_m, step_px, options.max_cells)
    else:
        grid = CellGrid.over(whole, max(step_px, math.sqrt(whole.area_px / options.max_cells)))
        audited = np.ones(grid.cells, np.bool_)
    return AuditPlan(
        grid.window, grid.cells, site, height_agl_m, options, level, view, view_offset_m, shape, audited
    )


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
        patch = rectify(blank, view)
        if patch is None:
            raise OptionError(
                f"height_agl_m: expected a frame of 8 x 8 map pixels or more, got less from {height_agl_m:g} m"
            )
        if max(patch.gray.shape) <= _MAX_TEMPLATE_PX or level == site.levels - 1:
            return level, view, (patch.gray.shape[0], patch.gray.shape[1])
        level += 1


# -------------------------------------------------------------------------------------------------------- parts


def _middle_of(part: MapPart, site: OrthoMap) -> Array:
    """The pixel (2,) in the middle of a part, clipped to the map."""
    lat_lon_deg = [] if part.around is None else [np.array([part.around[:2]])]
    lat_lon_deg += [] if part.route is None else [part.route]
    xy = site.pixel_from_geodetic(*np.concatenate(lat_lon_deg).T)
    middle = (xy.min(axis=0) + xy.max(axis=0)) / 2.0
    return np.asarray(np.clip(np.nan_to_num(middle), 0, [site.width_px - 1, site.height_px - 1]))


def _near(
    part: MapPart, site: OrthoMap, reach_m: float, view_offset_m: Array, step_px: float, max_cells: int
) -> tuple[CellGrid, Mask]:
    """A grid over the part, and which of its cells (rows, columns) belong to it.

    The cells are ``step_px`` wide, or wider if there would be more than ``max_cells``. They reach
    ``reach_m`` beside what the camera sees along a route.
    """
    gsd_m = site.gsd_m_per_px
    while True:
        discs = []  # (N, 3) each: pixels x and y, and a radius
        if part.around is not None:
            discs.append(np.array([[*site.pixel_from_geodetic(*part.around[:2]), part.around[2] / gsd_m]]))
        if part.route is not None:
            seen = site.pixel_from_enu(sample_route(site, part.route, 0.5 * step_px * gsd_m, view_offset_m).view_m)
            reach_px = max(reach_m / gsd_m, _MARGIN_STEPS * step_px)
            discs.append(np.column_stack([seen, np.full(len(seen), reach_px)]))
        window = _window_of(np.concatenate(discs), site)
        min_step_px = math.sqrt(window.area_px / (_CELLS_PER_AUDITED * max_cells))
        if step_px < min_step_px:
            step_px = min_step_px
            continue
        grid = CellGrid.over(window, step_px)
        audited = np.any([_within(some, grid) for some in discs], axis=0)
        count = np.count_nonzero(audited)
        if count == 0:
            raise OptionError(f"part: expected one on the map {site.name}, got one off it")
        if count <= max_cells or step_px >= max(window.width_px, window.height_px):
            return grid, audited
        step_px *= max(1.02, math.sqrt(count / max_cells))


def _window_of(discs: Array, site: OrthoMap) -> Window:
    """The part of the map that discs (N, 3) cover."""
    size = np.array([site.width_px, site.height_px])
    xy, reach = discs[:, :2], discs[:, 2:]
    low = np.clip(np.floor((xy - reach).min(axis=0)), 0, size)
    high = np.clip(np.ceil((xy + reach).max(axis=0)) + 1, 0, size)
    if not (high > low).all():  # NaN fails too
        raise OptionError(f"part: expected one on the map {site.name}, got one off it")
    (x0, y0), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
    return Window(x0, y0, width, height)


def _within(discs: Array, grid: CellGrid) -> Mask:
    """Which cells (rows, columns) are within the radius, the same for all, of any of the discs (N, 3)."""
    spacing, reach_px = grid.spacing_px, float(discs[0, 2])
    if len(discs) == 1:
        off = grid.centers_px - discs[0, :2]
        return np.asarray(np.hypot(off[..., 0], off[..., 1]) <= max(reach_px, 0.51 * float(np.hypot(*spacing))))
    x, y = np.floor(grid.cell_from_pixel(discs[:, :2]) + 0.5).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < grid.cells[1]) & (y < grid.cells[0])
    far = np.ones(grid.cells, np.uint8)
    far[y[inside], x[inside]] = 0
    if not inside.any():
        return np.zeros(grid.cells, np.bool_)
    return np.asarray(cv2.distanceTransform(far, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * spacing.min() <= reach_px)


# ------------------------------------------------------------------------------------------------------- routes


@dataclass(frozen=True, eq=False)
class RouteSamples:
    """A route in small steps.

    Attributes:
        along_m: (N,) distance along it.
        en_m: (N, 2) east and north of the vehicle.
        view_m: (N, 2) east and north of the ground in the middle of its frame.
    """

    along_m: Array
    en_m: Array
    view_m: Array


def sample_route(site: OrthoMap, route: ArrayLike, step_m: float, view_offset_m: Array) -> RouteSamples:
    """Sample straight legs between waypoints.

    Args:
        site: the map.
        route: (N, 2) latitude and longitude in degrees.
        step_m: largest step, above 0.
        view_offset_m: (2,) see :attr:`AuditPlan.view_offset_m`.

    Returns:
        RouteSamples: in equal steps, both ends included.

    Raises:
        OptionError: fewer than two waypoints, or all of them equal.
    """
    corners = np.atleast_2d(site.frame.enu_from_geodetic(*np.asarray(route, np.float64).T))
    legs = np.hypot(*np.diff(corners, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    if along[-1] <= 0.0:
        raise OptionError(f"route: expected two or more waypoints that differ, got {len(corners)} of length 0")
    at = np.linspace(0.0, along[-1], max(math.ceil(along[-1] / step_m) + 1, 2))
    en = np.stack([np.interp(at, along, corners[:, axis]) for axis in (0, 1)], axis=1)
    leg = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(legs) - 1)
    leg = np.where(legs[leg] > 0.0, leg, np.argmax(legs > 0.0))
    east, north = np.diff(corners, axis=0)[leg].T / legs[leg]
    right, ahead = view_offset_m
    view = np.stack([north * right + east * ahead, north * ahead - east * right], axis=1)
    return RouteSamples(at, en, en + view)
