"""The NCC method (Fig. 5): grey, rectify by height and attitude, enhance, correlate in the window, peak."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from engine.align import Patch, View, enhance, rectify, view_of
from engine.errors import OptionError
from engine.integrity import (
    AssumedErrors,
    PeakRule,
    judge_peak,
    ncc_covariance_m2,
    peak_covariance_px,
)
from engine.methods.query import Query, level_crop, level_for
from engine.ncc_fft import find_peak, ncc
from engine.types import Fix, NoFix, Peak, Reason, Window

Array = NDArray[np.float64]

# With no prior the whole map is searched on a level of about this many pixels, and the best places are refined.
_COARSE_PIXELS = 1_000_000
_COARSE_TEMPLATE_PX = 40
_CANDIDATES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class NccOptions:
    """Settings of the NCC method.

    Attributes:
        margin: the 1.3 of equations 4 and 5.
        fraction: the rectified patch's size against the frame's.
        enhance_radius_px: neighbourhood of the local normalisation; 0 leaves it out.
        min_valid_share: a place counts only where this share of the patch lies on map that is not nodata.
        rule: when a peak is believed.
        errors: what is assumed of the telemetry and the map.
    """

    margin: float = 1.3
    fraction: float = 0.7
    enhance_radius_px: int = 12
    min_valid_share: float = 0.9
    rule: PeakRule = field(default_factory=PeakRule)
    errors: AssumedErrors = field(default_factory=AssumedErrors)

    def __post_init__(self) -> None:
        if not self.margin >= 1.0:
            raise OptionError(f"margin: expected 1 or more, got {self.margin}")
        for name in ("fraction", "min_valid_share"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise OptionError(f"{name}: expected above 0 and at most 1, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True)
class _Aligned:
    """The frame laid on one level of the map's pyramid."""

    level: int
    jacobian: Array
    view: View
    patch: Patch
    enhanced: torch.Tensor


def locate(query: Query, options: NccOptions) -> Fix | NoFix:
    """One frame to a fix by correlation; needs its height and heading."""
    frame, watch = query.frame, query.watch
    if frame.height_agl_m is None:
        return query.refuse(Reason.NO_HEIGHT, "NCC needs the height above ground", "ncc")
    if frame.heading_deg is None:
        return query.refuse(Reason.NO_HEADING, "NCC needs the heading", "ncc")
    flat = query.refuse_flat("ncc", options.rule.min_deviation)
    if flat is not None:
        return flat
    frame_gsd = frame.height_agl_m / query.camera.focal_px
    level = level_for(query.site.gsd_m_per_px, frame_gsd, query.site.levels)
    with watch.stage("align"):
        aligned = _align(query, level, options)
    if isinstance(aligned, NoFix):
        return aligned
    center = query.prior_px()
    window: Window | None = None
    if center is not None:
        with watch.stage("window"):
            window = _window_about(query, aligned, center, options)
        if window is None:
            return query.refuse(Reason.OUTSIDE_MAP, "the window lies outside the map", "ncc")
        peak = _search(query, aligned, window, options)
    else:
        peak, window = _search_whole_map(query, aligned, options)
    if peak is None or window is None:
        detail = "the map does not cover the frame anywhere in the window"
        return query.refuse(Reason.OUTSIDE_MAP, detail, "ncc", window=window)
    if watch.deadline.remaining_ms < 0:
        return query.refuse(Reason.LATE, "the budget was spent before the peak was known", "ncc", window=window)
    refusal = judge_peak(peak, options.rule, whole_map=center is None)
    if refusal is not None:
        return query.refuse(*refusal, "ncc", score=peak.score, window=window)
    return _fix(query, aligned, peak, window, options)


def _align(query: Query, level: int, options: NccOptions) -> _Aligned | NoFix:
    """Equations 2 and 3: the frame in the pixels of one map level."""
    frame = query.frame
    attitude, height = frame.attitude, frame.height_agl_m
    assert attitude is not None  # locate() refused the frame otherwise
    assert height is not None
    jacobian = query.jacobian() * 2.0**level
    view = view_of(query.camera, attitude, height, jacobian)
    if view is None:
        tilt = f"roll {attitude.roll_deg:.1f}, pitch {attitude.pitch_deg:.1f} degrees"
        return query.refuse(Reason.TILTED, f"a corner of the frame looks at the horizon ({tilt})", "ncc")
    patch = rectify(query.gray, query.camera, view, fraction=options.fraction)
    if patch is None:
        detail = "the frame covers fewer than 8 x 8 pixels of the map"
        return query.refuse(Reason.NO_TEXTURE, detail, "ncc")
    enhanced = torch.from_numpy(enhance(patch.gray, radius_px=options.enhance_radius_px)).to(query.device)
    return _Aligned(level, jacobian, view, patch, enhanced)


def _window_about(query: Query, aligned: _Aligned, nadir_px: Array, options: NccOptions) -> Window | None:
    """The adaptive window about the place where the patch should lie, in full-resolution map pixels."""
    scale = 2.0**aligned.level
    height, width = aligned.enhanced.shape
    footprint = (aligned.view.footprint_px[0] * scale, aligned.view.footprint_px[1] * scale)
    center = nadir_px + aligned.view.center_px * scale
    least = ((width + 2) * scale, (height + 2) * scale)
    return query.window(center, footprint, least, margin=options.margin)


