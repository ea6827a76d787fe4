"""Self-match: what the map itself says of places on it, by correlating it with its own changed patches.

At places all over the map the patch that the camera would see is cut out, changed by noise, other ground and small
errors of the telemetry, and correlated with the window that a prior allows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from engine.align import View, enhance, rectify, view_of
from engine.camera import Camera
from engine.errors import OptionError
from engine.integrity import score_sigma
from engine.methods.laid import NccOptions
from engine.methods.query import level_for
from engine.ncc_fft import surface
from engine.orthomap import OrthoMap
from engine.peaks import fit_summit
from engine.prepared import PreparedMap
from engine.types import Attitude, Window, check_positive
from engine.window import place_window, window_size_px

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Pictures = NDArray[np.float32]

# The change that a patch goes through, the same at every place.
_DRAWS = 2
_TURN_DEG, _GROWTH, _SHIFT_PX = 1.0, 1.01, 0.4  # what telemetry and level leave over
_NOISE_SD = 3.0  # grey levels, of the sensor
_CHANGE, _CHANGE_PX = 1.0, 2.0  # other ground: deviations of the enhanced picture, and its size
_SHAKE_PX, _SHAKE_BLUR_PX = 2.0, 1.0  # how far the edges move, and a blur: a change that only fine texture minds
# Larger templates cost time and change the answer little: the audit then takes a coarser level.
_MAX_TEMPLATE_PX = 320
_SLACK_SIGMAS = 3.0  # as Query.window
_NEAR_PX = 3  # the changed patch is at its place if it is within so many pixels


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


@dataclass(frozen=True, slots=True)
class Evidence:
    """What is measured at places (...,); NaN where the map has no data for it.

    Attributes:
        texture: deviation of the grey levels from their neighbourhood's mean.
        rival: highest NCC of the unchanged patch elsewhere in its window.
        stability: NCC of the patch with itself, blurred, turned and grown a little.
        sharpness: curvature of the unchanged peak along its flattest direction, per square pixel.
        score: NCC of the changed patch at its own place, in sigmas.
        lead: how far that is above its best rival, in sigmas.
        other_score: the same of a patch of another date's map, unchanged; NaN without one.
        other_lead: the same.
    """

    texture: Array
    rival: Array
    stability: Array
    sharpness: Array
    score: Array
    lead: Array
    other_score: Array
    other_lead: Array


@dataclass(frozen=True)
class Plan:
    """Where an audit looks, and at what.

    Attributes:
        site: the map.
        camera: what the map will be seen by.
        height_agl_m: from where.
        options: settings.
        level: of the map's pyramid.
        view: of a level camera that looks north, in pixels of the level.
        shape: (h, w) of a template.
        cells: (rows, columns) of places.
        other: the same ground at another date, or None.
    """

    site: OrthoMap
    camera: Camera
    height_agl_m: float
    options: AuditOptions
    level: int
    view: View
    shape: tuple[int, int]
    cells: tuple[int, int]
    other: OrthoMap | None = None

    def __len__(self) -> int:
        return self.cells[0] * self.cells[1]

    @cached_property
    def spacing_px(self) -> Array:
        """(2,) between places along x and y, in pixels of the map."""
        return np.array([self.site.width_px / self.cells[1], self.site.height_px / self.cells[0]])

    @property
    def exclusion_px(self) -> float:
        """Rivals nearer than this are the peak itself, in pixels of the level."""
        return self.options.ncc.rule.exclusion_m / (self.site.gsd_m_per_px * 2.0**self.level)

    @cached_property
    def places_px(self) -> Array:
        """(rows, columns, 2) where the middle of the frame looks, in pixels of the map."""
        j, i = np.mgrid[: self.cells[0], : self.cells[1]]
        return np.stack([i + 0.5, j + 0.5], axis=-1) * self.spacing_px - 0.5

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
) -> Plan:
    """Lay places over a map.

    Args:
        site: the map.
        camera: what it will be seen by.
        height_agl_m: from where, above 0.
        options: settings; the defaults serve.
        other: the same ground at another date, by which stale places are found.

    Raises:
        OptionError: the height is no height, the camera looks at the horizon, or a frame covers more than the
            map or next to nothing of it.
    """
    options = options or AuditOptions()
    if not (math.isfinite(height_agl_m) and height_agl_m > 0):
        raise OptionError(f"height_agl_m: expected metres above 0, got {height_agl_m:g}")
    middle = np.array([site.width_px - 1, site.height_px - 1]) / 2.0
    level = level_for(site.gsd_m_per_px, height_agl_m / camera.focal_px, site.levels)
    blank = np.zeros((camera.height_px, camera.width_px), np.uint8)
    while True:
        jacobian = site.enu_jacobian(middle) * 2.0**level
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
            break
        level += 1
    shape = (patch.gray.shape[0], patch.gray.shape[1])
    step = options.spacing * math.sqrt(view.area_px) * 2.0**level
    step = max(step, math.sqrt(site.width_px * site.height_px / options.max_cells))
    cells = (math.ceil(site.height_px / step), math.ceil(site.width_px / step))
    return Plan(site, camera, height_agl_m, options, level, view, shape, cells, other)


# ------------------------------------------------------------------------------------------------- measuring


def measure(plan: Plan) -> Iterator[Evidence]:
    """The evidence at each place, row by row; the map is read as the places need it."""
    options = plan.options.ncc
    prepared = PreparedMap(plan.site, torch.device("cpu"), options.enhance_radius_px, options.score)
    noise = _noise(plan.shape)
    with torch.inference_mode():
        for place in plan.places_px.reshape(-1, 2):
            yield _measure(plan, prepared, noise, place)


def _noise(shape: tuple[int, int]) -> Pictures:
    """(draws, 2, h, w): the sensor's noise in grey levels, and other ground of unit deviation."""
    noise = np.random.default_rng(0).normal(size=(_DRAWS, 2, *shape)).astype(np.float32)
    noise[:, 0] *= _NOISE_SD
    for draw in noise[:, 1]:
        draw[:] = cv2.GaussianBlur(draw, (0, 0), _CHANGE_PX)
        draw /= draw.std()
    return noise