def _surface(query: Query, aligned: _Aligned, window: Window, options: NccOptions) -> torch.Tensor | None:
    """NCC over the window (H', W'); places on nodata score -1. None where the patch does not fit."""
    height, width = aligned.enhanced.shape
    if window.width_px < width or window.height_px < height:
        return None
    with query.watch.stage("map"):
        gray = query.site.gray(window, aligned.level)
        valid = None if query.site.fully_valid else query.site.valid(window, aligned.level)
        if valid is not None and not valid.any():
            return None
        search = torch.from_numpy(enhance(gray, radius_px=options.enhance_radius_px, valid=valid))
    with query.watch.stage("match"):
        surface = ncc(search.to(query.device)[None], aligned.enhanced[None, None])[0, 0]
        if valid is not None and not valid.all():
            share = _share_of_valid(valid, height, width)
            if not (share >= options.min_valid_share).any():
                return None
            surface[torch.from_numpy(share < options.min_valid_share).to(query.device)] = -1.0
    return surface


def _share_of_valid(valid: NDArray[np.bool_], height: int, width: int) -> NDArray[np.float64]:
    """The share of map that is not nodata under a patch at every place."""
    total = np.pad(valid.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    count = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    return np.asarray(count / (height * width), dtype=np.float64)


def _search(query: Query, aligned: _Aligned, window: Window, options: NccOptions) -> Peak | None:
    """The peak in the window, in pixels of the aligned level (not of the crop)."""
    crop = level_crop(query.site, window, aligned.level)
    surface = _surface(query, aligned, crop, options)
    if surface is None:
        return None
    exclusion_px = options.rule.exclusion_m / (query.site.gsd_m_per_px * 2.0**aligned.level)
    with query.watch.stage("peak"):
        peak = find_peak(surface[None], exclusion_px=exclusion_px)
    return Peak(peak.x + crop.x0, peak.y + crop.y0, peak.score, peak.second_score, peak.curvature)


def _search_whole_map(query: Query, aligned: _Aligned, options: NccOptions) -> tuple[Peak | None, Window | None]:
    """Coarse over the whole map, fine about its best places; the rival is the best of the other places."""
    site = query.site
    level = aligned.level
    while (
        level + 1 < site.levels
        and np.prod(site.level_shape(level)) > _COARSE_PIXELS
        and min(aligned.enhanced.shape) >> (level + 1 - aligned.level) >= _COARSE_TEMPLATE_PX
    ):
        level += 1
    everything = Window(0, 0, site.width_px, site.height_px)
    if level == aligned.level:
        return _search(query, aligned, everything, options), everything
    coarse = _align(query, level, options)
    if isinstance(coarse, NoFix):
        return None, everything
    rows, columns = site.level_shape(level)
    surface = _surface(query, coarse, Window(0, 0, columns, rows), options)
    if surface is None:
        return None, everything
    radius_px = options.rule.exclusion_m / (site.gsd_m_per_px * 2.0**level)
    with query.watch.stage("peak"):
        places = _best_places(surface, max(2.0, radius_px), _CANDIDATES)
    found: list[tuple[Peak, Window]] = []
    for x, y in places:
        nadir = site.full_from_level(np.array([x, y]) - coarse.patch.offset_px, level)
        window = _refinement_window(query, aligned, nadir, level)
        peak = _search(query, aligned, window, options)
        if peak is not None:
            found.append((peak, window))
    if not found:
        return None, everything
    found.sort(key=lambda pair: -pair[0].score)
    best, window = found[0]
    rival = found[1][0].score if len(found) > 1 else -1.0
    return Peak(best.x, best.y, best.score, max(rival, best.second_score), best.curvature), window


def _best_places(surface: torch.Tensor, radius_px: float, count: int) -> list[tuple[int, int]]:
    """The ``count`` highest places (x, y) that are at least a radius apart."""
    left = surface.clone()
    places = []
    r = int(np.ceil(radius_px))
    for _ in range(count):
        index = int(left.argmax())
        y, x = divmod(index, left.shape[1])
        if float(left[y, x]) <= -1.0:
            break
        places.append((x, y))
        left[max(0, y - r) : y + r + 1, max(0, x - r) : x + r + 1] = -1.0
    return places


def _refinement_window(query: Query, aligned: _Aligned, nadir_px: Array, level: int) -> Window:
    """A window that forgives three pixels of the coarse level."""
    scale = 2**aligned.level
    height, width = aligned.enhanced.shape
    slack = 3 * 2**level
    x0, y0 = (int(v) - slack for v in np.round(nadir_px + aligned.patch.offset_px * scale))
    x1 = min(query.site.width_px, x0 + width * scale + 2 * slack)
    y1 = min(query.site.height_px, y0 + height * scale + 2 * slack)
    x0, y0 = max(0, x0), max(0, y0)
    return Window(x0, y0, max(0, x1 - x0), max(0, y1 - y0))


def _fix(query: Query, aligned: _Aligned, peak: Peak, window: Window, options: NccOptions) -> Fix:
    """The camera's nadir and its covariance."""
    site, frame = query.site, query.frame
    nadir = site.full_from_level(np.array([peak.x, peak.y]) - aligned.patch.offset_px, aligned.level)
    east, north = site.enu_from_pixel(nadir)
    lat, lon = site.geodetic_from_pixel(nadir)
    peak_px2 = peak_covariance_px(peak, aligned.enhanced.numel())
    covariance = ncc_covariance_m2(peak_px2, frame, query.camera, aligned.jacobian, options.errors)
    return Fix(
        timestamp_ns=frame.timestamp_ns,
        lat_deg=float(lat),
        lon_deg=float(lon),
        east_m=float(east),
        north_m=float(north),
        up_m=None,
        covariance_m2=covariance,
        attitude=None,
        score=peak.score,
        method="ncc",
        window=window,
        timings=query.watch.timings,
        map_xy_px=(float(nadir[0]), float(nadir[1])),
    )