def _measure(plan: Plan, prepared: PreparedMap, noise: Pictures, place_px: Array) -> Evidence:
    site, level, (height, width) = plan.site, plan.level, plan.shape
    middle = site.level_from_full(place_px, level)
    x0, y0 = plan.corner_px(place_px)
    nothing = Evidence(*[np.array(np.nan)] * len(fields(Evidence)))
    if not plan.holds(place_px):
        return nothing
    lies = Window(x0, y0, width, height)
    if not site.fully_valid and site.valid(lies, level).mean() < plan.options.ncc.min_valid_share:
        return nothing
    gray = site.gray(lies, level)
    other = None if plan.other is None else _seen_on(plan.other, plan, lies)
    # Nodata is 0 once enhanced: rivals there are weak, as they are to the masked NCC that a flight uses.
    region = prepared.cut(_window(plan, middle), level)
    templates = torch.from_numpy(_templates(gray, noise, plan.options.ncc, other))
    scores = surface(region.search, templates).numpy()
    x, y = x0 - region.window.x0, y0 - region.window.y0
    own, rivals = _own_and_rivals(scores, x, y, plan.exclusion_px)
    leads = own - rivals
    sigma = score_sigma(height * width)
    changed = slice(2, 2 + _DRAWS)
    values = [
        _texture(gray),
        rivals[0],
        own[1],
        _sharpness(scores[0], x, y),
        own[changed].mean() / sigma,
        leads[changed].mean() / sigma,
        *([np.nan] * 2 if other is None else [own[-1] / sigma, leads[-1] / sigma]),
    ]
    return Evidence(*[np.array(value, np.float64) for value in values])


def _window(plan: Plan, middle_px: Array) -> Window:
    """The adaptive window about a place (eq. 4, 5) with the slack that the prior asks for; pixels of the level."""
    site, level, (height, width) = plan.site, plan.level, plan.shape
    rows, columns = site.level_shape(level)
    slack = 2.0 * _SLACK_SIGMAS * plan.options.prior_sigma_m / (site.gsd_m_per_px * 2.0**level)
    size = window_size_px(plan.view.footprint_px, (0.0, 0.0), margin=plan.options.ncc.margin)
    size = (max(size[0], width + 4 + slack), max(size[1], height + 4 + slack))
    window = place_window((float(middle_px[0]), float(middle_px[1])), size, (columns, rows))
    assert window is not None  # the place is on the map
    return window


def _templates(gray: Gray, noise: Pictures, options: NccOptions, other: Gray | None) -> Pictures:
    """(T, h, w) enhanced: the patch unchanged, shaken, changed (draws), and that of another date."""

    def enhanced(picture: Gray) -> Pictures:
        return enhance(picture, radius_px=options.enhance_radius_px, score=options.score)

    part = _SHAKE_PX / (max(gray.shape) / 2.0)
    shaken = cv2.GaussianBlur(_turned(gray, math.degrees(part), 1.0 + part, 0.0), (0, 0), _SHAKE_BLUR_PX)
    templates = [enhanced(gray), enhanced(np.asarray(shaken, np.uint8))]
    for sign, (sensor, ground) in zip((1.0, -1.0), noise, strict=True):
        turned = _turned(gray, sign * _TURN_DEG, _GROWTH**sign, sign * _SHIFT_PX)
        seen = np.clip(turned + sensor, 0.0, 255.0).astype(np.uint8)
        templates.append(enhanced(seen) + _CHANGE * ground)
    if other is not None:
        templates.append(enhanced(other))
    return np.stack(templates)


def _turned(gray: Gray, angle_deg: float, growth: float, shift_px: float) -> Gray:
    """The picture turned and grown about its middle, and moved along its diagonal."""
    height, width = gray.shape
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2.0, (height - 1) / 2.0), angle_deg, growth)
    matrix[:, 2] += shift_px
    return np.asarray(cv2.warpAffine(gray, matrix, (width, height), borderMode=cv2.BORDER_REFLECT_101), np.uint8)


def _texture(gray: Gray) -> float:
    smooth = cv2.GaussianBlur(gray, (3, 3), 0).astype(np.float32)
    return float((smooth - cv2.blur(smooth, (17, 17))).std())


def _own_and_rivals(scores: Pictures, x: int, y: int, exclusion_px: float) -> tuple[Array, Array]:
    """The highest score (T,) at a place, and outside its exclusion zone (-1 where nothing lies outside)."""
    near = scores[:, max(0, y - _NEAR_PX) : y + _NEAR_PX + 1, max(0, x - _NEAR_PX) : x + _NEAR_PX + 1]
    down, across = np.ogrid[-y : scores.shape[1] - y, -x : scores.shape[2] - x]
    outside = down * down + across * across > max(exclusion_px, _NEAR_PX) ** 2
    rivals = np.where(outside, scores, -1.0).max(axis=(1, 2))
    return near.max(axis=(1, 2)).astype(np.float64), rivals.astype(np.float64)


def _sharpness(scores: Pictures, x: int, y: int) -> float:
    """How fast the score falls along the flattest direction; 0 at the edge of the surface."""
    r = min(2, x, y, scores.shape[1] - 1 - x, scores.shape[0] - 1 - y)
    if r <= 0:
        return 0.0
    curvature = fit_summit(scores[y - r : y + r + 1, x - r : x + r + 1].astype(np.float64))[2]
    return max(0.0, float(-np.linalg.eigvalsh(curvature)[-1]))


def _seen_on(other: OrthoMap, plan: Plan, lies: Window) -> Gray | None:
    """The same ground (h, w) on another map, or None where that has none of it."""
    (height, width), scale = plan.shape, 2.0**plan.level
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float64)
    full = plan.site.full_from_level(corners + np.array([lies.x0, lies.y0]), plan.level)
    there = other.pixel_from_geodetic(*plan.site.geodetic_from_pixel(full))
    level = level_for(other.gsd_m_per_px, plan.site.gsd_m_per_px * scale, other.levels)
    there = other.level_from_full(there, level)
    low, high = np.floor(there.min(axis=0)).astype(int) - 1, np.ceil(there.max(axis=0)).astype(int) + 2
    rows, columns = other.level_shape(level)
    if low.min() < 0 or high[0] > columns or high[1] > rows:
        return None
    window = Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
    if not other.fully_valid and other.valid(window, level).mean() < plan.options.ncc.min_valid_share:
        return None
    matrix = cv2.getPerspectiveTransform(corners.astype(np.float32), (there - low).astype(np.float32))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpPerspective(other.gray(window, level), matrix, (width, height), flags=flags), np.uint8
    )
